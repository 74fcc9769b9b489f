"""Trains a learner as the offline phase does, in one scan."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

# Such small programs take far longer to compile than to run.
QUICK = {"xla_backend_optimization_level": 1}


def train(learner, data, hyper, updates, seed=0):
    """The state after ``updates`` steps from seed ``seed``, and the mean metrics."""

    @partial(jax.jit, static_argnums=2, compiler_options=QUICK)
    def run(key, data, updates):
        init_key, key = jax.random.split(key)
        step = lambda state, key: learner.update(state, data, key, hyper)  # noqa: E731
        state, info = jax.lax.scan(step, learner.init(init_key, hyper), jax.random.split(key, updates))
        return state, jax.tree.map(jnp.mean, info)

    return run(jax.random.key(seed), data, updates)


def train_members(learner, data, hyper, updates):
    """As ``train`` for a population: ``hyper`` holds [members] each, all members have seed 0."""
    keys = jax.random.split(jax.random.key(0), updates)

    @partial(jax.jit, compiler_options=QUICK)
    def run(data):
        def one(hyper):
            step = lambda state, key: learner.update(state, data, key, hyper)  # noqa: E731
            return jax.lax.scan(step, learner.init(jax.random.key(1), hyper), keys)[0]

        return jax.vmap(one)(jax.tree.map(jnp.asarray, hyper))

    return run(data)
