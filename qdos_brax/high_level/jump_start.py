"""Jump-start (JSRL, Uchendu et al. 2022): a guide learned from the data acts for an episode's first steps.

The number of steps is SUPE's for its baseline (Wilcoxson et al. 2025, their published code): an episode is guided at
all with probability ``ratio``, and a guide that acted goes on after each step with probability ``persistence``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


class JumpStart:
    """Schedule a guide for the first steps of episodes.

    Args:
        sample: (parameters, key, normalised observation[..., obs]) -> action[..., act] of the guide.
        ratio: probability that an episode is guided.
        persistence: probability that the guide goes on after a step, below 1.
    """

    def __init__(
        self, sample: Callable[[Any, jax.Array, jax.Array], jax.Array], ratio: float, persistence: float
    ) -> None:
        self.sample = sample
        self._ratio, self._persistence = ratio, persistence

    def draw(self, key: jax.Array, episodes: int) -> jax.Array:
        """Return int32[episodes], how many first steps of each the guide takes: 0, or geometric from 1 on."""
        guided_key, length_key = jax.random.split(key)
        guided = jax.random.bernoulli(guided_key, self._ratio, (episodes,))
        length = jax.random.geometric(length_key, 1 - self._persistence, (episodes,), jnp.int32)
        return jnp.where(guided, length, 0)
