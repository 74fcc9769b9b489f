"""The third phase: which skill each segment of the data played, by the frozen posterior."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from qdos_brax.config import Config
from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import window
from qdos_brax.networks import gaussian_sample
from qdos_brax.population import over_members
from qdos_brax.skills.vae import Segments, SkillModel


class LabelPhaseState(struct.PyTreeNode):
    """Labels so far, every leaf [members, ...]: key, z[S, latent], the next segment to label."""

    key: jax.Array
    latent: jax.Array
    position: jax.Array


class LabelPhase:
    """Infers z ~ q(z | tau) for every segment.

    Args:
        config: the run's configuration.
        data: the data set on the device.
        members: size of the population.
        model: posterior, prior and decoder.
        chunk_size: segments per chunk.
    """

    name = "label"
    part = "label"

    def __init__(
        self, config: Config, data: DeviceData, members: int, model: SkillModel, chunk_size: int = 16_384
    ) -> None:
        self._horizon, self._latent_dim = config.skills.horizon, config.skills.latent_dim
        self._data, self._model = data, model
        self._total = data.starts.shape[0]
        self._size = min(chunk_size, self._total)
        self.num_chunks = -(-self._total // self._size)
        self._chunk = jax.jit(over_members(self._label, members), donate_argnums=0)

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> LabelPhaseState:
        """No labels yet."""
        self._skills = artifacts["skills"]
        members = key.shape[0]
        latent = jnp.zeros((members, self._total, self._latent_dim))
        return LabelPhaseState(key, latent, jnp.zeros(members, jnp.int32))

    def chunk(self, state: LabelPhaseState) -> tuple[LabelPhaseState, dict[str, np.ndarray]]:
        """Labels the next ``chunk_size`` segments."""
        state = self._chunk(state, self._skills, self._data)
        return state, {"update": np.asarray(state.position)}

    def finish(self, state: LabelPhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Adds the labels, float32[members, S, latent]."""
        return artifacts | {"labels": state.latent}

    def _label(self, state: LabelPhaseState, skills: Any, data: DeviceData) -> LabelPhaseState:
        # The last chunk is moved back so that it is full; what it labels twice just gets a new sample.
        first = jnp.minimum(state.position, self._total - self._size)
        starts = jax.lax.dynamic_slice(data.starts, (first,), (self._size,))
        key, sample_key = jax.random.split(state.key)

        def encode(start: jax.Array) -> tuple[jax.Array, jax.Array]:
            segment = window((data.observations, data.actions), start[None], self._horizon)
            mean, log_std = self._model.encode(skills, Segments(*segment))
            return mean[0], log_std[0]

        mean, log_std = jax.lax.map(encode, starts, batch_size=min(1024, self._size))
        latent = gaussian_sample(sample_key, mean, log_std)
        return LabelPhaseState(key, jax.lax.dynamic_update_slice(state.latent, latent, (first, 0)), first + self._size)
