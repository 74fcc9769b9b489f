"""Collect the episodes of a scripted demonstrator: NumPy from the action to the row."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics import MujocoEngine, PipelineState
from envs.physics.mujoco.simulations import Simulations
from envs.task import Task
from qdos_brax.collection import scripted
from qdos_brax.collection.recipes import CollectionRecipe
from qdos_brax.collection.scripted.demonstrator import Demonstrator, SimStates
from qdos_brax.errors import UserError

PROGRESS_STEPS = 50  # control steps between two reports


class _Played(NamedTuple):
    """Hold n episodes of ``length`` steps.

    Attributes:
        qpos, qvel, extra, sensed: [n, length + 1, ..], before each step and after the last.
        actions: float32[n, length, act].
        quality: int8[n, length].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray
    actions: np.ndarray
    quality: np.ndarray


class ScriptedCollector:
    """Run a demonstrator in many simulations at once, on MuJoCo C.

    Args:
        env: the task, of a family among ``scripted.DEMONSTRATORS``.
        recipe: what is collected.

    Attributes:
        version: of the rows, given the demonstrator's actions.
        chunk_steps: an episode may have any length.
        at_once: calls of ``episodes``, each with a demonstrator of its own: while one acts, in Python on one core,
            another one's physics go on.

    Raises:
        UserError: the task runs on another engine.
    """

    version = 1
    chunk_steps = 1
    at_once = 2

    def __init__(self, env: Task, recipe: CollectionRecipe) -> None:
        if not isinstance(env.engine, MujocoEngine):
            raise UserError(
                f"{env.spec.family} is demonstrated on MuJoCo C, not on {env.backend}; use --physics mujoco"
            )
        self.env, self.recipe, self._engine = env, recipe, env.engine
        self._observe = jax.jit(jax.vmap(jax.vmap(env.observe)))

    @property
    def expert_id(self) -> str:
        """Return the demonstrator's class and version."""
        demonstrator = scripted.demonstrator_class(self.env.spec)
        return f"{demonstrator.__name__}-{demonstrator.version}"

    def episodes(
        self, kinds: np.ndarray, length: int, seed: int, turn: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the rows of n episodes, one after another; see ``EpisodeCollector``.

        Raises:
            ValueError: the demonstrator's actions leave [-1, 1].
            UserError: a simulation broke, and its states are no numbers.
        """
        own, sensors = np.random.default_rng([seed, turn]).spawn(2)
        simulations = self._engine.simulations(sensors)
        demonstrator = scripted.make(self.env, len(kinds), self.recipe.noise)
        played = _play(demonstrator, simulations, kinds, length, own, progress)
        if not (np.abs(played.actions) <= 1.0).all():
            raise ValueError(f"{self.expert_id} acts outside [-1, 1], or with what is no number")
        if not (np.isfinite(played.qpos).all() and np.isfinite(played.qvel).all()):
            raise UserError(f"a simulation of {self.env.spec.name} broke while it was demonstrated; use another --seed")
        return self._rows(played)

    def _rows(self, played: _Played) -> dict[str, np.ndarray]:
        """Return the rows by their name in the file."""
        observations = self._observations(played)
        n, length = played.quality.shape
        rows = {
            "observations": observations[:, :-1],
            "actions": played.actions,
            "next_observations": observations[:, 1:],
            "timeouts": np.broadcast_to(np.arange(length) == length - 1, (n, length)),
            "infos/qpos": played.qpos[:, :-1],
            "infos/qvel": played.qvel[:, :-1],
            "infos/quality": played.quality,
        }
        if self.env.extra_size:
            rows["infos/extra"] = played.extra[:, :-1]
        return {name: value.reshape(n * length, *value.shape[2:]) for name, value in rows.items()}

    def _observations(self, played: _Played) -> np.ndarray:
        """Return float32[n, length + 1, obs], what the task observes."""
        qpos, qvel, sensed, extra = map(jnp.asarray, (played.qpos, played.qvel, played.sensed, played.extra))
        states = PipelineState(qpos, qvel, sensed, extra, carry=(), steps=jnp.zeros(qpos.shape[:2], jnp.int32))
        return np.asarray(self._observe(states))


def _play(
    demonstrator: Demonstrator,
    simulations: Simulations,
    kinds: np.ndarray,
    length: int,
    rng: np.random.Generator,
    progress: Callable[[int], None] | None,
) -> _Played:
    """Play one episode of ``length`` steps in every simulation."""
    start = demonstrator.begin(kinds, rng)
    simulations.start(start.qpos, start.qvel, start.extra)
    states, actions, qualities = [_current(simulations)], [], []
    for step in range(1, length + 1):
        action, quality = demonstrator.act(states[-1], rng)
        simulations.step(action)
        states.append(_current(simulations))
        actions.append(action)
        qualities.append(quality)
        if progress is not None and (step % PROGRESS_STEPS == 0 or step == length):
            progress(step * len(kinds))
    qpos, qvel, extra, sensed = (np.stack(part, axis=1) for part in zip(*states, strict=True))
    single = (qpos.astype(np.float32), qvel.astype(np.float32))
    return _Played(*single, extra, sensed, np.stack(actions, axis=1, dtype=np.float32), np.stack(qualities, axis=1))


def _current(simulations: Simulations) -> SimStates:
    return SimStates(simulations.qpos, simulations.qvel, simulations.extra, simulations.sensed)
