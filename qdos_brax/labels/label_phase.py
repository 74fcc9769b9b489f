"""The label phase: what each segment of the data played, by the frozen skills, as the high level's action."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import rows_ahead, window
from qdos_brax.nn.networks import gaussian_sample
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.low_level import LowLevelPolicy
from qdos_brax.skills.vae import Segments


class LabelPhaseState(struct.PyTreeNode):
    """Hold the labels so far, every leaf [members, ...].

    Attributes:
        key: typed key.
        action: float32[members, S, width], u of every segment.
        update: int32[members], the next segment to label.
        healthy: as the phases before left it.
    """

    key: jax.Array
    action: jax.Array
    update: jax.Array
    healthy: jax.Array


class LabelPhase(MemberPhase):
    """Infer z from q(z | tau) for every segment, and the action u that plays it from the segment's first state.

    Args:
        horizon: steps of a segment.
        total: S, segments of the data.
        low_level: the frozen low-level policy.
        latent: "sample" of the posterior, or its "mean".
        chunk_size: segments per chunk.
    """

    def __init__(
        self, horizon: int, total: int, low_level: LowLevelPolicy, latent: str = "sample", chunk_size: int = 16_384
    ) -> None:
        self._sampled = latent == "sample"
        self._horizon, self._total, self._low_level = horizon, total, low_level
        self._size = min(chunk_size, total)
        super().__init__("label", "label", -(-total // self._size))

    def constants(self, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the skills' parameters; {} for methods without skills."""
        return {"skills": artifacts.get("skills", {})}

    def metrics(self, state: LabelPhaseState, info: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return how many segments have their label."""
        return {"update": np.asarray(state.update)}

    def finish(self, state: LabelPhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the labels, float32[members, S, width]."""
        return artifacts | {"labels": state.action}

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> LabelPhaseState:
        """Return blank labels."""
        blank = jnp.zeros((self._total, self._low_level.width))
        return LabelPhaseState(key, blank, jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def train_member(
        self, state: LabelPhaseState, constants: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[LabelPhaseState, dict[str, jax.Array]]:
        """Label the next ``chunk_size`` segments."""
        skills = constants["skills"]
        # The last chunk is moved back so that it is full; what it labels twice just gets a new sample.
        first = jnp.minimum(state.update, self._total - self._size)
        starts = jax.lax.dynamic_slice(data.starts, (first,), (self._size,))
        key, sample_key = jax.random.split(state.key)

        def encode(start: jax.Array) -> tuple[jax.Array, jax.Array]:
            segment = window((data.observations, data.actions), start[None], self._horizon)
            after = data.next_observations[rows_ahead(start, data.last, self._low_level.reach or self._horizon)]
            mean, log_std = self._low_level.posterior(skills, Segments(*segment), after[None])
            return mean[0], log_std[0]

        mean, log_std = jax.lax.map(encode, starts, batch_size=min(1024, self._size))
        latent = gaussian_sample(sample_key, mean, log_std) if self._sampled else mean
        action = self._low_level.to_action(skills, latent, data.observations[starts], hyper["skills.latent_box"])
        labels = jax.lax.dynamic_update_slice(state.action, action, (first, 0))
        return state.replace(key=key, action=labels, update=first + self._size), {}
