"""The optimiser step that every learner takes: Adam with a learning rate that may be traced, and Polyak averaging."""

from __future__ import annotations

from typing import Any

import jax
import optax

Params = Any

ADAM = optax.scale_by_adam()


def adam_step(params: Params, moments: optax.OptState, grads: Params, learning_rate: Any) -> tuple[Params, Any]:
    """One Adam step with a learning rate that may be traced: (new parameters, new moments)."""
    updates, moments = ADAM.update(grads, moments, params)
    return jax.tree.map(lambda p, u: p - learning_rate * u, params, updates), moments


def polyak(target: Params, params: Params, rate: jax.Array | float) -> Params:
    """``target`` moved towards ``params`` by ``rate`` of the way."""
    return jax.tree.map(lambda t, p: t + rate * (p - t), target, params)
