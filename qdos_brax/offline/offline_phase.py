"""A phase that learns from the data alone: gradient steps of any learner, and its evaluation if it is a policy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env
from flax import struct

from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.high_level.agent import Player
from qdos_brax.high_level.evaluation import Episodes, evaluate, summary
from qdos_brax.offline.learner import Learner
from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.memory import working_bytes


class OfflinePhaseState(struct.PyTreeNode):
    """What the phase carries, every leaf [members, ...]; healthy: False once a learned number is not finite."""

    key: jax.Array
    learner: Any
    update: jax.Array
    healthy: jax.Array


class Evaluation:
    """Episodes of what a learner has learned so far.

    Args:
        env: the task.
        player: (the learner's parameters of one member) -> what plays.
        episodes: per evaluation.
        horizon: environment steps per decision of the player.
        every_updates: gradient steps between two evaluations.
    """

    def __init__(
        self, env: Env, player: Callable[[Any], Player], episodes: int, horizon: int, every_updates: int
    ) -> None:
        self._env, self._player, self._episodes, self._horizon = env, player, episodes, horizon
        self.every_updates = every_updates

    def __call__(self, params: Any, key: jax.Array) -> Episodes:
        """Plays them with one member's parameters."""
        player = self._player(params)
        return evaluate(self._env, player.choose, player.play, key, self._episodes, self._horizon)


class OfflinePhase:
    """Gradient steps of a learner on the data set.

    Args:
        name: of the phase, and of what it leaves.
        learner: what learns.
        data: the data set on the device.
        normaliser: of observations.
        population: the members.
        updates: gradient steps.
        evaluation: of a policy, or None.
        updates_per_chunk: gradient steps between two looks of the host.
    """

    part = "pretrain"

    def __init__(
        self,
        name: str,
        learner: Learner,
        data: DeviceData,
        normaliser: Normaliser,
        population: Population,
        updates: int,
        evaluation: Evaluation | None = None,
        updates_per_chunk: int = 500,
    ) -> None:
        self.name = name
        self._learner, self._data, self._normalise = learner, data, normaliser
        self._hyper = population.hyper
        every = updates if evaluation is None else evaluation.every_updates
        self._updates = min(updates_per_chunk, updates, every)
        self.num_chunks = -(-updates // self._updates)
        self._evaluate_every = max(1, round(every / self._updates))
        self._start = population.program(self._init)
        self._chunk = population.program(self._train, carries=True)
        self._evaluate = None
        if evaluation is not None:
            self._evaluate = population.program(lambda params, key, _: evaluation(params, key))

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> OfflinePhaseState:
        """A fresh learner for every member."""
        state: OfflinePhaseState = self._start(key, None)
        return state.replace(healthy=health.inherited(artifacts, len(key)))

    def chunk(self, state: OfflinePhaseState) -> tuple[OfflinePhaseState, dict[str, Any]]:
        """``updates_per_chunk`` gradient steps, and an evaluation when one is due (always after the last chunk)."""
        state, info = self._chunk(state, self._hyper, self._data)
        update = np.asarray(state.update)
        metrics = {"update": update, **jax.tree.map(np.asarray, info), "status_ok": np.asarray(state.healthy)}
        chunk = int(update[0]) // self._updates
        if self._evaluate is not None and (chunk % self._evaluate_every == 0 or chunk == self.num_chunks):
            started = time.perf_counter()
            # A key that no update uses, so that evaluating does not change what is learned.
            keys = jax.vmap(jax.random.fold_in)(state.key, state.update)
            episodes = self._evaluate(self._learner.params(state.learner), keys, self._data)
            metrics |= summary(episodes) | {"eval_seconds": time.perf_counter() - started}
        return state, metrics

    def working_bytes(self, state: Any) -> int:
        """What a chunk needs beside the state, which may be shapes alone."""
        return working_bytes(self._chunk, state, self._hyper, self._data)

    def finish(self, state: OfflinePhaseState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Adds the learner's parameters under the phase's name, and what observations they were learned on."""
        normaliser = self._normalise.repeated(state.update.shape[0])
        learned = {self.name: self._learner.params(state.learner), "normaliser": normaliser}
        return artifacts | learned | {health.KEY: state.healthy}

    def _init(self, key: jax.Array, _: None) -> OfflinePhaseState:
        learner_key, key = jax.random.split(key)
        return OfflinePhaseState(key, self._learner.init(learner_key), jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def _train(self, state: OfflinePhaseState, hyper: dict[str, jax.Array], data: DeviceData) -> Any:
        def update(learner: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            return self._learner.update(learner, data, key, hyper)

        keys = jax.random.split(state.key, self._updates + 1)
        learner, info = jax.lax.scan(update, state.learner, keys[1:])
        learner, healthy = health.keep_finite(state.healthy, learner, state.learner)
        state = OfflinePhaseState(keys[0], learner, state.update + self._updates, healthy)
        return state, jax.tree.map(jnp.mean, info)
