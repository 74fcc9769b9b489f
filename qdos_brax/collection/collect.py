"""Collection of a task's offline data: whole episodes by a recipe (``qdos_brax.collection.recipes``).

An episode runs for a fixed number of steps, whether it reaches a goal or not. All tasks of a variant, such as a maze,
share the same data; only rewards and masks depend on the task.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import NamedTuple, Protocol

import numpy as np

from envs.task import Task
from qdos_brax.collection.recipes import CollectionRecipe, episode_kinds
from qdos_brax.errors import UserError

SHORTEST_EPISODE = 200


class EpisodeCollector(Protocol):
    """Collect whole episodes of a task, many at once."""

    @property
    def env(self) -> Task:
        """Return the task."""

    @property
    def recipe(self) -> CollectionRecipe:
        """Return what is collected."""

    @property
    def version(self) -> int:
        """Return a number that is raised when the same arguments give other rows; part of the default sets' names."""

    @property
    def expert_id(self) -> str:
        """Return what identifies who acts; part of the default sets' names."""

    @property
    def chunk_steps(self) -> int:
        """Return what the length of an episode has to be a multiple of, in control steps."""

    @property
    def at_once(self) -> int:
        """Return how many threads may call ``episodes`` at once."""

    def episodes(
        self, kinds: np.ndarray, length: int, seed: int, turn: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the rows of n episodes, one after another; the same arguments give the same rows.

        Args:
            kinds: int8[n], the behaviour in each, see ``recipes.BEHAVIOURS``.
            length: control steps of an episode, a multiple of ``chunk_steps``.
            seed: seed of the whole collection.
            turn: how many times the n were collected before; other turns have other random numbers.
            progress: called with the number of rows so far, now and then; what it raises ends the episodes.

        Returns:
            arrays[n * length, ..] by their name in the file: observations, actions, next_observations, timeouts,
            infos/qpos, infos/qvel, infos/quality, and infos/extra where the task has a discrete state.
        """
        ...


class _Visited(NamedTuple):
    """Hold the simulator states of all rows, as ``Task.labels`` takes them."""

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray | None


def collect(
    collector: EpisodeCollector,
    transitions: int,
    seed: int,
    num_envs: int = 64,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Collect ``transitions`` rows; the same arguments on the same machine give the same rows.

    Args:
        collector: task, recipe and who acts.
        transitions: number of rows, at least SHORTEST_EPISODE.
        seed: seed of all random numbers.
        num_envs: environments stepped at once (fewer when there are not enough episodes).
        progress: called as ``progress(rows so far, rows)`` now and then.

    Returns:
        Rows in D4RL's flat layout, keyed as in the file (``infos/qpos``), with true ``next_observations``. No row is
        terminal: episodes go on after a success and end by time.

    Raises:
        UserError: an argument is out of range.
    """
    check_size(transitions, seed, num_envs)
    env, recipe, chunk = collector.env, collector.recipe, collector.chunk_steps
    length = recipe.episode_steps or episode_length(transitions, num_envs, env.episode_length, chunk)
    episodes = -(-transitions // length)
    rounds = -(-episodes // num_envs)
    width = -(-episodes // rounds)
    kinds = episode_kinds(recipe.mix, rounds * width, seed).reshape(rounds, width)

    def report(done: int) -> None:
        if progress is not None:
            progress(min(done, transitions), transitions)

    count = _Count(rounds, report)
    with ThreadPoolExecutor(collector.at_once) as pool:
        waiting = [
            pool.submit(collector.episodes, kinds[index], length, seed, index, count.of(index))
            for index in range(rounds)
        ]
        try:
            for played in as_completed(waiting):
                played.result()
        except BaseException:  # Ctrl-C too: nobody wants the other rounds any more
            count.stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    parts = [played.result() for played in waiting]
    rows = {name: np.concatenate([part[name] for part in parts])[:transitions] for name in parts[0]}
    rows["timeouts"][-1] = True
    states = _Visited(rows["infos/qpos"], rows["infos/qvel"], rows.get("infos/extra"))
    rows["rewards"] = np.asarray(env.labels(states)[0], np.float32)
    rows["terminals"] = np.zeros(transitions, bool)
    return rows


def check_size(transitions: int, seed: int, num_envs: int) -> None:
    """Raise UserError if ``collect`` cannot take one of these numbers."""
    if transitions < SHORTEST_EPISODE:
        raise UserError(f"transitions must be at least {SHORTEST_EPISODE} (one episode), got {transitions}")
    if num_envs < 1 or not 0 <= seed < 2**32:
        raise UserError(f"seed must be 0 to 2^32 - 1 and num_envs 1 or more, got {seed} and {num_envs}")


def episode_length(transitions: int, num_envs: int, cap: int, chunk: int) -> int:
    """Return the steps of an episode: the task's ``cap``, or fewer so that a small set uses all environments."""
    return min(max(transitions // num_envs, SHORTEST_EPISODE), cap) // chunk * chunk


class _Count:
    """Add up the rows of rounds that run at once, and stop them.

    Args:
        rounds: how many.
        report: called with the sum whenever it grows, by one thread at a time.
    """

    def __init__(self, rounds: int, report: Callable[[int], None]) -> None:
        self._rows, self._report = [0] * rounds, report
        self._lock, self._stopped = threading.Lock(), False

    def of(self, index: int) -> Callable[[int], None]:
        """Return what a round calls with the number of its rows so far; it raises when the rounds were stopped."""

        def report(rows: int) -> None:
            with self._lock:
                if self._stopped:
                    raise InterruptedError("another round failed, or the program was interrupted")
                self._rows[index] = rows
                self._report(sum(self._rows))

        return report

    def stop(self) -> None:
        """Let all rounds that run end at their next report."""
        with self._lock:
            self._stopped = True
