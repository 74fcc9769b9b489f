"""Find what is wrong with rows for a task: the cheap part before every training, all of it for ``data check``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envs.task import Task, count_rows
from qdos_brax.data.dataset import episode_bounds
from qdos_brax.data.labelling import drop_unknown, task_labels
from qdos_brax.data.readers.rows import SAME, Rows

_ACTION_SLACK = 1e-3  # rounding of files stored in half precision; more than that is another action space


@dataclass
class Findings:
    """Hold one line each: ``errors`` forbid the use for the task, ``notes`` do not."""

    errors: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def errors(rows: Rows, env: Task) -> list[str]:
    """Return what makes ``rows`` unusable for ``env`` and is cheap to see: sizes, numbers, actions, labels, states."""
    if rows.size == 0:
        return ["no transitions; every episode needs at least two rows, the last is only a next state"]
    lines = _sizes(rows, env)
    for key in ("observations", "actions", "next_observations", "rewards", "terminals", "qpos", "qvel"):
        array = getattr(rows, key)
        if array is not None and not np.isfinite(array).all():
            bad = ~np.isfinite(array).reshape(rows.size, -1).all(axis=1)
            lines.append(f"{key} has NaN or infinity in {count_rows(bad)}: remove them")
    over = float(max(rows.actions.max(initial=0.0), -rows.actions.min(initial=0.0)))
    if over > 1.0 + _ACTION_SLACK:
        lines.append(f"actions reach {over:.3g}, the task takes [-1, 1]: scale them")
    if rows.qpos is None and rows.rewards is None:
        lines.append("neither qpos nor rewards: the task's rewards are unknown; OGBench sets need add_info's qpos")
    return lines or env.check_rows(rows)


def inspect(rows: Rows, env: Task, horizon: int, attributes: Mapping[str, Any]) -> Findings:
    """Return everything that is found in ``rows``.

    Args:
        rows: as a reader made them.
        env: the task.
        horizon: steps of a segment.
        attributes: the file's; ``env`` names the task that its rewards were made for.
    """
    lines = errors(rows, env)
    if not lines:
        drop_unknown(rows, env)
        lines = errors(rows, env)
    found = Findings(lines, list(rows.notes))
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
    """Return (errors, notes) on how the episodes fit windows of ``horizon`` steps."""
    bounds = episode_bounds(ends)
    lengths = bounds[:, 1] - bounds[:, 0]
    short = int((lengths < horizon).sum())
    if short == len(lengths):
        return [f"no episode has {horizon} steps (longest {lengths.max()}): use a shorter segment horizon"], []
    note = f"{short} of {len(lengths)} episodes are shorter than {horizon} steps and give no segment"
    return [], [note] if short else []


def _sizes(rows: Rows, env: Task) -> list[str]:
    obs, act = env.observation_size, env.action_size
    widths = {"observations": obs, "next_observations": obs, "actions": act}
    widths |= {"qpos": env.engine.nq, "qvel": env.engine.nv, "extra": env.extra_size}
    lines = []
    for key, width in widths.items():
        array = getattr(rows, key)
        if array is not None and array.shape != (rows.size, width):
            shape = "x".join(map(str, array.shape[1:])) or "1"
            lines.append(f"{key} has {shape} numbers per row, {env.spec.name} has {width}: made for another task?")
    if env.extra_size and rows.qpos is not None and rows.extra is None:
        lines.append(f"qpos without infos/extra, the discrete state of {env.spec.name}: the states are not whole")
    return lines


def _order(rows: Rows, env: Task) -> list[str]:
    """Return lines on rows that do not follow from one another: windows would cross from one episode to another."""
    lines = []
    inner = np.flatnonzero(~rows.ends[:-1])
    gaps = np.zeros(rows.size, bool)
    step = 1 << 16  # bounds memory
    for start in range(0, len(inner), step):
        some = inner[start : start + step]
        gaps[some] = _apart(rows.next_observations[some], rows.observations[some + 1])
    if gaps.any():
        lines.append(
            f"next_observations are not the row that follows in {count_rows(gaps)}: windows would cross episodes"
        )
    return lines + env.check_steps(rows)


def _apart(some: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return bool[N], rows that are not the same."""
    with np.errstate(over="ignore"):
        return np.abs(some - other).max(axis=1) > SAME


def _compare_rewards(rows: Rows, env: Task, attributes: Mapping[str, Any], found: Findings) -> None:
    if rows.qpos is None:
        found.notes.append("no simulator states: rewards and masks are the file's own, of whatever task that was")
        return
    rewards, masks = task_labels(rows, env)
    if not (masks == 0).any():
        found.notes.append("no row is at the task's goal: no reward to learn from")
    if rows.rewards is None:
        return
    differ = env.file_rewards(rows.rewards) != rewards
    if not differ.any():
        return
    where, name = count_rows(differ), env.spec.full_name
    if attributes.get("env") == name:
        found.errors.append(f"rewards disagree with {name}, which they were made for, in {where}")
    else:
        found.notes.append(f"rewards of another task or goal in {where}; they are made anew for the task")
