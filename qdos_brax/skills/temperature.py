"""The temperature lambda of the weights exp(A / lambda): a number, or what gives a share of effective segments.

With ``skills.advantage_temperature=auto`` lambda is where the effective sample size of the weights, (sum w)^2 over
sum w^2, is ``skills.effective_share`` of the segments. It grows with lambda, from the share of the best to all, and is
found by bisection of log lambda, once, on the logged advantages of all segments. Of normal scores
(``skills.advantage_scale=rank``) without a clip the answer is 1 / sqrt(-log share), which holds for the scores within a
batch too (``skills.advantage=latent``).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from qdos_brax.config import is_auto
from qdos_brax.skills.weights import advantage_weights

LOWEST, HIGHEST, HALVINGS = 1e-2, 1e2, 40


def effective_share(weight: jax.Array) -> jax.Array:
    """Return the effective sample size of weights[B] over B (Kish 1965)."""
    return jnp.sum(weight) ** 2 / jnp.sum(weight**2) / weight.shape[0]


def temperature_for(advantage: jax.Array, share: Any, clip: Any) -> jax.Array:
    """Return lambda in [0.01, 100] at which the weights of advantage[B], clipped at ``clip``, have this share."""

    def halve(_: int, bounds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bounds
        middle = (low + high) / 2
        short = effective_share(advantage_weights(advantage, jnp.exp(middle), clip)) < share
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    bounds = jnp.log(jnp.asarray(LOWEST)), jnp.log(jnp.asarray(HIGHEST))
    low, high = jax.lax.fori_loop(0, HALVINGS, halve, bounds)
    return jnp.exp((low + high) / 2)


def member_temperature(advantage: jax.Array, hyper: dict[str, jax.Array]) -> jax.Array:
    """Return one member's lambda for advantages[B]: its number, or what auto finds."""
    given = hyper["skills.advantage_temperature"]
    found = temperature_for(advantage, hyper["skills.effective_share"], hyper["skills.weight_clip"])
    return jnp.where(is_auto(given), found, given)
