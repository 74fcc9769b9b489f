"""The last phase: the high level learns online which skill (or action) to play, with or without the data's help."""

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
from qdos_brax.high_level.evaluation import Episodes, evaluate, summary
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.macro_step import MacroStep, macro_step, reset_done
from qdos_brax.high_level.sac import SAC, Batch, Reference, SACHyper, SACState
from qdos_brax.labels.bonus import Bonus
from qdos_brax.labels.offline_reward import OfflineReward
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.memory import working_bytes
from qdos_brax.skills.source import SkillSource

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
    rnd: Any
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
        guided: int32[members, num_envs], steps that the guide still takes in each environment's episode; None if there
            is no guide.
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
    guided: Any


class OnlinePhase:
    """SAC over skills, or over actions where the source has none.

    Each iteration plays one macro step in every environment, stores them, and makes ``utd`` critic steps, one actor
    and one temperature step per macro step played. Of a batch, ``offline_fraction`` is labelled data, the rest online
    experience. As in the published code of SUPE and ExPLORe the bonus learns from every macro step once, when it was
    just played, and the labeller as often as the critics do.

    Args:
        config: the run's configuration.
        env: the task; the training environments and those of the evaluation are separate states of it.
        data: the data set on the device.
        normaliser: of observations.
        population: the members.
        source: the frozen skills.
        labeller: gives offline rows their reward and mask.
        bonus: for novelty.
        guide: acts for an episode's first steps, or None; it acts step by step, so the horizon must be 1.
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
        population: Population,
        source: SkillSource,
        labeller: OfflineReward,
        bonus: Bonus,
        guide: JumpStart | None = None,
        steps_per_chunk: int = 2_000,
    ) -> None:
        high, self._horizon = config.high_level, config.skills.horizon
        self._config, self._env, self._data, self._normalise = config, env, data, normaliser
        self._hyper, self._source, self._labeller = population.hyper, source, labeller
        self._novelty, self._guide = bonus, guide
        self._sac = high_level_sac(config, data.observations.shape[-1], source)
        self._offline = round(high.batch_size * high.offline_fraction)
        if guide is not None and self._horizon != 1:
            raise ValueError("a guide acts step by step: the horizon must be 1")

        per_iteration = high.num_envs * self._horizon
        chunk_steps = min(steps_per_chunk, high.env_steps, config.eval.every_env_steps)
        self._iterations = max(1, chunk_steps // per_iteration)
        self.num_chunks = -(-high.env_steps // (self._iterations * per_iteration))
        self._capacity = min(high.replay_capacity, self.num_chunks * self._iterations * high.num_envs)
        self._evaluate_every = max(1, round(config.eval.every_env_steps / (self._iterations * per_iteration)))

        self._start = population.program(self._init)
        self._chunk = population.program(self._train, carries=True)
        self._evaluate = population.program(self._play_episodes, carries=True)

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> OnlinePhaseState:
        """Fresh learners, empty replay, environments at their starts."""
        self._frozen = {name: artifacts.get(name, {}) for name in ("skills", "labels", "guide")}
        state: OnlinePhaseState = self._start(key, self._hyper, None)
        return state.replace(healthy=health.inherited(artifacts, len(key)))

    def chunk(self, state: OnlinePhaseState) -> tuple[OnlinePhaseState, dict[str, Any]]:
        """Some iterations, and an evaluation when one is due (always after the last chunk)."""
        state, info = self._chunk(state, self._frozen, self._hyper, self._data)
        metrics = jax.tree.map(np.asarray, info)
        chunk = int(state.chunk[0])
        if chunk % self._evaluate_every == 0 or chunk == self.num_chunks:
            started = time.perf_counter()
            state, episodes = self._evaluate(state, self._frozen, self._hyper, self._data)
            metrics |= summary(episodes) | {"eval_seconds": time.perf_counter() - started}
        first = np.asarray(state.first_goal_step, np.float64)
        metrics |= {
            "env_steps": np.asarray(state.env_steps),
            "update": np.asarray(state.update),
            "first_goal_step": np.where(first == NEVER, np.nan, first),
            "broken_envs": np.asarray(state.broken),
            "status_ok": np.asarray(state.healthy),
        }
        return state, metrics

    def working_bytes(self, state: Any) -> int:
        """What a chunk needs beside the state, which may be shapes alone."""
        return working_bytes(self._chunk, state, self._frozen, self._hyper, self._data)

    def finish(self, state: OnlinePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Adds the actor and what it needs to see; labels and the guide are done with."""
        kept = {name: value for name, value in artifacts.items() if name not in ("labels", "guide")}
        normaliser = self._normalise.repeated(state.env_steps.shape[0])
        return kept | {"actor": state.learners.sac.actor, "normaliser": normaliser, health.KEY: state.healthy}

    # --- One member ------------------------------------------------------------------------------------------

    def _init(self, key: jax.Array, hyper: dict[str, jax.Array], _: None) -> OnlinePhaseState:
        sac_key, rnd_key, labeller_key, env_key, key = jax.random.split(key, 5)
        high = self._config.high_level
        observation = jnp.zeros(self._sac.observation_dim)
        row = OnlineRow(observation, jnp.zeros(self._sac.action_dim), jnp.zeros(()), jnp.zeros(()), observation)
        learners = Learners(
            sac=self._sac.init(sac_key, hyper["high_level.init_temperature"]),
            rnd=self._novelty.init(rnd_key),
            labeller=self._labeller.init(labeller_key),
        )
        return OnlinePhaseState(
            key=key,
            learners=learners,
            replay=replay_buffer.create(row, self._capacity),
            env_state=jax.vmap(self._env.reset)(jax.random.split(env_key, high.num_envs)),
            env_steps=jnp.zeros((), jnp.int32),
            update=jnp.zeros((), jnp.int32),
            first_goal_step=jnp.full((), NEVER, jnp.int32),
            broken=jnp.zeros((), jnp.int32),
            healthy=jnp.ones((), bool),
            chunk=jnp.zeros((), jnp.int32),
            guided=None if self._guide is None else self._guide.draw(_guide_key(env_key), high.num_envs),
        )

    def _train(
        self, state: OnlinePhaseState, frozen: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        iteration = partial(self._iteration, frozen=frozen, hyper=hyper, data=data)
        state, info = jax.lax.scan(iteration, state, None, length=self._iterations)
        played = {name: jnp.sum(info.pop(name)) for name in ("reached", "ended")}
        success = {"train/success": played["reached"] / played["ended"]}  # of the episodes; nan where none ended
        return state.replace(chunk=state.chunk + 1), jax.tree.map(jnp.mean, info) | success

    def _iteration(
        self, state: OnlinePhaseState, _: None, frozen: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        act_key, update_key, key = jax.random.split(state.key, 3)
        state, newest, info = self._act(state.replace(key=key), act_key, frozen, hyper)
        learn = partial(self._learn, replay=state.replay, env_steps=state.env_steps)
        learn = partial(learn, frozen=frozen, hyper=hyper, data=data)
        keys = jax.random.split(update_key, self._config.high_level.num_envs)
        learners, losses = jax.lax.scan(learn, state.learners, (keys, newest))

        learners, healthy = health.keep_finite(state.healthy, learners, state.learners)
        state = state.replace(
            learners=learners,
            healthy=healthy,
            update=state.update + self._config.high_level.num_envs * self._config.high_level.utd,
        )
        return state, info | jax.tree.map(jnp.mean, losses)

    def _act(
        self, state: OnlinePhaseState, key: jax.Array, frozen: Any, hyper: dict[str, jax.Array]
    ) -> tuple[OnlinePhaseState, OnlineRow, dict[str, jax.Array]]:
        """One macro step in every environment, stored, and their rows[num_envs]; episodes that are over start anew."""
        num_envs = self._config.high_level.num_envs
        first_key, actor_key, reset_key = jax.random.split(key, 3)
        agent = self._agent(state.learners.sac.actor, frozen["skills"], hyper)
        observation = self._normalise(state.env_state.obs)
        first = self._source.first(agent.skills, first_key, observation, agent.box)
        action = self._sac.act(state.learners.sac.actor, actor_key, observation)
        warmup = state.env_steps < self._config.high_level.warmup_env_steps
        action = jnp.where(warmup, first, action)
        if self._guide is not None:
            guide_action = self._guide.sample(frozen["guide"], _guide_key(actor_key), observation)
            guide_action = self._source.to_action(agent.skills, guide_action, observation, agent.box)
            action = jnp.where(state.guided[:, None] > 0, guide_action, action)
        latent = self._source.to_latent(agent.skills, action, observation, agent.box)
        discount = hyper["high_level.discount"]

        def one(env_state: State, latent: jax.Array) -> tuple[State, MacroStep]:
            return macro_step(self._env, lambda obs: agent.play(obs, latent), env_state, self._horizon, discount)

        env_state, result = jax.vmap(one)(state.env_state, latent)
        rows = OnlineRow(observation, action, result.reward, result.mask, self._normalise(result.next_observation))
        keys = jax.random.split(reset_key, num_envs)
        env_steps = state.env_steps + jnp.sum(result.steps)
        reached = jnp.any(result.success > 0) & (state.first_goal_step == NEVER)
        over = (env_state.done > 0.5) | ~result.finite
        if self._guide is not None:
            fresh = self._guide.draw(_guide_key(reset_key), num_envs)
            state = state.replace(guided=jnp.where(over, fresh, jnp.maximum(state.guided - 1, 0)))
        state = state.replace(
            replay=replay_buffer.insert(state.replay, rows, result.finite),
            env_state=jax.vmap(partial(reset_done, self._env))(env_state, ~result.finite, keys),
            env_steps=env_steps,
            first_goal_step=jnp.where(reached, env_steps, state.first_goal_step),
            broken=state.broken + jnp.sum(~result.finite).astype(jnp.int32),
        )
        return state, rows, {"reached": jnp.sum(result.success), "ended": jnp.sum(over)}

    def _learn(
        self,
        learners: Learners,
        given: tuple[jax.Array, OnlineRow],
        replay: replay_buffer.Replay,
        env_steps: jax.Array,
        frozen: Any,
        hyper: dict[str, jax.Array],
        data: DeviceData,
    ) -> tuple[Learners, dict[str, jax.Array]]:
        """Of a macro step, ``given`` its key and row: the labels' steps, ``utd`` of the critics, one of the actor."""
        high = self._config.high_level
        (key, newest), active = given, env_steps >= self._config.labels.start_env_steps
        label_key, actor_key, critic_key = jax.random.split(key, 3)
        rnd = self._novelty.learn(learners.rnd, newest.observation[None], newest.action[None], hyper, active)
        learners = learners.replace(rnd=rnd)
        learners = self._learn_rewards(learners, label_key, replay, hyper, active)

        target_entropy, reference = self._regulariser(frozen["skills"], hyper)
        sac_hyper = SACHyper(
            learning_rate=hyper["high_level.learning_rate"],
            discount=hyper["high_level.discount"],
            target_rate=hyper["high_level.target_rate"],
            target_entropy=target_entropy,
        )
        sample = partial(self._sample, learners, replay, frozen=frozen, hyper=hyper, data=data)

        def critic_step(sac: SACState, key: jax.Array) -> tuple[SACState, dict[str, jax.Array]]:
            batch_key, update_key = jax.random.split(key)
            return self._sac.update_critic(sac, sample(batch_key), update_key, sac_hyper, reference)

        sac, critic_info = jax.lax.scan(critic_step, learners.sac, jax.random.split(critic_key, high.utd))
        batch_key, update_key = jax.random.split(actor_key)
        sac, actor_info = self._sac.update_actor(sac, sample(batch_key).observation, update_key, sac_hyper, reference)
        bonus = self._novelty.of(learners.rnd, newest.observation, newest.action, hyper)
        info = jax.tree.map(jnp.mean, critic_info) | actor_info | {"bonus": jnp.mean(bonus)}
        return learners.replace(sac=sac), info

    def _regulariser(self, skills: Any, hyper: dict[str, jax.Array]) -> tuple[jax.Array, Reference | None]:
        """The entropy that the temperature aims at, and what density it is relative to."""
        if self._config.high_level.regulariser == "entropy":
            return -hyper["high_level.target_entropy_scale"] * self._sac.action_dim, None

        def log_prior(observation: jax.Array, action: jax.Array) -> jax.Array:
            return self._source.log_prior(skills, action, observation, hyper["skills.latent_box"])

        return -hyper["high_level.target_divergence"], log_prior

    def _learn_rewards(
        self,
        learners: Learners,
        key: jax.Array,
        replay: replay_buffer.Replay,
        hyper: dict[str, jax.Array],
        active: jax.Array,
    ) -> Learners:
        """As many steps of the labeller as of the critics, on as many online rows (SUPE's and ExPLORe's code)."""
        high, rate = self._config.high_level, hyper["labels.reward_learning_rate"]

        def step(labeller: Any, key: jax.Array) -> tuple[Any, None]:
            online = replay_buffer.sample(replay, key, high.batch_size - self._offline)
            rows = MacroRows(online.observation, online.reward, online.mask, online.next_observation)
            return self._labeller.learn(labeller, rows, online.action, rate, active), None

        labeller, _ = jax.lax.scan(step, learners.labeller, jax.random.split(key, high.utd))
        return learners.replace(labeller=labeller)

    def _sample(
        self,
        learners: Learners,
        replay: replay_buffer.Replay,
        key: jax.Array,
        frozen: Any,
        hyper: dict[str, jax.Array],
        data: DeviceData,
    ) -> Batch:
        """A batch, offline rows first, with the bonus for novelty."""
        online_key, offline_key = jax.random.split(key)
        rows = replay_buffer.sample(replay, online_key, self._config.high_level.batch_size - self._offline)
        if self._offline:
            offline = self._sample_offline(learners, offline_key, frozen, hyper, data)
            rows = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), offline, rows)
        bonus = self._novelty.of(learners.rnd, rows.observation, rows.action, hyper)
        if self._config.labels.bonus_rows == "online":
            bonus = jnp.where(jnp.arange(len(rows.reward)) < self._offline, 0.0, bonus)
        return Batch(rows.observation, rows.action, rows.reward + bonus, rows.mask, rows.next_observation)

    def _sample_offline(
        self, learners: Learners, key: jax.Array, frozen: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> OnlineRow:
        """Labelled segments, with the reward and mask that they are given."""
        index = jax.random.randint(key, (self._offline,), 0, data.starts.shape[0])
        action = frozen["labels"][index]
        discount = hyper["high_level.discount"]
        rows = macro_rows(data, data.starts[index], self._horizon, discount)
        reward, mask = self._labeller.label(learners.labeller, rows, action, discount)
        return OnlineRow(rows.observation, action, reward, mask, rows.next_observation)

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
        return Agent(self._normalise, self._source, self._sac, hyper["skills.latent_box"], skills, actor)


def high_level_sac(config: Config, observation_dim: int, source: SkillSource) -> SAC:
    """The high level's learner. SPiRL (Pertsch et al. 2020) has its regulariser in the bootstrap value too."""
    high = config.high_level
    regularised = high.regulariser == "prior"
    return SAC(
        observation_dim,
        source.width,
        high.hidden,
        high.ensemble,
        high.target_subset,
        entropy_backup=regularised,
        value_scale=high.value_scale,
    )


def _guide_key(key: jax.Array) -> jax.Array:
    """A key for the guide beside what ``key`` itself is used for."""
    return jax.random.fold_in(key, 1)
