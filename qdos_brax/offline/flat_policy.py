"""What plays a flat policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from qdos_brax.data.device import Normaliser


@dataclass(frozen=True)
class FlatPolicy:
    """Decide at every step (``qdos_brax.high_level.agent.Policy`` with H = 1): a decision is an action.

    Attributes:
        normaliser: of observations.
        act: (parameters, normalised observation) -> action.
        params: parameters of the policy.
    """

    normaliser: Normaliser
    act: Callable[[Any, jax.Array], jax.Array]
    params: Any

    def choose(self, observation: jax.Array) -> jax.Array:
        """Return the action[..., act] at observation[..., obs]."""
        return self.act(self.params, self.normaliser(observation))

    def play(self, observation: jax.Array, latent: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the decision itself."""
        return latent
