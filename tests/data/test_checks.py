"""What data check finds, one fault at a time, in data that is otherwise without fault."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import envs
from qdos_brax.commands.main import main
from qdos_brax.config import load_config, replace
from qdos_brax.data import checks, formats
from qdos_brax.data.readers.rows import Rows
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick

TASK = "antmaze-medium-task1"
CONFIG = load_config(TASK, "smoke")


@pytest.fixture(scope="module")
def env() -> envs.Task:
    return envs.make(TASK, physics="mujoco")


def walk() -> Rows:
    """Three episodes of 40 steps along the free cells (1, 1), (1, 2) of the maze and back."""
    states = np.zeros((3, 41, 29), np.float32)
    states[..., 0] = 2.0 + 2.0 * np.sin(np.arange(41) / 8)
    states[..., 2] = 0.5
    ends = np.zeros((3, 40), bool)
    ends[:, -1] = True
    before = states[:, :-1].reshape(120, 29)
    return Rows(
        observations=before,
        actions=np.zeros((120, 8), np.float32),
        next_observations=states[:, 1:].reshape(120, 29).copy(),
        ends=ends.reshape(120),
        qpos=before[:, :15].copy(),
        qvel=before[:, 15:].copy(),
    )


def findings(rows: Rows, env: envs.Task, made_for: str | None = None) -> checks.Findings:
    return checks.inspect(rows, env, CONFIG, {} if made_for is None else {"env": made_for}, "the walk")


def test_a_good_set_has_no_errors(env: envs.Task) -> None:
    found = findings(walk(), env)
    assert found.errors == [] and found.notes == [
        "actions are the same in every row",
        "no row is at the task's goal: no reward to learn from",
    ]


def _set(array: np.ndarray | None, index: object, value: float) -> None:
    assert array is not None
    array[index] = value  # type: ignore[index]


def _shift_ends(rows: Rows) -> None:
    rows.ends = np.roll(rows.ends, 3)
    rows.ends[-1] = True


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: _set(r.observations, (7, 3), np.nan), "observations has NaN or infinity in 1 row (first 7)"),
        (lambda r: _set(r.qvel, (slice(5, 7), 0), np.inf), "qvel has NaN or infinity in 2 rows (first 5)"),
        (lambda r: _set(r.actions, (0, 0), -1.5), "actions reach 1.5, the task takes [-1, 1]"),
        (lambda r: _set(r.qpos, (slice(0, 30), 0), -3.0), "the body is inside the walls of antmaze-medium in 25%"),
        (lambda r: _set(r.qpos, (8, 1), 0.5), "qpos, qvel and observations disagree on the state in 1 row (first 8)"),
        (lambda r: _set(r.qvel, (9, 13), 1.0), "qpos, qvel and observations disagree on the state in 1 row (first 9)"),
        (lambda r: _set(r.next_observations, (50, 20), 1.0), "not the row that follows in 1 row (first 50): windows"),
        (_shift_ends, "not the row that follows in 2 rows (first 39): windows would cross episodes"),
        (
            lambda r: _set(r.next_observations, (39, 0), 9.0),
            "the body moves more than 1.5 in one step in 1 row (first 39)",
        ),
    ],
)
def test_every_fault_is_one_line(env: envs.Task, spoil: Callable[[Rows], None], says: str) -> None:
    rows = walk()
    spoil(rows)
    errors = findings(rows, env).errors
    assert any(says in line for line in errors), errors
    assert len(errors) == 1 and "\n" not in errors[0]


def test_rewards_are_compared_with_the_task(env: envs.Task) -> None:
    """-1 everywhere is right, for the walk is never at the goal; D4RL's 0 means the same."""
    rows = walk()
    for right in (-np.ones(120, np.float32), np.zeros(120, np.float32)):
        rows.rewards = right
        found = findings(rows, env, TASK)
        assert found.errors == [] and len(found.notes) == 2
    rows.rewards = -np.ones(120, np.float32)
    rows.rewards[4:6] = 0.0
    assert findings(rows, env, TASK).errors == [
        f"rewards disagree with {TASK}, which they were made for, in 2 rows (first 4)"
    ]
    found = findings(rows, env, "antmaze-medium-task2")
    assert found.errors == [] and "rewards of another task or goal in 2 rows (first 4)" in found.notes[2]


def test_what_training_needs_hides_no_other_fault(env: envs.Task) -> None:
    rows = walk()
    _set(rows.next_observations, (50, 20), 1.0)
    rows.qvel = None
    (needed, order) = findings(rows, env).errors
    assert "no qvel" in needed and "not the row that follows in 1 row (first 50)" in order


