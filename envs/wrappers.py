"""Wrap a task for learners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from envs.brax_base import Env, State


class _Wrapper(Env):
    """Stand for another environment in all that a subclass does not change."""

    def __init__(self, env: Env) -> None:
        self.env = env

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not set yet, while unpickling or copying
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def observation_size(self) -> int:
        """Return the numbers per observation."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Return the numbers per action."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Return the engine's name."""
        return self.env.backend

    @property
    def unwrapped(self) -> Env:
        """Return the task."""
        return self.env.unwrapped


class AutoReset(_Wrapper):
    """Start the next episode inside the step that ends one.

    After a step with ``done``, ``obs``, ``pipeline_state`` and the episode's ``info`` are of a fresh reset, drawn from
    a key that is never used twice, while reward, done, ``metrics`` and ``info["truncation"]`` are of the ended episode
    and ``info["final_obs"]`` is its true last observation.

    Physics that is no longer finite ends the episode too: ``metrics["nan"]`` is 1, the episode counts as truncated and
    ``final_obs`` is the observation before the step, so that nothing non-finite reaches a learner.

    Wraps a single environment: put ``jax.vmap`` around this class's reset and step.
    """

    def reset(self, rng: jax.Array, **options: Any) -> State:
        """Return the first episode's start; ``rng`` is a typed key.

        ``options`` (a maze's ``start_ij``, ``goal_ij``, ``ball_ij``) go to the task's reset and hold for this episode
        alone: those that follow start as the task does.
        """
        return _with_nan_count(self.env.reset(rng, **options))

    def reset_to(self, *args: Any, **kwargs: Any) -> State:
        """Return the state that the task's ``reset_to`` makes."""
        return _with_nan_count(self.env.reset_to(*args, **kwargs))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step, and after the reset where it ends the episode."""
        after = self.env.step(state, action)
        bad = ~_is_finite((after.pipeline_state.qpos, after.pipeline_state.qvel, after.obs, after.reward))
        done = bad | (after.done > 0)
        fresh = _when_any(self.env.reset)(done, state.info["reset_key"])

        def start_anew(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda n, o: jnp.where(done, n, o), new, old)

        info = start_anew(fresh.info, after.info) | {
            "truncation": jnp.where(bad, 1.0, after.info["truncation"]),
            "final_obs": jnp.where(bad, state.obs, after.obs),
        }
        return after.replace(
            pipeline_state=start_anew(fresh.pipeline_state, after.pipeline_state),
            obs=start_anew(fresh.obs, after.obs),
            reward=jnp.where(jnp.isfinite(after.reward), after.reward, 0.0),
            done=done.astype(after.done.dtype),
            metrics=after.metrics | {"nan": bad.astype(jnp.float32)},
            info=info,
        )


class BesideBody(_Wrapper):
    """Put beside each observation what the task's body sees from where it is (``Frame.beside``).

    Args:
        env: a task that offers a ``body_frame``.
    """

    def reset(self, rng: jax.Array, **options: Any) -> State:
        """Return an episode's start; ``options`` go to the task's reset."""
        return self._seen(self.env.reset(rng, **options))

    def reset_to(self, *args: Any, **kwargs: Any) -> State:
        """Return the state that the task's ``reset_to`` makes."""
        return self._seen(self.env.reset_to(*args, **kwargs))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step."""
        return self._seen(self.env.step(state, action))

    @property
    def observation_size(self) -> int:
        """Return the numbers per observation, those beside it included."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    def show(self, observation: jax.Array) -> jax.Array:
        """Return float[..., obs + k], the task's ``observation[..., obs]`` and what stands beside it."""
        return jnp.concatenate([observation, self.env.body_frame.beside(observation)], axis=-1)

    def _seen(self, state: State) -> State:
        # Once: of a task, which nothing resets, final_obs is obs.
        seen = self.show(state.obs)
        return state.replace(obs=seen, info=state.info | {"final_obs": seen})


def _when_any(reset: Callable[[jax.Array], State]) -> Callable[[jax.Array, jax.Array], State]:
    """Return ``reset`` as a function of (wanted, key) that is skipped, and gives zeros, unless some of a batch want it.

    Few steps end an episode, and a reset can cost as much as a step. Under ``vmap`` an ordinary ``cond`` would compute
    both branches; here the batch decides together, through any number of axes.
    """

    @jax.custom_batching.custom_vmap
    def conditional(wanted: jax.Array, key: jax.Array) -> State:
        shapes = jax.eval_shape(reset, key)

        def nothing(key: jax.Array) -> State:
            return jax.tree.map(lambda leaf: _blank(leaf, key), shapes)

        return jax.lax.cond(wanted, reset, nothing, key)

    @conditional.def_vmap
    def batched(size: int, is_batched: list[bool], wanted: jax.Array, key: jax.Array) -> tuple[State, Any]:
        if not is_batched[1]:
            key = jnp.broadcast_to(key, (size, *key.shape))
        any_wanted = wanted.any(axis=0) if is_batched[0] else wanted
        out = _when_any(jax.vmap(reset))(any_wanted, key)
        return out, jax.tree.map(lambda _: True, out)

    return conditional


def _blank(leaf: jax.ShapeDtypeStruct, key: jax.Array) -> jax.Array:
    """Return zeros, or where a key is wanted, the one at hand."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(key, leaf.shape)
    return jnp.zeros(leaf.shape, leaf.dtype)


def _with_nan_count(state: State) -> State:
    return state.replace(metrics=state.metrics | {"nan": jnp.zeros(())})


def _is_finite(tree: Any) -> jax.Array:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()
