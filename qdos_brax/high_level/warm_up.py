"""The first environment steps online: who acts, and whether the high level learns from them already."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp


class WarmUp(Protocol):
    """Define the first environment steps."""

    def action(self, env_steps: jax.Array, first: jax.Array, own: jax.Array) -> jax.Array:
        """Return the decision to play after ``env_steps``: ``first``, a random one, or the high level's ``own``."""
        ...

    def learns(self, env_steps: jax.Array) -> jax.Array | bool:
        """Return whether the high level learns after ``env_steps``."""
        ...


class RandomWarmUp:
    """Play random skills or actions first, and learn from the first step on.

    Args:
        env_steps: length of the warm-up.
    """

    def __init__(self, env_steps: int) -> None:
        self._env_steps = env_steps

    def action(self, env_steps: jax.Array, first: jax.Array, own: jax.Array) -> jax.Array:
        """Return the random decision until the warm-up is over."""
        return jnp.where(env_steps < self._env_steps, first, own)

    def learns(self, env_steps: jax.Array) -> jax.Array | bool:
        """Return True."""
        return True


class OfflineWarmUp:
    """Play what was learned offline, and learn only once it has been seen online (WSRL, Zhou et al. 2025; Q-chunking).

    Args:
        env_steps: length of the warm-up.
    """

    def __init__(self, env_steps: int) -> None:
        self._env_steps = env_steps

    def action(self, env_steps: jax.Array, first: jax.Array, own: jax.Array) -> jax.Array:
        """Return the high level's own decision."""
        return own

    def learns(self, env_steps: jax.Array) -> jax.Array | bool:
        """Return whether the warm-up is over."""
        return env_steps > self._env_steps
