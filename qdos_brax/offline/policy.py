"""The flat policy of the offline learners: a Gaussian whose standard deviation does not depend on the state."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from qdos_brax.nn.networks import LOG_STD_MAX, LOG_STD_MIN, MLP, gaussian_log_prob

Params = dict[str, dict[str, jax.Array]]


class GaussianPolicy(nn.Module):
    """Compute pi(a | s) = N(tanh(MLP(s)), sigma^2): mean in the action box, one sigma per dimension (IQL's actor).

    Attributes:
        hidden: hidden widths.
        action_dim: width of actions.
        learned_std: False fixes sigma at 1; maximum likelihood is then least squares, and the policy its mean.
    """

    hidden: Sequence[int]
    action_dim: int
    learned_std: bool = True

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps [..., obs] to (mean[..., act] in (-1, 1), log standard deviation[act])."""
        mean = jnp.tanh(MLP((*self.hidden, self.action_dim))(observation))
        if not self.learned_std:
            return mean, jnp.zeros(self.action_dim)
        log_std = self.param("log_std", nn.initializers.zeros, (self.action_dim,))
        return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def weighted_imitation_loss(
    policy: GaussianPolicy, params: Params, observation: jax.Array, action: jax.Array, weight: jax.Array | float
) -> jax.Array:
    """Return -mean_i w_i log pi(a_i | s_i)."""
    return -jnp.mean(weight * gaussian_log_prob(action, *policy.apply(params, observation)))
