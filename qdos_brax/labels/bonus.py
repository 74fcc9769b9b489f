"""The bonus for novelty that is added to rewards: two options behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.labels.rnd import RND, RNDState


class Bonus(Protocol):
    """Define a bonus that may learn from online rows. ``hyper`` is one member's numbers by dotted key."""

    def init(self, key: jax.Array) -> Any:
        """Return what the bonus carries between steps."""
        ...

    def learn(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array], active: jax.Array
    ) -> Any:
        """Make one gradient step on online rows[B], if ``active``."""
        ...

    def of(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]
    ) -> jax.Array | float:
        """Return what rows[B] earn beside their reward, [B] or one number for all."""
        ...


class NoBonus:
    """Give no bonus (RLPD)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Return nothing to carry."""
        return {}

    def learn(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array], active: jax.Array
    ) -> Any:
        """Return ``state`` as it is."""
        return state

    def of(self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]) -> float:
        """Return 0."""
        return 0.0


class RNDBonus:
    """Give the error of random network distillation as a bonus.

    Args:
        rnd: its networks.
        see: what they are shown of normalised observations[..., obs].
    """

    def __init__(self, rnd: RND, see: Callable[[jax.Array], jax.Array]) -> None:
        self._rnd, self._see = rnd, see

    def init(self, key: jax.Array) -> RNDState:
        """Return fresh networks."""
        return self._rnd.init(key)

    def learn(
        self,
        state: RNDState,
        observation: jax.Array,
        action: jax.Array,
        hyper: dict[str, jax.Array],
        active: jax.Array,
    ) -> RNDState:
        """Make one step of the predictor."""
        new = self._rnd.update(state, self._see(observation), action, hyper["labels.rnd_learning_rate"])
        return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, state)

    def of(self, state: RNDState, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]) -> jax.Array:
        """Return the coefficient times the predictor's error, [B]."""
        error = self._rnd.error(state.predictor, state.target, self._see(observation), action)
        return hyper["labels.rnd_coefficient"] * error
