"""The skill phase: the weighted VAE, and the mutual information between a skill and what it does."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from qdos_brax.config import Config, SkillsConfig, asks_auto
from qdos_brax.data.device import DeviceData
from qdos_brax.nn.optim import ADAM, adam_step, rate_schedule
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase, even_chunks
from qdos_brax.skills.alpha import AdaptiveAlpha, Alpha, FixedAlpha, unreadable_share
from qdos_brax.skills.information_terms import InformationTerm, Rollout
from qdos_brax.skills.latent_map import Prior, latent_map
from qdos_brax.skills.segment_weights import SegmentBatch, SegmentWeights
from qdos_brax.skills.temperature import effective_share, member_temperature
from qdos_brax.skills.vae import Segments, SkillModel, segments_at
from qdos_brax.skills.weights import advantage_weights

_UPDATES_PER_CHUNK = 1_000  # at most, where a block is not longer: a run looks for signals between chunks


class SkillPhaseState(struct.PyTreeNode):
    """Hold what the phase carries, every leaf [members, ...].

    Attributes:
        key: typed key.
        params: of the skill model.
        opt_state: Adam's, of ``params``.
        weights: what the segment weights learn.
        information: what the mutual-information term learns and remembers by itself.
        alpha: what the weight of the mutual-information loss carries.
        update: gradient steps so far.
        broken: rollouts whose simulation broke; they are left out.
        healthy: False once a number that is learned stopped being finite; the member is frozen from then on.
    """

    key: jax.Array
    params: Any
    opt_state: optax.OptState
    weights: Any
    information: Any
    alpha: Any
    update: jax.Array
    broken: jax.Array
    healthy: jax.Array


class SkillPhase(MemberPhase):
    """Learn skills by the weighted trajectory VAE and the mutual-information term.

    A block of ``mi_every`` gradient steps shares one batch of rollouts of random skills (none when ``information`` is
    None): simulating is far dearer than a gradient step.

    Args:
        config: the run's configuration.
        model: posterior, prior and decoder.
        weights: where segment advantages come from.
        information: the mutual-information term, or None to leave it out.
        view: what the model's view knows of the data.
        blocks_per_chunk: blocks between two looks of the host, at most; fewer where they would make more than
            1,000 gradient steps.
    """

    def __init__(
        self,
        config: Config,
        model: SkillModel,
        weights: SegmentWeights,
        information: InformationTerm | None,
        view: Mapping[str, Any] = MappingProxyType({}),
        blocks_per_chunk: int = 10,
    ) -> None:
        self._skills: SkillsConfig = config.skills
        self._view = view
        # The map by which random skills are drawn: an absolute box, or where the high level plays.
        self._drawn = "box" if config.skills.mi_latent == "box" else config.high_level.latent_map
        self._model, self._weights, self._information = model, weights, information
        self._alpha: Alpha = AdaptiveAlpha() if asks_auto(config.skills.alpha) else FixedAlpha()
        self._finds_temperature = asks_auto(config.skills.advantage_temperature)
        every = self._skills.mi_every
        chunks, self._blocks = even_chunks(
            -(-self._skills.updates // every), min(blocks_per_chunk, max(1, _UPDATES_PER_CHUNK // every))
        )
        self._rate = rate_schedule(self._skills.schedule, chunks * self._blocks * every)
        super().__init__("skills", "pretrain", chunks)

    def bind(self, population: Population, data: DeviceData) -> None:
        """Compile the programs, that of the weights' temperature included."""
        super().bind(population, data)
        self._temperatures = population.program(lambda advantage, hyper, _: member_temperature(advantage, hyper))

    def constants(self, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the segments' advantages, where values were learned, and the temperature that was found for them."""
        if "advantage" not in artifacts:
            return {}
        advantage = artifacts["advantage"]
        if not self._finds_temperature:
            return {"advantage": advantage}
        return {"advantage": advantage, "temperature": self._temperatures(advantage, self.hyper, self.data)}

    def metrics(self, state: SkillPhaseState, info: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return the columns of metrics.csv after a chunk, [members] each."""
        if self._information is not None:
            info = info | {"broken_envs": np.asarray(state.broken)}
        return super().metrics(state, info)

    def finish(self, state: SkillPhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the skill model's parameters; what the weights learned is dropped."""
        return artifacts | {"skills": state.params, health.KEY: state.healthy}

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> SkillPhaseState:
        """Return fresh networks."""
        model_key, weights_key, key, information_key = jax.random.split(key, 4)
        params = self._model.init(model_key, self._view)
        return SkillPhaseState(
            key=key,
            params=params,
            opt_state=ADAM.init(params),
            weights=self._weights.init(weights_key),
            information={} if self._information is None else self._information.init(information_key),
            alpha=self._alpha.start(),
            update=jnp.zeros((), jnp.int32),
            broken=jnp.zeros((), jnp.int32),
            healthy=jnp.ones((), bool),
        )

    def train_member(
        self, state: SkillPhaseState, constants: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[SkillPhaseState, dict[str, jax.Array]]:
        """Make a chunk's gradient steps."""
        keys = jax.random.split(state.key, self._blocks + 1)
        block = partial(self._block, data=data, hyper=hyper, artifacts=constants)
        after, info = jax.lax.scan(block, state, keys[1:])
        learned, healthy = health.keep_finite(state.healthy, _learned(after), _learned(state))
        state = after.replace(key=keys[0], healthy=healthy, **learned)
        return state, jax.tree.map(jnp.mean, info)

    def _block(
        self, state: SkillPhaseState, key: jax.Array, data: DeviceData, hyper: Any, artifacts: Any
    ) -> tuple[SkillPhaseState, dict[str, jax.Array]]:
        """One batch of rollouts, then ``mi_every`` gradient steps on it and on fresh segments."""
        rollout_key, latent_key, update_key, error_key = jax.random.split(key, 4)
        played = None
        if self._information is not None:
            state, rollout = self._roll_out(state, rollout_key, latent_key, data, hyper, artifacts)
            information, played = self._information.receive(state.information, state.params, rollout)
            state = state.replace(information=information)
            error = partial(self._unreadable, state, played, rollout.weight, error_key, hyper)
            state = state.replace(alpha=self._alpha.after_rollouts(state.alpha, error, self._skills.mi_every, hyper))
        update = partial(self._update, data=data, hyper=hyper, artifacts=artifacts, played=played)
        return jax.lax.scan(update, state, jax.random.split(update_key, self._skills.mi_every))

    def _roll_out(
        self,
        state: SkillPhaseState,
        key: jax.Array,
        latent_key: jax.Array,
        data: DeviceData,
        hyper: Any,
        artifacts: Any,
    ) -> tuple[SkillPhaseState, Rollout]:
        """Return ``mi_batch`` random skills and where they led, and the state with those counted that broke."""
        assert self._information is not None
        index = jax.random.randint(key, (self._skills.mi_batch,), 0, data.starts.shape[0])
        starts, half_side = data.starts[index], hyper["skills.latent_box"]
        action = jax.random.uniform(latent_key, (self._skills.mi_batch, self._skills.latent_dim), minval=-1.0)
        prior = Prior(*self._model.prior(state.params, data.observations[starts]))
        latent = latent_map(self._drawn, half_side).to_latent(action, prior)
        observations = self._information.source(state.params, data, starts, latent)
        weight = self._weight(state, self._batch(state, data, index), artifacts, hyper)
        # One simulation that broke must not cost the member: it is counted, and weighs nothing.
        finite = jnp.all(jnp.isfinite(observations), axis=(1, 2))
        observations = jnp.where(finite[:, None, None], observations, 0.0)
        rollout = Rollout(observations, latent, half_side * action, jnp.where(finite, weight, 0.0))
        return state.replace(broken=state.broken + jnp.sum(~finite).astype(jnp.int32)), rollout

    def _unreadable(
        self, state: SkillPhaseState, played: Any, weight: jax.Array, key: jax.Array, hyper: Any
    ) -> jax.Array:
        """Return the share of a random skill's variance that cannot be read back from what it did."""
        assert self._information is not None
        loss = self._information.loss(state.params, state.information, played, key)
        return unreadable_share(loss, weight, hyper["skills.latent_box"], self._skills.latent_dim)

    def _update(
        self, state: SkillPhaseState, key: jax.Array, data: DeviceData, hyper: Any, artifacts: Any, played: Any
    ) -> tuple[SkillPhaseState, dict[str, jax.Array]]:
        index_key, sample_key, learn_key, loss_key = jax.random.split(key, 4)
        index = jax.random.randint(index_key, (self._skills.batch_size,), 0, data.starts.shape[0])
        batch = self._batch(state, data, index)
        state = state.replace(weights=self._weights.learn(state.weights, batch, artifacts, hyper))
        weight = self._weight(state, batch, artifacts, hyper)
        segments = self._segments(data, index)
        state, found = self._learn_information(state, segments, learn_key)

        def loss(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            total, info = self._model.vae_loss(
                params, segments, weight, hyper["skills.kl_weight"], sample_key, self._skills.kl_weighted
            )
            if self._information is None:
                return total, info
            information_loss = self._information.loss(params, state.information, played, loss_key)
            info = info | {"information_loss": information_loss} | self._alpha.metrics(state.alpha, hyper)
            return total + self._alpha.weight(state.alpha, hyper) * information_loss, info

        grads, info = jax.grad(loss, has_aux=True)(state.params)
        rate = hyper["skills.learning_rate"] * self._rate(state.update)
        params, opt_state = adam_step(state.params, state.opt_state, grads, rate)
        info = info | {"weight_ess": effective_share(weight)}
        if "temperature" in artifacts:
            info = info | {"weight_temperature": artifacts["temperature"]}
        state = state.replace(params=params, opt_state=opt_state, update=state.update + 1)
        return state, info | found

    def _learn_information(
        self, state: SkillPhaseState, segments: Segments, key: jax.Array
    ) -> tuple[SkillPhaseState, dict[str, jax.Array]]:
        if self._information is None:
            return state, {}
        information, info = self._information.learn(state.information, state.params, segments, key)
        return state.replace(information=information), info

    def _segments(self, data: DeviceData, index: jax.Array) -> Segments:
        return segments_at(data, data.starts[index], self._skills.horizon, self._model.reach)

    def _batch(self, state: SkillPhaseState, data: DeviceData, index: jax.Array) -> SegmentBatch:
        observation = data.observations[data.starts[index]]
        return SegmentBatch(
            index, observation, latent=lambda: self._model.encode(state.params, self._segments(data, index)).mean
        )

    def _weight(self, state: SkillPhaseState, batch: SegmentBatch, artifacts: Any, hyper: Any) -> jax.Array:
        advantage = self._weights.advantage(state.weights, batch, artifacts)
        temperature = artifacts.get("temperature", hyper["skills.advantage_temperature"])
        return advantage_weights(advantage, temperature, hyper["skills.weight_clip"])


def _learned(state: SkillPhaseState) -> dict[str, Any]:
    return {name: getattr(state, name) for name in ("params", "opt_state", "weights", "information", "alpha")}
