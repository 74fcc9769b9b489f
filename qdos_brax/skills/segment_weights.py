"""Where the weight of a segment comes from: nowhere, from values learned before, or from a Q over skills.

One interface, so that the skill learner does not know which: ``init`` makes what learns, ``learn`` lets it learn from
a batch of segments, ``advantage`` judges one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.nn.networks import Ensemble
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.skills.weights import scaled_advantage


class SegmentBatch(NamedTuple):
    """Hold segments to judge.

    Attributes:
        segment: int32[B], into the list of all segments.
        observation: float32[B, obs], their first observations, normalised.
        latent: gives the posterior's mean[B, z]; a function, so that only who needs it pays for it.
    """

    segment: jax.Array
    observation: jax.Array
    latent: Callable[[], jax.Array]


class SegmentWeights(Protocol):
    """Define where advantages come from. ``artifacts`` is the value phase's: "advantage", scaled, of all segments."""

    def init(self, key: jax.Array) -> Any:
        """Return what is carried between gradient steps."""
        ...

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """Make one gradient step, if there is something to learn; return the new state."""
        ...

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Return advantages[B], scaled (``scaled_advantage``)."""
        ...


class UniformWeights:
    """Weight all segments the same (SUPE, OPAL)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Return nothing to carry."""
        return {}

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """Return ``state`` as it is."""
        return state

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Return advantage 0 for every segment."""
        return jnp.zeros(batch.segment.shape[0])


class LoggedWeights(UniformWeights):
    """Weight segments by advantages that were computed once from the values ("segment" and "transition")."""

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Look up the segments' advantages."""
        return artifacts["advantage"][batch.segment]


class LatentWeights:
    """Weight segments by Q(s_0, z) - V(s_0), learned along with the skills (Algorithm 1).

    Q is V(s_0) + f(s_0, z), and f is regressed on the logged H-step advantages, which is to regress Q on the H-step
    returns: a whole Q would have to be known to a hundredth before its difference from V says anything.

    Args:
        observation_dim: width of observations.
        latent_dim: dimension of z.
        hidden: hidden widths of f.
        scale: of the advantages (``scaled_advantage``).
    """

    def __init__(self, observation_dim: int, latent_dim: int, hidden: Sequence[int], scale: str) -> None:
        self._width = observation_dim + latent_dim
        self._gain = Ensemble(tuple(hidden), size=2)
        self._scale = scale

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Return fresh parameters of f's two heads and Adam's state."""
        params = self._gain.init(key, jnp.zeros((1, self._width)))
        return {"params": params, "opt_state": ADAM.init(params)}

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """Regress both heads on the segments' own advantages."""
        target = artifacts["advantage"][batch.segment]
        inputs = self._inputs(batch)

        def loss(params: Any) -> jax.Array:
            return jnp.mean(jnp.sum((self._gain.apply(params, inputs) - target) ** 2, axis=0))

        grads = jax.grad(loss)(state["params"])
        params, opt_state = adam_step(state["params"], state["opt_state"], grads, hyper["values.learning_rate"])
        return {"params": params, "opt_state": opt_state}

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Return ``smaller_head``, scaled over the batch."""
        return scaled_advantage(self.smaller_head(state, batch), self._scale)

    def smaller_head(self, state: Any, batch: SegmentBatch) -> jax.Array:
        """Return the smaller of the two heads of Q minus V, [B], on the scale of the logged advantages."""
        return self._gain.apply(state["params"], self._inputs(batch)).min(axis=0)

    def _inputs(self, batch: SegmentBatch) -> jax.Array:
        return jax.lax.stop_gradient(jnp.concatenate([batch.observation, batch.latent()], axis=-1))
