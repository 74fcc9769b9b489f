"""The last phase: the high level learns online which skill to play, with the data's help."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct

from qdos_brax.config import Config
from qdos_brax.data.device import DeviceData, MacroRows, Normaliser, macro_rows
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.evaluation import Episodes, evaluate
from qdos_brax.high_level.macro_step import MacroStep, macro_step, reset_done
from qdos_brax.high_level.sac import SAC, Batch, SACHyper, SACState
from qdos_brax.labels.offline_reward import OfflineReward
from qdos_brax.labels.rnd import RND, RNDState
from qdos_brax.latent_map import latent_map
from qdos_brax.networks import gaussian_sample
from qdos_brax.population import over_members
from qdos_brax.skills.vae import SkillModel

NEVER = -1


class OnlineRow(struct.PyTreeNode):
    """A macro transition of the replay; observations are normalised."""

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array
    next_observation: jax.Array


class Learners(struct.PyTreeNode):
    """Everything that learns online."""

    sac: SACState
    rnd: RNDState
    labeller: Any


class OnlinePhaseState(struct.PyTreeNode):
    """What the phase carries, every leaf [members, ...].

    Attributes:
        key: typed key.
        learners: networks and optimisers.
        replay: macro transitions.
        env_state: State of the training environments, [members, num_envs, ...].
        env_steps: live environment steps so far, over all environments.
        update: critic steps so far.
        first_goal_step: env_steps when the goal was first reached, in training or evaluation; -1 before.
        broken: simulations that broke and were reset.
        healthy: False once a parameter stopped being finite; the member is frozen from then on.
        chunk: chunks done.
    """

    key: jax.Array
    learners: Learners
    replay: replay_buffer.Replay
    env_state: State
    env_steps: jax.Array
    update: jax.Array
    first_goal_step: jax.Array
    broken: jax.Array
    healthy: jax.Array
    chunk: jax.Array


class OnlinePhase:
    """SAC over skills.

    Each iteration plays one macro step in every environment, stores them, and makes ``utd`` critic steps, one actor
    and one temperature step per macro step played. Half of a batch is online experience, half labelled data.

    Args:
        config: the run's configuration.
        env: the task; the training environments and those of the evaluation are separate states of it.
        data: the data set on the device.
        normaliser: of observations.
        hyper: scannable numbers by dotted key, float32[members] each.
        model: the frozen skills.
        labeller: gives offline rows their reward and mask.
        steps_per_chunk: environment steps between two looks of the host.
    """

    name = "online"
    part = "online"

    def __init__(
        self,
        config: Config,
        env: Env,
        data: DeviceData,
        normaliser: Normaliser,
        hyper: dict[str, jax.Array],
        model: SkillModel,
        labeller: OfflineReward,
        steps_per_chunk: int = 2_000,
    ) -> None:
        high, self._horizon = config.high_level, config.skills.horizon
        self._config, self._env, self._data, self._normalise = config, env, data, normaliser
        self._hyper, self._model, self._labeller = hyper, model, labeller
        width, latent = data.observations.shape[-1], config.skills.latent_dim
        self._sac = SAC(width, latent, high.hidden, high.ensemble, high.target_subset)
        self._rnd = RND(width + latent, config.labels.rnd_hidden, config.labels.rnd_features)
        self._offline = round(high.batch_size * high.offline_fraction)

        per_iteration = high.num_envs * self._horizon
        chunk_steps = min(steps_per_chunk, high.env_steps, config.eval.every_env_steps)
        self._iterations = max(1, chunk_steps // per_iteration)
        self.num_chunks = -(-high.env_steps // (self._iterations * per_iteration))
        self._evaluate_every = max(1, round(config.eval.every_env_steps / (self._iterations * per_iteration)))

        members = len(hyper["skills.alpha"])
        self._start = jax.jit(jax.vmap(self._init))
        self._chunk = jax.jit(over_members(self._train, members), donate_argnums=0)
        self._evaluate = jax.jit(over_members(self._play_episodes, members))

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> OnlinePhaseState:
        """Fresh learners, empty replay, environments at their starts."""
        self._frozen = {"skills": artifacts["skills"], "labels": artifacts["labels"]}
        return self._start(key, self._hyper)

    def chunk(self, state: OnlinePhaseState) -> tuple[OnlinePhaseState, dict[str, Any]]:
        """Some iterations, and an evaluation when one is due (always after the last chunk)."""
        state, info = self._chunk(state, self._frozen, self._hyper, self._data)
        metrics = jax.tree.map(np.asarray, info)
        chunk = int(state.chunk[0])
        if chunk % self._evaluate_every == 0 or chunk == self.num_chunks:
            started = time.perf_counter()
            state, episodes = self._evaluate(state, self._frozen, self._hyper, self._data)
            metrics |= _summary(episodes) | {"eval_seconds": time.perf_counter() - started}
        first = np.asarray(state.first_goal_step, np.float64)
        metrics |= {
            "env_steps": np.asarray(state.env_steps),
            "update": np.asarray(state.update),
            "first_goal_step": np.where(first == NEVER, np.nan, first),
            "broken_envs": np.asarray(state.broken),
            "status_ok": np.asarray(state.healthy),
        }
        return state, metrics

    def finish(self, state: OnlinePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Adds the actor and what it needs to see; labels and advantages are done with."""
        kept = {name: value for name, value in artifacts.items() if name not in ("labels", "advantage")}
        members = state.env_steps.shape[0]
        repeated = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), self._normalise)
        normaliser = {"mean": repeated.mean, "scale": repeated.scale}
        return kept | {"actor": state.learners.sac.actor, "normaliser": normaliser}

    # --- One member ------------------------------------------------------------------------------------------

    def _init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> OnlinePhaseState:
        sac_key, rnd_key, labeller_key, env_key, key = jax.random.split(key, 5)
        high = self._config.high_level
        observation = jnp.zeros(self._sac.observation_dim)
        row = OnlineRow(observation, jnp.zeros(self._sac.action_dim), jnp.zeros(()), jnp.zeros(()), observation)
        learners = Learners(
            sac=self._sac.init(sac_key, hyper["high_level.init_temperature"]),
            rnd=self._rnd.init(rnd_key),
            labeller=self._labeller.init(labeller_key),
        )
        return OnlinePhaseState(
            key=key,
            learners=learners,
            replay=replay_buffer.create(row, high.replay_capacity),
            env_state=jax.vmap(self._env.reset)(jax.random.split(env_key, high.num_envs)),
            env_steps=jnp.zeros((), jnp.int32),
            update=jnp.zeros((), jnp.int32),
            first_goal_step=jnp.full((), NEVER, jnp.int32),
            broken=jnp.zeros((), jnp.int32),
            healthy=jnp.ones((), bool),
            chunk=jnp.zeros((), jnp.int32),
        )

    def _train(
        self, state: OnlinePhaseState, frozen: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        iteration = partial(self._iteration, frozen=frozen, hyper=hyper, data=data)
        state, info = jax.lax.scan(iteration, state, None, length=self._iterations)
        return state.replace(chunk=state.chunk + 1), jax.tree.map(jnp.mean, info)

    def _iteration(
        self, state: OnlinePhaseState, _: None, frozen: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        act_key, update_key, key = jax.random.split(state.key, 3)
        state, info = self._act(state.replace(key=key), act_key, frozen, hyper)
        learn = partial(self._learn, replay=state.replay, env_steps=state.env_steps)
        learn = partial(learn, frozen=frozen, hyper=hyper, data=data)
        keys = jax.random.split(update_key, self._config.high_level.num_envs)
        learners, losses = jax.lax.scan(learn, state.learners, keys)

        healthy = state.healthy & _all_finite(learners)
        learners = jax.tree.map(lambda a, b: jnp.where(healthy, a, b), learners, state.learners)
        state = state.replace(
            learners=learners,
            healthy=healthy,
            update=state.update + self._config.high_level.num_envs * self._config.high_level.utd,
        )
        return state, info | jax.tree.map(jnp.mean, losses)

    def _act(
        self, state: OnlinePhaseState, key: jax.Array, frozen: Any, hyper: dict[str, jax.Array]
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        """One macro step in every environment, stored; episodes that are over start anew."""
        num_envs = self._config.high_level.num_envs
        prior_key, actor_key, reset_key = jax.random.split(key, 3)
        agent = self._agent(state.learners.sac.actor, frozen["skills"], hyper)
        observation = self._normalise(state.env_state.obs)
        prior = agent.prior(observation)
        from_prior = agent.latent_map.to_action(gaussian_sample(prior_key, *prior), prior)
        action = self._sac.act(state.learners.sac.actor, actor_key, observation)
        warmup = state.env_steps < self._config.high_level.warmup_env_steps
        action = jnp.where(warmup, from_prior, action)
        discount = hyper["high_level.discount"]

        def one(env_state: State, latent: jax.Array) -> tuple[State, MacroStep]:
            return macro_step(self._env, lambda obs: agent.play(obs, latent), env_state, self._horizon, discount)

        env_state, result = jax.vmap(one)(state.env_state, agent.latent_map.to_latent(action, prior))
        rows = OnlineRow(observation, action, result.reward, result.mask, self._normalise(result.next_observation))
        keys = jax.random.split(reset_key, num_envs)
        env_steps = state.env_steps + jnp.sum(result.steps)
        reached = jnp.any(result.success > 0) & (state.first_goal_step == NEVER)
        state = state.replace(
            replay=replay_buffer.insert(state.replay, rows, result.finite),
            env_state=jax.vmap(partial(reset_done, self._env))(env_state, ~result.finite, keys),
            env_steps=env_steps,
            first_goal_step=jnp.where(reached, env_steps, state.first_goal_step),
            broken=state.broken + jnp.sum(~result.finite).astype(jnp.int32),
        )
        return state, {"train/success": jnp.mean(result.success)}

    def _learn(
        self,
        learners: Learners,
        key: jax.Array,
        replay: replay_buffer.Replay,
        env_steps: jax.Array,
        frozen: Any,
        hyper: dict[str, jax.Array],
        data: DeviceData,
    ) -> tuple[Learners, dict[str, jax.Array]]:
        """``utd`` critic steps, one actor and temperature step, one step of what labels (on online rows only)."""
        high = self._config.high_level
        label_key, actor_key, critic_key = jax.random.split(key, 3)
        online = replay_buffer.sample(replay, label_key, high.batch_size)
        active = env_steps >= self._config.labels.start_env_steps
        learners = self._learn_labels(learners, online, hyper, active)

        sac_hyper = SACHyper(
            learning_rate=hyper["high_level.learning_rate"],
            discount=hyper["high_level.discount"],
            target_rate=hyper["high_level.target_rate"],
            target_entropy=-hyper["high_level.target_entropy_scale"] * self._sac.action_dim,
        )
        sample = partial(self._sample, learners, replay, frozen=frozen, hyper=hyper, data=data)

        def critic_step(sac: SACState, key: jax.Array) -> tuple[SACState, dict[str, jax.Array]]:
            batch_key, update_key = jax.random.split(key)
            return self._sac.update_critic(sac, sample(batch_key), update_key, sac_hyper)

        sac, critic_info = jax.lax.scan(critic_step, learners.sac, jax.random.split(critic_key, high.utd))
        batch_key, update_key = jax.random.split(actor_key)
        sac, actor_info = self._sac.update_actor(sac, sample(batch_key).observation, update_key, sac_hyper)
        bonus = self._bonus(learners.rnd, online.observation, online.action, hyper)
        info = jax.tree.map(jnp.mean, critic_info) | actor_info | {"bonus": jnp.mean(bonus)}
        return learners.replace(sac=sac), info

    def _learn_labels(
        self, learners: Learners, online: OnlineRow, hyper: dict[str, jax.Array], active: jax.Array
    ) -> Learners:
        rnd = self._rnd.update(learners.rnd, online.observation, online.action, hyper["labels.rnd_learning_rate"])
        rows = MacroRows(online.observation, online.reward, online.mask, online.next_observation)
        rate = hyper["labels.reward_learning_rate"]
        labeller = self._labeller.learn(learners.labeller, rows, online.action, rate, active)
        return learners.replace(
            rnd=jax.tree.map(lambda a, b: jnp.where(active, a, b), rnd, learners.rnd), labeller=labeller
        )

    def _sample(
        self,
        learners: Learners,
        replay: replay_buffer.Replay,
        key: jax.Array,
        frozen: Any,
        hyper: dict[str, jax.Array],
        data: DeviceData,
    ) -> Batch:
        """A batch, offline rows first; the bonus for novelty is on all of them."""
        online_key, offline_key = jax.random.split(key)
        online = replay_buffer.sample(replay, online_key, self._config.high_level.batch_size - self._offline)
        index = jax.random.randint(offline_key, (self._offline,), 0, data.starts.shape[0])
        action = frozen["labels"][index]
        discount = hyper["high_level.discount"]
        rows = macro_rows(data, data.starts[index], self._horizon, discount)
        reward, mask = self._labeller.label(learners.labeller, rows, action, discount)
        offline = OnlineRow(rows.observation, action, reward, mask, rows.next_observation)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), offline, online)
        bonus = self._bonus(learners.rnd, both.observation, both.action, hyper)
        return Batch(both.observation, both.action, both.reward + bonus, both.mask, both.next_observation)

    def _bonus(
        self, rnd: RNDState, observation: jax.Array, action: jax.Array, hyper: dict[str, jax.Array]
    ) -> jax.Array:
        return hyper["labels.rnd_coefficient"] * self._rnd.error(rnd.predictor, rnd.target, observation, action)

    def _play_episodes(
        self, state: OnlinePhaseState, frozen: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, Episodes]:
        key, episode_key = jax.random.split(state.key)
        agent = self._agent(state.learners.sac.actor, frozen["skills"], hyper)
        episodes = evaluate(
            self._env,
            agent.choose,
            agent.play,
            episode_key,
            self._config.eval.episodes,
            self._horizon,
        )
        reached = jnp.any(episodes.success > 0) & (state.first_goal_step == NEVER)
        first = jnp.where(reached, state.env_steps, state.first_goal_step)
        return state.replace(key=key, first_goal_step=first), episodes

    def _agent(self, actor: Any, skills: Any, hyper: dict[str, jax.Array]) -> Agent:
        to_skill = latent_map(self._config.high_level.latent_map, hyper["skills.latent_box"])
        return Agent(self._normalise, self._model, self._sac, to_skill, skills, actor)


def _all_finite(tree: Any) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def _summary(episodes: Episodes) -> dict[str, np.ndarray]:
    """Evaluation metrics, [members] each."""
    success = np.asarray(episodes.success)
    return {
        "eval/success": success.mean(axis=-1),
        "eval/return": np.asarray(episodes.episode_return).mean(axis=-1),
        "eval/length": np.asarray(episodes.length).mean(axis=-1),
        "eval/episodes": np.full(success.shape[0], success.shape[-1]),
    }
