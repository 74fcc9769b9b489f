"""Readers: files of the real OGBench and the real Minari; D4RL's are in test_d4rl.py."""

import json
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from ogbench.relabel_utils import relabel_dataset
from ogbench.utils import load_dataset

import envs
from envs.mazes.families import MAZE_FAMILIES
from qdos_brax.data import formats
from qdos_brax.data.labelling import label
from qdos_brax.data.readers.rows import Rows
from qdos_brax.errors import UserError
from tests.data.d4rl_files import d4rl_antmaze, write_d4rl

pytestmark = pytest.mark.quick

FILES = Path(__file__).parent / "files"
OGBENCH = FILES / "ogbench-antmaze-medium.npz"  # two trajectories of twelve rows
SHARED = ("observations", "actions", "next_observations", "qpos", "qvel")


@pytest.fixture(scope="module")
def reference() -> dict[str, np.ndarray]:
    """OGBench's own reading of its file: the regular layout with states."""
    return load_dataset(str(OGBENCH), add_info=True)


def assert_same(rows: Rows, reference: Mapping[str, np.ndarray], keys: tuple[str, ...] = SHARED) -> None:
    for key in keys:
        array = getattr(rows, key)
        np.testing.assert_array_equal(array, reference[key], err_msg=key)
        assert array.dtype == np.float32 and array.flags.c_contiguous
    np.testing.assert_array_equal(rows.ends, reference["terminals"].astype(bool))


# --- OGBench ---


@pytest.mark.parametrize("layout", ["file", "regular", "compact"])
def test_every_layout_of_ogbench_is_the_same_data(
    tmp_path: Path, reference: dict[str, np.ndarray], layout: str
) -> None:
    path = OGBENCH
    if layout != "file":
        path = tmp_path / f"{layout}.npz"
        np.savez(path, **load_dataset(str(OGBENCH), compact_dataset=layout == "compact", add_info=True))
    rows = formats.load(path)
    assert_same(rows, reference)
    assert rows.size == 22 and rows.notes == []


@pytest.mark.parametrize("number", [np.nan, 0.5])
def test_a_discrete_state_is_whole_numbers(tmp_path: Path, number: float) -> None:
    """Rewards of scene and kitchen are counted from it."""
    with np.load(OGBENCH) as file:
        buttons = np.zeros((len(file["actions"]), 2))
        buttons[5, 1] = number
        np.savez(tmp_path / "set.npz", **file, button_states=buttons)
    with pytest.raises(UserError, match="'button_states' holds a number that is not whole, in row 5"):
        formats.load(tmp_path / "set.npz")
    columns = d4rl_antmaze() | {"infos/extra": np.full((24, 1), number)}
    with pytest.raises(UserError, match="'infos/extra' holds a number that is not whole, in row 0"):
        formats.load(write_d4rl(tmp_path / "a.hdf5", columns))


def test_valids_and_terminals_must_agree(tmp_path: Path) -> None:
    compact = load_dataset(str(OGBENCH), compact_dataset=True, add_info=True)
    compact["terminals"][4] = 1.0
    np.savez(tmp_path / "bad.npz", **compact)
    with pytest.raises(UserError, match="different trajectories"):
        formats.load(tmp_path / "bad.npz")


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_other_precisions_and_orders_become_float32_rows(tmp_path: Path, dtype: type) -> None:
    with np.load(OGBENCH) as file:
        stored = {key: np.asfortranarray(file[key].astype(dtype)) for key in file}
    np.savez(tmp_path / "set.npz", **stored)
    rows = formats.load(tmp_path / "set.npz")
    np.testing.assert_array_equal(rows.actions, np.delete(stored["actions"], [11, 23], axis=0).astype(np.float32))
    assert rows.actions.flags.c_contiguous


