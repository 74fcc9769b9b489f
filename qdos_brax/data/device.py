"""Hold the data set on the device: loaded once, normalised once, shared by every member of a population."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from qdos_brax.data.dataset import Dataset
from qdos_brax.data.segments import episode_last, segment_starts


class Normaliser(struct.PyTreeNode):
    """Normalise by fixed statistics of the data: x -> (x - mean) / scale.

    Attributes:
        mean: float32[obs].
        scale: float32[obs], the standard deviation, at least 1e-3 (a constant column stays finite).
    """

    mean: jax.Array
    scale: jax.Array

    def __call__(self, observation: jax.Array) -> jax.Array:
        """Return ``observation[..., obs]`` normalised."""
        return (observation - self.mean) / self.scale

    def restored(self, observation: jax.Array) -> jax.Array:
        """Return normalised ``observation[..., obs]`` in the task's own units."""
        return observation * self.scale + self.mean

    def repeated(self, members: int) -> dict[str, jax.Array]:
        """Return its fields, with a leading axis of ``members`` copies."""
        fields = {"mean": self.mean, "scale": self.scale}
        return {name: jnp.broadcast_to(x, (members, *x.shape)) for name, x in fields.items()}


class DeviceData(struct.PyTreeNode):
    """Hold N transitions as device arrays; observations are normalised, rewards and masks are the task's.

    Attributes:
        observations: float32[N, obs].
        next_observations: float32[N, obs].
        actions: float32[N, act].
        rewards: float32[N].
        masks: float32[N].
        starts: int32[S], first rows of all windows of H steps inside one episode.
        last: int32[N], the last row of each row's episode.
        qpos: float32[N, nq], or None when the file holds no simulator states.
        qvel: float32[N, nv], or None.
        extra: int32[N, e], the discrete state, or None.
        labels: float32[S, width], one member's decisions u that the windows are labelled with, where a phase asks for
            them; else None.
    """

    observations: jax.Array
    next_observations: jax.Array
    actions: jax.Array
    rewards: jax.Array
    masks: jax.Array
    starts: jax.Array
    last: jax.Array
    qpos: jax.Array | None
    qvel: jax.Array | None
    extra: jax.Array | None = None
    labels: jax.Array | None = None


def fit_normaliser(dataset: Dataset) -> Normaliser:
    """Return the normaliser of a data set's own statistics."""
    mean = dataset.observations.mean(axis=0, dtype=np.float64).astype(np.float32)
    scale = np.maximum(dataset.observations.std(axis=0, dtype=np.float64), 1e-3).astype(np.float32)
    return Normaliser(jnp.asarray(mean), jnp.asarray(scale))


def to_device(dataset: Dataset, horizon: int, normaliser: Normaliser | None = None) -> tuple[DeviceData, Normaliser]:
    """Put ``dataset`` on the default device, normalised by ``normaliser`` (None: by its own statistics)."""
    normaliser = normaliser or fit_normaliser(dataset)
    data = DeviceData(
        observations=normaliser(jnp.asarray(dataset.observations)),
        next_observations=normaliser(jnp.asarray(dataset.next_observations)),
        actions=jnp.asarray(dataset.actions),
        rewards=jnp.asarray(dataset.rewards),
        masks=jnp.asarray(dataset.masks),
        starts=jnp.asarray(segment_starts(dataset.ends, horizon)),
        last=jnp.asarray(episode_last(dataset.ends)),
        qpos=None if dataset.qpos is None else jnp.asarray(dataset.qpos),
        qvel=None if dataset.qvel is None else jnp.asarray(dataset.qvel),
        extra=None if dataset.extra is None else jnp.asarray(dataset.extra),
    )
    return data, normaliser
