"""Whatever is wrong with a data file: ``data check`` and training say the same, in one line, and nothing is changed."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main

TASK = "antmaze-medium-task1"
FILES = Path(__file__).parent / "files"

Columns = dict[str, Any]


def walk() -> Columns:
    """Three episodes of 40 steps along the free cells (1, 1), (1, 2) of the maze and back, without fault."""
    states = np.zeros((3, 41, 29), np.float32)
    states[..., 0] = 2.0 + 2.0 * np.sin(np.arange(41) / 8)
    states[..., 2], states[..., 3] = 0.5, 1.0
    before, after = states[:, :-1].reshape(120, 29), states[:, 1:].reshape(120, 29)
    return {
        "observations": before,
        "next_observations": after,
        "actions": np.random.default_rng(0).uniform(-1, 1, (120, 8)).astype(np.float32),
        "rewards": -np.ones(120, np.float32),
        "terminals": np.zeros(120, bool),
        "timeouts": np.arange(120) % 40 == 39,
        "infos/qpos": before[:, :15],
        "infos/qvel": before[:, 15:],
    }


def with_(columns: Columns, **changes: Any) -> Columns:
    """Other columns, ``qpos`` and ``qvel`` for those in ``infos``; None leaves one out."""
    named = {f"infos/{key}" if key in ("qpos", "qvel") else key: value for key, value in changes.items()}
    return {key: value for key, value in (columns | named).items() if value is not None}


def at(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def constant(c: Columns) -> Columns:
    still = np.repeat(c["observations"][:1], 120, axis=0)
    return with_(c, observations=still, next_observations=still, qpos=still[:, :15], qvel=still[:, 15:])


def elsewhere(c: Columns) -> Columns:
    """The same walk with the origin in the middle, as Minari's mazes have it."""
    moved = {key: at(c[key], (slice(None), 1), -7.0) for key in ("observations", "next_observations", "infos/qpos")}
    return c | moved


ended = np.ones(120, bool)
COLUMNS: dict[str, tuple[Callable[[Columns], Columns], str]] = {
    "no states": (lambda c: with_(c, qpos=None, qvel=None), "no qpos and qvel, the simulator states"),
    "no velocities": (lambda c: with_(c, qvel=None), "no qvel, the simulator states"),
    "neither states nor rewards": (lambda c: with_(c, qpos=None, qvel=None, rewards=None), "neither qpos nor rewards"),
    "constant observations": (constant, "observations are the same in every row"),
    "episodes shorter than a segment": (
        lambda c: with_(c, timeouts=np.arange(120) % 15 == 14),
        "no episode has 20 steps, the length of a segment (longest 15)",
    ),
    "one long row of one step episodes": (lambda c: with_(c, timeouts=ended), "(longest 1)"),
    "rounded next observations": (
        lambda c: with_(c, next_observations=c["next_observations"].astype(np.float16)),
        "next_observations do not match the next row's observations in 116 of 120 rows, by up to",
    ),
    "rows in no order": (
        lambda c: {key: value[np.random.default_rng(0).permutation(120)] for key, value in c.items()},
        "(longest 2); next_observations are not the next row's observations in 117 of 120 rows",
    ),
    "every row terminal, without a next one": (
        lambda c: with_(c, next_observations=None, terminals=ended, timeouts=None),
        "no transitions are left: no next_observations: of 120 terminal rows",
    ),
    "no rows": (lambda c: {key: value[:0] for key, value in c.items()}, "no transitions"),
    "one row without a next one": (
        lambda c: {key: value[:1] for key, value in with_(c, next_observations=None).items()},
        "no transitions; every episode needs at least two rows",
    ),
    "not a number": (lambda c: with_(c, rewards=at(c["rewards"], 5, np.nan)), "rewards has NaN or infinity in 1 row"),
    "infinite": (lambda c: with_(c, qvel=at(c["infos/qvel"], (7, 2), -np.inf)), "qvel has NaN or infinity in 1 row"),
    "beyond float32": (
        lambda c: with_(c, rewards=at(c["rewards"].astype(np.float64), 5, 1e300)),
        "rewards has NaN or infinity in 1 row (first 5)",
    ),
    "huge": (
        lambda c: with_(c, observations=at(c["observations"], (3, 20), -1e30)),
        "observations has numbers beyond 1e+18 in 1 row (first 3)",
    ),
    "actions of another scale": (lambda c: with_(c, actions=c["actions"] * 30), "the task takes [-1, 1]: scale them"),
    "actions of another task": (lambda c: with_(c, actions=c["actions"][:, :7]), "actions has 7 numbers per row"),
    "actions of one number": (lambda c: with_(c, actions=c["actions"][:, 0]), "actions has 1 numbers per row"),
    "pictures": (
        lambda c: with_(c, observations=np.zeros((120, 4, 4, 3), np.uint8), next_observations=None),
        "observations has 4x4x3 numbers per row",
    ),
    "positions of another body": (lambda c: with_(c, qpos=c["infos/qpos"][:, :14]), "qpos has 14 numbers per row"),
    "another origin": (elsewhere, "the body is inside the walls of antmaze-medium"),
    "columns by rows": (lambda c: with_(c, observations=c["observations"].T.copy()), "the file is damaged"),
    "a column that is too short": (lambda c: with_(c, rewards=c["rewards"][:-1]), "'rewards' has 119 rows"),
    "several rewards per row": (lambda c: with_(c, rewards=np.zeros((120, 3))), "'rewards' has 3 numbers per row"),
    "two flags per row": (lambda c: with_(c, terminals=np.zeros((120, 2))), "'terminals' has 2 numbers per row"),
    "text": (lambda c: with_(c, actions=np.full((120, 8), b"x")), "'actions' is not numeric"),
    "complex": (lambda c: with_(c, actions=c["actions"].astype(np.complex64)), "'actions' is not numeric"),
    "no actions": (lambda c: with_(c, actions=None), "has no 'actions'"),
    "no flags": (lambda c: with_(c, terminals=None, timeouts=None), "has no 'terminals'"),
}


