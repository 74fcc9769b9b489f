"""A phase that learns from the data alone: gradient steps of any learner, and its evaluation if it is a policy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs.brax_base import Env
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.high_level.agent import Policy
from qdos_brax.high_level.evaluation import Episodes, evaluate, summary
from qdos_brax.offline.learner import Learner
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase, even_chunks


class OfflinePhaseState(struct.PyTreeNode):
    """Hold what the phase carries, every leaf [members, ...]; healthy: False once a learned number is not finite."""

    key: jax.Array
    learner: Any
    update: jax.Array
    healthy: jax.Array


class Evaluation:
    """Play episodes with what a learner has learned so far.

    Args:
        env: the task.
        policy: makes the policy from one member's parameters.
        episodes: per evaluation.
        horizon: environment steps per decision of the policy.
        every_updates: gradient steps between two evaluations.
    """

    def __init__(
        self, env: Env, policy: Callable[[Any], Policy], episodes: int, horizon: int, every_updates: int
    ) -> None:
        self._env, self._policy, self._episodes, self._horizon = env, policy, episodes, horizon
        self.every_updates = every_updates

    def __call__(self, params: Any, key: jax.Array) -> Episodes:
        """Plays them with one member's parameters."""
        policy = self._policy(params)
        return evaluate(self._env, policy.choose, policy.play, key, self._episodes, self._horizon)


class OfflinePhase(MemberPhase):
    """Make gradient steps of a learner on the data set.

    Args:
        name: of the phase, and of what it leaves.
        learner: what learns.
        normaliser: of observations.
        updates: gradient steps.
        evaluation: of a policy, or None.
        reads: what the learner reads of the artifacts, as a field of the data: ("labels",) or nothing.
        drops: what no later phase reads.
        updates_per_chunk: gradient steps between two looks of the host, at most.
    """

    def __init__(
        self,
        name: str,
        learner: Learner,
        normaliser: Normaliser,
        updates: int,
        evaluation: Evaluation | None = None,
        reads: tuple[str, ...] = (),
        drops: tuple[str, ...] = (),
        updates_per_chunk: int = 500,
    ) -> None:
        every = updates if evaluation is None else evaluation.every_updates
        chunks, self._updates = even_chunks(updates, min(updates_per_chunk, every))
        super().__init__(name, "pretrain", chunks)
        self._learner, self._normalise, self._evaluation = learner, normaliser, evaluation
        self._reads, self._drops = reads, drops
        self._evaluate_every = max(1, round(every / self._updates))

    def bind(self, population: Population, data: DeviceData) -> None:
        """Compile the programs, that of the evaluation included."""
        super().bind(population, data)
        evaluation = self._evaluation
        if evaluation is not None:
            self._evaluate = population.program(lambda params, key, _: evaluation(params, key))

    def chunk(self, state: OfflinePhaseState, constants: Any) -> tuple[OfflinePhaseState, dict[str, Any]]:
        """Make a chunk's gradient steps, and an evaluation when one is due (always after the last)."""
        state, metrics = super().chunk(state, constants)
        chunk = int(metrics["update"][0]) // self._updates
        if self._evaluation is not None and (chunk % self._evaluate_every == 0 or chunk == self.num_chunks):
            started = time.perf_counter()
            # A key that no update uses, so that evaluating does not change what is learned: fold_in(key, i) is
            # split(key, n)[i], and the next chunk uses those up to its number of updates.
            keys = jax.vmap(jax.random.fold_in)(state.key, jnp.maximum(state.update, self._updates + 1))
            episodes = self._evaluate(self._learner.params(state.learner), keys, self.data)
            metrics |= summary(episodes) | {"eval_seconds": time.perf_counter() - started}
        return state, metrics

    def constants(self, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return what the learner reads."""
        return {name: artifacts[name] for name in self._reads}

    def finish(self, state: OfflinePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the learner's parameters under the phase's name, and their normaliser."""
        normaliser = self._normalise.repeated(state.update.shape[0])
        learned = {self.name: self._learner.params(state.learner), "normaliser": normaliser}
        kept = {name: value for name, value in artifacts.items() if name not in self._drops}
        return kept | learned | {health.KEY: state.healthy}

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> OfflinePhaseState:
        """Return a fresh learner."""
        learner_key, key = jax.random.split(key)
        learner = self._learner.init(learner_key, hyper)
        return OfflinePhaseState(key, learner, jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def train_member(
        self, state: OfflinePhaseState, constants: dict[str, Any], hyper: dict[str, jax.Array], data: DeviceData
    ) -> tuple[OfflinePhaseState, dict[str, jax.Array]]:
        """Make a chunk's gradient steps."""
        data = data.replace(**constants)

        def update(learner: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            return self._learner.update(learner, data, key, hyper)

        keys = jax.random.split(state.key, self._updates + 1)
        learner, info = jax.lax.scan(update, state.learner, keys[1:])
        learner, healthy = health.keep_finite(state.healthy, learner, state.learner)
        state = OfflinePhaseState(keys[0], learner, state.update + self._updates, healthy)
        return state, jax.tree.map(jnp.mean, info)
