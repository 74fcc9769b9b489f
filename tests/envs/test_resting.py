"""How high the ant stands with the installed MuJoCo, how high it stood before 3.5, and what data check makes of it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import envs
from envs.mazes.resting import lowest_points
from envs.task import Resting
from qdos_brax.commands.main import main
from qdos_brax.config import load_config
from qdos_brax.data import checks, formats
from qdos_brax.data.readers.rows import Rows

TASKS = ("antmaze-medium-task1", "antsoccer-arena-task1")
NOTE = "recorded with MuJoCo before 3.5"


def model_of(env: envs.Task, before: bool) -> mujoco.MjModel:
    """The whole model; ``before``: margins whose sum is the larger of today's two, as contacts had it then."""
    model = env.whole_model()  # type: ignore[attr-defined]
    if before:
        model.geom_margin[:] /= 2
    return model


def steps(env: envs.Task, before: bool, noise: float, count: int, settle: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """States (qpos[count, nq], qvel[count, nv]) under random actions, after control steps without any."""
    model, rng = model_of(env, before), np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qpos[:2] = env.layout.ij_to_xy((1, 1))  # type: ignore[attr-defined]
    if model.nq > 15:
        data.qpos[15:17] = env.layout.ij_to_xy((1, 2))  # type: ignore[attr-defined]
    found = []
    for step in range(settle + count):
        if step >= settle:
            found.append((data.qpos.copy(), data.qvel.copy()))
            data.ctrl[:] = noise * rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data, 5)
    return tuple(np.asarray(part, np.float32) for part in zip(*found, strict=True))  # type: ignore[return-value]


@pytest.fixture(scope="module", params=TASKS)
def env(request: pytest.FixtureRequest) -> envs.Task:
    return envs.make(request.param, physics="mujoco")


def test_lowest_points_by_hand(env: envs.Task) -> None:
    """Legs stretched level: the lowest point is the torso's, a sphere of radius 0.25; legs down: a foot's."""
    model = model_of(env, before=False)
    qpos = np.zeros((2, model.nq))
    qpos[:, 2], qpos[:, 3] = 1.0, 1.0
    qpos[1, 8:15:2] = [np.pi / 2, -np.pi / 2, -np.pi / 2, np.pi / 2]
    level, down = lowest_points(model, qpos, 1)
    assert level == pytest.approx(0.75, abs=1e-9)
    assert down == pytest.approx(1.0 - 0.4 * np.sqrt(2) - 0.08, abs=1e-3)


@pytest.mark.parametrize("before", [False, True])
def test_the_ant_stands_one_margin_higher_today(env: envs.Task, before: bool) -> None:
    qpos, _ = steps(env, before, noise=0.0, count=1, settle=200)
    resting = env.resting(qpos)
    assert resting is not None and resting.today - resting.before == pytest.approx(0.01)
    assert resting.heights[0] == pytest.approx(resting.before if before else resting.today, abs=5e-4)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("before", [False, True])
def test_data_check_says_which_mujoco_it_was(
    env: envs.Task, before: bool, noise: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    qpos, qvel = steps(env, before, noise, 400)
    path = tmp_path / "set.npz"
    ends, actions = np.arange(400) == 399, np.zeros((400, 8), np.float32)
    np.savez(path, observations=np.hstack([qpos, qvel]), actions=actions, terminals=ends, qpos=qpos, qvel=qvel)
    assert main(["data", "check", str(path), "--env", env.spec.full_name]) == 0
    said = capsys.readouterr().out
    assert (f"note: {NOTE}" in said) == before
    assert not before or "7 mm above the ground, today 17 mm" in said


def test_few_rows_and_rows_in_the_air_say_nothing() -> None:
    env = envs.make(TASKS[0], physics="mujoco")
    config = load_config(TASKS[0], "smoke")
    qpos, qvel = steps(env, True, 1.0, 400)

    def notes(qpos: np.ndarray, count: int) -> list[str]:
        seen = np.hstack([qpos, qvel])
        rows = Rows(seen[:count], np.zeros((count, 8), np.float32), seen[1 : count + 1], np.arange(count) == count - 1)
        rows.qpos, rows.qvel = qpos[:count], qvel[:count]
        return [line for line in checks.inspect(rows, env, config, {}, "rows").notes if NOTE in line]

    assert len(notes(qpos, 399)) == 1
    assert notes(qpos, 40) == []
    qpos[:, 2] += 1.0
    assert notes(qpos, 399) == []


def test_a_family_offers_its_own_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as the cubes of a manipulation task; the humanoid, whose contacts hardly differ, offers none."""
    assert envs.make("humanoidmaze-medium", physics="mujoco").resting(np.zeros((3, 28))) is None
    env = envs.make(TASKS[0], physics="mujoco")
    rows = formats.load(Path(__file__).parents[1] / "data" / "files" / "ogbench-antmaze-medium.npz")
    config = load_config(TASKS[0], "smoke", {"skills.horizon": 5})
    for height, expected in ((0.02, 1), (0.03, 0), (0.025, 0)):
        monkeypatch.setattr(env, "resting", lambda qpos, at=height: Resting(np.full(60, at), today=0.03, before=0.02))
        assert sum(NOTE in line for line in checks.inspect(rows, env, config, {}, "rows").notes) == expected
