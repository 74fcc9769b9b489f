"""MuJoCo's profiling clock stands still, and no step changes by it."""

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

import envs

ANT = envs.make("antmaze-medium", physics="mujoco").engine.model


@pytest.fixture(autouse=True)
def own_clock_first() -> Iterator[None]:
    before = mujoco.get_mjcb_time()
    mujoco.set_mjcb_time(None)
    yield
    mujoco.set_mjcb_time(before)


def rolled() -> tuple[np.ndarray, float]:
    """Return qpos after 50 steps under a fixed control, and the seconds that MuJoCo's clock saw."""
    data = mujoco.MjData(ANT)
    data.ctrl[:] = 0.3
    for _ in range(50):
        mujoco.mj_step(ANT, data)
    return data.qpos.copy(), float(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration)


def test_an_engine_stops_the_clock_and_changes_no_step() -> None:
    with_clock, seconds = rolled()
    assert 0 < seconds < 10
    envs.make("antmaze-large", physics="mujoco")
    without, none = rolled()
    assert none == 0 and without.tobytes() == with_clock.tobytes()


def test_a_clock_of_the_users_own_is_left_alone() -> None:
    mujoco.set_mjcb_time(lambda: 7.0)
    envs.make("antmaze-large", physics="mujoco")
    assert mujoco.get_mjcb_time()() == 7.0
