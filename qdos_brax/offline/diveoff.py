"""DiveOff (Osa, Harada 2024): several solutions of one task from logged transitions.

A latent-conditioned actor pi(a | s, z) and an autoencoder q(z | s, a), p(s, a | z) learn together. The actor imitates
actions weighted by exp(scale A), with A(s, a, z) = Q(s, a, z) - Q(s, pi(s, z), z) of its own latent-conditioned critic;
the information term makes z readable from what the actor does with it: z uniform in a box, decoded along logged
states, encoded again. Numbers follow the authors' code (github.com/TakaOsa/DiveOff, train.py): z of dimension 2 from
[-2, 2], scale 3, weights at most 100, KL weight 50, information 2, learning rate 3e-4, the autoencoder's 0.3 of that,
batch 256, two critic steps per actor step, 10^6 critic steps (here ``updates`` are the actor's, half as many). Their KL
weight lets the posterior collapse (in the task of tests/offline/test_diveoff.py every z then plays the mean of the
solutions); 0.1 does not.

What differs from that code: the weight of a transition in the autoencoder's loss is its own, not another batch's; the
target's action has the policy's narrow spread, not 1; in the first 10^4 updates actor and critics learn beside the
autoencoder, which does so at its later rate, while there it learns alone at the full one; the weight of the posterior's
sharpness is 0 in them and exp(A) afterwards, there exp(v A) with v from 0 to 1 along a cosine over the first half of
all steps. Its cosine decay of learning rates is left out.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import DiveOffConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.nn.networks import MLP, DiagonalGaussian, Ensemble, gaussian_kl, gaussian_log_prob, gaussian_sample
from qdos_brax.nn.optim import ADAM, adam_step, polyak
from qdos_brax.offline.iql_policy import regression_weight
from qdos_brax.offline.policy import GaussianPolicy, weighted_imitation_loss
from qdos_brax.offline.rows import random_rows, transitions
from qdos_brax.skills.values import ValueBatch

Params = Any
CRITIC_STEPS = 2  # per step of actor and autoencoder
_ACTION_STD = 0.082  # exp(-2.5), of the action whose value the critic is trained on


class DiveOffHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary.

    Attributes:
        learning_rate: Adam's, of actor and critic.
        autoencoder_rate: of the step on autoencoder and information, as a share of ``learning_rate``.
        discount: per step.
        target_rate: Polyak rate of the target networks.
        scale: of the advantage in the weights.
        kl_weight: of KL(q(z | s, a) || N(0, 1)), against a mean squared error of reconstruction.
        information: weight of the information term.
        latent_box: half the side of the box that random z are drawn from.
    """

    learning_rate: jax.Array | float
    autoencoder_rate: jax.Array | float
    discount: jax.Array | float
    target_rate: jax.Array | float
    scale: jax.Array | float
    kl_weight: jax.Array | float
    information: jax.Array | float
    latent_box: jax.Array | float


class DiveOffState(struct.PyTreeNode):
    """Hold parameters of all networks, targets, Adam's state, and the updates done.

    ``shared_opt_state`` are those of the step on encoder, decoder and actor together.
    """

    actor: Params
    target_actor: Params
    critic: Params
    target_critic: Params
    autoencoder: Params
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    shared_opt_state: optax.OptState
    count: jax.Array


