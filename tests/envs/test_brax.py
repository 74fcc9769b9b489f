"""The tasks under Brax's own wrappers and learners."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import wrap
from brax.training.agents.sac import train as brax_sac

import envs


def wrapped(episode_length: int, action_repeat: int = 1):
    return wrap(envs.make("antmaze-medium", physics="mujoco"), episode_length, action_repeat)


@pytest.mark.parametrize(("action_repeat", "calls"), [(1, 50), (2, 25)])
def test_brax_episodes_have_their_length(action_repeat: int, calls: int) -> None:
    env = wrapped(50, action_repeat)
    step, state = jax.jit(env.step), env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    for episode in range(2):  # the second begins where Brax puts the first one's start back
        for count in range(1, calls + 1):
            state = step(state, jnp.zeros((2, 8)))
            np.testing.assert_array_equal(state.done, [float(count == calls)] * 2, f"{episode}, {count}")
    np.testing.assert_array_equal(state.info["truncation"], [1.0, 1.0])


def test_the_tasks_cap_starts_anew_with_braxs_episodes() -> None:
    """A wrapper that puts the first state back puts its step count back, or every episode after the cap would end."""
    env = wrapped(10_000)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    physics = state.pipeline_state
    state = state.replace(pipeline_state=physics.replace(steps=jnp.array([999, 10], jnp.int32)))
    step = jax.jit(env.step)
    state = step(state, jnp.zeros((2, 8)))
    np.testing.assert_array_equal(state.done, [1, 0])
    state = step(state, jnp.zeros((2, 8)))
    np.testing.assert_array_equal(state.done, [0, 0])
    np.testing.assert_array_equal(state.pipeline_state.steps, [1, 12])


def test_braxs_sac_trains_on_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    # Brax 0.14.2 asks for a function that jax has dropped since; this is what it did.
    replicated = lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)  # noqa: E731
    monkeypatch.setattr(jax, "device_put_replicated", replicated, raising=False)
    seen: list[dict] = []
    _, params, _ = brax_sac.train(
        environment=envs.make("antmaze-medium", physics="mujoco"),
        num_timesteps=120,
        episode_length=30,
        num_envs=2,
        num_eval_envs=2,
        batch_size=8,
        grad_updates_per_step=1,
        min_replay_size=20,
        max_replay_size=200,
        num_evals=2,
        progress_fn=lambda _, metrics: seen.append(metrics),
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    assert seen[-1]["eval/avg_episode_length"] == 30.0
    assert seen[-1]["eval/episode_reward"] == -30.0
