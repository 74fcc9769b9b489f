"""The bonus for novelty that is added to rewards: two options behind one interface."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.labels.rnd import RND, RNDState


class Bonus(Protocol):
    """A bonus; it may learn from online rows. ``hyper`` is one member's numbers by dotted key."""

    def init(self, key: jax.Array) -> Any:
        """What it carries."""
        ...

    def learn(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array], active: jax.Array
    ) -> Any:
        """One gradient step on online rows[B], if ``active``."""
        ...

    def of(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]
    ) -> jax.Array | float:
        """What rows[B] earn beside their reward, [B] or one number for all."""
        ...


class NoBonus:
    """None (RLPD)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Carries nothing."""
        return {}

    def learn(
        self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array], active: jax.Array
    ) -> Any:
        """Learns nothing."""
        return state

    def of(self, state: Any, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]) -> float:
        """0."""
        return 0.0


class RNDBonus:
    """Random network distillation.

    Args:
        rnd: its networks.
    """

    def __init__(self, rnd: RND) -> None:
        self._rnd = rnd

    def init(self, key: jax.Array) -> RNDState:
        """Fresh networks."""
        return self._rnd.init(key)

    def learn(
        self,
        state: RNDState,
        observation: jax.Array,
        action: jax.Array,
        hyper: dict[str, jax.Array],
        active: jax.Array,
    ) -> RNDState:
        """One step of the predictor."""
        new = self._rnd.update(state, observation, action, hyper["labels.rnd_learning_rate"])
        return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, state)

    def of(self, state: RNDState, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]) -> jax.Array:
        """The coefficient times the predictor's error, [B]."""
        error = self._rnd.error(state.predictor, state.target, observation, action)
        return hyper["labels.rnd_coefficient"] * error
