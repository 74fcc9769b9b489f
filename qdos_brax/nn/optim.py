"""The optimiser step that every learner takes: Adam with a learning rate that may be traced, and Polyak averaging."""

from __future__ import annotations

from typing import Any

import jax
import optax

Params = Any

ADAM = optax.scale_by_adam()


def adam_step(params: Params, opt_state: optax.OptState, grads: Params, learning_rate: Any) -> tuple[Params, Any]:
    """Make one Adam step with a learning rate that may be traced: (new parameters, new optimiser state)."""
    updates, opt_state = ADAM.update(grads, opt_state, params)
    return jax.tree.map(lambda p, u: p - learning_rate * u, params, updates), opt_state


def rate_schedule(name: str, steps: int) -> optax.Schedule:
    """Return the factor on a learning rate by the step: "constant" is 1, "cosine" falls from 1 to 0 at ``steps``."""
    return optax.constant_schedule(1.0) if name == "constant" else optax.cosine_decay_schedule(1.0, steps)


def polyak(target: Params, params: Params, rate: jax.Array | float) -> Params:
    """Return ``target`` moved towards ``params`` by ``rate`` of the way."""
    return jax.tree.map(lambda t, p: t + rate * (p - t), target, params)


def running_mean(mean: Params, params: Params, share: jax.Array | float) -> Params:
    """Return ``mean`` moved towards ``params`` by ``share`` of the way.

    It is exactly ``params`` if that is 1, which ``polyak`` misses by a last bit.
    """
    return jax.tree.map(lambda m, p: (1 - share) * m + share * p, mean, params)
