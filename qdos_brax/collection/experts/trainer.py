"""The jitted program that trains an expert with SAC: it steps all environments, fills the replay, makes the updates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from qdos_brax.collection.experts.tasks.base import EnvState, ExpertTask
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.config import HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.sac import SAC, SACHyper, SACState
from qdos_brax.nn.optim import polyak

EVALUATION_STEPS = 250
INITIAL_TEMPERATURE = 0.1


@dataclass(frozen=True)
class Sizes:
    """Hold the static sizes of the training.

    Attributes:
        num_envs: environments stepped at once.
        updates_per_step: critic updates per step of all environments.
        actor_every: critic updates per actor update.
        batch_size: rows per update.
        hidden: widths of actor and critics.
        capacity: rows of the replay.
        random_steps: environment steps at the start with random actions and without updates.
        steps_per_chunk: steps of all environments per call of the program.
        average_rate: rate, per step of all environments, of the running mean of the actor that is kept.
    """

    num_envs: int = 64
    updates_per_step: int = 16
    actor_every: int = 2
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    capacity: int = 500_000
    random_steps: int = 5_000
    steps_per_chunk: int = 50
    average_rate: float = 0.002


class TrainState(struct.PyTreeNode):
    """Hold everything the training loop carries.

    Attributes:
        sac: networks and optimisers.
        average: running mean of the actor's parameters, which performs more steadily than the latest ones.
        replay: the transitions.
        envs: the environments, EnvState of arrays [num_envs, ..].
        key: random key.
    """

    sac: SACState
    average: Any
    replay: replay_buffer.Replay
    envs: EnvState
    key: jax.Array


class Trainer:
    """Compile the training program of one expert: ``init``, ``chunk`` and ``evaluate``.

    Args:
        task: what is learned.
        sizes: static sizes.
    """

    def __init__(self, task: ExpertTask, sizes: Sizes) -> None:
        self.task, self.sizes = task, sizes
        networks = HighLevelConfig(hidden=sizes.hidden, ensemble=2, target_subset=2)
        self.sac = SAC(task.observation_dim, task.action_dim, networks, entropy_backup=True)
        self.hyper = SACHyper(
            learning_rate=3e-4, discount=task.discount, target_rate=0.005, target_entropy=-task.action_dim / 2
        )

    def init(self, key: jax.Array, learner: SACState | None = None) -> TrainState:
        """Create new environments, an empty replay, and fresh networks unless a ``learner`` is given."""
        sac_key, reset_key, steps_key, key = jax.random.split(key, 4)
        n = self.sizes.num_envs
        envs = jax.vmap(self.task.reset)(jax.random.split(reset_key, n))
        steps = jax.random.randint(steps_key, (n,), 0, self.task.episode_steps)  # so that not all end at once
        observation = jnp.zeros(self.task.observation_dim)
        row = Transition(observation, jnp.zeros(self.task.action_dim), jnp.zeros(()), jnp.zeros(()), observation)
        sac = self.sac.init(sac_key, INITIAL_TEMPERATURE) if learner is None else learner
        return TrainState(
            sac=sac,
            average=jax.tree.map(jnp.copy, sac.actor),
            replay=replay_buffer.create(row, self.sizes.capacity),
            envs=envs.replace(steps=steps),
            key=key,
        )

    @partial(jax.jit, static_argnums=(0, 2, 3), donate_argnums=1)
    def chunk(self, state: TrainState, random_actions: bool, learns: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        """Step every environment ``steps_per_chunk`` times; return (state, means of the measures).

        Args:
            state: the loop's state; its arrays are reused.
            random_actions: act uniformly at random instead of with the policy.
            learns: make the updates.
        """

        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            state, info = self._act(state, random_actions)
            if not learns:
                return state, info
            count = self.sizes.updates_per_step // self.sizes.actor_every
            keys = jax.random.split(state.key, count + 1)
            sac, losses = jax.lax.scan(partial(self._updates, state.replay), state.sac, keys[1:])
            average = polyak(state.average, sac.actor, self.sizes.average_rate)
            state = state.replace(sac=sac, average=average, key=keys[0])
            return state, {**info, **jax.tree.map(jnp.mean, losses)}

        state, info = jax.lax.scan(step, state, length=self.sizes.steps_per_chunk)
        return state, jax.tree.map(jnp.mean, info)

    def _act(self, state: TrainState, random_actions: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        """Make one control step in every environment and insert the rows into the replay."""
        act_key, step_key, key = jax.random.split(state.key, 3)
        observation = jax.vmap(self.task.observe)(state.envs)
        if random_actions:
            action = jax.random.uniform(act_key, (self.sizes.num_envs, self.task.action_dim), minval=-1.0)
        else:
            action = self.sac.act(state.sac.actor, act_key, observation)
        row, envs, info = self._step(state.envs, observation, action, step_key)
        return state.replace(replay=replay_buffer.insert(state.replay, row), envs=envs, key=key), info

    def _step(
        self, envs: EnvState, observation: jax.Array, action: jax.Array, key: jax.Array
    ) -> tuple[Transition, EnvState, dict[str, jax.Array]]:
        """Make one control step; return (rows, the next states, means of the measures)."""
        n = action.shape[0]
        reset_key, turn_key, direction_key, noise_key = jax.random.split(key, 4)
        torques = jax.vmap(self.task.torques)(envs, action)
        noise = self.task.action_noise * jax.random.normal(noise_key, torques.shape)
        torques = jnp.clip(torques + noise, -1.0, 1.0)
        after = jax.vmap(self.task.engine.step)(envs.pipeline, torques)
        result = jax.vmap(self.task.evaluate_step)(envs, torques, after)
        next_observation = jax.vmap(self.task.observe)(envs.replace(pipeline=after))
        row = Transition(observation, action, result.reward, result.alive.astype(jnp.float32), next_observation)

        turns = jax.random.uniform(turn_key, (n, 1)) < 1 / self.task.direction_steps
        directions = jax.vmap(random_direction)(jax.random.split(direction_key, n))
        onward = EnvState(after, jnp.where(turns, directions, envs.direction), envs.steps + 1)
        fresh = jax.vmap(self.task.reset)(jax.random.split(reset_key, n))
        goes_on = result.alive & ~result.truncated & (onward.steps < self.task.episode_steps)
        info = {
            "reward": result.reward,
            "falls_per_1000": 1000.0 * (1.0 - result.alive),
            "truncated_per_1000": 1000.0 * result.truncated,
            **result.measures,
        }
        return row, _select_rows(goes_on, onward, fresh), jax.tree.map(jnp.mean, info)

    def _updates(
        self, replay: replay_buffer.Replay, sac: SACState, key: jax.Array
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Make ``actor_every`` critic updates and one actor update."""
        info: dict[str, jax.Array] = {}
        for sub_key in jax.random.split(key, self.sizes.actor_every):
            sample_key, mirror_key, critic_key, actor_key = jax.random.split(sub_key, 4)
            batch = replay_buffer.sample(replay, sample_key, self.sizes.batch_size)
            straight = jax.random.bernoulli(mirror_key, shape=batch.reward.shape)
            batch = _select_rows(straight, batch, self.task.mirror(batch))
            sac, info = self.sac.update_critic(sac, batch, critic_key, self.hyper)
        sac, actor_info = self.sac.update_actor(sac, batch, actor_key, self.hyper)
        return sac, {**info, **actor_info}

    @partial(jax.jit, static_argnums=0)
    def evaluate(self, actor: Any, key: jax.Array) -> dict[str, jax.Array]:
        """Average the measures over EVALUATION_STEPS steps of every environment under the deterministic policy."""

        def step(envs: EnvState, key: jax.Array) -> tuple[EnvState, dict[str, jax.Array]]:
            observation = jax.vmap(self.task.observe)(envs)
            _, envs, info = self._step(envs, observation, self.sac.mode(actor, observation), key)
            return envs, info

        reset_key, key = jax.random.split(key)
        envs = jax.vmap(self.task.reset)(jax.random.split(reset_key, self.sizes.num_envs))
        info = jax.lax.scan(step, envs, jax.random.split(key, EVALUATION_STEPS))[1]
        return jax.tree.map(jnp.mean, info)


def _select_rows(chosen: jax.Array, these: Any, those: Any) -> Any:
    """Take the rows of ``these`` where ``chosen[n]``, of ``those`` elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b), these, those)
