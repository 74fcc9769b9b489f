"""Single transitions of the data, as the flat learners read them."""

from __future__ import annotations

import jax

from qdos_brax.data.device import DeviceData
from qdos_brax.skills.values import ValueBatch


def random_rows(data: DeviceData, key: jax.Array, size: int) -> jax.Array:
    """Return int32[size], rows of the data, uniform with replacement."""
    return jax.random.randint(key, (size,), 0, data.observations.shape[0])


def transitions(data: DeviceData, rows: jax.Array, discount: jax.Array | float) -> ValueBatch:
    """Return the one-step transitions of ``rows[B]``; the value of the next state counts ``discount``, or 0 after
    an end.
    """
    return ValueBatch(
        observation=data.observations[rows],
        action=data.actions[rows],
        reward=data.rewards[rows],
        discount=data.masks[rows] * discount,
        next_observation=data.next_observations[rows],
    )
