"""A ring buffer on the device, for any pytree of transitions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


class Replay(struct.PyTreeNode):
    """Hold a ring buffer.

    Attributes:
        data: pytree of arrays [capacity, ...]; slots not yet written hold NaN (floats), so that reading one is loud.
        position: int32, the next slot to write.
        size: int32, slots written so far, at most the capacity.
    """

    data: Any
    position: jax.Array
    size: jax.Array


def create(example: Any, capacity: int) -> Replay:
    """Return an empty buffer for rows shaped like ``example`` (one transition, no leading axis)."""

    def allocate(x: jax.Array) -> jax.Array:
        x = jnp.asarray(x)
        blank = jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else 0
        return jnp.full((capacity, *x.shape), blank, x.dtype)

    # Two arrays, not one twice: a donated buffer must appear once.
    return Replay(jax.tree.map(allocate, example), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def insert(replay: Replay, rows: Any, valid: jax.Array | None = None) -> Replay:
    """Write ``rows`` (leading axis n <= capacity) at the position, over the oldest.

    Args:
        replay: the buffer.
        rows: pytree of arrays [n, ...].
        valid: bool[n] or None; rows that are not valid are left out.
    """
    capacity = jax.tree.leaves(replay.data)[0].shape[0]
    n = jax.tree.leaves(rows)[0].shape[0]
    if valid is None:
        valid = jnp.ones(n, bool)
    rank = jnp.cumsum(valid) - 1
    slots = jnp.where(valid, (replay.position + rank) % capacity, capacity)  # out of range = dropped
    data = jax.tree.map(lambda buffer, x: buffer.at[slots].set(x, mode="drop"), replay.data, rows)
    count = jnp.sum(valid).astype(jnp.int32)
    return Replay(data, (replay.position + count) % capacity, jnp.minimum(replay.size + count, capacity))


def sample(replay: Replay, key: jax.Array, n: int) -> Any:
    """Return ``n`` rows, uniformly with replacement; an empty buffer gives NaN rows."""
    index = jax.random.randint(key, (n,), 0, jnp.maximum(replay.size, 1))
    return jax.tree.map(lambda buffer: buffer[index], replay.data)
