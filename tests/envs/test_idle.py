"""A simulation whose next step nobody reads costs no physics, and those beside it step as they would have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.physics.mujoco.stepper import BatchStepper

N = 4
OVER = jnp.arange(N) % 2 == 1


@pytest.mark.parametrize(
    "task", ["antmaze-medium", "antsoccer-arena", "humanoidmaze-medium", "kitchen-mixed", "cube-single", "scene"]
)
def test_idle_simulations_are_not_stepped_and_change_no_other(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = envs.make(task, physics="mujoco")
    stepped = []
    sub_steps = BatchStepper._sub_steps

    def counted(stepper, batch, ids):
        stepped.append(N if ids is None else len(ids))
        sub_steps(stepper, batch, ids)

    monkeypatch.setattr(BatchStepper, "_sub_steps", counted)
    step = jax.jit(jax.vmap(lambda state, action, over: env.step(env.idle(state, over), action)))
    one = other = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), N))
    for k in range(5):
        action = jax.random.uniform(jax.random.key(k), (N, env.action_size), minval=-1.0)
        one = jax.block_until_ready(step(one, action, jnp.zeros(N, bool)))
        new = jax.block_until_ready(step(other, action, OVER))
        other = jax.tree.map(lambda old, new: jnp.where(OVER.reshape(-1, *[1] * (new.ndim - 1)), old, new), other, new)
    assert stepped == [N, N - 2] * 5
    one, other = one.pipeline_state, other.pipeline_state
    for name in ("qpos", "qvel", "sensed", "extra"):
        np.testing.assert_array_equal(getattr(one, name)[::2], getattr(other, name)[::2])
    np.testing.assert_array_equal(one.carry.bits[::2], other.carry.bits[::2])
    assert not np.array_equal(one.qpos[1], other.qpos[1])
