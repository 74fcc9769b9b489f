"""Skills that are fine-tuned online: a bounded correction of their actions, learned by the value that it brings.

Skill-Critic (Hao et al. 2024, arXiv 2306.08388) lets the decoder learn by a low-level critic that bootstraps from the
high level's, near the decoder that was learned offline; SPAARS (2026, arXiv 2603.09378) hands control to raw actions
where a critic says that they are better than the decoder's. Here the decoder stays, and what is added to its action
is zero at first, bounded, and moves only where every head of the critic agrees that it helps.

How the high level's critic stays valid while the decoder changes: the correction is small by its bound and slow (one
gradient step per macro step, beside several of the critics); the high level learns from macro steps of the tuned
decoder only while the guard prefers it, so that without that its replay is the frozen decoder's alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import Config
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.actor_critic import Reference
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.guard import FROZEN, TUNED, Guard, GuardState
from qdos_brax.high_level.macro_step import InnerStep
from qdos_brax.high_level.skill_critic import (
    SkillCritic,
    SkillCriticState,
    Tracks,
    live_mean,
    macro_returns,
    sure_gain,
    through_clip,
)
from qdos_brax.high_level.skill_learning import Lesson, Play, Played
from qdos_brax.nn.optim import ADAM, Params, adam_step
from qdos_brax.skills.low_level import TunableSkills


class Valued(Protocol):
    """Define a high level that says what states are worth to it."""

    def target_value(
        self, state: Any, key: jax.Array, next_observation: jax.Array, reference: Reference | None = None
    ) -> jax.Array:
        """Return the value[B] of next_observation[B, obs], at the actor's decision."""
        ...


class Tuned(struct.PyTreeNode):
    """Hold what learns: the critic of actions, and the correction with Adam's state of its network."""

    critic: SkillCriticState
    correction: dict[str, Params]
    opt_state: optax.OptState


class Seen(struct.PyTreeNode):
    """Hold what was played: the last macro steps, and the comparison of the two decoders."""

    replay: replay_buffer.Replay
    guard: GuardState


class Conduct(NamedTuple):
    """Hold how environments play a macro step: share[n] of the correction, 0 or 1, and noise[n, H, act] on actions."""

    share: jax.Array
    noise: jax.Array


