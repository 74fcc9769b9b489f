"""A critic of single actions within a skill, and the correction of actions that it asks for.

Q(s, w, k, a) is what a macro step still brings when its skill w, k steps old, takes action a in s, in the macro step's
own account: sum_{j>=k} discount^j r_j + discount V(s'), with V the high level's value where the macro step ends. At
k = 0 it is the high level's Q(s, u). Skill-Critic (Hao et al. 2024, arXiv 2306.08388, eq. 8 to 10) has the same two
critics and bootstraps likewise, one step at a time; here returns within the macro step are lambda-returns.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.nn.networks import Ensemble
from qdos_brax.nn.optim import ADAM, Params, adam_step, polyak


class Tracks(NamedTuple):
    """Hold macro steps with their environment steps (B of them, or one without that axis); observations are normalised.

    Attributes:
        observations: float32[B, H, obs].
        actions: float32[B, H, act], as played.
        rewards: float32[B, H].
        live: float32[B, H], 0 for steps after the episode's end.
        skill: float32[B, s], the skill that was begun.
        mask: float32[B], 0 if the episode terminated.
        next_observation: float32[B, obs], after the last live step.
    """

    observations: jax.Array
    actions: jax.Array
    rewards: jax.Array
    live: jax.Array
    skill: jax.Array
    mask: jax.Array
    next_observation: jax.Array


class SkillCriticState(struct.PyTreeNode):
    """Hold parameters of the heads, of their targets, and Adam's state."""

    critic: Params
    target_critic: Params
    opt_state: optax.OptState


class SkillCritic:
    """Regress Q(s, w, k, a) by heads that each bootstrap from themselves, so that they disagree where data is thin.

    Args:
        input_dim: width of observation, context and action together.
        hidden: hidden layers of each head.
        heads: how many.
        value_scale: Q per unit of a head's output.
    """

    def __init__(self, input_dim: int, hidden: tuple[int, ...], heads: int, value_scale: float) -> None:
        self._input_dim, self._scale = input_dim + 1, value_scale
        self._heads = Ensemble(hidden, heads)

    def init(self, key: jax.Array) -> SkillCriticState:
        """Return fresh parameters; the targets start as a copy."""
        critic = self._heads.init(key, jnp.zeros((1, self._input_dim)))
        return SkillCriticState(critic, jax.tree.map(jnp.copy, critic), ADAM.init(critic))

    def values(self, critic: Params, observation: jax.Array, context: jax.Array, action: jax.Array) -> jax.Array:
        """Return Q of every head, [heads, B, H], at every step of macro steps.

        Args:
            critic: parameters.
            observation: float32[B, H, obs].
            context: float32[B, H, c], what is known of the skill.
            action: float32[B, H, act].
        """
        horizon = observation.shape[-2]
        age = jnp.broadcast_to((jnp.arange(horizon) / horizon)[:, None], (*observation.shape[:-1], 1))
        return self._scale * self._heads.apply(critic, jnp.concatenate([observation, context, age, action], axis=-1))

    def update(
        self,
        state: SkillCriticState,
        tracks: Tracks,
        context: jax.Array,
        targets: jax.Array,
        learning_rate: jax.Array | float,
        target_rate: jax.Array | float,
    ) -> tuple[SkillCriticState, jax.Array]:
        """Make one step of every head towards targets[heads, B, H]: (the state after, mean squared error)."""

        def loss(critic: Params) -> jax.Array:
            error = self.values(critic, tracks.observations, context, tracks.actions) - targets
            return live_mean(jnp.sum(error**2, axis=0), tracks.live)

        value, grads = jax.value_and_grad(loss)(state.critic)
        critic, opt_state = adam_step(state.critic, state.opt_state, grads, learning_rate)
        target_critic = polyak(state.target_critic, critic, target_rate)
        return SkillCriticState(critic, target_critic, opt_state), value / targets.shape[0]


def live_mean(values: jax.Array, live: jax.Array) -> jax.Array:
    """Return the mean of values[B, H] over the live steps."""
    return jnp.sum(values * live) / jnp.maximum(jnp.sum(live), 1.0)


def macro_returns(
    tracks: Tracks, discount: jax.Array | float, trace: jax.Array | float, end: jax.Array, later: jax.Array
) -> jax.Array:
    """Return lambda-returns[heads, B, H] within macro steps, in the account of ``skill_critic``.

    G_k = discount^k r_k + (1 - trace) Q_{k+1} + trace G_{k+1}; after the last live step follows discount mask V.

    Args:
        tracks: the macro steps.
        discount: of the high level.
        trace: lambda; 1 uses no Q within the macro step.
        end: float32[B], V at ``next_observation``.
        later: float32[heads, B, H], Q at every step under the policy; that of step 0 is not read.
    """
    horizon = tracks.live.shape[-1]
    going = jnp.concatenate([tracks.live[:, 1:], jnp.zeros_like(tracks.live[:, :1])], axis=1)  # a live step follows
    weighted = discount ** jnp.arange(horizon) * tracks.rewards * tracks.live
    after = jnp.concatenate([later[..., 1:], jnp.zeros_like(later[..., :1])], axis=-1)
    last = discount * tracks.mask * end

    def step(following: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        reward, goes_on, value = now  # [B], [B], [heads, B]
        rest = jnp.where(goes_on > 0, (1 - trace) * value + trace * following, last)
        return reward + rest, reward + rest

    steps = (weighted.T, going.T, jnp.moveaxis(after, -1, 0))
    _, returns = jax.lax.scan(step, jnp.zeros(later.shape[:-1]), steps, reverse=True)
    return jnp.moveaxis(returns, 0, -1)


def sure_gain(corrected: jax.Array, frozen: jax.Array) -> jax.Array:
    """Return the least gain[B, H] over heads of a corrected action, min_i [Q_i(corrected) - Q_i(frozen)].

    Both are [heads, B, H]. It is 0 where nothing is corrected, and rises only in directions in which every head sees
    an improvement.
    """
    return jnp.min(corrected - frozen, axis=0)


def through_clip(action: jax.Array) -> jax.Array:
    """Return actions clipped to [-1, 1] whose gradient passes as if they were not, so that none is stuck outside."""
    return action + jax.lax.stop_gradient(jnp.clip(action, -1.0, 1.0) - action)
