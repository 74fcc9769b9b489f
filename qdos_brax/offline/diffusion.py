"""Behaviour cloning by diffusion: a small DDPM over actions, so that several ways of acting stay several.

Denoising diffusion (Ho et al. 2020) with predicted noise; the schedule, the residual network with learned Fourier
features of time and the averaged parameters are those of IDQL (Hansen-Estruch et al. 2023), which SUPE's guide policy
(Wilcoxson et al. 2024) is made of: 5 steps, variance-preserving schedule, 3 blocks, dropout 0.1, average rate 0.001.
So few steps blur: the last one starts from noise of deviation 0.44. Of two modes 1.2 apart (tests/offline/
test_diffusion.py) 5 steps put 0.69 of the actions within 0.2 of a mode, 10 steps 0.92.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from qdos_brax.config import GuideConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.nn.optim import ADAM, adam_step, polyak
from qdos_brax.offline.rows import random_rows

Params = Any
_TIME_FEATURES = 128
_BETA_MIN, _BETA_MAX = 0.1, 10.0


class Schedule(struct.PyTreeNode):
    """Hold how noise is added in K steps, float32[K] each; entry k belongs to step k + 1.

    Attributes:
        beta: variance that the step adds.
        alpha_bar: product of (1 - beta) up to the step: the share of the action's variance that is left.
        posterior_std: standard deviation of the step back, given the clean action; 0 for the last one.
    """

    beta: jax.Array
    alpha_bar: jax.Array
    posterior_std: jax.Array


def variance_preserving_schedule(steps: int) -> Schedule:
    """Return alpha_bar(t) = exp(-b_min t - (b_max - b_min) t^2 / 2) at t = 1/K .. 1 (Xiao et al. 2022), b from 0.1
    to 10.

    Args:
        steps: K, at least 1.
    """
    time = np.arange(steps + 1) / steps
    alpha_bar = np.exp(-_BETA_MIN * time - 0.5 * (_BETA_MAX - _BETA_MIN) * time**2)
    beta = 1 - alpha_bar[1:] / alpha_bar[:-1]
    posterior = beta * (1 - alpha_bar[:-1]) / (1 - alpha_bar[1:])
    return Schedule(*(jnp.asarray(x, jnp.float32) for x in (beta, alpha_bar[1:], np.sqrt(posterior))))


def add_noise(schedule: Schedule, action: jax.Array, step: jax.Array, noise: jax.Array) -> jax.Array:
    """Return the action after step + 1 noising steps: sqrt(alpha_bar) a + sqrt(1 - alpha_bar) noise; ``step`` is
    int32[B].
    """
    alpha_bar = schedule.alpha_bar[step][..., None]
    return jnp.sqrt(alpha_bar) * action + jnp.sqrt(1 - alpha_bar) * noise


class Denoiser(nn.Module):
    """Predict the noise in an action: Fourier features of the step, then residual blocks.

    Attributes:
        hidden: width of the blocks.
        blocks: their number.
        action_dim: width of actions.
        dropout: share of units dropped in training.
    """

    hidden: int
    blocks: int
    action_dim: int
    dropout: float

    @nn.compact
    def __call__(self, observation: jax.Array, action: jax.Array, step: jax.Array, train: bool) -> jax.Array:
        """Maps observation[..., obs], noisy action[..., act], step[...] to the noise[..., act]."""
        frequency = self.param("frequency", nn.initializers.normal(0.2), (_TIME_FEATURES // 2,))
        angle = 2 * jnp.pi * step[..., None] * frequency
        time = jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        time = nn.Dense(2 * _TIME_FEATURES)(nn.swish(nn.Dense(2 * _TIME_FEATURES)(time)))
        x = nn.Dense(self.hidden)(jnp.concatenate([action, observation, time], axis=-1))
        for _ in range(self.blocks):
            y = nn.Dropout(self.dropout, deterministic=not train)(x)
            y = nn.swish(nn.Dense(4 * self.hidden)(nn.LayerNorm()(y)))
            x = x + nn.Dense(self.hidden)(y)
        return nn.Dense(self.action_dim)(nn.swish(x))


class DiffusionState(struct.PyTreeNode):
    """Hold parameters of the denoiser, their moving average, and Adam's state."""

    denoiser: Params
    average: Params
    opt_state: optax.OptState


class DiffusionHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: learning rate, and the rate at which the average follows the parameters."""

    learning_rate: jax.Array | float
    average_rate: jax.Array | float


class DiffusionBC:
    """Clone behaviour by a diffusion policy (``qdos_brax.offline.learner.Learner``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions, which lie in [-1, 1].
        config: width of the denoiser's residual blocks, denoising steps K, and batch size.
        blocks: residual blocks.
        dropout: share of units dropped in training.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        config: GuideConfig,
        blocks: int = 3,
        dropout: float = 0.1,
    ) -> None:
        self.observation_dim, self.action_dim, self.batch_size = observation_dim, action_dim, config.batch_size
        self.steps = config.steps
        self.schedule = variance_preserving_schedule(config.steps)
        self._denoiser = Denoiser(config.hidden, blocks, action_dim, dropout)

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> DiffusionState:
        """Return fresh parameters; the average starts as a copy."""
        observation, action = jnp.zeros((1, self.observation_dim)), jnp.zeros((1, self.action_dim))
        denoiser = self._denoiser.init(key, observation, action, jnp.zeros(1), False)
        return DiffusionState(denoiser, jax.tree.map(jnp.copy, denoiser), ADAM.init(denoiser))

    def loss(self, denoiser: Params, observation: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        """Return mean_i ||noise - predicted noise||^2 at a random step each (Ho et al. 2020, eq. 14)."""
        step_key, noise_key, dropout_key = jax.random.split(key, 3)
        step = jax.random.randint(step_key, action.shape[:-1], 0, self.steps)
        noise = jax.random.normal(noise_key, action.shape)
        noisy = add_noise(self.schedule, action, step, noise)
        predicted = self._denoiser.apply(denoiser, observation, noisy, step, True, rngs={"dropout": dropout_key})
        return jnp.mean(jnp.sum((noise - predicted) ** 2, axis=-1))

    def step(
        self, state: DiffusionState, observation: jax.Array, action: jax.Array, key: jax.Array, hyper: DiffusionHyper
    ) -> tuple[DiffusionState, dict[str, jax.Array]]:
        """Make one gradient step on observation[B, obs], action[B, act]; the average follows."""
        loss, grads = jax.value_and_grad(self.loss)(state.denoiser, observation, action, key)
        denoiser, opt_state = adam_step(state.denoiser, state.opt_state, grads, hyper.learning_rate)
        average = polyak(state.average, denoiser, hyper.average_rate)
        return DiffusionState(denoiser, average, opt_state), {"denoising_loss": loss}

    def sample(self, params: dict[str, Any], key: jax.Array, observation: jax.Array) -> jax.Array:
        """Return an action[..., act] in [-1, 1] of pi(a | s), by K denoising steps; ``observation`` is normalised.

        Each step estimates the clean action, clips it into the box, and draws the step back given that estimate
        (Ho et al. 2020, eq. 6 and 7).
        """
        start_key, noise_key = jax.random.split(key)
        shape = (*observation.shape[:-1], self.action_dim)
        beta, alpha_bar, posterior_std = self.schedule.beta, self.schedule.alpha_bar, self.schedule.posterior_std
        before = jnp.concatenate([jnp.ones(1), alpha_bar[:-1]])

        def back(noisy: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            step, key = inputs
            steps = jnp.broadcast_to(step, shape[:-1])
            noise = self._denoiser.apply(params["denoiser"], observation, noisy, steps, False)
            clean = (noisy - jnp.sqrt(1 - alpha_bar[step]) * noise) / jnp.sqrt(alpha_bar[step])
            clean = jnp.clip(clean, -1.0, 1.0)
            of_clean = jnp.sqrt(before[step]) * beta[step] / (1 - alpha_bar[step])
            of_noisy = jnp.sqrt(1 - beta[step]) * (1 - before[step]) / (1 - alpha_bar[step])
            mean = of_clean * clean + of_noisy * noisy
            return mean + posterior_std[step] * jax.random.normal(key, shape), None

        inputs = (jnp.arange(self.steps)[::-1], jax.random.split(noise_key, self.steps))
        return jax.lax.scan(back, jax.random.normal(start_key, shape), inputs)[0]

    def update(
        self, state: DiffusionState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[DiffusionState, dict[str, jax.Array]]:
        """Make one gradient step on a batch of the data; reads ``guide.learning_rate`` and ``.average_rate``."""
        rows_key, loss_key = jax.random.split(key)
        rows = random_rows(data, rows_key, self.batch_size)
        own = DiffusionHyper(hyper["guide.learning_rate"], hyper["guide.average_rate"])
        return self.step(state, data.observations[rows], data.actions[rows], loss_key, own)

    def params(self, state: DiffusionState) -> dict[str, Any]:
        """Return {"denoiser"}: the average."""
        return {"denoiser": state.average}
