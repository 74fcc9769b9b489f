"""What is wrong with rows for a task: the cheap part before every training, all of it for ``data check``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from qdos_brax.data.dataset import episode_bounds
from qdos_brax.data.labelling import as_costs, task_labels
from qdos_brax.data.readers.d4rl import JUMP
from qdos_brax.data.readers.rows import SAME, Rows

_ACTION_SLACK = 1e-3  # rounding of files stored in half precision; more than that is another action space
_IN_WALLS = 0.01  # share of positions; no body's centre gets into a wall at all, but files in half precision round


@dataclass
class Findings:
    """One line each: ``errors`` forbid the use for the task, ``notes`` do not."""

    errors: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def errors(rows: Rows, env: Any) -> list[str]:
    """What makes ``rows`` unusable for ``env`` and is cheap to see: sizes, numbers, actions, labels, the maze."""
    if rows.size == 0:
        return ["no transitions; every episode needs at least two rows, the last is only a next state"]
    lines = _sizes(rows, env)
    for key in ("observations", "actions", "next_observations", "rewards", "terminals", "qpos", "qvel"):
        array = getattr(rows, key)
        if array is not None and not np.isfinite(array).all():
            bad = ~np.isfinite(array).reshape(rows.size, -1).all(axis=1)
            lines.append(f"{key} has NaN or infinity in {_rows(bad)}: remove them")
    over = float(max(rows.actions.max(initial=0.0), -rows.actions.min(initial=0.0)))
    if over > 1.0 + _ACTION_SLACK:
        lines.append(f"actions reach {over:.3g}, the task takes [-1, 1]: scale them")
    if rows.qpos is None and rows.rewards is None:
        lines.append("neither qpos nor rewards: the task's rewards cannot be told; OGBench sets need add_info's qpos")
    return lines or _walls(rows, env)


def inspect(rows: Rows, env: Any, horizon: int, attributes: Mapping[str, Any]) -> Findings:
    """Everything that is found in ``rows``.

    Args:
        rows: as a reader made them.
        env: the task.
        horizon: steps of a segment.
        attributes: the file's; ``env`` names the task that its rewards were made for.
    """
    found = Findings(errors(rows, env), list(rows.notes))
    if rows.size == 0:
        return found
    horizon_errors, horizon_notes = horizon_lines(rows.ends, horizon)
    found.errors += horizon_errors
    found.notes += horizon_notes
    lengths = np.diff(episode_bounds(rows.ends), axis=1)
    if (longest := int(lengths.max())) > env.episode_length:
        found.notes.append(f"the longest episode has {longest} steps, {env.spec.name} ends after {env.episode_length}")
    if not found.errors:  # what follows presumes right sizes and finite numbers
        found.errors += _order(rows, env)
        _compare_rewards(rows, env, attributes, found)
    return found


def horizon_lines(ends: np.ndarray, horizon: int) -> tuple[list[str], list[str]]:
    """(errors, notes) on how the episodes fit windows of ``horizon`` steps."""
    bounds = episode_bounds(ends)
    lengths = bounds[:, 1] - bounds[:, 0]
    short = int((lengths < horizon).sum())
    if short == len(lengths):
        return [f"no episode has {horizon} steps (longest {lengths.max()}): use a shorter segment horizon"], []
    note = f"{short} of {len(lengths)} episodes are shorter than {horizon} steps and give no segment"
    return [], [note] if short else []


def _sizes(rows: Rows, env: Any) -> list[str]:
    obs, act = env.observation_size, env.action_size
    widths = {"observations": obs, "next_observations": obs, "actions": act}
    widths |= {"qpos": env.engine.nq, "qvel": env.engine.nv}
    lines = []
    for key, width in widths.items():
        array = getattr(rows, key)
        if array is not None and array.shape != (rows.size, width):
            shape = "x".join(map(str, array.shape[1:])) or "1"
            lines.append(f"{key} has {shape} numbers per row, {env.spec.name} has {width}: made for another task?")
    return lines


def _walls(rows: Rows, env: Any) -> list[str]:
    """A position inside a wall: the data is another maze's, or has another origin (as Minari's ant mazes)."""
    states = rows.observations if rows.qpos is None else rows.qpos  # both have body and ball at the same places
    lines = []
    for index in env.body.places:
        with np.errstate(invalid="ignore"):  # of numbers too large for a cell, which is a wall then
            cells = env.layout.xy_to_ij(states[:, index : index + 2])
        inside = env.layout.grid[cells[:, 0], cells[:, 1]] == 1
        if inside.mean() > _IN_WALLS:
            what = "the body" if index == 0 else "the ball"
            lines.append(
                f"{what} is inside the walls of {env.spec.name} in {inside.mean():.0%} of the rows: "
                "made for another maze, or with another origin?"
            )
    return lines


def _order(rows: Rows, env: Any) -> list[str]:
    """Rows that do not follow from one another: windows would cross from one episode to another."""
    lines = []
    inner = np.flatnonzero(~rows.ends[:-1])
    gaps = np.zeros(rows.size, bool)
    step = 1 << 16  # bounds memory
    for start in range(0, len(inner), step):
        some = inner[start : start + step]
        gaps[some] = _apart(rows.next_observations[some], rows.observations[some + 1])
    if gaps.any():
        lines.append(f"next_observations are not the row that follows in {_rows(gaps)}: windows would cross episodes")
    if rows.qpos is None:
        return lines
    places = rows.observations[:, :2]
    differ = _apart(rows.observations[:, :2], rows.qpos[:, :2])
    if rows.qvel is not None and env.observation_size == env.engine.nq + env.engine.nv:  # it is the whole state
        differ |= _apart(rows.observations, np.concatenate([rows.qpos, rows.qvel], axis=1))
    if differ.any():
        lines.append(f"qpos, qvel and observations disagree on the state in {_rows(differ)}")
    if env.layout.teleporters is None:
        jumps = np.linalg.norm(rows.next_observations[:, :2] - places, axis=1) > JUMP
        if jumps.any():
            lines.append(f"the body moves more than {JUMP} in one step in {_rows(jumps)}: ends out of step?")
    return lines


def _apart(some: np.ndarray, other: np.ndarray) -> np.ndarray:
    """bool[N], rows that are not the same."""
    with np.errstate(over="ignore"):
        return np.abs(some - other).max(axis=1) > SAME


def _compare_rewards(rows: Rows, env: Any, attributes: Mapping[str, Any], found: Findings) -> None:
    if rows.qpos is None:
        found.notes.append("no simulator states: rewards and masks are the file's own, of whatever task that was")
        return
    rewards, masks = task_labels(rows, env)
    if not (masks == 0).any():
        found.notes.append("no row is at the task's goal: no reward to learn from")
    if rows.rewards is None:
        return
    differ = as_costs(rows.rewards) != rewards
    if not differ.any():
        return
    if attributes.get("env") == env.spec.full_name:
        found.errors.append(f"rewards disagree with {env.spec.full_name}, which they were made for, in {_rows(differ)}")
    else:
        found.notes.append(f"rewards of another task or goal in {_rows(differ)}; they are made anew for the task")


def _rows(bad: np.ndarray) -> str:
    """As "3 rows (first 17)"."""
    count = int(bad.sum())
    return f"{count:,} row{'s' if count > 1 else ''} (first {bad.argmax()})"