@pytest.mark.parametrize("name", [s.full_name for s in envs.list_tasks() if s.family in MAZE_FAMILIES])
def test_relabelling_equals_ogbench_for_every_maze(name: str) -> None:
    """Places on rings about the goal, inside and outside the tolerance, and at random."""
    env = envs.make(name, physics="mujoco")
    base, task = name.rsplit("-", 1)
    rng = np.random.default_rng(0)
    n = 64
    qpos = rng.uniform(-4, 40, (n, env.engine.nq)).astype(np.float32)
    radius, angle = np.linspace(0.1, 1.0, n // 2), rng.uniform(0, 6.28, n // 2)
    moved = env.body.places[-1]
    qpos[: n // 2, moved] = env.goal_xy[0] + radius * np.cos(angle)
    qpos[: n // 2, moved + 1] = env.goal_xy[1] + radius * np.sin(angle)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = gymnasium.make(f"{base}-singletask-{task}-v0")
    expected = {"qpos": qpos}
    relabel_dataset(f"{base}-singletask", theirs, expected)

    empty = np.zeros((n, 1), np.float32)
    ours = label(Rows(empty, empty, empty, np.zeros(n, bool), qpos=qpos), env, name)

    np.testing.assert_array_equal(ours.rewards, expected["rewards"])
    np.testing.assert_array_equal(ours.masks, expected["masks"])
    assert 8 < (ours.rewards == 0).sum() < n // 2  # the ring's inner half


@pytest.mark.parametrize("name", ["cube-double-task3", "scene-task4"])
def test_button_states_are_kept_and_relabelling_equals_ogbench(name: str, tmp_path: Path) -> None:
    """Everything in place, or off by a little or much, in a file as published: T + 1 rows per trajectory."""
    env: Any = envs.make(name, physics="mujoco")
    rng, n = np.random.default_rng(0), 400
    placed = env.goal_state(env.description)
    qpos = np.tile(env.engine.model.qpos0, (n, 1)).astype(np.float32)
    for index, place in enumerate(placed.cubes):
        qpos[:, 14 + 7 * index : 17 + 7 * index] = place
    if len(placed.fixtures):
        qpos[:, 21:] = placed.fixtures
    qpos[:, 14:] += rng.choice([0.0, 0.02, 0.1], (n, 1)) * rng.uniform(-1, 1, (n, env.engine.nq - 14))
    extra = np.where(rng.uniform(size=(n, len(placed.extra))) < 0.7, placed.extra, 1 - placed.extra)
    stored = {
        "observations": np.zeros((n, env.observation_size), np.float32),
        "actions": np.zeros((n, 5), np.float32),
        "terminals": np.arange(n) % 100 == 99,
        "qpos": qpos,
        "qvel": np.zeros((n, env.engine.nv), np.float32),
    } | ({"button_states": extra} if extra.size else {})
    np.savez(tmp_path / "set.npz", **stored)

    base, task = name.rsplit("-", 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = gymnasium.make(f"{base}-singletask-{task}-v0")
    expected = load_dataset(str(tmp_path / "set.npz"), add_info=True)
    relabel_dataset(f"{base}-singletask", theirs, expected)

    rows = formats.load(tmp_path / "set.npz")
    ours = label(rows, env, name)
    if extra.size:
        assert rows.extra is not None and rows.extra.dtype == np.int32
        np.testing.assert_array_equal(rows.extra, expected["button_states"])
    np.testing.assert_array_equal(ours.rewards, expected["rewards"])
    np.testing.assert_array_equal(ours.masks, expected["masks"])
    assert 0 < (ours.masks == 0).sum() < n and len(np.unique(ours.rewards)) >= 3


# --- Minari ---


@pytest.mark.parametrize("observations", ["flat", "dict"])
@pytest.mark.parametrize("given", ["folder", "file"])
def test_what_minari_collected_is_what_ogbench_stored(
    reference: dict[str, np.ndarray], observations: str, given: str
) -> None:
    """The same steps, written by Minari 0.5.4: numbers equal, and terminations told apart from truncations."""
    folder = FILES / f"minari-{observations}"
    rows = formats.load(folder if given == "folder" else folder / "data" / "main_data.hdf5")
    assert_same(rows, reference)
    assert rows.terminals is not None and rows.rewards is not None
    np.testing.assert_array_equal(np.flatnonzero(rows.terminals), [21])  # the second episode's last step
    np.testing.assert_array_equal(rows.rewards, [*range(1, 12), *range(13, 24)])  # the row shown, by make_files.py


def minari_copy(tmp_path: Path, name: str = "flat") -> tuple[Path, Path]:
    """(folder, its file) of a data set that may be spoiled."""
    folder = tmp_path / name
    shutil.copytree(FILES / f"minari-{name}", folder)
    return folder, folder / "data" / "main_data.hdf5"


def test_older_minari_layouts(tmp_path: Path, reference: dict[str, np.ndarray]) -> None:
    """Rewards [T, 1], infos without reset's, metadata as attributes, integers for flags."""
    folder, path = minari_copy(tmp_path)
    (folder / "data" / "metadata.json").unlink()
    with h5py.File(path, "r+") as file:
        file.attrs["total_episodes"] = 2
        for group in file.values():
            for key, change in (
                ("rewards", lambda x: x[:, None]),
                ("infos/qpos", lambda x: x[:-1]),
                ("infos/qvel", lambda x: x[:-1]),
                ("terminations", lambda x: x.astype(np.int8)),
            ):
                value = change(group[key][()])
                del group[key]
                group[key] = value
    assert_same(formats.load(folder), reference)


def test_nested_minari_observations_are_flattened_as_gymnasium_does(tmp_path: Path) -> None:
    steps = {"b": np.arange(8.0).reshape(4, 2), "a": [np.full((4, 1), 10.0 + i) for i in range(11)]}
    path = tmp_path / "main_data.hdf5"
    with h5py.File(path, "w") as file:
        group = file.create_group("episode_0")
        group["observations/b"] = steps["b"]
        for index, part in enumerate(steps["a"]):
            group[f"observations/a/_index_{index}"] = part
        group["actions"], group["rewards"] = np.zeros((3, 1)), np.zeros(3)
        group["terminations"], group["truncations"] = np.zeros(3, bool), np.array([0, 0, 1], bool)
    space = gymnasium.spaces.Dict(
        {
            "a": gymnasium.spaces.Tuple([gymnasium.spaces.Box(-99, 99, (1,))] * 11),
            "b": gymnasium.spaces.Box(-99, 99, (2,)),
        }
    )
    expected = [
        gymnasium.spaces.flatten(space, {"a": tuple(part[t] for part in steps["a"]), "b": steps["b"][t]})
        for t in range(4)
    ]
    rows = formats.load(path)
    np.testing.assert_array_equal(rows.observations, expected[:-1])
    np.testing.assert_array_equal(rows.next_observations, expected[1:])


def test_damaged_minari_is_refused(tmp_path: Path) -> None:
    folder, path = minari_copy(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["episode_0"]
    with pytest.raises(UserError, match=r"episode_0 is missing \(1 of 2"):
        formats.load(folder)

    folder, path = minari_copy(tmp_path, "dict")
    metadata = folder / "data" / "metadata.json"
    metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {"total_episodes": 3}))
    with pytest.raises(UserError, match=r"episode_2 is missing \(2 of 3"):
        formats.load(folder)
    path.unlink()
    with pytest.raises(UserError, match=r"has no data/main_data\.hdf5"):
        formats.load(folder)
