"""How much a segment counts: three estimates of its advantage, its scale, and the weight made of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtri


def segment_advantage(
    macro_reward: jax.Array, discount: jax.Array, value_end: jax.Array, value_start: jax.Array
) -> jax.Array:
    """Return the H-step estimate sum_t gamma^t r_t + gamma^H V(s_H) - V(s_0), all [B]; ``discount`` is 0 after an
    end.
    """
    return macro_reward + discount * value_end - value_start


def transition_advantage(q: jax.Array, value: jax.Array) -> jax.Array:
    """Return the paper's text: mean_t [Q(s_t, a_t) - V(s_t)], from q[B, H] and value[B, H]."""
    return jnp.mean(q - value, axis=-1)


def scaled_advantage(advantage: jax.Array, scale: str) -> jax.Array:
    """Return advantages[B] on a scale that does not depend on their unit, about mean square 1.

    Args:
        advantage: [B], in units of reward.
        scale: "rank", their normal scores, or "std", in units of their standard deviation.
    """
    if scale == "rank":
        return normal_scores(advantage)
    return advantage / (jnp.std(advantage) + 1e-6)


def normal_scores(x: jax.Array) -> jax.Array:
    """Return the quantile of the standard normal distribution at each x[B]'s mid-rank (van der Waerden; Bliss 1967).

    Weights exp(score / lambda) of a large batch then have effective sample share exp(-1 / lambda^2), whatever x's
    distribution; a few outliers cannot take all the weight. Equal x get equal scores, all equal x get 0.
    """
    ordered = jnp.sort(x)
    below, up_to = jnp.searchsorted(ordered, x, side="left"), jnp.searchsorted(ordered, x, side="right")
    return ndtri((below + up_to) / (2 * x.shape[0]))


@jax.jit
def advantage_weights(advantage: jax.Array, temperature: jax.Array | float, clip: jax.Array | float) -> jax.Array:
    """Return exp(A / lambda), normalised over the batch to mean 1, clipped above (paper, eq. 2).

    Args:
        advantage: [B], on the scale that lambda is meant for (``scaled_advantage``).
        temperature: lambda > 0.
        clip: the largest weight after normalisation.

    Returns:
        [B], no gradient. The maximum is taken out of the exponent first, so that nothing overflows.
    """
    weight = jnp.exp((advantage - jnp.max(advantage)) / temperature)
    weight = weight / jnp.mean(weight)
    return jax.lax.stop_gradient(jnp.minimum(weight, clip))
