"""The recurrent layer and its hand-written gradients against flax's own cells and automatic differentiation."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.nn.gru import BidirectionalGRU, orthogonal

HIDDEN, WIDTH = 4, 3


@pytest.fixture
def layer_and_input():
    x = jax.random.normal(jax.random.key(0), (6, 2, WIDTH))  # [T, B, in]
    params = BidirectionalGRU(HIDDEN).init(jax.random.key(1), x)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(2), len(leaves))  # biases start at zero, which would hide them
    return tree.unflatten([x + 0.3 * jax.random.normal(key, x.shape) for key, x in zip(keys, leaves, strict=True)]), x


def flax_cells(params, x):
    """The same layer from ``nn.GRUCell``: (states, last states)."""
    outputs, lasts = [], []
    for name, steps in (("forward", range(len(x))), ("backward", range(len(x) - 1, -1, -1))):
        own = params["params"]
        kernels = jnp.split(own[f"{name}_input"], 3, axis=1)
        recurrent = jnp.split(own[f"{name}_recurrent"], 3, axis=1)
        biases = jnp.split(own[f"{name}_bias"], 4)
        cell = {}
        for index, gate in enumerate("rzn"):
            cell[f"i{gate}"] = {"kernel": kernels[index], "bias": biases[index]}
            cell[f"h{gate}"] = {"kernel": recurrent[index]}
        cell["hn"]["bias"] = biases[3]
        state, states = jnp.zeros((x.shape[1], HIDDEN)), {}
        for t in steps:
            state, _ = nn.GRUCell(HIDDEN).apply({"params": cell}, state, x[t])
            states[t] = state
        outputs.append(jnp.stack([states[t] for t in range(len(x))]))
        lasts.append(state)
    return jnp.concatenate(outputs, axis=-1), jnp.concatenate(lasts, axis=-1)


def total(layer, params, x):
    """A number that every output has its own part in."""
    states, last = layer(params, x)
    return jnp.sum(jnp.sin(states) * jnp.arange(states.size).reshape(states.shape)) + jnp.sum(jnp.cos(3 * last))


def test_equals_flax_cells(layer_and_input):
    params, x = layer_and_input
    for ours, theirs in zip(BidirectionalGRU(HIDDEN).apply(params, x), flax_cells(params, x), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_gradients_are_those_of_flax_cells(layer_and_input):
    ours = jax.grad(lambda p, x: total(BidirectionalGRU(HIDDEN).apply, p, x), argnums=(0, 1))(*layer_and_input)
    theirs = jax.grad(lambda p, x: total(flax_cells, p, x), argnums=(0, 1))(*layer_and_input)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_members_learn_as_they_do_alone(layer_and_input):
    params, x = layer_and_input
    gradient = jax.grad(lambda p, x: total(BidirectionalGRU(HIDDEN).apply, p, x))
    other = jax.tree.map(lambda p: -0.7 * p, params)
    both = jax.vmap(gradient, in_axes=(0, None))(jax.tree.map(lambda a, b: jnp.stack([a, b]), params, other), x)
    for index, alone in enumerate((params, other)):
        for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(gradient(alone, x)), strict=True):
            np.testing.assert_allclose(a[index], b, rtol=1e-4, atol=1e-4)


def test_members_matrices_are_drawn_one_by_one_and_are_flaxs() -> None:
    """A batch of factorisations beside another one can wait for it for ever; numbers are those of the batch."""
    keys = jax.random.split(jax.random.key(0), 3)
    ours = jax.jit(jax.vmap(lambda key: orthogonal(key, (4, 12))))
    theirs = jax.vmap(lambda key: nn.initializers.orthogonal()(key, (4, 12)))
    np.testing.assert_allclose(ours(keys), theirs(keys), atol=1e-6)
    np.testing.assert_allclose(ours(keys)[1] @ ours(keys)[1].T, np.eye(4), atol=1e-5)
    assert "f32[3,12,4]" in str(jax.make_jaxpr(theirs)(keys))
    assert "f32[3,12,4]" not in str(jax.make_jaxpr(ours)(keys))
