"""A bidirectional GRU (Cho et al. 2014) in the reset-after form of cuDNN and PyTorch, for CPUs as well.

Two things make it fast there. The three gates are arrays of their own: as slices of one array, XLA's loops over them
are not vectorised and cost more than the matmuls. And gradients are written by hand: those of the weights are matmuls
over all time steps at once, after the loop instead of inside it.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

Gates = tuple[jax.Array, jax.Array, jax.Array]  # reset, update, candidate
Biases = tuple[jax.Array, jax.Array, jax.Array, jax.Array]  # of the gates, and of the candidate's recurrent share


class _Saved(NamedTuple):
    """What the way back needs: of every step the new state, two gates, the recurrent share and the candidate."""

    states: jax.Array
    reset: jax.Array
    update: jax.Array
    share: jax.Array
    candidate: jax.Array
    kernels: Gates


class BidirectionalGRU(nn.Module):
    """Run one layer from the first step to the last and from the last to the first.

    Attributes:
        hidden: state width of each direction.
    """

    hidden: int

    @nn.compact
    def __call__(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps [T, B, in] to (both directions' states[T, B, 2 hidden], those after their last steps[B, 2 hidden])."""
        width, directions = 3 * self.hidden, (("forward", False), ("backward", True))
        kernels = [
            self.param(f"{name}_input", nn.initializers.lecun_normal(), (x.shape[-1], width)) for name, _ in directions
        ]
        inputs = project(x, tuple(_thirds(kernels[0]) + _thirds(kernels[1])))
        outputs = []
        for index, (name, reverse) in enumerate(directions):
            kernel = self.param(f"{name}_recurrent", orthogonal, (self.hidden, width))
            bias = self.param(f"{name}_bias", nn.initializers.zeros, (4 * self.hidden,))
            gates = inputs[3 * index : 3 * index + 3]
            outputs.append(recur(reverse, gates, _thirds(kernel), tuple(jnp.split(bias, 4))))
        last = jnp.concatenate([outputs[0][-1], outputs[1][0]], axis=-1)
        return jnp.concatenate(outputs, axis=-1), last


def orthogonal(key: jax.Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> jax.Array:
    """Return flax's orthogonal initialisation, of a population one member after the other.

    On CPUs jaxlib factorises a batch of matrices in parallel, and two such batches at once, as of two directions, can
    wait for one another's threads for ever (seen with jaxlib 0.10.2 on two cores).
    """
    draw = jax.custom_batching.sequential_vmap(lambda key: nn.initializers.orthogonal()(key, shape, dtype))
    return draw(key)


def _thirds(kernel: jax.Array) -> Gates:
    reset, update, candidate = jnp.split(kernel, 3, axis=-1)
    return reset, update, candidate


@jax.custom_vjp
def project(x: jax.Array, kernels: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """Return ``x[T, B, in]`` times each of ``kernels``[in, n]; the gradient by ``x`` is one matmul, not a sum of
    many.
    """
    return tuple(x @ kernel for kernel in kernels)


def _project_forward(x: jax.Array, kernels: tuple[jax.Array, ...]) -> tuple[tuple[jax.Array, ...], tuple]:
    return project(x, kernels), (x, kernels)


def _project_backward(saved: tuple, gradients: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    x, kernels = saved
    gradient, kernel = jnp.concatenate(gradients, axis=-1), jnp.concatenate(kernels, axis=-1)
    by_kernel = _rows(x).T @ _rows(gradient)
    return gradient @ kernel.T, tuple(jnp.split(by_kernel, len(kernels), axis=-1))


project.defvjp(_project_forward, _project_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def recur(reverse: bool, inputs: Gates, kernels: Gates, biases: Biases) -> jax.Array:
    """Return the states[T, B, hidden] after each step, from a state of zeros.

    Args:
        reverse: run from the last step to the first.
        inputs: the input's share of the gates, [T, B, hidden] each.
        kernels: recurrent weights, [hidden, hidden] each.
        biases: [hidden] each.
    """
    return _recur_forward(reverse, inputs, kernels, biases)[0]


def _recur_forward(reverse: bool, inputs: Gates, kernels: Gates, biases: Biases) -> tuple[jax.Array, _Saved]:
    def step(state: jax.Array, given: Gates) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        recurrent = [state @ kernel for kernel in kernels]
        reset = nn.sigmoid(given[0] + recurrent[0] + biases[0])
        update = nn.sigmoid(given[1] + recurrent[1] + biases[1])
        share = recurrent[2] + biases[3]
        candidate = jnp.tanh(given[2] + biases[2] + reset * share)
        state = candidate + update * (state - candidate)
        return state, (state, reset, update, share, candidate)

    _, steps = jax.lax.scan(step, jnp.zeros_like(inputs[0][0]), inputs, reverse=reverse)
    states, reset, update, share, candidate = steps
    return states, _Saved(states, reset, update, share, candidate, kernels)


def _recur_backward(reverse: bool, saved: _Saved, gradient: jax.Array) -> tuple[Gates, Gates, Biases]:
    start = jnp.zeros_like(saved.states[:1])
    before = [saved.states[1:], start] if reverse else [start, saved.states[:-1]]
    previous = jnp.concatenate(before)
    transposed = [kernel.T for kernel in saved.kernels]

    def step(later: jax.Array, given: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        own, previous, reset, update, share, candidate = given
        by_state = later + own
        by_candidate = by_state * (1 - update) * (1 - candidate**2)
        by_share = by_candidate * reset
        by_reset = by_candidate * share * reset * (1 - reset)
        by_update = by_state * (previous - candidate) * update * (1 - update)
        recurrent = by_reset @ transposed[0] + by_update @ transposed[1] + by_share @ transposed[2]
        return by_state * update + recurrent, (by_reset, by_update, by_candidate, by_share)

    given = (gradient, previous, saved.reset, saved.update, saved.share, saved.candidate)
    _, (by_reset, by_update, by_candidate, by_share) = jax.lax.scan(step, start[0], given, reverse=not reverse)
    before_all = _rows(previous).T
    by_kernels = (before_all @ _rows(by_reset), before_all @ _rows(by_update), before_all @ _rows(by_share))
    by_biases = (by_reset.sum((0, 1)), by_update.sum((0, 1)), by_candidate.sum((0, 1)), by_share.sum((0, 1)))
    return (by_reset, by_update, by_candidate), by_kernels, by_biases


recur.defvjp(_recur_forward, _recur_backward)


def _rows(x: jax.Array) -> jax.Array:
    """[T, B, n] as [T B, n]."""
    return x.reshape(-1, x.shape[-1])
