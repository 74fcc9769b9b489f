"""Readers: files of the real OGBench and the real Minari, and D4RL's layout with the faults it is known for."""

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


# --- D4RL ---


KEPT = np.delete(np.arange(24), [8, 15, 23])  # all but the last row of each episode


def assert_antmaze(rows: Rows, columns: Mapping[str, np.ndarray], kept: np.ndarray = KEPT) -> None:
    observations = columns["observations"]
    np.testing.assert_array_equal(rows.observations, observations[kept])
    np.testing.assert_array_equal(rows.next_observations, observations[kept + 1])
    np.testing.assert_array_equal(rows.actions, columns["actions"][kept])
    np.testing.assert_array_equal(rows.qpos, observations[kept, :15])  # before the action
    np.testing.assert_array_equal(rows.qvel, observations[kept, 15:])
    assert any("after the action" in note for note in rows.notes)


def test_d4rl_states_after_the_action_and_last_rows_without_a_next_state(tmp_path: Path) -> None:
    columns = d4rl_antmaze()
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns))
    assert_antmaze(rows, columns)
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [7, 13, 20])
    assert len(rows.notes) == 1


def test_d4rl_rows_at_the_goal_are_terminal_without_ending_the_episode(tmp_path: Path) -> None:
    """Version 2's files: clusters of terminals in the middle of an episode (D4RL issue 199)."""
    columns = d4rl_antmaze()
    columns["terminals"][[3, 4, 12]] = True
    columns["rewards"][[3, 4, 12]] = 1.0
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns))
    assert_antmaze(rows, columns)
    assert rows.terminals is not None
    np.testing.assert_array_equal(np.flatnonzero(rows.terminals), [3, 4, 11])  # row 8 is gone


def test_d4rl_arrays_in_an_npz_are_read_as_in_an_hdf5(tmp_path: Path) -> None:
    """What ``numpy.savez`` makes of ``env.get_dataset()``: its terminals are no rows without an action."""
    columns = d4rl_antmaze()
    columns["terminals"][[3, 4, 12]] = True
    columns["rewards"][[3, 4, 12]] = 1.0
    np.savez(tmp_path / "a.npz", **columns)
    rows = formats.load(tmp_path / "a.npz")
    assert_antmaze(rows, columns)
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [7, 13, 20])
    np.testing.assert_array_equal(np.flatnonzero(rows.terminals), [3, 4, 11])
    np.testing.assert_array_equal(np.flatnonzero(rows.rewards), [3, 4, 11])


def test_an_npz_of_transitions_ends_episodes_where_they_do_not_follow(tmp_path: Path) -> None:
    """D4RL's ``qlearning_dataset``: next observations and terminals, no timeouts."""
    columns = d4rl_antmaze()
    following = np.concatenate([columns["infos/qpos"], columns["infos/qvel"]], axis=1)
    kept = {name: columns[name] for name in ("observations", "actions", "rewards", "terminals")}
    np.savez(tmp_path / "q.npz", **kept, next_observations=following)
    rows = formats.load(tmp_path / "q.npz")
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [8, 15, 23])
    np.testing.assert_array_equal(rows.next_observations, following)
    assert any("2 episode ends are not marked, the first at row 8" in note for note in rows.notes)


@pytest.mark.parametrize("missing", ["the positions", "the distance that is too far for a step"])
def test_d4rl_episodes_end_at_terminals_where_nothing_shows_that_they_go_on(tmp_path: Path, missing: str) -> None:
    """The ordinary layout: an episode that terminates has no timeout, and no next observation."""
    columns = d4rl_antmaze()
    columns["terminals"][15], columns["timeouts"][15] = True, False
    if missing == "the positions":
        del columns["infos/qpos"], columns["infos/qvel"]
    path = write_d4rl(tmp_path / "a.hdf5", columns)
    rows = formats.load(path) if missing == "the positions" else formats.load(path, None)
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [7, 14, 21])  # a terminal row stays
    assert rows.terminals is not None
    np.testing.assert_array_equal(np.flatnonzero(rows.terminals), [14])


def test_d4rl_timeouts_out_of_step_do_not_join_episodes(tmp_path: Path) -> None:
    """Version 0's files (D4RL issue 77): the marks come two rows late, the resets are where the body jumps."""
    columns = d4rl_antmaze()
    columns["timeouts"] = np.roll(columns["timeouts"], 2)
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns))
    late = np.flatnonzero(columns["timeouts"])
    assert_antmaze(rows, columns, np.setdiff1d(KEPT, late))
    assert any("2 episode ends are not marked, the first at row 8" in note for note in rows.notes)
    steps = np.linalg.norm(rows.next_observations[:, :2] - rows.observations[:, :2], axis=1)
    assert steps.max() < 0.3


def test_d4rl_kitchen_demonstrations_end_at_their_terminals_solved_or_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    columns = {
        "observations": rng.normal(size=(20, 60)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (20, 9)).astype(np.float32),
        "rewards": np.repeat([0.0, 2.0, 3.0, 4.0], 5).astype(np.float32),
        "terminals": np.isin(np.arange(20), [9, 19]),
    }
    rows = formats.load(write_d4rl(tmp_path / "kitchen.hdf5", columns))
    kept = np.delete(np.arange(20), [9, 19])
    np.testing.assert_array_equal(rows.observations, columns["observations"][kept])
    np.testing.assert_array_equal(rows.next_observations, columns["observations"][kept + 1])
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [8, 17])
    assert rows.terminals is not None
    np.testing.assert_array_equal(rows.terminals, rows.rewards == 4.0)  # not at row 8, where only two were done


def test_d4rl_kitchen_files_are_refused_in_one_line_that_says_why(tmp_path: Path) -> None:
    columns = {
        "observations": np.zeros((20, 60), np.float32),
        "actions": np.zeros((20, 9), np.float32),
        "rewards": np.repeat([0.0, 1.0], 10).astype(np.float32),
        "terminals": np.isin(np.arange(20), [9, 19]),
    }
    path = write_d4rl(tmp_path / "kitchen.hdf5", columns)
    with pytest.raises(
        UserError, match=r"60 numbers, kitchen-mixed has 59: D4RL's kitchen: .* neither velocities"
    ) as caught:
        formats.read(path, envs.make("kitchen-mixed"))
    assert "neither velocities" in str(caught.value)
    assert "\n" not in str(caught.value) and "more" not in str(caught.value)


def test_next_observations_show_where_episodes_end(tmp_path: Path) -> None:
    """A replay buffer's file: true next observations, neither timeouts nor terminals."""
    columns = d4rl_antmaze()
    following = np.concatenate([columns["infos/qpos"], columns["infos/qvel"]], axis=1)
    columns |= {"next_observations": following, "timeouts": np.zeros(24, bool)}
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns))
    np.testing.assert_array_equal(np.flatnonzero(rows.ends), [8, 15, 23])
    np.testing.assert_array_equal(rows.next_observations, following)
    assert rows.size == 24


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("following", [True, False])
def test_files_with_hardly_any_rows_are_read(tmp_path: Path, count: int, following: bool) -> None:
    columns = {"observations": np.zeros((count, 29)), "actions": np.zeros((count, 8)), "terminals": np.zeros(count)}
    if following:
        columns["next_observations"] = np.zeros((count, 29))
    rows = formats.load(write_d4rl(tmp_path / "few.hdf5", columns))
    assert rows.size == (count if following else 0)
