"""What learners put around a task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.brax_base import Env, State


class AutoReset(Env):
    """Starts the next episode inside the step that ends one.

    After a step with ``done``, ``obs``, ``pipeline_state`` and the episode's ``info`` are of a fresh reset, drawn from
    a key that is never used twice, while reward, done, ``metrics`` and ``info["truncation"]`` tell of the ended episode
    and ``info["final_obs"]`` is its true last observation.

    Physics that is no longer finite ends the episode too: ``metrics["nan"]`` is 1, the episode counts as truncated and
    ``final_obs`` is the observation before the step, so that nothing non-finite reaches a learner.

    Wraps a single environment: put ``jax.vmap`` around this class's reset and step.
    """

    def __init__(self, env: Env) -> None:
        self.env = env

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not set yet, while unpickling or copying
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def observation_size(self) -> int:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.backend

    @property
    def unwrapped(self) -> Env:
        return self.env.unwrapped

    def reset(self, rng: jax.Array, **cells: Any) -> State:
        """The first episode's start; ``rng`` is a typed key.

        ``cells`` (``start_ij``, ``goal_ij``, ``ball_ij``) go to the task's reset and hold for this episode alone: those
        that follow have the task's own cells.
        """
        return _with_nan_count(self.env.reset(rng, **cells))

    def reset_to(self, *args: Any, **kwargs: Any) -> State:
        """As the task's ``reset_to``."""
        return _with_nan_count(self.env.reset_to(*args, **kwargs))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step, and the reset where it ends the episode."""
        after = self.env.step(state, action)
        bad = ~_is_finite((after.pipeline_state.qpos, after.pipeline_state.qvel, after.obs, after.reward))
        done = bad | (after.done > 0)
        fresh = self.env.reset(state.info["reset_key"])

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


def _with_nan_count(state: State) -> State:
    return state.replace(metrics=state.metrics | {"nan": jnp.zeros(())})


def _is_finite(tree: Any) -> jax.Array:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()
