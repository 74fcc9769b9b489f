"""The phase before the last: what each segment of the data played, by the frozen source, as the high level's action."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from qdos_brax.config import Config
from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import window
from qdos_brax.nn.networks import gaussian_sample
from qdos_brax.population.members import Population
from qdos_brax.population.memory import working_bytes
from qdos_brax.skills.source import SkillSource
from qdos_brax.skills.vae import Segments


class LabelPhaseState(struct.PyTreeNode):
    """Labels so far, every leaf [members, ...]: key, u[S, width], the next segment to label."""

    key: jax.Array
    action: jax.Array
    position: jax.Array


class LabelPhase:
    """Infers z ~ q(z | tau) for every segment, and the action u that plays it from the segment's first state.

    Args:
        config: the run's configuration.
        data: the data set on the device.
        population: the members.
        source: of low-level behaviour.
        chunk_size: segments per chunk.
    """

    name = "label"
    part = "label"

    def __init__(
        self,
        config: Config,
        data: DeviceData,
        population: Population,
        source: SkillSource,
        chunk_size: int = 16_384,
    ) -> None:
        self._horizon = config.skills.horizon
        self._data, self._hyper, self._source = data, population.hyper, source
        self._total = data.starts.shape[0]
        self._size = min(chunk_size, self._total)
        self.num_chunks = -(-self._total // self._size)
        self._start = population.program(self._init)
        self._chunk = population.program(self._label, carries=True)

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> LabelPhaseState:
        """No labels yet."""
        self._skills = artifacts.get("skills", {})
        state: LabelPhaseState = self._start(key, None)
        return state

    def chunk(self, state: LabelPhaseState) -> tuple[LabelPhaseState, dict[str, np.ndarray]]:
        """Labels the next ``chunk_size`` segments."""
        state, _ = self._chunk(state, self._skills, self._hyper, self._data)
        return state, {"update": np.asarray(state.position)}

    def working_bytes(self, state: Any) -> int:
        """What a chunk needs beside the state, which may be shapes alone."""
        return working_bytes(self._chunk, state, self._skills, self._hyper, self._data)

    def finish(self, state: LabelPhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Adds the labels, float32[members, S, width]."""
        return artifacts | {"labels": state.action}

    def _init(self, key: jax.Array, _: None) -> LabelPhaseState:
        return LabelPhaseState(key, jnp.zeros((self._total, self._source.width)), jnp.zeros((), jnp.int32))

    def _label(self, state: LabelPhaseState, skills: Any, hyper: Any, data: DeviceData) -> tuple[LabelPhaseState, None]:
        # The last chunk is moved back so that it is full; what it labels twice just gets a new sample.
        first = jnp.minimum(state.position, self._total - self._size)
        starts = jax.lax.dynamic_slice(data.starts, (first,), (self._size,))
        key, sample_key = jax.random.split(state.key)

        def encode(start: jax.Array) -> tuple[jax.Array, jax.Array]:
            segment = window((data.observations, data.actions), start[None], self._horizon)
            after = data.next_observations[start + self._horizon - 1]
            mean, log_std = self._source.posterior(skills, Segments(*segment), after[None])
            return mean[0], log_std[0]

        mean, log_std = jax.lax.map(encode, starts, batch_size=min(1024, self._size))
        latent = gaussian_sample(sample_key, mean, log_std)
        action = self._source.to_action(skills, latent, data.observations[starts], hyper["skills.latent_box"])
        labels = jax.lax.dynamic_update_slice(state.action, action, (first, 0))
        return LabelPhaseState(key, labels, first + self._size), None
