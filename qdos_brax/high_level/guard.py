"""The guard of fine-tuned skills: which of two decoders an episode plays, by what their episodes earned lately."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

FROZEN, TUNED = 0, 1
_LEAST = 3.0  # episodes that must be counted of each before the tuned decoder can be preferred


class GuardState(struct.PyTreeNode):
    """Hold the comparison and what the episodes under way belong to.

    Attributes:
        tuned: bool[num_envs], whether the episode plays the tuned decoder.
        earned: float32[num_envs], return of the episode so far.
        episodes: float32[2], episodes counted of the frozen and of the tuned decoder; old ones count less.
        total: float32[2], the sum of their returns, weighted likewise.
    """

    tuned: jax.Array
    earned: jax.Array
    episodes: jax.Array
    total: jax.Array


class Guard:
    """Compare two decoders on episodes that take turns by chance.

    Episodes of both kinds are forgotten together, one part in ``window`` per episode that ends, whichever it played:
    both means are over the same stretch of training, so that a high level that gets better favours neither. The tuned
    decoder is preferred while its mean return is above that of the frozen one: on a sparse task all returns are equal
    before the first goal, and nothing is proven.

    Args:
        window: episodes after which one has lost most of its weight.
        trial_share: probability that an episode plays the decoder that is not preferred.
    """

    def __init__(self, window: int, trial_share: float) -> None:
        self._keep, self._share = 1 - 1 / window, trial_share

    def start(self, num_envs: int) -> GuardState:
        """Return a comparison without episodes; the first ones are the frozen decoder's."""
        return GuardState(jnp.zeros(num_envs, bool), jnp.zeros(num_envs), jnp.zeros(2), jnp.zeros(2))

    def means(self, state: GuardState) -> jax.Array:
        """Return the mean returns[2] of frozen and tuned decoder; nan where no episode was counted."""
        return jnp.where(state.episodes > 0, state.total / jnp.maximum(state.episodes, 1e-9), jnp.nan)

    def prefers_tuned(self, state: GuardState) -> jax.Array:
        """Return whether the tuned decoder is preferred, bool; not before some episodes of each were seen."""
        means = self.means(state)
        return (jnp.min(state.episodes) >= _LEAST) & (means[TUNED] > means[FROZEN])

    def observe(
        self, state: GuardState, key: jax.Array, earned: jax.Array, over: jax.Array, valid: jax.Array, tries: jax.Array
    ) -> GuardState:
        """Count what a macro step brought, and choose what the episodes that begin now play.

        Args:
            state: before.
            key: for the choice.
            earned: float32[num_envs], rewards of the macro step.
            over: bool[num_envs], whether the episode ended with it.
            valid: bool[num_envs], False where the simulation broke: such an episode is not counted.
            tries: bool, whether the tuned decoder is played at all yet.
        """
        earned = state.earned + jnp.where(valid, earned, 0.0)
        counted = (over & valid).astype(jnp.float32)
        kind = jnp.stack([~state.tuned, state.tuned]).astype(jnp.float32)  # [2, num_envs]
        keep = self._keep ** jnp.sum(counted)
        state = state.replace(
            episodes=keep * state.episodes + kind @ counted,
            total=keep * state.total + kind @ (counted * earned),
            earned=jnp.where(over, 0.0, earned),
        )
        share = jnp.where(self.prefers_tuned(state), 1 - self._share, self._share)
        drawn = jax.random.bernoulli(key, share, over.shape) & tries
        return state.replace(tuned=jnp.where(over, drawn, state.tuned))
