"""Cut windows of H steps: where they may start, how a batch is read, what reward and mask they have as one step."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.data.dataset import episode_bounds

Tree = TypeVar("Tree")


def segment_starts(ends: np.ndarray, horizon: int) -> np.ndarray:
    """Return int32[S], every t whose window [t, t + horizon) lies inside one episode.

    Args:
        ends: bool[N], the last row of each episode.
        horizon: steps per window, at least 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    bounds = episode_bounds(np.asarray(ends, bool))
    runs = [np.arange(first, stop - horizon + 1, dtype=np.int32) for first, stop in bounds]
    return np.concatenate(runs) if runs else np.zeros(0, np.int32)


def episode_last(ends: np.ndarray) -> np.ndarray:
    """Return int32[N], the last row of the episode that each row belongs to; ``ends``: bool[N], the last rows."""
    bounds = episode_bounds(np.asarray(ends, bool))
    return np.repeat(bounds[:, 1] - 1, bounds[:, 1] - bounds[:, 0]).astype(np.int32)


def window(tree: Tree, starts: jax.Array, horizon: int) -> Tree:
    """Return the windows that begin at ``starts[B]``: every leaf [N, ...] of ``tree`` becomes [B, horizon, ...].

    ``starts`` must come from ``segment_starts``, since an index past the end is clamped.
    """
    rows = starts[..., None] + jnp.arange(horizon)
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def rows_ahead(starts: jax.Array, last: jax.Array, steps: int) -> jax.Array:
    """Return the row whose next observation lies ``steps`` steps after each of the rows ``starts[B]``, or the last row
    of its episode; ``last``: int[N], the last row of each row's episode.
    """
    return jnp.minimum(starts + steps - 1, last[starts])


def macro_return(rewards: jax.Array, masks: jax.Array, discount: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a window's reward and mask as one macro step.

    The reward is the discounted sum over the live steps: all up to the first with mask 0, whose own reward counts.

    Args:
        rewards: float32[..., H].
        masks: float32[..., H], 0 where the episode terminates with that step.
        discount: per environment step.

    Returns:
        (reward[...], mask[...]); the mask is 0 when any step of the window terminates.
    """
    after = jnp.cumprod(masks, axis=-1)
    live = jnp.concatenate([jnp.ones_like(masks[..., :1]), after[..., :-1]], axis=-1)
    discounts = jnp.asarray(discount, rewards.dtype) ** jnp.arange(rewards.shape[-1])
    return jnp.sum(discounts * live * rewards, axis=-1), after[..., -1]
