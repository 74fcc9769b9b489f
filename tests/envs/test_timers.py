"""MuJoCo's profiling clock stands still, and nothing else does."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from envs.mazes import models
from envs.physics.mujoco import timers
from envs.physics.mujoco.engine import MujocoEngine


@pytest.fixture(autouse=True)
def own_clock_first() -> Iterator[None]:
    before = mujoco.get_mjcb_time()
    mujoco.set_mjcb_time(None)
    yield
    mujoco.set_mjcb_time(before)


def rolled(model: mujoco.MjModel) -> tuple[np.ndarray, float]:
    """(qpos after 50 steps under a fixed control, seconds that MuJoCo's clock saw)."""
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.3
    for _ in range(50):
        mujoco.mj_step(model, data)
    return data.qpos.copy(), float(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration)


def test_an_engine_stops_the_clock_and_changes_no_step() -> None:
    model = models.ant_model()
    with_clock, seconds = rolled(model)
    assert 0 < seconds < 10
    MujocoEngine(model)
    assert mujoco.get_mjcb_time() is not None
    without, counted = rolled(model)
    assert float(counted).is_integer() and without.tobytes() == with_clock.tobytes()  # sums of -1, 0 and 1


def test_a_clock_of_the_users_own_is_left_alone() -> None:
    mujoco.set_mjcb_time(lambda: 7.0)
    MujocoEngine(models.ant_model())
    assert mujoco.get_mjcb_time()() == 7.0
    assert timers._no_clock() is not None
