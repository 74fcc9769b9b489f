"""Where the weight of a segment comes from: nowhere, from values learned before, or from a Q over skills.

One interface, so that the skill learner does not know which: ``init`` makes what learns, ``learn`` lets it learn from
a batch of segments, ``advantage`` judges one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.data.device import MacroRows
from qdos_brax.high_level.sac import ADAM, adam_step
from qdos_brax.networks import Ensemble
from qdos_brax.skills.weights import latent_advantage


class SegmentBatch(NamedTuple):
    """Segments to judge.

    Attributes:
        segment: int32[B], into the list of all segments.
        rows: the segments as macro transitions.
        latent: gives the posterior's mean[B, z]; a function, so that only who needs it pays for it.
    """

    segment: jax.Array
    rows: MacroRows
    latent: Callable[[], jax.Array]


class SegmentWeights(Protocol):
    """A source of advantages. ``artifacts`` are the value phase's: "value" and "advantage"."""

    def init(self, key: jax.Array) -> Any:
        """What it carries between gradient steps."""
        ...

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """One gradient step, if it learns."""
        ...

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Advantages[B], in units of their spread."""
        ...


class UniformWeights:
    """All segments count the same (SUPE, OPAL)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Carries nothing."""
        return {}

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """Learns nothing."""
        return state

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Advantage 0."""
        return jnp.zeros(batch.segment.shape[0])


class LoggedWeights(UniformWeights):
    """Advantages of all segments, computed once from the values ("segment" and "transition")."""

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Looks them up."""
        return artifacts["advantage"][batch.segment]


class LatentWeights:
    """Algorithm 1: Q(s_0, z) - V(s_0), with Q regressed on the H-step return along with the skills.

    Args:
        observation_dim: width of observations.
        latent_dim: dimension of z.
        hidden: hidden widths of Q.
        value: V as a function of (parameters, observations).
        horizon: H, the power of the discount in front of V(s_H).
    """

    def __init__(
        self,
        observation_dim: int,
        latent_dim: int,
        hidden: Sequence[int],
        value: Callable[[Any, jax.Array], jax.Array],
        horizon: int,
    ) -> None:
        self._width = observation_dim + latent_dim
        self._q = Ensemble(tuple(hidden), size=2)
        self._value, self._horizon = value, horizon

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Fresh parameters of Q and Adam's moments."""
        params = self._q.init(key, jnp.zeros((1, self._width)))
        return {"params": params, "moments": ADAM.init(params)}

    def learn(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any], hyper: dict[str, Any]) -> Any:
        """Regresses both heads on r_0 + .. + gamma^H V(s_H)."""
        bootstrap = self._value(artifacts["value"], batch.rows.next_observation)
        target = batch.rows.reward + hyper["values.discount"] ** self._horizon * batch.rows.mask * bootstrap
        inputs = self._inputs(batch)

        def loss(params: Any) -> jax.Array:
            return jnp.mean(jnp.sum((self._q.apply(params, inputs) - target) ** 2, axis=0))

        grads = jax.grad(loss)(state["params"])
        params, moments = adam_step(state["params"], state["moments"], grads, hyper["values.learning_rate"])
        return {"params": params, "moments": moments}

    def advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """``raw_advantage`` over the batch's standard deviation."""
        advantage = self.raw_advantage(state, batch, artifacts)
        return advantage / (jnp.std(advantage) + 1e-6)

    def raw_advantage(self, state: Any, batch: SegmentBatch, artifacts: dict[str, Any]) -> jax.Array:
        """Smaller head of Q minus V, [B], in units of reward."""
        q = self._q.apply(state["params"], self._inputs(batch)).min(axis=0)
        return latent_advantage(q, self._value(artifacts["value"], batch.rows.observation))

    def _inputs(self, batch: SegmentBatch) -> jax.Array:
        return jax.lax.stop_gradient(jnp.concatenate([batch.rows.observation, batch.latent()], axis=-1))
