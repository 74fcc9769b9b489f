"""One decision of the high level: a skill, played for H environment steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.brax_base import Env, State


class MacroStep(NamedTuple):
    """Hold what a macro step brought; scalars but for the observation.

    Attributes:
        reward: sum of discounted environment rewards over the live steps.
        mask: 0 if the episode terminated within it; a cut-off episode keeps 1.
        next_observation: [obs], after the last live step.
        steps: live environment steps, 1 to H.
        episode_return: undiscounted sum of rewards over the live steps.
        success: 1 if the goal was reached.
        finite: False if the simulation broke; such a step must not be learned from.
        track: what was recorded of each of the H environment steps, leaves [H, ...].
    """

    reward: jax.Array
    mask: jax.Array
    next_observation: jax.Array
    steps: jax.Array
    episode_return: jax.Array
    success: jax.Array
    finite: jax.Array
    track: Any = None


class InnerStep(NamedTuple):
    """Hold one environment step within a macro step.

    Attributes:
        observation: [obs], before the step, as the environment gives it.
        action: [act].
        reward: of the step, 0 if it is idle.
        live: 1 if the episode was still going on, otherwise 0.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    live: jax.Array


def no_record(step: InnerStep) -> None:
    """Keep nothing."""


def macro_step(
    env: Env,
    policy: Callable[[jax.Array, jax.Array], jax.Array],
    state: State,
    horizon: int,
    discount: jax.Array | float,
    record: Callable[[InnerStep], Any] = no_record,
) -> tuple[State, MacroStep]:
    """Play ``policy`` for ``horizon`` steps of one environment, batched by ``jax.vmap``; it is a function of the
    observation and of the number of steps before.

    An episode that ends early idles to the end of the macro step: its state stays, and only live steps count; a task
    that can (``Task.idle``) spends no physics on it. The environment is not reset. A state that is done already gives
    a macro step of no live steps and reward 0.

    ``record`` says what is kept of each environment step, idle ones included, as the result's ``track``.
    """

    idle = getattr(env, "idle", lambda state, over: state)

    def step(carry: tuple[State, MacroStep], index: jax.Array) -> tuple[tuple[State, MacroStep], Any]:
        state, result = carry
        alive = state.done < 0.5
        action = policy(state.obs, index)
        new = env.step(idle(state, ~alive), action)
        finite = jnp.all(jnp.isfinite(new.obs)) & jnp.isfinite(new.reward)
        terminated = (new.done > 0.5) & (new.info["truncation"] < 0.5)
        live = alive.astype(jnp.float32)
        # An idle state is not finite, nor is what a task computes of it, and 0 times NaN is NaN.
        reward, success = (jnp.where(alive, value, 0.0) for value in (new.reward, new.metrics["success"]))
        result = MacroStep(
            reward=result.reward + discount**index * reward,
            mask=jnp.where(alive & terminated, 0.0, result.mask),
            next_observation=jnp.where(alive, new.info["final_obs"], result.next_observation),
            steps=result.steps + alive.astype(jnp.int32),
            episode_return=result.episode_return + reward,
            success=jnp.maximum(result.success, success),
            finite=result.finite & (finite | ~alive),
        )
        recorded = record(InnerStep(state.obs, action, reward, live))
        return (jax.tree.map(lambda a, b: jnp.where(alive, a, b), new, state), result), recorded

    zero = jnp.zeros(())
    start = MacroStep(zero, jnp.ones(()), state.obs, jnp.zeros((), jnp.int32), zero, zero, jnp.ones((), bool))
    (state, result), track = jax.lax.scan(step, (state, start), jnp.arange(horizon))
    return state, result._replace(track=track)


def reset_done(env: Env, state: State, broken: jax.Array, key: jax.Array) -> State:
    """Return a fresh episode where the old one is over or the simulation broke; for one environment."""
    fresh = env.reset(key)
    over = (state.done > 0.5) | broken
    return jax.tree.map(lambda a, b: jnp.where(over, a, b), fresh, state)
