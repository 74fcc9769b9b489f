"""The value phase with implicit Q-learning: values, and from them the advantage of every segment of the data."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from qdos_brax.config import Config, SkillsConfig, ValuesConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import macro_return, window
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase, even_chunks
from qdos_brax.skills.values import IQL, ValueBatch, ValueHyper, ValueState
from qdos_brax.skills.weights import scaled_advantage, segment_advantage, transition_advantage

LABEL_BATCH = 2048


class ValuePhaseState(struct.PyTreeNode):
    """Hold what the phase carries, every leaf [members, ...]: healthy is False once a number of the values is not
    finite.
    """

    key: jax.Array
    values: ValueState
    update: jax.Array
    healthy: jax.Array


class ValuePhase(MemberPhase):
    """Learn values by implicit Q-learning, and from them the segments' advantages.

    Args:
        config: the run's configuration.
        iql: the learner.
        updates_per_chunk: gradient steps between two looks of the host, at most.
    """

    def __init__(self, config: Config, iql: IQL, updates_per_chunk: int = 500) -> None:
        self._values: ValuesConfig = config.values
        self._skills: SkillsConfig = config.skills
        self._iql = iql
        chunks, self._updates = even_chunks(config.values.updates, updates_per_chunk)
        super().__init__("values", "pretrain", chunks)

    def bind(self, population: Population, data: DeviceData) -> None:
        """Compile the programs, that of the advantages included."""
        super().bind(population, data)
        self._advantages = population.program(self._all_advantages)

    def finish(self, state: ValuePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the scaled advantage of every segment, float32[members, S]."""
        advantage = self._advantages(state, self.hyper, self.data)
        return artifacts | {"advantage": advantage, health.KEY: state.healthy}

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> ValuePhaseState:
        """Return fresh networks."""
        init_key, key = jax.random.split(key)
        return ValuePhaseState(key, self._iql.init(init_key), jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def train_member(
        self, state: ValuePhaseState, constants: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[ValuePhaseState, dict[str, jax.Array]]:
        """Make a chunk's gradient steps."""
        value_hyper = ValueHyper(hyper["values.learning_rate"], hyper["values.expectile"], hyper["values.target_rate"])

        def update(values: ValueState, key: jax.Array) -> tuple[ValueState, dict[str, jax.Array]]:
            batch = sample_batch(data, key, self._values.batch_size, self._values.n_step, hyper["values.discount"])
            return self._iql.update(values, batch, value_hyper)

        keys = jax.random.split(state.key, self._updates + 1)
        values, info = jax.lax.scan(update, state.values, keys[1:])
        values, healthy = health.keep_finite(state.healthy, values, state.values)
        state = ValuePhaseState(keys[0], values, state.update + self._updates, healthy)
        return state, jax.tree.map(jnp.mean, info)

    def _all_advantages(self, state: ValuePhaseState, hyper: dict[str, jax.Array], data: DeviceData) -> jax.Array:
        estimate = self.transition if self._skills.advantage == "transition" else self.segment
        return scaled_advantage(estimate(state.values, data, hyper["values.discount"]), self._skills.advantage_scale)

    def segment(self, values: ValueState, data: DeviceData, discount: jax.Array) -> jax.Array:
        """Return sum_t gamma^t r_t + gamma^H V(s_H) - V(s_0) of every window at ``data.starts``, [S]."""
        value = partial(self._iql.value, values.value)
        before, after = over_rows(value, data.observations), over_rows(value, data.next_observations)
        return segment_advantages(before, after, data, self._skills.horizon, discount)

    def transition(self, values: ValueState, data: DeviceData, discount: jax.Array) -> jax.Array:
        """Return mean_t [min Q(s_t, a_t) - V(s_t)] of every window at ``data.starts``, [S]."""

        def gap(observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
            q = self._iql.q(values.critic, observation, action).min(axis=0)
            return q, self._iql.value(values.value, observation)

        q, value = over_rows(gap, data.observations, data.actions)
        return transition_advantage(*window((q, value), data.starts, self._skills.horizon))


def segment_advantages(
    value: jax.Array, next_value: jax.Array, data: DeviceData, horizon: int, discount: jax.Array
) -> jax.Array:
    """Return sum_t gamma^t r_t + gamma^H V(s_H) - V(s_0) of every window of ``horizon`` rows at ``data.starts``, [S].

    Args:
        value: [N], V of every row's state.
        next_value: [N], V of the state after it.
        data: the data set.
        horizon: H.
        discount: gamma.
    """
    reward, mask = macro_return(*window((data.rewards, data.masks), data.starts, horizon), discount)
    value_end = next_value[data.starts + horizon - 1]
    return segment_advantage(reward, mask * discount**horizon, value_end, value[data.starts])


def over_rows(function: Callable[..., Any], *arrays: jax.Array) -> Any:
    """Return ``function`` of single rows, over all N rows in batches that fit the cache."""
    return jax.lax.map(lambda row: function(*row), arrays, batch_size=min(LABEL_BATCH, arrays[0].shape[0]))


def sample_batch(data: DeviceData, key: jax.Array, size: int, n_step: int, discount: jax.Array) -> ValueBatch:
    """Return ``size`` transitions of ``n_step`` steps, or as many as their episode has left, uniform over the rows.

    An episode's last rows count too: success is there where the data ends with it.
    """
    first = jax.random.randint(key, (size,), 0, data.rewards.shape[0])
    last = jnp.minimum(first + n_step - 1, data.last[first])
    rows = first[:, None] + jnp.arange(n_step)
    inside, rows = rows <= last[:, None], jnp.minimum(rows, last[:, None])
    rewards, masks = jnp.where(inside, data.rewards[rows], 0.0), jnp.where(inside, data.masks[rows], 1.0)
    reward, mask = macro_return(rewards, masks, discount)
    return ValueBatch(
        observation=data.observations[first],
        action=data.actions[first],
        reward=reward,
        discount=mask * discount ** (last - first + 1),
        next_observation=data.next_observations[last],
    )
