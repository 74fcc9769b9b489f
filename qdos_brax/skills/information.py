"""Give the states of the mutual-information term: from the simulator, or from the log."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from envs.brax_base import State
from envs.task import Task
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.data.segments import window
from qdos_brax.skills.vae import SkillModel


class StateSource(Protocol):
    """Define where the states along a skill come from."""

    def __call__(self, params: Any, data: DeviceData, starts: jax.Array, latent: jax.Array) -> jax.Array:
        """Return normalised observations[B, H + 1, obs], before each action of skill latent[B, z] and after the last,
        from the segments at starts[B].
        """
        ...


class PhysicsRollout:
    """Play each skill in the simulator, from the logged simulator state at the start of its segment.

    Args:
        env: the task's environment; episode ends are ignored, a rollout always has H steps.
        model: the skills.
        normaliser: of observations.
        horizon: H.
    """

    def __init__(self, env: Task, model: SkillModel, normaliser: Normaliser, horizon: int) -> None:
        self._env, self._model, self._normalise, self._horizon = env, model, normaliser, horizon

    def __call__(self, params: Any, data: DeviceData, starts: jax.Array, latent: jax.Array) -> jax.Array:
        """Return normalised observations[B, H + 1, obs] of the rollouts."""

        def one(qpos: jax.Array, qvel: jax.Array, extra: Any, key: jax.Array, latent: jax.Array) -> jax.Array:
            start = self._env.reset_to(qpos, qvel, key=key, extra=extra)
            skill = self._model.begin(params, latent, self._normalise(start.obs))

            def step(state: State, _: None) -> tuple[State, jax.Array]:
                observation = self._normalise(state.obs)
                return self._env.step(state, self._model.act(params, observation, skill)), observation

            end, before = jax.lax.scan(step, start, None, length=self._horizon)
            return jnp.concatenate([before, self._normalise(end.obs)[None]])

        assert data.qpos is not None and data.qvel is not None  # data.requirements saw to it
        # What the physics draws (a teleporter's exit), it draws from the key of the logged state, for all skills.
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(starts)
        extra = None if data.extra is None else data.extra[starts]
        return jax.vmap(one)(data.qpos[starts], data.qvel[starts], extra, keys, latent)


class LoggedStates:
    """Decode each skill along the logged states of its segment (DiveOff): no simulator.

    Args:
        horizon: H.
    """

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon

    def __call__(self, params: Any, data: DeviceData, starts: jax.Array, latent: jax.Array) -> jax.Array:
        """Return normalised observations[B, H + 1, obs] of the segments."""
        return logged_path(data, starts, self._horizon)


def logged_path(data: DeviceData, starts: jax.Array, horizon: int) -> jax.Array:
    """Return observations[B, H + 1, obs] of the segments of H rows at starts[B], the one behind the last included."""
    before = window(data.observations, starts, horizon)
    after = data.next_observations[starts + horizon - 1]
    return jnp.concatenate([before, after[:, None]], axis=1)
