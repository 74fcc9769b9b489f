"""100,000 environment steps of every task: nothing breaks, nothing flies. Figures: results/long_rollouts.json."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import envs
from benchmarks import long_rollouts
from envs.mazes.families import MAZE_FAMILIES


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "physics"),
    [
        *((name, "mujoco") for name in dict.fromkeys(s.name for s in envs.list_tasks() if s.family in MAZE_FAMILIES)),
        *((name, "mjx") for name in ("antmaze-large", "antsoccer-arena", "humanoidmaze-medium")),
    ],
)
def test_long_rollouts_stay_plausible(name: str, physics: str) -> None:
    """Bounds are in m, m/s and J; no energy comes from nowhere."""
    found = long_rollouts.watch(name, physics)
    print(found)
    assert found["steps"] == long_rollouts.STEPS and found["not_finite"] == 0
    for thing in ("body", "ball") if "soccer" in name else ("body",):
        assert found[thing]["height"]["least"] > 0 and found[thing]["height"]["most"] < 4
        assert found[thing]["speed"]["most"] < 20
        assert found[thing]["inside_a_wall"] == 0
    assert found["energy"]["least"] > 0
    assert found["energy"]["rose_beyond_motors"] == 0


def test_energy_of_a_falling_ant_is_its_weight_and_its_motion() -> None:
    model = envs.make("antmaze-medium", physics="mujoco").engine.model
    mass = model.body_mass.sum()
    qpos, qvel = np.tile(model.qpos0, (2, 1)), np.zeros((2, model.nv))
    qpos[1, 2] += 1.0
    qvel[1, :3] = (3.0, 0.0, -4.0)
    resting, falling = long_rollouts.energy(model, qpos, qvel)
    assert falling - resting == pytest.approx(mass * (9.81 * 1.0 + 0.5 * 25), rel=1e-6)


def test_rounding_bounds_what_float32_does_to_the_energy() -> None:
    """Ants with a ball at random, hardly moving: no energy is off by more, and some by a good part of it."""
    model = envs.make("antsoccer-medium", physics="mujoco").engine.model
    rng = np.random.default_rng(0)
    qpos = model.qpos0 + rng.normal(size=(500, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 18:] = model.qpos0[18:]
    qvel = 1e-6 * rng.normal(size=(500, model.nv))
    exact, seen = (long_rollouts.energy(model, qpos.astype(d), qvel.astype(d)) for d in (np.float64, np.float32))
    share = np.abs(seen - exact) / long_rollouts.rounding(model, qpos, qvel)
    assert 0.2 < share.max() <= 1


def test_motors_work_is_torque_times_the_faster_rate() -> None:
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 0 1"/><geom size="0.1"/></body></worldbody>
        <actuator><motor joint="hinge" gear="30" ctrlrange="-0.5 0.5"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    work = long_rollouts.motor_work(model, np.array([[1.0], [-4.0], [2.0]]), seconds=0.1)
    np.testing.assert_allclose(work, [15 * 4 * 0.1, 15 * 4 * 0.1])
