"""A model of the next state, good for one thing: how a change of the actions changes where a rollout leads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.nn.networks import MLP

Params = Any

_SMALLEST_SCALE = 1e-3  # of a number that never changes; what is seen has deviation 1


def step_scale(seen: np.ndarray) -> jax.Array:
    """Return float32[seen], the root mean square change in one step of paths seen[B, H + 1, seen]."""
    change = np.sqrt(np.mean(np.diff(seen, axis=1) ** 2, axis=(0, 1)))
    return jnp.asarray(np.maximum(change, _SMALLEST_SCALE), jnp.float32)


class ForwardModel:
    """Predict what is seen after an action: s' = s + scale * f(s, a).

    Args:
        scale: [seen], the root mean square change of each number in one step; it decides what an error counts.
        action_dim: width of actions.
        hidden: hidden widths of f.
    """

    def __init__(self, scale: jax.Array, action_dim: int, hidden: Sequence[int]) -> None:
        self._scale, self._action_dim = scale, action_dim
        self._net = MLP((*hidden, len(scale)))

    def init(self, key: jax.Array) -> Params:
        """Return fresh parameters."""
        return self._net.init(key, jnp.zeros((1, len(self._scale) + self._action_dim)))

    def predict(self, params: Params, seen: jax.Array, action: jax.Array) -> jax.Array:
        """Return what is seen[..., seen] after action[..., act]."""
        return seen + self._scale * self._net.apply(params, jnp.concatenate([seen, action], axis=-1))

    def error(self, params: Params, seen: jax.Array, action: jax.Array, after: jax.Array) -> jax.Array:
        """Return the mean squared error of the change, [...], in units of ``scale``."""
        return jnp.mean(((self.predict(params, seen, action) - after) / self._scale) ** 2, axis=-1)

    def follow(
        self,
        params: Params,
        seen: jax.Array,
        actions: jax.Array,
        act: Callable[[jax.Array], jax.Array],
    ) -> jax.Array:
        """Return where a rollout would end if ``act`` played it, [B, seen]: the rollout's own end while ``act`` gives
        the rollout's actions.

        What was simulated stays; the model says only what differs from it: x_{t+1} = s_{t+1} + m(x_t, act(x_t)) -
        m(s_t, a_t), x_0 = s_0. The model's bias cancels, and the gradient by ``act`` is the one along the real
        trajectory (stochastic value gradients, Heess et al. 2015, SVG(infinity)).

        Args:
            params: of the model; no gradient reaches them.
            seen: [B, H + 1, seen], the rollout's states.
            actions: [B, H, act], its actions.
            act: what acts at states[B, seen].
        """
        params, seen, actions = jax.lax.stop_gradient((params, seen, actions))
        surprise = seen[:, 1:] - self.predict(params, seen[:, :-1], actions)

        def step(x: jax.Array, surprise: jax.Array) -> tuple[jax.Array, None]:
            return self.predict(params, x, act(x)) + surprise, None

        return jax.lax.scan(step, seen[:, 0], jnp.swapaxes(surprise, 0, 1))[0]
