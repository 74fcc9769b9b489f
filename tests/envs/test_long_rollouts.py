"""100,000 environment steps of every task: nothing breaks, nothing flies."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.physics.walls import cells_in_reach
from qdos_brax.experts import policies

STEPS = 100_000
NUM_ENVS = 100


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "physics"),
    [*((name, "mujoco") for name in dict.fromkeys(s.name for s in envs.list_tasks())), ("antmaze-large", "mjx")],
)
def test_long_rollouts_stay_plausible(name: str, physics: str) -> None:
    """Half of the ants walk, everything else acts at random; height (m) and speed (m/s) of the body are watched."""
    env = envs.AutoReset(envs.make(name, physics=physics))
    act = policies.ant_walker().act if env.spec.family.startswith("ant") else None
    angle = jax.random.uniform(jax.random.key(1), (NUM_ENVS,), minval=-np.pi, maxval=np.pi)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def body(state: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        action = jax.random.uniform(key, (NUM_ENVS, env.action_size), minval=-1)
        qpos, qvel = state.pipeline_state.qpos, state.pipeline_state.qvel
        if act is not None:
            walks = (jnp.arange(NUM_ENVS) < NUM_ENVS // 2)[:, None]
            action = jnp.where(walks, act(qpos[:, :15], qvel[:, :14], direction), action)
        after = jax.vmap(env.step)(state, action)
        speed = jnp.linalg.norm(after.pipeline_state.qvel[:, :3], axis=1).max()
        height = after.pipeline_state.qpos[:, 2]
        return after, {
            "nan": after.metrics["nan"].sum(),
            "low": height.min(),
            "high": height.max(),
            "speed": speed,
            "outside": cells_in_reach(env.layout, after.pipeline_state.qpos[:, :2])[1][:, 0].mean(),
        }

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), NUM_ENVS))
    rollout = jax.jit(lambda s, k: jax.lax.scan(body, s, k))
    state, seen = rollout(state, jax.random.split(jax.random.key(2), STEPS // NUM_ENVS))
    print(name, physics, {key: (float(value.min()), float(value.max())) for key, value in seen.items()})
    assert float(seen["nan"].sum()) == 0
    assert bool(jnp.isfinite(state.obs).all())
    assert float(seen["low"].min()) > 0 and float(seen["high"].max()) < 4
    assert float(seen["speed"].max()) < 20
    assert float(seen["outside"].max()) == 0
