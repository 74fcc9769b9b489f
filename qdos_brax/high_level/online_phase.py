"""The online phase: the high level learns which skill (or action) to play, with or without the data's help."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from flax.serialization import from_state_dict, to_state_dict

from envs.brax_base import Env
from qdos_brax.config import Config
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.acting import NEVER, Acting, ActingState, with_first_goal
from qdos_brax.high_level.actor_critic import AGENT, ActorCritic
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.evaluation import Episodes, evaluate, summary
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.learning import Learners, Learning, Sources
from qdos_brax.high_level.skill_learning import FrozenSkills, SkillLearning
from qdos_brax.high_level.warm_up import WarmUp
from qdos_brax.labels.bonus import Bonus
from qdos_brax.labels.offline_reward import OfflineReward
from qdos_brax.nn.optim import running_mean
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.low_level import LowLevelPolicy


class OnlinePhaseState(struct.PyTreeNode):
    """Hold what the phase carries, every leaf [members, ...].

    Attributes:
        key: typed key.
        learners: networks and optimiser states.
        played: what evaluations and the finished run play, the actor or its running mean.
        acting: environments, replay and counts.
        update: critic steps so far.
        healthy: False once a parameter stopped being finite; the member is frozen from then on.
        chunk: chunks done.
    """

    key: jax.Array
    learners: Learners
    played: Any
    acting: ActingState
    update: jax.Array
    healthy: jax.Array
    chunk: jax.Array


class OnlinePhase(MemberPhase):
    """Learn which skill to play, or which action where the low-level policy has no skills.

    Each iteration plays one macro step in every environment, stores them, and makes ``utd`` critic steps and
    ``actor_updates`` of the actor per macro step played. Of a batch, ``offline_fraction`` is labelled data, the rest
    online experience (``qdos_brax.high_level.batches``).

    Args:
        config: the run's configuration.
        env: the task; the training environments and those of the evaluation are separate states of it.
        normaliser: of observations.
        low_level: the skills.
        high_level: what decides; it begins as an earlier phase left it under "agent", if one did.
        warm_up: who acts in the first steps, and when learning begins.
        labeller: gives offline rows their reward and mask.
        bonus: for novelty.
        guide: acts for an episode's first steps, or None; it acts step by step, so the horizon must be 1.
        skill_learning: what becomes of the skills; None leaves them frozen.
        steps_per_chunk: environment steps between two returns to the host.
    """

    def __init__(
        self,
        config: Config,
        env: Env,
        normaliser: Normaliser,
        low_level: LowLevelPolicy,
        high_level: ActorCritic,
        warm_up: WarmUp,
        labeller: OfflineReward,
        bonus: Bonus,
        guide: JumpStart | None = None,
        skill_learning: SkillLearning | None = None,
        steps_per_chunk: int = 2_000,
    ) -> None:
        high, self._horizon = config.high_level, config.skills.horizon
        per_iteration = high.num_envs * self._horizon
        chunk_steps = min(steps_per_chunk, high.env_steps, config.eval.every_env_steps)
        self._iterations = max(1, chunk_steps // per_iteration)
        super().__init__("online", "online", -(-high.env_steps // (self._iterations * per_iteration)))
        self._evaluate_every = max(1, round(config.eval.every_env_steps / (self._iterations * per_iteration)))
        self._episodes, self._num_envs, self._utd = config.eval.episodes, high.num_envs, high.utd
        self._env, self._normalise, self._low_level = env, normaliser, low_level
        self._high_level, self._warm_up = high_level, warm_up
        capacity = min(high.replay_capacity, self.num_chunks * self._iterations * high.num_envs)
        self._skill_learning = skill_learning or FrozenSkills()
        self._acting = Acting(config, env, normaliser, capacity, warm_up, guide, self._skill_learning)
        self.learning = Learning(config, high_level, low_level, labeller, bonus, self._skill_learning)

    def bind(self, population: Population, data: DeviceData) -> None:
        """Compile the programs, that of the evaluation included."""
        super().bind(population, data)
        self._evaluate = population.program(self._play_episodes, carries=True)

    def compile(self, state: Any, constants: Any) -> None:
        """Compile the programs of chunks, that of the evaluation included."""
        super().compile(state, constants)
        self._evaluate.compile(state, constants, self.hyper, self.data)

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[Any, Any]:
        """Return the first state, with the high level as it was learned offline if it was, and the constants."""
        state, constants = super().init(key, artifacts)
        fresh = state.learners.high_level
        given = jax.tree.map(jnp.array, artifacts.get(AGENT, to_state_dict(fresh)))  # copies: states are donated
        high_level = from_state_dict(fresh, given)
        played = jax.tree.map(jnp.array, self._high_level.actor_params(high_level))
        return state.replace(learners=state.learners.replace(high_level=high_level), played=played), constants

    def chunk(self, state: OnlinePhaseState, constants: Any) -> tuple[OnlinePhaseState, dict[str, Any]]:
        """Make some iterations, and an evaluation when one is due (always after the last chunk)."""
        state, info = self._chunk(state, constants, self.hyper, self.data)
        found = jax.tree.map(np.asarray, info)
        chunk = int(state.chunk[0])
        if chunk % self._evaluate_every == 0 or chunk == self.num_chunks:
            started = time.perf_counter()
            state, episodes = self._evaluate(state, constants, self.hyper, self.data)
            found |= summary(episodes) | {"eval_seconds": time.perf_counter() - started}
        return state, self.metrics(state, found)

    def metrics(self, state: OnlinePhaseState, info: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return the columns of metrics.csv after a chunk, [members] each."""
        first = np.asarray(state.acting.first_goal_step, np.float64)
        return {
            **info,
            "env_steps": np.asarray(state.acting.env_steps),
            "update": np.asarray(state.update),
            "first_goal_step": np.where(first == NEVER, np.nan, first),
            "broken_envs": np.asarray(state.acting.broken),
            "status_ok": np.asarray(state.healthy),
        }

    def constants(self, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the skills, the labels and the guide of earlier phases; {} for what there is none of."""
        return {name: artifacts.get(name, {}) for name in ("skills", "labels", "guide")}

    def finish(self, state: OnlinePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the actor, its normaliser and the skills; what served learning alone is dropped."""
        kept = {name: value for name, value in artifacts.items() if name not in ("labels", "guide", AGENT)}
        if "skills" in kept:
            learned, seen = state.learners.skills, state.acting.seen
            kept["skills"] = jax.vmap(self._skill_learning.final_skills)(learned, seen, kept["skills"])
        normaliser = self._normalise.repeated(state.update.shape[0])
        return kept | {"actor": state.played, "normaliser": normaliser, health.KEY: state.healthy}

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> OnlinePhaseState:
        """Return fresh learners, an empty replay, environments at their starts."""
        high_level_key, bonus_key, labeller_key, env_key, key, skill_key = jax.random.split(key, 6)
        keys = Learners(high_level_key, bonus_key, labeller_key, skill_key)
        observation = jnp.zeros(self._high_level.observation_dim)
        row = Transition(observation, jnp.zeros(self._high_level.action_dim), jnp.zeros(()), jnp.zeros(()), observation)
        learners = self.learning.init(keys, hyper)
        return OnlinePhaseState(
            key=key,
            learners=learners,
            played=self._high_level.actor_params(learners.high_level),
            acting=self._acting.start(env_key, row),
            update=jnp.zeros((), jnp.int32),
            healthy=jnp.ones((), bool),
            chunk=jnp.zeros((), jnp.int32),
        )

    def train_member(
        self, state: OnlinePhaseState, constants: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        """Make one member's iterations of a chunk."""
        iteration = partial(self._iteration, constants=constants, hyper=hyper, data=data)
        state, info = jax.lax.scan(iteration, state, None, length=self._iterations)
        played = {name: jnp.sum(info.pop(name)) for name in ("reached", "ended")}
        success = {"train/success": played["reached"] / played["ended"]}  # of the episodes; nan where none ended
        return state.replace(chunk=state.chunk + 1), jax.tree.map(jnp.mean, info) | success

    def _iteration(
        self, state: OnlinePhaseState, _: None, constants: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, dict[str, jax.Array]]:
        act_key, update_key, key = jax.random.split(state.key, 3)
        skills = self._skill_learning.training_skills(state.learners.skills, constants["skills"])
        agent = self._agent(self._high_level.actor_params(state.learners.high_level), skills, hyper)
        acting, newest, info = self._acting.step(state.acting, act_key, agent, constants["guide"], hyper)
        sources = Sources(acting.replay, data, constants["skills"], constants["labels"], hyper, acting.seen)
        learn = partial(self.learning.step, env_steps=acting.env_steps, sources=sources)
        keys = jax.random.split(update_key, self._num_envs)
        learners, losses = jax.lax.scan(learn, state.learners, (keys, newest))

        # Not from an empty replay, whose rows are NaN: the simulation may break in the very first macro step.
        learns = self._warm_up.learns(acting.env_steps) & (acting.replay.size > 0)
        learners = jax.tree.map(lambda new, old: jnp.where(learns, new, old), learners, state.learners)
        learners, healthy = health.keep_finite(state.healthy, learners, state.learners)
        update = state.update + jnp.where(learns, self._num_envs * self._utd, 0)
        actor = self._high_level.actor_params(learners.high_level)
        played = running_mean(state.played, actor, hyper["high_level.actor_average"])
        state = state.replace(key=key, learners=learners, played=played, acting=acting, healthy=healthy, update=update)
        return state, info | jax.tree.map(jnp.mean, losses)

    def _play_episodes(
        self, state: OnlinePhaseState, constants: Any, hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OnlinePhaseState, Episodes]:
        key, episode_key = jax.random.split(state.key)
        skills = self._skill_learning.final_skills(state.learners.skills, state.acting.seen, constants["skills"])
        agent = self._agent(state.played, skills, hyper)
        episodes = evaluate(self._env, agent.choose, agent.play, episode_key, self._episodes, self._horizon)
        return state.replace(key=key, acting=with_first_goal(state.acting, episodes.success)), episodes

    def _agent(self, actor: Any, skills: Any, hyper: dict[str, jax.Array]) -> Agent:
        return Agent(self._normalise, self._low_level, self._high_level, hyper["skills.latent_box"], skills, actor)
