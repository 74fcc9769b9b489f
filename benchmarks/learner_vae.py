"""The trajectory VAE's pretraining step for ``learner.py``: flax's recurrent modules and ours, at the paper's sizes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from qdos_brax.config import SkillsConfig
from qdos_brax.nn.networks import (
    DiagonalGaussian,
    gaussian_kl,
    gaussian_log_prob,
    gaussian_sample,
)
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.skills.vae import Segments, SkillModel

OBSERVATION, LATENT, ACTION = 29, 8, 8
BATCH = 256
HORIZON = 20
RATE = 3e-4

Calls = Callable[[], int]  # does some work, waits for it, and says how many updates it made


class Encoder(nn.Module):
    """Two bidirectional layers of flax's own recurrent modules."""

    @nn.compact
    def __call__(self, observations: jax.Array, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See ``qdos_brax.nn.networks.SegmentEncoder``."""
        x = jnp.concatenate([observations, actions], axis=-1)
        for _ in range(2):
            forward = nn.RNN(nn.GRUCell(256))(x)
            backward = nn.RNN(nn.GRUCell(256), reverse=True, keep_order=True)(x)
            x = jnp.concatenate([forward, backward], axis=-1)
        summary = jnp.concatenate([forward[:, -1], backward[:, 0]], axis=-1)
        mean, log_std = jnp.split(nn.Dense(2 * LATENT)(summary), 2, axis=-1)
        return mean, jnp.clip(log_std, -5.0, 2.0)


def reference_vae() -> Calls:
    """The same loss on flax's ``nn.RNN`` and optax's Adam."""
    encoder, prior, decoder = Encoder(), DiagonalGaussian((256, 256), LATENT), DiagonalGaussian((256, 256), ACTION)
    segments, optimiser = windows(), optax.adam(RATE)
    parameters = {
        "encoder": encoder.init(jax.random.key(0), segments.observations, segments.actions),
        "prior": prior.init(jax.random.key(1), segments.observations[:, 0]),
        "decoder": decoder.init(jax.random.key(2), jnp.zeros((1, OBSERVATION + LATENT))),
    }

    @jax.jit
    def update(parameters: Any, opt_state: Any, key: jax.Array) -> tuple[Any, Any]:
        def loss(parameters: Any) -> jax.Array:
            posterior = encoder.apply(parameters["encoder"], segments.observations, segments.actions)
            latent = gaussian_sample(key, *posterior)
            repeated = jnp.broadcast_to(latent[:, None], (BATCH, HORIZON, LATENT))
            action = decoder.apply(parameters["decoder"], jnp.concatenate([segments.observations, repeated], axis=-1))
            log_likelihood = jnp.sum(gaussian_log_prob(segments.actions, *action), axis=1)
            kl = gaussian_kl(*posterior, *prior.apply(parameters["prior"], segments.observations[:, 0]))
            return jnp.mean(0.1 * kl - log_likelihood)

        updates, opt_state = optimiser.update(jax.grad(loss)(parameters), opt_state)
        return optax.apply_updates(parameters, updates), opt_state

    return repeated_update(update, parameters, optimiser.init(parameters))


def our_vae() -> Calls:
    """``SkillModel``'s loss and step, every weight 1, without the mutual information."""
    model, segments = SkillModel(OBSERVATION, ACTION, SkillsConfig(latent_dim=LATENT)), windows()
    parameters = model.init(jax.random.key(0))

    @jax.jit
    def update(parameters: Any, opt_state: Any, key: jax.Array) -> tuple[Any, Any]:
        gradient = jax.grad(lambda p: model.vae_loss(p, segments, jnp.ones(BATCH), 0.1, key, True)[0])(parameters)
        return adam_step(parameters, opt_state, gradient, RATE)

    return repeated_update(update, parameters, ADAM.init(parameters))


def windows() -> Segments:
    """Made-up segments."""
    random = np.random.default_rng(0)
    shapes = ((BATCH, HORIZON, OBSERVATION), (BATCH, HORIZON, ACTION))
    return Segments(*(jnp.asarray(random.standard_normal(shape), jnp.float32) for shape in shapes))


def repeated_update(update: Callable[..., tuple[Any, Any]], parameters: Any, opt_state: Any) -> Calls:
    """One gradient step a call."""
    held = [parameters, opt_state, 0]

    def calls() -> int:
        held[2] += 1
        held[:2] = jax.block_until_ready(update(held[0], held[1], jax.random.key(held[2])))
        return 1

    return calls