class TunedSkills:
    """Learn corrections of skills behind a guard (``qdos_brax.high_level.skill_learning.SkillLearning``).

    Args:
        config: the run's configuration.
        low_level: the skills.
        high_level: what values the states in which macro steps end.
        observation_dim: width of observations.
        action_dim: width of the environment's actions.
    """

    def __init__(
        self, config: Config, low_level: TunableSkills, high_level: Valued, observation_dim: int, action_dim: int
    ) -> None:
        self._config, self._low_level, self._high_level = config.tuning, low_level, high_level
        self._horizon, self._num_envs = config.skills.horizon, config.high_level.num_envs
        self._observation_dim, self._action_dim = observation_dim, action_dim
        played = -(-config.high_level.env_steps // self._horizon) + self._num_envs
        self._capacity = min(played, config.tuning.replay_capacity)
        self._guard = Guard(config.tuning.window, config.tuning.trial_share)
        width = observation_dim + low_level.context_size + action_dim
        self._critic = SkillCritic(width, config.high_level.hidden, config.tuning.heads, config.high_level.value_scale)

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> Tuned:
        """Return a fresh critic and a correction of nothing."""
        critic_key, correction_key = jax.random.split(key)
        correction = self._low_level.init_correction(correction_key, hyper["tuning.bound"])
        return Tuned(self._critic.init(critic_key), correction, ADAM.init(correction["network"]))

    def start(self) -> Seen:
        """Return an empty replay, and a comparison without episodes."""
        observation = jnp.zeros(self._observation_dim)
        example = Tracks(
            observations=jnp.zeros((self._horizon, self._observation_dim)),
            actions=jnp.zeros((self._horizon, self._action_dim)),
            rewards=jnp.zeros(self._horizon),
            live=jnp.zeros(self._horizon),
            skill=jnp.zeros(self._low_level.skill_size),
            mask=jnp.zeros(()),
            next_observation=observation,
        )
        return Seen(replay_buffer.create(example, self._capacity), self._guard.start(self._num_envs))

    def record(self, step: InnerStep) -> InnerStep:
        """Keep all of it."""
        return step

    def training_skills(self, learned: Tuned, skills: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters with the correction as it is."""
        return {**skills, "correction": learned.correction}

    def final_skills(self, learned: Tuned, seen: Seen, skills: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters with the correction where the guard prefers it, otherwise with one of size 0."""
        return scaled(self.training_skills(learned, skills), self._guard.prefers_tuned(seen.guard))

    def conduct(self, seen: Seen, key: jax.Array, hyper: dict[str, jax.Array]) -> Conduct:
        """Return which environments play the correction, and the noise, which all have."""
        noise = jax.random.normal(key, (self._num_envs, self._horizon, self._action_dim))
        return Conduct(seen.guard.tuned.astype(jnp.float32), hyper["tuning.noise"] * noise)

    def player(self, agent: Agent, conduct: Conduct) -> Play:
        """Return the agent's play, with its share of the correction, and with noise."""
        agent = dataclasses.replace(agent, skills=scaled(agent.skills, conduct.share))

        def play(observation: jax.Array, skill: jax.Array, step: jax.Array) -> jax.Array:
            return jnp.clip(agent.play(observation, skill, step) + conduct.noise[step], -1.0, 1.0)

        return play

    def shown(self, seen: Seen) -> jax.Array:
        """Return False for episodes of the tuned decoder while it is not preferred."""
        return ~seen.guard.tuned | self._guard.prefers_tuned(seen.guard)

    def observe(self, seen: Seen, key: jax.Array, played: Played) -> Seen:
        """Store the macro steps, and count the episodes that ended."""
        result, rows, inner = played.result, played.rows, played.result.track
        tracks = Tracks(
            inner.observation, inner.action, inner.reward, inner.live, played.skill, result.mask, rows.next_observation
        )
        replay = replay_buffer.insert(seen.replay, tracks, result.finite)
        tries = played.env_steps >= self._config.start_env_steps
        guard = self._guard.observe(seen.guard, key, result.episode_return, played.over, result.finite, tries)
        return Seen(replay, guard)

    def learn(self, learned: Tuned, key: jax.Array, lesson: Lesson) -> tuple[Tuned, dict[str, jax.Array]]:
        """Make ``utd`` steps of the critic, and one of the correction once it is tried."""
        critic_key, correction_key = jax.random.split(key)

        def critic_step(critic: SkillCriticState, key: jax.Array) -> tuple[SkillCriticState, jax.Array]:
            return self._learn_critic(learned.replace(critic=critic), key, lesson)

        critic, losses = jax.lax.scan(critic_step, learned.critic, jax.random.split(critic_key, self._config.utd))
        learned = learned.replace(critic=critic)
        tracks = replay_buffer.sample(lesson.seen.replay, correction_key, self._config.batch_size)
        corrected, info = self.learn_correction(learned, tracks, lesson.skills, lesson.hyper["tuning.learning_rate"])
        active = lesson.env_steps >= self._config.start_env_steps
        learned = jax.tree.map(lambda new, old: jnp.where(active, new, old), corrected, learned)
        means = self._guard.means(lesson.seen.guard)
        preferred = self._guard.prefers_tuned(lesson.seen.guard).astype(jnp.float32)
        return learned, info | {
            "tuning_critic_loss": jnp.mean(losses),
            "tuning_return": means[TUNED],
            "frozen_return": means[FROZEN],
            "tuning_preferred": preferred,
        }

    def learn_correction(
        self, learned: Tuned, tracks: Tracks, skills: Any, learning_rate: jax.Array | float
    ) -> tuple[Tuned, dict[str, jax.Array]]:
        """Make one step of the correction's network up the gain that every head of the critic sees."""
        low_level, observation = self._low_level, tracks.observations
        skill = self._along(tracks)
        context, frozen = low_level.context(skills, observation, skill), low_level.act(skills, observation, skill, 0)
        without = self._critic.values(learned.critic.critic, observation, context, frozen)

        def loss(network: Params) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            correction = {**learned.correction, "network": network}
            change = low_level.correction({**skills, "correction": correction}, observation, skill)
            action = through_clip(frozen + change)
            gain = sure_gain(self._critic.values(learned.critic.critic, observation, context, action), without)
            return -live_mean(gain, tracks.live), (live_mean(gain, tracks.live), change)

        (_, (gain, change)), grads = jax.value_and_grad(loss, has_aux=True)(learned.correction["network"])
        network, opt_state = adam_step(learned.correction["network"], learned.opt_state, grads, learning_rate)
        size = live_mean(jnp.mean(jnp.abs(change), axis=-1), tracks.live)
        learned = learned.replace(correction={**learned.correction, "network": network}, opt_state=opt_state)
        return learned, {"tuning_gain": gain, "tuning_size": size}

    def _learn_critic(self, learned: Tuned, key: jax.Array, lesson: Lesson) -> tuple[SkillCriticState, jax.Array]:
        skills, hyper = lesson.skills, lesson.hyper
        batch_key, value_key = jax.random.split(key)
        tracks = replay_buffer.sample(lesson.seen.replay, batch_key, self._config.batch_size)
        skill, observation = self._along(tracks), tracks.observations
        context = self._low_level.context(skills, observation, skill)
        action = self._low_level.act(self.training_skills(learned, skills), observation, skill, 0)
        later = self._critic.values(learned.critic.target_critic, observation, context, action)
        end = self._high_level.target_value(lesson.high_level, value_key, tracks.next_observation, lesson.reference)
        targets = macro_returns(tracks, hyper["high_level.discount"], hyper["tuning.trace"], end, later)
        rates = hyper["tuning.learning_rate"], hyper["high_level.target_rate"]
        return self._critic.update(learned.critic, tracks, context, jax.lax.stop_gradient(targets), *rates)

    def _along(self, tracks: Tracks) -> jax.Array:
        """Return the skill at every step, [B, H, s]."""
        shape = (*tracks.live.shape, tracks.skill.shape[-1])
        return jnp.broadcast_to(tracks.skill[..., None, :], shape)


def scaled(skills: Mapping[str, Any], share: jax.Array) -> dict[str, Any]:
    """Return parameters whose correction has its bound times a share; at 0 they play as the frozen ones."""
    correction = skills["correction"]
    return {**skills, "correction": {**correction, "bound": correction["bound"] * share}}