class DiveOff:
    """Learn diverse and good latents of transitions (``qdos_brax.offline.learner.Learner``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        latent_dim: dimension of z.
        config: widths, batch size, and the number of first updates in which every transition counts the same and there
            is no information term.
    """

    def __init__(self, observation_dim: int, action_dim: int, latent_dim: int, config: DiveOffConfig) -> None:
        self.observation_dim, self.action_dim, self.latent_dim = observation_dim, action_dim, latent_dim
        self.batch_size, self.autoencoder_updates = config.batch_size, config.autoencoder_updates
        self.policy = GaussianPolicy(config.hidden, action_dim, learned_std=False)
        self._critic = Ensemble(config.hidden, size=2)
        self._encoder = DiagonalGaussian(config.hidden, latent_dim)
        self._decoder = MLP((*config.hidden, observation_dim + action_dim))

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> DiveOffState:
        """Return fresh parameters; the targets start as copies."""
        actor_key, critic_key, encoder_key, decoder_key = jax.random.split(key, 4)
        pair, latent = jnp.zeros((1, self.observation_dim + self.action_dim)), jnp.zeros((1, self.latent_dim))
        actor = self.policy.init(actor_key, jnp.zeros((1, self.observation_dim + self.latent_dim)))
        critic = self._critic.init(critic_key, jnp.concatenate([pair, latent], axis=-1))
        autoencoder = {
            "encoder": self._encoder.init(encoder_key, pair),
            "decoder": self._decoder.init(decoder_key, latent),
        }
        return DiveOffState(
            actor=actor,
            target_actor=jax.tree.map(jnp.copy, actor),
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            autoencoder=autoencoder,
            actor_opt_state=ADAM.init(actor),
            critic_opt_state=ADAM.init(critic),
            shared_opt_state=ADAM.init((autoencoder, actor)),
            count=jnp.zeros((), jnp.int32),
        )

    # --- What it gives to others, from ``params`` ------------------------------------------------------------

    def act(self, params: dict[str, Any], observation: jax.Array, latent: jax.Array) -> jax.Array:
        """Return the mode of pi(a | s, z), [..., act] in [-1, 1]; ``observation`` is normalised."""
        return self._mean_action(params["actor"], observation, latent)

    def encode(self, params: dict[str, Any], observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return q(z | s, a): (mean[..., latent], log standard deviation[..., latent])."""
        return self._encoder.apply(params["encoder"], jnp.concatenate([observation, action], axis=-1))

    def prior(self, params: dict[str, Any], observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return p(z), standard normal in every state: (mean[..., latent], log standard deviation[..., latent])."""
        zeros = jnp.zeros((*observation.shape[:-1], self.latent_dim))
        return zeros, zeros

    def params(self, state: DiveOffState) -> dict[str, Any]:
        """Return {"actor", "encoder"}."""
        return {"actor": state.actor, "encoder": state.autoencoder["encoder"]}

    # --- Learning --------------------------------------------------------------------------------------------

    def q(self, critic: Params, observation: jax.Array, action: jax.Array, latent: jax.Array) -> jax.Array:
        """Return Q(s, a, z) of both heads, [2, B]."""
        return self._critic.apply(critic, jnp.concatenate([observation, action, latent], axis=-1))

    def critic_step(
        self, state: DiveOffState, batch: ValueBatch, key: jax.Array, hyper: DiveOffHyper
    ) -> tuple[DiveOffState, jax.Array]:
        """Make one step of the critic to r + discount min Q(s', a', z), z ~ q(z | s, a), a' ~ pi(. | s', z); its
        loss.
        """
        latent_key, action_key = jax.random.split(key)
        latent = gaussian_sample(latent_key, *self.encode(state.autoencoder, batch.observation, batch.action))
        action = self._target_action(state, batch.next_observation, latent, action_key)
        bootstrap = self.q(state.target_critic, batch.next_observation, action, latent).min(axis=0)
        target = batch.reward + batch.discount * bootstrap

        def loss(critic: Params) -> jax.Array:
            error = self.q(critic, batch.observation, batch.action, latent) - target
            return jnp.mean(jnp.sum(error**2, axis=0))

        value, grads = jax.value_and_grad(loss)(state.critic)
        critic, opt_state = adam_step(state.critic, state.critic_opt_state, grads, hyper.learning_rate)
        return state.replace(critic=critic, critic_opt_state=opt_state), value

    def advantage(self, state: DiveOffState, batch: ValueBatch, latent: jax.Array, key: jax.Array) -> jax.Array:
        """Return min Q(s, a, z) - min Q(s, a', z) with a' ~ pi(. | s, z), [B], all of the targets."""
        own = self._target_action(state, batch.observation, latent, key)
        logged = self.q(state.target_critic, batch.observation, batch.action, latent).min(axis=0)
        return logged - self.q(state.target_critic, batch.observation, own, latent).min(axis=0)

    def autoencoder_loss(
        self, autoencoder: Params, batch: ValueBatch, weight: jax.Array, sharpness: jax.Array, key: jax.Array, kl: Any
    ) -> jax.Array:
        """Return mean_i w_i [mean squared error of (s, a) + beta KL(q || N(0, 1))] - v_i log q(z_i | s_i, a_i).

        Args:
            autoencoder: {"encoder", "decoder"}.
            batch: transitions, leading axis B.
            weight: w[B].
            sharpness: v[B]; its term narrows the posterior of good transitions, against the KL.
            key: for the posterior sample.
            kl: beta.
        """
        posterior = self.encode(autoencoder, batch.observation, batch.action)
        latent = gaussian_sample(key, *posterior)
        pair = jnp.concatenate([batch.observation, batch.action], axis=-1)
        error = jnp.mean((self._decoder.apply(autoencoder["decoder"], latent) - pair) ** 2, axis=-1)
        divergence = gaussian_kl(*posterior, jnp.zeros_like(latent), jnp.zeros_like(latent))
        sharp = gaussian_log_prob(latent, *posterior)
        return jnp.mean(weight * (error + kl * divergence) - sharpness * sharp)

    def information_loss(self, encoder: Params, actor: Params, observation: jax.Array, latent: jax.Array) -> jax.Array:
        """Return mean squared error of z as encoded from (s, pi(s, z)), for ``latent``[B, d] at logged states."""
        action = self._mean_action(actor, observation, latent)
        recovered = self.encode({"encoder": encoder}, observation, action)[0]
        return jnp.mean((recovered - latent) ** 2)

    def policy_step(
        self, state: DiveOffState, batch: ValueBatch, key: jax.Array, hyper: DiveOffHyper
    ) -> tuple[DiveOffState, dict[str, jax.Array]]:
        """Make one step of the actor, one of autoencoder and actor on information, and one of the targets."""
        latent_key, action_key, sample_key, random_key = jax.random.split(key, 4)
        latent = gaussian_sample(latent_key, *self.encode(state.autoencoder, batch.observation, batch.action))
        started = (state.count >= self.autoencoder_updates).astype(jnp.float32)
        advantage = started * self.advantage(state, batch, latent, action_key)
        weight = regression_weight(advantage, hyper.scale)
        sharpness = started * regression_weight(advantage, 1.0)
        seen = jnp.concatenate([batch.observation, latent], axis=-1)

        def actor_loss(actor: Params) -> jax.Array:
            return weighted_imitation_loss(self.policy, actor, seen, batch.action, weight)

        imitation, grads = jax.value_and_grad(actor_loss)(state.actor)
        actor, actor_opt_state = adam_step(state.actor, state.actor_opt_state, grads, hyper.learning_rate)
        random = jax.random.uniform(random_key, latent.shape, minval=-hyper.latent_box, maxval=hyper.latent_box)

        def shared_loss(shared: tuple[Params, Params]) -> tuple[jax.Array, jax.Array]:
            autoencoder, actor = shared
            loss = self.autoencoder_loss(autoencoder, batch, weight, sharpness, sample_key, hyper.kl_weight)
            information = self.information_loss(autoencoder["encoder"], actor, batch.observation, random)
            return loss + started * hyper.information * information, information

        (loss, information), grads = jax.value_and_grad(shared_loss, has_aux=True)((state.autoencoder, actor))
        rate = hyper.autoencoder_rate * hyper.learning_rate
        shared, shared_opt_state = adam_step((state.autoencoder, actor), state.shared_opt_state, grads, rate)
        autoencoder, actor = shared
        state = state.replace(
            actor=actor,
            target_actor=polyak(state.target_actor, actor, hyper.target_rate),
            target_critic=polyak(state.target_critic, state.critic, hyper.target_rate),
            autoencoder=autoencoder,
            actor_opt_state=actor_opt_state,
            shared_opt_state=shared_opt_state,
            count=state.count + 1,
        )
        info = {"actor_loss": imitation, "autoencoder_loss": loss, "information_loss": information}
        return state, info | {"policy_weight": jnp.mean(weight)}

    def update(
        self, state: DiveOffState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[DiveOffState, dict[str, jax.Array]]:
        """Make two critic steps and one of everything else, on batches of the data.

        Reads ``diveoff.learning_rate``, ``.autoencoder_rate``, ``.discount``, ``.target_rate``, ``.scale``,
        ``.kl_weight``, ``.information`` and ``skills.latent_box``.
        """
        names = [name for name in DiveOffHyper.__dataclass_fields__ if name != "latent_box"]
        own = DiveOffHyper(**{name: hyper[f"diveoff.{name}"] for name in names}, latent_box=hyper["skills.latent_box"])
        policy_key, *critic_keys = jax.random.split(key, CRITIC_STEPS + 1)

        def critic_step(state: DiveOffState, key: jax.Array) -> tuple[DiveOffState, jax.Array]:
            rows_key, step_key = jax.random.split(key)
            batch = transitions(data, random_rows(data, rows_key, self.batch_size), own.discount)
            return self.critic_step(state, batch, step_key, own)

        state, critic_loss = jax.lax.scan(critic_step, state, jnp.stack(critic_keys))
        rows_key, step_key = jax.random.split(policy_key)
        batch = transitions(data, random_rows(data, rows_key, self.batch_size), own.discount)
        state, info = self.policy_step(state, batch, step_key, own)
        return state, info | {"critic_loss": jnp.mean(critic_loss)}

    def _mean_action(self, actor: Params, observation: jax.Array, latent: jax.Array) -> jax.Array:
        return self.policy.apply(actor, jnp.concatenate([observation, latent], axis=-1))[0]

    def _target_action(
        self, state: DiveOffState, observation: jax.Array, latent: jax.Array, key: jax.Array
    ) -> jax.Array:
        mean = self._mean_action(state.target_actor, observation, latent)
        return jnp.clip(mean + _ACTION_STD * jax.random.normal(key, mean.shape), -1.0, 1.0)