def test_what_never_changes_is_said(env: envs.Task) -> None:
    rows = walk()
    assert rows.qpos is not None
    at_goal = env.goal_xy  # type: ignore[attr-defined]
    for array in (rows.observations, rows.next_observations, rows.qpos):
        array[:, :2] = at_goal
    found = findings(rows, env)
    assert (
        len(found.errors) == 1 and "estimator=iql" in found.errors[0]
    )  # by the graph no state can be told from another
    iql = replace(CONFIG, **{"values.estimator": "iql"})
    assert checks.inspect(rows, env, iql, {}, "the walk").notes == [
        "observations are the same in every row",
        "actions are the same in every row",
        "every row is at the task's goal: no reward to learn from",
    ]
    rows = walk()
    rows.rewards, rows.qpos, rows.qvel = np.zeros(120, np.float32), None, None
    logged = replace(CONFIG, **{"skills.mi_rollout": "logged"})
    assert "every reward is -1: no reward to learn from" in checks.inspect(rows, env, logged, {}, "the walk").notes


@pytest.mark.parametrize("count", [1, 2])
def test_one_row_is_enough_for_single_transitions(env: envs.Task, count: int) -> None:
    rows = walk()
    rows.drop(np.arange(120) >= count)
    config = load_config(TASK, "smoke", {"method": "rlpd"})
    found = checks.inspect(rows, env, config, {}, "the walk")
    assert found.errors == [] and found.dataset is not None and found.dataset.size == count
    assert len(findings(rows, env).errors) == 1


def test_a_single_row_holds_no_segment(env: envs.Task) -> None:
    rows = walk()
    rows.drop(np.arange(120) >= 1)
    rows.ends[:] = True
    (line,) = findings(rows, env).errors
    assert line.startswith("no episode has 20 steps, the length of a segment (longest 1)")


def test_lengths_are_compared_with_horizon_and_cap(env: envs.Task) -> None:
    some = walk()
    some.ends[9] = True
    assert "1 of 4 episodes are shorter than 20 steps and give no segment" in findings(some, env).notes
    some.ends[19::20] = True
    some.ends[12::20] = True
    (line,) = findings(some, env).errors
    assert "no episode has 20 steps, the length of a segment (longest 13)" in line
    long = walk()
    parts = {key: np.tile(value, (9, *[1] * (value.ndim - 1))) for key, value in long.arrays().items()}
    parts["ends"][:-1] = False
    notes = findings(Rows(**parts), env).notes
    assert any("the longest episode has 1080 steps, antmaze-medium ends after 1000" in note for note in notes)


def test_training_refuses_another_mazes_data(tmp_path: Path) -> None:
    """The cheap part runs before training: same sizes, wrong maze."""
    rows = walk()
    assert rows.qpos is not None and rows.qvel is not None
    rows.observations[:, 1] = rows.qpos[:, 1] = 8.0  # cell (3, 1): free in large, a wall in medium
    path = tmp_path / "set.hdf5"
    columns = {"observations": rows.observations, "actions": rows.actions, "terminals": rows.ends}
    formats.write_hdf5(path, columns | {"infos/qpos": rows.qpos, "infos/qvel": rows.qvel}, {})
    assert formats.read(path, envs.make("antmaze-large", physics="mujoco")).size == 117
    medium = envs.make("antmaze-medium", physics="mujoco")
    with pytest.raises(UserError, match="inside the walls of antmaze-medium"):
        formats.read(path, medium)
    formats.write_hdf5(path, columns | {"rewards": np.zeros(120, np.float32)}, {})
    with pytest.raises(UserError, match="inside the walls of antmaze-medium"):  # seen without states as well
        formats.read(path, medium)


def test_command_draws_the_map_and_ends_with_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = walk()
    assert rows.qpos is not None and rows.qvel is not None
    columns = {
        "observations": rows.observations,
        "next_observations": rows.next_observations,
        "actions": rows.actions,
        "terminals": np.zeros(120, bool),
        "timeouts": rows.ends,
        "infos/qpos": rows.qpos,
        "infos/qvel": rows.qvel,
    }
    path, picture = tmp_path / "set.hdf5", tmp_path / "map.png"
    formats.write_hdf5(path, columns, {"env": TASK})
    assert main(["data", "check", str(path), "--env", TASK, "--map", str(picture)]) == 0
    assert matplotlib.image.imread(picture).std() > 0.1
    picture.unlink()
    assert main(["data", "info", str(path), "--map", str(picture)]) == 0 and picture.exists()
    assert {item.name for item in tmp_path.iterdir()} == {"set.hdf5", "map.png"}
    capsys.readouterr()
    assert main(["data", "check", str(path), "--env", "antsoccer"]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 3 and all(line.startswith(("error: ", "note: ")) for line in lines)
    assert main(["data", "check", str(path), "--env", "antsoccer", "--map", str(picture)]) == 2
    assert "a map needs" in capsys.readouterr().err
    assert main(["data", "info", str(path), "--map", str(tmp_path / "absent" / "map.png")]) == 2
    assert "cannot write" in capsys.readouterr().err
