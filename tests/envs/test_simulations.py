"""Simulations outside jax make the engine's bits, also of a task whose sensors err (``tests/collection``: others)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np

from envs.physics.mujoco.engine import _SENSORS
from tests.envs.kitchen_reference import kitchen

STEPS, COUNT = 12, 2


def test_the_kitchen_goes_the_same_way_given_the_same_errors() -> None:
    engine: Any = kitchen("kitchen-mixed").engine
    draw = jax.jit(jax.vmap(lambda key: engine._draw(key)[0][0]))
    step = jax.jit(jax.vmap(engine.step))
    keys = jax.random.split(jax.random.key(0), COUNT)
    qpos, qvel = np.full((COUNT, 30), 0.1, np.float32), np.zeros((COUNT, 29), np.float32)
    qpos[:, :9] = np.random.default_rng(1).uniform(-0.5, 0.5, (COUNT, 9))
    actions = np.random.default_rng(0).uniform(-1.3, 1.3, (STEPS, COUNT, 9)).astype(np.float32)

    states = [jax.vmap(engine.init)(qpos, qvel, np.eye(COUNT, 7, dtype=np.int32), keys)]
    errors = [draw(jax.vmap(lambda key: jax.random.fold_in(key, _SENSORS))(keys))]
    for action in actions:
        errors.append(draw(states[-1].carry.key))
        states.append(step(states[-1], action))

    drawn = iter(errors)
    chance: Any = SimpleNamespace(uniform=lambda low, high, shape: np.asarray(next(drawn)))
    simulations = engine.simulations(chance)
    simulations.start(qpos, qvel, np.eye(COUNT, 7))
    np.testing.assert_array_equal(simulations.sensed, states[0].sensed)
    for action, state in zip(actions, states[1:], strict=True):
        simulations.step(action)
        exact = engine.exact_state(state)
        np.testing.assert_array_equal(simulations.qpos, exact[0])
        np.testing.assert_array_equal(simulations.qvel, exact[1])
        np.testing.assert_array_equal(simulations.extra, state.extra)
        np.testing.assert_array_equal(simulations.sensed, state.sensed)
    assert (simulations.sensed[:, :9] != simulations.qpos[:, :9].astype(np.float32)).all()
