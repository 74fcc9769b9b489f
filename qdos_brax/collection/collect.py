"""Collection of a task's offline data: episodes of repeated navigation, by a recipe (``qdos_brax.collection.recipes``).

An episode starts at random free cells and runs for a fixed number of steps, whether it reaches a goal or not: the body
is sent along a shortest path to a random free cell (soccer: it brings the ball there), and on arrival to another. All
tasks of a maze share the same data; only rewards and masks depend on the task.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from qdos_brax.collection.collector import CHUNK_STEPS, Collector
from qdos_brax.collection.recipes import episode_kinds
from qdos_brax.errors import UserError

COLLECTION_VERSION = 5
"""Version of the collected rows: raised when the same arguments give other rows. Part of the default sets' names."""

SHORTEST_EPISODE = 200


def collect(
    collector: Collector,
    transitions: int,
    seed: int,
    num_envs: int = 64,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Collect ``transitions`` rows; the same arguments on the same machine give the same rows.

    Args:
        collector: task, recipe and expert.
        transitions: number of rows, at least SHORTEST_EPISODE.
        seed: seed of all random numbers.
        num_envs: environments stepped at once (fewer when there are not enough episodes).
        progress: called as ``progress(rows so far, rows)`` after every chunk.

    Returns:
        Rows in D4RL's flat layout, keyed as in the file (``infos/qpos``), with true ``next_observations``. No row is
        terminal: episodes go on after a success and end by time.

    Raises:
        UserError: an argument is out of range.
    """
    check_size(transitions, seed, num_envs)
    env, recipe = collector.env, collector.recipe
    length = recipe.episode_steps or episode_length(transitions, num_envs, env.episode_length)
    episodes = -(-transitions // length)
    rounds = -(-episodes // num_envs)
    width = -(-episodes // rounds)
    kinds = episode_kinds(recipe.mix, rounds * width, seed).reshape(rounds, width)
    parts: list[dict[str, np.ndarray]] = []
    for index in range(rounds):
        reset_key, step_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
        report = None if progress is None else _offset(progress, index * width * length, transitions)
        states = collector.reset(jax.random.split(reset_key, width))
        parts.append(collector.run(states, kinds[index], length, step_key, report)[0])
    rows = {name: np.concatenate([part[name] for part in parts])[:transitions] for name in parts[0]}
    rows["timeouts"][-1] = True
    success = np.asarray(env.success(rows["infos/qpos"], env.goal_xy))
    rows["rewards"] = success.astype(np.float32) - 1.0
    rows["terminals"] = np.zeros(transitions, bool)
    return rows


def check_size(transitions: int, seed: int, num_envs: int) -> None:
    """Raise UserError if ``collect`` cannot take one of these numbers."""
    if transitions < SHORTEST_EPISODE:
        raise UserError(f"transitions must be at least {SHORTEST_EPISODE} (one episode), got {transitions}")
    if num_envs < 1 or seed < 0:
        raise UserError(f"seed must be 0 or more and num_envs 1 or more, got {seed} and {num_envs}")


def episode_length(transitions: int, num_envs: int, cap: int) -> int:
    """Return the steps of an episode: the task's ``cap``, or fewer so that a small set uses all environments."""
    return min(max(transitions // num_envs, SHORTEST_EPISODE), cap) // CHUNK_STEPS * CHUNK_STEPS


def _offset(progress: Callable[[int, int], None], done: int, total: int) -> Callable[[int], None]:
    return lambda rows: progress(min(done + rows, total), total)
