"""Flows from noise to data: the velocity field, and its integration forwards and back (Lipman et al. 2023)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp


class VelocityField(nn.Module):
    """Compute v(s, x, t), the velocity of x at time t in [0, 1], by dense layers with GELU (Park et al. 2025, FQL).

    Attributes:
        hidden: hidden widths.
        dim: width of x.
    """

    hidden: Sequence[int]
    dim: int

    @nn.compact
    def __call__(self, observation: jax.Array, x: jax.Array, time: jax.Array) -> jax.Array:
        """Maps observation[..., obs], x[..., dim] and time[...] to the velocity[..., dim]."""
        y = jnp.concatenate([observation, x, time[..., None]], axis=-1)
        for width in self.hidden:
            y = nn.gelu(nn.Dense(width)(y))
        return nn.Dense(self.dim)(y)


Velocity = Callable[[jax.Array, jax.Array], jax.Array]  # (x[..., dim], time[...]) -> velocity[..., dim]


def transport(velocity: Velocity, noise: jax.Array, steps: int) -> jax.Array:
    """Return x(1) of dx/dt = v(x, t) from x(0) = ``noise[..., dim]``, by ``steps`` steps of Euler's method."""

    def step(x: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        time = jnp.broadcast_to(index / steps, x.shape[:-1])
        return x + velocity(x, time) / steps, None

    return jax.lax.scan(step, noise, jnp.arange(steps))[0]


def recover(velocity: Velocity, x: jax.Array, steps: int, corrections: int = 6) -> jax.Array:
    """Return the noise that ``transport`` brings to ``x[..., dim]``: each of its steps solved for where it began.

    A step y = x + v(x, t) / steps is undone by the fixed point of x = y - v(x, t) / steps, which contracts where the
    field changes by less than ``steps`` per unit of x.

    Args:
        velocity: the field.
        x: where the transport ends.
        steps: those of ``transport``.
        corrections: iterations of the fixed point per step.
    """

    def back(y: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        time = jnp.broadcast_to(index / steps, y.shape[:-1])
        before = y
        for _ in range(corrections):
            before = y - velocity(before, time) / steps
        return before, None

    return jax.lax.scan(back, x, jnp.arange(steps)[::-1])[0]
