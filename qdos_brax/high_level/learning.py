"""Learning online: what one member's networks make of a macro step and of batches from replay and data."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from qdos_brax.config import Config
from qdos_brax.data.device import DeviceData
from qdos_brax.data.transitions import Transition, macro_transitions
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.actor_critic import ActorCritic, Reference
from qdos_brax.high_level.batches import make_batches
from qdos_brax.high_level.skill_learning import Lesson, SkillLearning
from qdos_brax.labels.bonus import Bonus
from qdos_brax.labels.offline_reward import OfflineReward
from qdos_brax.nn.optim import rate_schedule
from qdos_brax.skills.low_level import LowLevelPolicy


class Learners(struct.PyTreeNode):
    """Hold everything that learns online: the high level, the bonus for novelty, the labeller, and skills that do."""

    high_level: Any
    bonus: Any
    labeller: Any
    skills: Any


class Sources(NamedTuple):
    """Hold what one member's learning reads and does not change.

    Attributes:
        replay: online macro transitions.
        data: the data set.
        skills: parameters of the low-level policy.
        labels: float32[S, width], the high level's action of every offline segment; {} without offline rows.
        hyper: numbers by dotted key.
        seen: what skills that learn have seen.
    """

    replay: replay_buffer.Replay
    data: DeviceData
    skills: Any
    labels: Any
    hyper: dict[str, jax.Array]
    seen: Any = ()


class Learning:
    """Make one member's gradient steps.

    As in the published code of SUPE and ExPLORe the bonus learns from every macro step once, when it was just played,
    and the labeller as often as the critics do.

    Args:
        config: the run's configuration.
        high_level: what decides.
        low_level: the low-level policy.
        labeller: gives offline rows their reward and mask.
        bonus: for novelty.
        skill_learning: what becomes of the skills.
    """

    def __init__(
        self,
        config: Config,
        high_level: ActorCritic,
        low_level: LowLevelPolicy,
        labeller: OfflineReward,
        bonus: Bonus,
        skill_learning: SkillLearning,
    ) -> None:
        self._skill_learning = skill_learning
        self._config, self._labels, self._horizon = config.high_level, config.labels, config.skills.horizon
        self._high_level, self._low_level, self._labeller, self._bonus = high_level, low_level, labeller, bonus
        self._batches = make_batches(config)
        self._rate = rate_schedule(self._config.schedule, self._config.env_steps)

    def init(self, keys: Learners, hyper: dict[str, jax.Array]) -> Learners:
        """Return fresh learners, each from its key."""
        return Learners(
            high_level=self._high_level.start(keys.high_level, hyper),
            bonus=self._bonus.init(keys.bonus),
            labeller=self._labeller.init(keys.labeller),
            skills=self._skill_learning.init(keys.skills, hyper),
        )

    def step(
        self, learners: Learners, given: tuple[jax.Array, Transition], env_steps: jax.Array, sources: Sources
    ) -> tuple[Learners, dict[str, jax.Array]]:
        """Learn from one macro step: labels, ``utd`` steps of the critics, those of actor and temperature, skills.

        Args:
            learners: before.
            given: a key, and the macro step that was just played (no leading axis).
            env_steps: environment steps so far; the labels wait for ``labels.start_env_steps``.
            sources: what batches are drawn from.

        Returns:
            The learners after, and scalars for metrics.csv.
        """
        (key, newest), hyper = given, self._decayed(sources.hyper, env_steps)
        sources = sources._replace(hyper=hyper)
        active = env_steps >= self._labels.start_env_steps
        label_key, actor_key, critic_key, skill_key = jax.random.split(key, 4)
        bonus = self._bonus.learn(learners.bonus, newest.observation[None], newest.action[None], hyper, active)
        learners = learners.replace(bonus=bonus)
        learners = self._learn_rewards(learners, label_key, active, sources)
        high_level, info = self._learn_high_level(learners, critic_key, actor_key, sources)
        earned = self._bonus.of(learners.bonus, newest.observation, newest.action, hyper)
        reference = self._reference(sources.skills, hyper)
        lesson = Lesson(sources.skills, sources.seen, high_level, reference, env_steps, hyper)
        skills, skill_info = self._skill_learning.learn(learners.skills, skill_key, lesson)
        learners = learners.replace(high_level=high_level, skills=skills)
        return learners, info | {"bonus": jnp.mean(earned)} | skill_info

    def sample(self, learners: Learners, key: jax.Array, sources: Sources) -> Transition:
        """Return a batch, with the bonus for novelty added to rewards."""
        offline = partial(self._sample_offline, learners, sources)
        rows, logged = self._batches.draw(key, sources.replay, sources.data.starts.shape[0], offline)
        bonus = self._bonus.of(learners.bonus, rows.observation, rows.action, sources.hyper)
        if self._labels.bonus_rows == "online":
            bonus = jnp.where(logged, 0.0, bonus)
        return rows._replace(reward=rows.reward + bonus)

    def _sample_offline(self, learners: Learners, sources: Sources, key: jax.Array, rows_wanted: int) -> Transition:
        """Return labelled segments, with the reward and mask that the labeller gives them."""
        data, discount = sources.data, sources.hyper["high_level.discount"]
        index = jax.random.randint(key, (rows_wanted,), 0, data.starts.shape[0])
        rows = macro_transitions(data, data.starts[index], self._horizon, discount, sources.labels[index])
        reward, mask = self._labeller.label(learners.labeller, rows, discount)
        return rows._replace(reward=reward, mask=mask)

    def _learn_rewards(self, learners: Learners, key: jax.Array, active: jax.Array, sources: Sources) -> Learners:
        """Make as many steps of the labeller as of the critics (SUPE's, ExPLORe's code), on a batch's online rows.

        ExPLORe's code gives its reward model as many rows as the critics have in all, of which half are online.
        """
        rate, online = sources.hyper["labels.reward_learning_rate"], self._batches.online

        def step(labeller: Any, key: jax.Array) -> tuple[Any, None]:
            rows = replay_buffer.sample(sources.replay, key, online)
            return self._labeller.learn(labeller, rows, rate, active), None

        labeller, _ = jax.lax.scan(step, learners.labeller, jax.random.split(key, self._config.utd))
        return learners.replace(labeller=labeller)

    def _learn_high_level(
        self, learners: Learners, critic_key: jax.Array, actor_key: jax.Array, sources: Sources
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Make ``utd`` critic steps and ``actor_updates`` of the actor, which take turns."""
        learner, hyper = self._high_level, self._high_level.hyper(sources.hyper)
        reference = self._reference(sources.skills, sources.hyper)
        sample = partial(self.sample, learners, sources=sources)

        def critic_step(state: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            batch_key, update_key = jax.random.split(key)
            return learner.update_critic(state, sample(batch_key), update_key, hyper, reference)

        def turn(state: Any, keys: tuple[jax.Array, jax.Array]) -> tuple[Any, dict[str, jax.Array]]:
            critic_keys, actor_key = keys
            state, critic_info = jax.lax.scan(critic_step, state, critic_keys)
            batch_key, update_key = jax.random.split(actor_key)
            state, actor_info = learner.update_actor(state, sample(batch_key), update_key, hyper, reference)
            return state, jax.tree.map(jnp.mean, critic_info) | actor_info

        turns = self._config.actor_updates
        critic_keys = jax.random.split(critic_key, self._config.utd).reshape(turns, -1)
        actor_keys = actor_key[None] if turns == 1 else jax.random.split(actor_key, turns)
        state, info = jax.lax.scan(turn, learners.high_level, (critic_keys, actor_keys))
        return state, jax.tree.map(jnp.mean, info)

    def _decayed(self, hyper: dict[str, jax.Array], env_steps: jax.Array) -> dict[str, jax.Array]:
        """Return the numbers with the high level's learning rate as it is by now."""
        key = "high_level.learning_rate"
        return hyper | {key: hyper[key] * self._rate(env_steps)}

    def _reference(self, skills: Any, hyper: dict[str, jax.Array]) -> Reference | None:
        """Return the density that the actor is held against, the skill prior's or none."""
        if self._config.regulariser == "entropy":
            return None

        def log_prior(observation: jax.Array, action: jax.Array) -> jax.Array:
            return self._low_level.log_prior(skills, action, observation, hyper["skills.latent_box"])

        return log_prior