def hdf5(path: Path, columns: Columns) -> Path:
    with h5py.File(path.with_suffix(".hdf5"), "w") as file:
        for key, value in columns.items():
            file[key] = value
    return path.with_suffix(".hdf5")


def npz(path: Path, **changes: Any) -> Path:
    with np.load(FILES / "ogbench-antmaze-medium.npz") as file:
        np.savez(path.with_suffix(".npz"), **dict(file) | changes)
    return path.with_suffix(".npz")


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def minari(path: Path) -> Path:
    return shutil.copytree(FILES / "minari-flat", path)


def minari_without_states(path: Path) -> Path:
    with h5py.File(minari(path) / "data" / "main_data.hdf5", "r+") as file:
        for group in file.values():
            del group["infos"]
    return path


FILE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "short OGBench": (npz, "no episode has 20 steps, the length of a segment (longest 11)"),
    "pickled OGBench": (lambda p: npz(p, actions=np.full((24, 8), None)), "'actions' is not numeric (object)"),
    "a number for a column": (lambda p: npz(p, actions=np.float32(3)), "'actions' has 0 rows"),
    "Minari of short episodes": (minari, "no episode has 20 steps, the length of a segment (longest 11)"),
    "Minari without states": (minari_without_states, "no episode has 20 steps"),
    "an empty folder": (lambda p: p.mkdir() or p, "has no data/main_data.hdf5"),
    "an empty file": (lambda p: written(p, b""), "cannot be read as .npz or .hdf5"),
    "compressed": (lambda p: written(p, gzip.compress(b"1")), "cannot be read as .npz or .hdf5"),
    "a table of text": (lambda p: written(p, b"x,y\n1,2\n"), "cannot be read as .npz or .hdf5"),
    "no HDF5 groups": (lambda p: hdf5(p, {}), "has no 'observations'"),
}


def refused(path: Path, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> None:
    """Whether ``data check`` and training refuse ``path`` in the same words."""
    before = {item: item.read_bytes() for item in tmp_path.rglob("*") if item.is_file()}
    more = ("--preset", "smoke", *more)
    assert main(["data", "check", str(path), "--env", TASK, *more]) == 2
    checked = capsys.readouterr()
    line = next(line for line in (checked.out + checked.err).splitlines() if line.startswith("error: "))
    line = line.removeprefix("error: ").removeprefix(f"{path}: ")
    assert says in line
    out = tmp_path / "run"
    flags = ["--env", TASK, "--dataset", str(path), "--out", str(out), *more]
    assert train_main(flags) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and error.startswith("error: ") and line in error, error
    assert not (out / "metrics.csv").exists()
    assert {item: item.read_bytes() for item in before} == before


@pytest.mark.parametrize("what", COLUMNS)
def test_bad_columns(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, says = COLUMNS[what]
    refused(hdf5(tmp_path / "data", change(walk())), says, tmp_path, capsys)


@pytest.mark.parametrize("what", FILE)
def test_bad_files(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, says = FILE[what]
    refused(make(tmp_path / "data"), says, tmp_path, capsys)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--set", "skills.horizon=41"], "no episode has 41 steps"),
        (["--method", "rlpd", "--set", "skills.horizon=2"], "skills.horizon must stay 1, not 2"),
        (["--set", "skills.horizon=0"], "skills.horizon"),
        (["--method", "nosuch"], "there is no method 'nosuch'"),
        (["--set", "skills.horizno=5"], "did you mean 'skills.horizon'"),
    ],
)
def test_settings_that_do_not_suit(
    more: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(hdf5(tmp_path / "data", walk()), says, tmp_path, capsys, *more)


@pytest.mark.parametrize(
    ("what", "more"),
    [
        ("no states", ["--set", "skills.mi_rollout=logged"]),
        ("no states", ["--method", "supe"]),
        ("no velocities", ["--set", "skills.mi_rollout=logged"]),
        ("constant observations", ["--set", "values.estimator=iql"]),
        ("episodes shorter than a segment", ["--horizon", "15"]),
        ("one long row of one step episodes", ["--method", "rlpd"]),
        ("rounded next observations", ["--method", "bc"]),
    ],
)
def test_the_setting_that_is_named_helps(
    what: str, more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = hdf5(tmp_path / "data", COLUMNS[what][0](walk()))
    assert main(["data", "check", str(path), "--env", TASK, *more]) == 0, capsys.readouterr().out


def test_the_walk_itself_is_without_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "check", str(hdf5(tmp_path / "data", walk())), "--env", TASK]) == 0
    assert "fits antmaze-medium-task1: 120 transitions, 3 episodes" in capsys.readouterr().out
