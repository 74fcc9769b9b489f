"""How much a segment counts: three estimates of its advantage, and the weight made of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def segment_advantage(
    macro_reward: jax.Array, discount: jax.Array, value_end: jax.Array, value_start: jax.Array
) -> jax.Array:
    """The H-step estimate sum_t gamma^t r_t + gamma^H V(s_H) - V(s_0), all [B]; ``discount`` is 0 after an end."""
    return macro_reward + discount * value_end - value_start


def transition_advantage(q: jax.Array, value: jax.Array) -> jax.Array:
    """The paper's text: mean_t [Q(s_t, a_t) - V(s_t)], from q[B, H] and value[B, H]."""
    return jnp.mean(q - value, axis=-1)


def latent_advantage(q: jax.Array, value_start: jax.Array) -> jax.Array:
    """The paper's Algorithm 1: Q(s_0, z) - V(s_0), [B]."""
    return q - value_start


def advantage_weights(advantage: jax.Array, temperature: jax.Array | float, clip: jax.Array | float) -> jax.Array:
    """exp(A / lambda), normalised over the batch to mean 1, clipped above (paper, eq. 2).

    Args:
        advantage: [B], already divided by its scale over the dataset if lambda is meant in units of that scale.
        temperature: lambda > 0.
        clip: the largest weight after normalisation.

    Returns:
        [B], no gradient. The maximum is taken out of the exponent first, so that nothing overflows.
    """
    weight = jnp.exp((advantage - jnp.max(advantage)) / temperature)
    weight = weight / jnp.mean(weight)
    return jax.lax.stop_gradient(jnp.minimum(weight, clip))
