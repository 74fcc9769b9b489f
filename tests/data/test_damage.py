"""Damaged files of every format: one line or the very same data, never a traceback, never other numbers unnoticed."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

import envs
from qdos_brax.config import load_config
from qdos_brax.data import checks, formats
from qdos_brax.data.readers.rows import Rows
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick

FILES = Path(__file__).parent / "files"
FORMATS = ("npz", "npz-plain", "ours", "d4rl", "minari-flat", "minari-dict")
GUARDED = ("npz", "npz-plain", "ours")  # by checksums over everything that is read; D4RL's and Minari's are not
TASK = "antmaze-medium-task1"
CONFIG = load_config(TASK, "smoke", {"skills.horizon": 5, "skills.mi_rollout": "logged"})


@pytest.fixture(scope="module")
def env() -> envs.Task:
    return envs.make(TASK, physics="mujoco")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """A sound file of every format, all with the same 22 steps."""
    folder = tmp_path_factory.mktemp("whole")
    rows = formats.load(FILES / "ogbench-antmaze-medium.npz")
    assert rows.qpos is not None and rows.qvel is not None
    with np.load(FILES / "ogbench-antmaze-medium.npz") as file:
        np.savez(folder / "plain.npz", **file)
    columns = {
        "observations": rows.observations,
        "actions": rows.actions,
        "next_observations": rows.next_observations,
        "rewards": -np.ones(22, np.float32),
        "terminals": np.zeros(22, bool),
        "timeouts": rows.ends,
        "infos/qpos": rows.qpos,
        "infos/qvel": rows.qvel,
        "infos/quality": np.arange(22, dtype=np.int8) % 4,
    }
    formats.write_hdf5(folder / "ours.hdf5", columns, {"env": TASK, "seed": 0})
    with h5py.File(folder / "d4rl.hdf5", "w") as file:
        for key, value in columns.items():
            if key not in ("next_observations", "infos/quality"):
                file.create_dataset(key, data=value, compression="gzip")
    return {
        "npz": FILES / "ogbench-antmaze-medium.npz",
        "npz-plain": folder / "plain.npz",
        "ours": folder / "ours.hdf5",
        "d4rl": folder / "d4rl.hdf5",
        "minari-flat": FILES / "minari-flat" / "data" / "main_data.hdf5",
        "minari-dict": FILES / "minari-dict" / "data" / "main_data.hdf5",
    }


def outcome(path: Path, env: envs.Task) -> Rows | None:
    """What comes of a file on the way to training and through ``data check``; None where it is refused."""
    try:
        rows = formats.load(path)
        found = checks.inspect(rows, env, CONFIG, formats.read_attrs(path), str(path))
        return None if found.errors else rows
    except UserError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return None


def same(rows: Rows, other: Rows) -> bool:
    ours, theirs = rows.arrays(), other.arrays()
    return ours.keys() == theirs.keys() and all(np.array_equal(ours[key], theirs[key]) for key in ours)


def flip(content: bytes, rng: np.random.Generator) -> bytes:
    """One to eight bytes changed."""
    array = np.frombuffer(content, np.uint8).copy()
    where = rng.integers(0, len(array), rng.integers(1, 9))
    array[where] ^= rng.integers(1, 256, len(where)).astype(np.uint8)
    return array.tobytes()


def truncate(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(0, len(content))]


@pytest.mark.parametrize(("damage", "cases"), [(flip, 24), (truncate, 6)])
@pytest.mark.parametrize("kind", FORMATS)
def test_flipped_and_missing_bytes(
    tmp_path: Path,
    env: envs.Task,
    whole: Mapping[str, Path],
    kind: str,
    damage: Callable[[bytes, np.random.Generator], bytes],
    cases: int,
) -> None:
    content, reference = whole[kind].read_bytes(), outcome(whole[kind], env)
    assert reference is not None and reference.size in (20, 22)
    refused = 0
    for seed in range(cases):
        path = tmp_path / f"{seed}{whole[kind].suffix}"
        path.write_bytes(damage(content, np.random.default_rng(seed)))
        rows = outcome(path, env)
        refused += rows is None
        if kind in GUARDED or damage is truncate:
            assert rows is None or same(rows, reference), f"{kind}, seed {seed}: other numbers, and nobody noticed"
    assert refused >= (cases if damage is truncate else 1)


@pytest.mark.parametrize("kind", FORMATS)
def test_missing_arrays(tmp_path: Path, env: envs.Task, whole: Mapping[str, Path], kind: str) -> None:
    """Only what may be missing in such a file may be missing."""
    may_go = {
        "npz": {"qvel"},
        "npz-plain": {"qvel"},
        "ours": set(),
        "d4rl": {"rewards", "timeouts", "infos/qpos", "infos/qvel"},
        "minari-dict": {"observations/desired_goal"},
    }.get(kind, set())
    keys = _keys(whole[kind])
    assert len(keys) >= 5
    for index, key in enumerate(keys):
        path = tmp_path / f"{index}{whole[kind].suffix}"
        _rewrite(whole[kind], path, key, None)
        short = key.removeprefix("episode_0/").removeprefix("episode_1/")
        if short not in may_go:
            assert outcome(path, env) is None, f"{kind} without {key}"
        else:
            outcome(path, env)


@pytest.mark.parametrize("kind", FORMATS)
def test_swapped_types(tmp_path: Path, env: envs.Task, whole: Mapping[str, Path], kind: str) -> None:
    """Text is refused; rounding to integers or to half precision too where a checksum or a comparison can tell."""
    reference = outcome(whole[kind], env)
    assert reference is not None
    swaps: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "text": lambda x: x.astype("S8"),
        "complex": lambda x: x.astype(np.complex64),
        "integers": lambda x: x.astype(np.int32),
        "bytes": lambda x: np.ascontiguousarray(x).view(np.uint8).reshape(len(x), -1),
    }
    for index, key in enumerate(("observations", "actions")):
        for name, swap in swaps.items():
            path = tmp_path / f"{index}-{name}{whole[kind].suffix}"
            for full in [k for k in _keys(whole[kind]) if k.split("/observation")[0].endswith(key) or k == key]:
                _rewrite(path if path.exists() else whole[kind], path, full, swap)
            rows = outcome(path, env)
            unseen = name == "integers" and key == "actions" and kind != "ours"  # a file may well hold such actions
            assert rows is None or unseen, f"{kind}: {key} as {name}"


def _keys(path: Path) -> list[str]:
    """All arrays of a file."""
    if path.suffix == ".npz":
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    keys: list[str] = []
    with h5py.File(path, "r") as file:
        file.visititems(lambda key, item: keys.append(key) if isinstance(item, h5py.Dataset) else None)
    return keys


def _rewrite(source: Path, path: Path, key: str, change: Callable[[np.ndarray], np.ndarray] | None) -> None:
    """Copies ``source`` to ``path`` with ``change`` made to one array, or without it."""
    if path.suffix == ".npz":
        with np.load(source) as file:
            arrays = dict(file)
        value = arrays.pop(key)
        np.savez(path, **arrays, **({} if change is None else {key: change(value)}))
        return
    if source != path:
        shutil.copyfile(source, path)
    with h5py.File(path, "r+") as file:
        value = file[key][()]
        del file[key]
        if change is not None:
            file[key] = change(value)
