"""D4RL's layout, with the faults it is known for, and what others made of its arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import envs
from qdos_brax.data import formats
from qdos_brax.data.readers.rows import Rows
from qdos_brax.errors import UserError
from tests.data.d4rl_files import d4rl_antmaze, write_d4rl

pytestmark = pytest.mark.quick

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
