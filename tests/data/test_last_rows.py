"""D4RL's rows without a next state, and next states that are not the next row's: kept, dropped or refused, and said."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import envs
from envs.mazes.maze_task import MazeTask
from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main
from qdos_brax.config import load_config
from qdos_brax.data import formats
from qdos_brax.data.labelling import drop_unknown, label
from qdos_brax.data.requirements import remarks, unmet
from tests.data.d4rl_files import d4rl_antmaze, write_d4rl

pytestmark = pytest.mark.quick

KEPT = np.delete(np.arange(24), [8, 15, 23])  # all but the last row of each episode


@pytest.mark.parametrize("states", [False, True])
def test_d4rl_terminal_last_rows_are_kept_where_the_task_ends(tmp_path: Path, states: bool) -> None:
    """The file marks each episode's end; with states the task decides, and here no state is at its goal."""
    columns = d4rl_antmaze()
    columns["terminals"] = columns.pop("timeouts")
    columns["rewards"][columns["terminals"]] = 1.0
    if not states:
        del columns["infos/qpos"], columns["infos/qvel"]
    env = envs.make("antmaze-medium")
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns), env.jump)
    np.testing.assert_array_equal(np.flatnonzero(rows.terminals), [8, 15, 23])
    drop_unknown(rows, env)
    labelled = label(rows, env, "a")
    kept = KEPT if states else np.arange(24)
    np.testing.assert_array_equal(labelled.observations, columns["observations"][kept])
    np.testing.assert_array_equal(np.flatnonzero(labelled.ends), [7, 13, 20] if states else [8, 15, 23])
    np.testing.assert_array_equal(labelled.masks == 0, np.zeros(21, bool) if states else columns["terminals"])
    assert f"{0 if states else 3} are kept and {3 if states else 0} dropped" in rows.notes[-1]


def test_rounded_next_observations_are_named(tmp_path: Path) -> None:
    columns = d4rl_antmaze()
    following = np.concatenate([columns["infos/qpos"], columns["infos/qvel"]], axis=1)
    columns["next_observations"] = following.astype(np.float16)
    rows = formats.load(write_d4rl(tmp_path / "a.hdf5", columns))
    assert re.search(r"next_observations do not match .*by up to \S+ in a typical one", rows.mismatch)
    env = envs.make("antmaze-medium")
    assert unmet(rows, env, load_config("antmaze-medium", "smoke")) == [rows.mismatch]
    for method in ("rlpd", "bc"):  # single transitions are what they were
        config = load_config("antmaze-medium", "smoke", {"method": method})
        assert unmet(rows, env, config) == [] and rows.mismatch in remarks(rows, config)


def towards(env: MazeTask, stop: float) -> dict[str, np.ndarray]:
    """Two episodes of 30 rows towards the goal, the last one ``stop`` away from it, with states before the action."""
    states = np.zeros((2, 30, 29), np.float32)
    states[..., 0], states[..., 1] = env.goal_xy
    states[..., 0] -= stop + 0.04 * np.arange(30)[::-1]
    states[..., 2], states[..., 3], states[1, :, 4] = 0.5, 1.0, 0.1
    rows, last = states.reshape(60, 29), np.arange(60) % 30 == 29
    return {
        "observations": rows,
        "actions": np.random.default_rng(0).uniform(-1, 1, (60, 8)).astype(np.float32),
        "rewards": last.astype(np.float32),
        "terminals": last,
        "infos/qpos": rows[:, :15],
        "infos/qvel": rows[:, 15:],
    }


@pytest.fixture(scope="module")
def env() -> MazeTask:
    made = envs.make("antmaze-medium", physics="mujoco")
    assert isinstance(made, MazeTask)
    return made


def test_last_rows_at_the_goal_are_kept_with_their_states(tmp_path: Path, env: MazeTask) -> None:
    """Their mask is 0, so that nothing takes the next observation, which the file has not, for true."""
    columns = towards(env, 0.45)
    data = formats.read(write_d4rl(tmp_path / "a.hdf5", columns), env)
    assert data.size == 60 and data.qpos is not None and data.qvel is not None
    np.testing.assert_array_equal(data.qpos, columns["infos/qpos"])
    np.testing.assert_array_equal(data.qvel, columns["infos/qvel"])
    for mark in (data.ends, data.masks == 0, data.rewards == 0):
        assert np.flatnonzero(mark)[-1] == 59 and mark[29]
    np.testing.assert_array_equal(np.flatnonzero(data.ends), [29, 59])
    np.testing.assert_array_equal(data.masks == 0, np.linalg.norm(data.qpos[:, :2] - env.goal_xy, axis=1) <= 0.5)
    assert "of 2 terminal rows that end an episode, 2 are kept and 0 dropped" in data.notes[0]


def test_training_says_what_data_check_says_of_dropped_rows(
    tmp_path: Path, env: MazeTask, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_d4rl(tmp_path / "a.hdf5", towards(env, 2.0))
    note = "of 2 terminal rows that end an episode, 0 are kept and 2 dropped, where antmaze-medium-task1 goes on"
    assert main(["data", "check", str(path), "--env", "antmaze-medium"]) == 0
    assert note in capsys.readouterr().out
    flags = ["--env", "antmaze-medium", "--preset", "smoke", "--dataset", str(path), "--out", str(tmp_path / "run")]
    assert train_main([*flags, "--set", "skills.horizon=30"]) == 2  # soon over: the dropped rows made episodes shorter
    said = capsys.readouterr()
    assert note in next(line for line in said.out.splitlines() if line.startswith("note "))
    assert "no episode has 30 steps, the length of a segment (longest 29)" in said.err


def test_info_lists_what_is_in_the_file_alone(
    tmp_path: Path, env: MazeTask, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_d4rl(tmp_path / "a.hdf5", towards(env, 0.45))
    assert main(["data", "info", str(path)]) == 0
    said = capsys.readouterr().out
    assert "unknown_next" not in said and "terminals          float32 60" in said
    assert "note: no next_observations: 2 terminal rows that end an episode count where the task ends" in said
