"""The mutual-information term: what tells random skills apart, behind one interface; here as in the paper."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax

from qdos_brax.skills.information import StateSource
from qdos_brax.skills.vae import Segments, SkillModel


class Rollout(NamedTuple):
    """Hold random skills and where they led.

    Attributes:
        observations: [B, H + 1, obs], normalised, before each action and after the last.
        latent: z[B, latent].
        place: [B, latent], where z was drawn in a box of half side c; z itself where that is the absolute box.
        weight: [B], of the segments that they began at; 0 where the simulation broke.
    """

    observations: jax.Array
    latent: jax.Array
    place: jax.Array
    weight: jax.Array


class InformationTerm(Protocol):
    """Define a mutual-information term. The skill phase plays random skills at ``source``'s states, hands them over
    once, then makes some gradient steps.

    Attributes:
        source: where the states along a random skill come from.
    """

    source: StateSource

    def init(self, key: jax.Array) -> Any:
        """Return what the term learns and remembers by itself."""
        ...

    def receive(self, state: Any, params: Any, rollout: Rollout) -> tuple[Any, Any]:
        """Return the new state, and what ``loss`` takes of a batch of rollouts that ``params`` has just played."""
        ...

    def learn(self, state: Any, params: Any, segments: Segments, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        """Make one gradient step of what the term learns by itself; return the new state, and metrics."""
        ...

    def loss(self, params: Any, state: Any, played: Any, key: jax.Array) -> jax.Array:
        """Return the loss of the skill model's parameters, a scalar."""
        ...


class SegmentTerm:
    """Identify skills by the posterior of the trajectory VAE, from states and actions (paper, eq. 5).

    Args:
        model: the skills.
        source: where the states along a random skill come from.
    """

    def __init__(self, model: SkillModel, source: StateSource) -> None:
        self.source, self._model = source, model

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Return nothing: the posterior is the skill model's own."""
        return {}

    def receive(self, state: Any, params: Any, rollout: Rollout) -> tuple[Any, Rollout]:
        """Return the rollouts as they are."""
        return state, rollout

    def learn(self, state: Any, params: Any, segments: Segments, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        """Return ``state`` as it is."""
        return state, {}

    def loss(self, params: Any, state: Any, played: Rollout, key: jax.Array) -> jax.Array:
        """Return ``SkillModel.information_loss``."""
        return self._model.information_loss(params, played.observations[:, :-1], played.latent, played.weight)
