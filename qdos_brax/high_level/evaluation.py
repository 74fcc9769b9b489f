"""Evaluation: whole episodes on environments of their own, the actor's mode, no exploration."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_base import Env, State
from qdos_brax.high_level.macro_step import macro_step
from qdos_brax.runs.metrics import PART_DONE


class Episodes(NamedTuple):
    """Hold one entry per episode.

    Attributes:
        success: float[N], 0 or 1.
        episode_return: float[N], undiscounted.
        length: int[N], environment steps.
        score: float[N], the share of the task that was done by the end; None for tasks that are done or not.
        parts: bool[N] by name, which parts of the task are done at the end; None for tasks without parts.
    """

    success: jax.Array
    episode_return: jax.Array
    length: jax.Array
    score: jax.Array | None = None
    parts: dict[str, jax.Array] | None = None


def evaluate(
    env: Env,
    choose: Callable[[jax.Array], jax.Array],
    play: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
    key: jax.Array,
    episodes: int,
    horizon: int,
) -> Episodes:
    """Play ``episodes`` episodes side by side until all are over.

    Args:
        env: the task.
        choose: observation[obs] -> skill z[latent], asked every ``horizon`` steps.
        play: (observation[obs], z[latent], steps since it was chosen) -> action.
        key: for the starts.
        episodes: how many.
        horizon: environment steps per decision.
    """

    def one(state: State) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        latent = choose(state.obs)
        state, result = macro_step(env, lambda obs, step: play(obs, latent, step), state, horizon, 1.0)
        return state, result.success, result.episode_return, result.steps

    def going(carry: tuple[State, Episodes]) -> jax.Array:
        return jnp.any(carry[0].done < 0.5)

    def body(carry: tuple[State, Episodes]) -> tuple[State, Episodes]:
        state, totals = carry
        state, success, episode_return, steps = jax.vmap(one)(state)
        totals = Episodes(
            jnp.maximum(totals.success, success), totals.episode_return + episode_return, totals.length + steps
        )
        return state, totals

    start = jax.vmap(env.reset)(jax.random.split(key, episodes))
    zeros = jnp.zeros(episodes)
    first = Episodes(zeros, zeros, jnp.zeros(episodes, jnp.int32))
    # A state stays as it was when its episode was over.
    state, totals = jax.lax.while_loop(going, body, (start, first))
    parts = env.parts(state.pipeline_state) if hasattr(env, "parts") else None
    return totals._replace(score=state.metrics.get("score"), parts=None if parts is None else dict(parts))


def summary(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return columns of metrics.csv, [members] each, of episodes[members, N]."""
    success = np.asarray(episodes.success)
    score = {} if episodes.score is None else {"eval/score": np.asarray(episodes.score).mean(axis=-1)}
    parts = {f"{PART_DONE}{name}": np.mean(done, axis=-1) for name, done in (episodes.parts or {}).items()}
    return score | {
        "eval/success": success.mean(axis=-1),
        "eval/return": np.asarray(episodes.episode_return).mean(axis=-1),
        "eval/length": np.asarray(episodes.length).mean(axis=-1),
        "eval/episodes": np.full(success.shape[0], success.shape[-1]),
        **parts,
    }
