"""Find what is wrong with rows for a task: the cheap part before every training, all of it for ``data check``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envs.task import Task, count_rows
from qdos_brax.config import Config
from qdos_brax.data.dataset import Dataset, episode_bounds
from qdos_brax.data.labelling import drop_unknown, label
from qdos_brax.data.readers.rows import SAME, Rows
from qdos_brax.data.requirements import remarks, unmet

_LARGEST = 1e18  # the square of a larger number is none in float32
_MOST_RESTING, _LEAST_RESTING = 5_000, 50  # rows whose heights are looked at, and rows that must be near the ground
_NEAR_GROUND = 0.05  # m
_ACTION_SLACK = 1e-3  # rounding of files stored in half precision; more than that is another action space


@dataclass
class Findings:
    """Hold one line each, and what training would read.

    Attributes:
        errors: what forbids the use for the task.
        notes: what does not.
        dataset: the labelled rows; None where sizes or numbers are wrong.
    """

    errors: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    dataset: Dataset | None = None


def errors(rows: Rows, env: Task) -> list[str]:
    """Return what makes ``rows`` unusable for ``env`` and is cheap to see: sizes, numbers, actions, labels, states."""
    if rows.size == 0:
        return ["no transitions; every episode needs at least two rows, the last is only a next state"]
    lines = _sizes(rows, env)
    for key in ("observations", "actions", "next_observations", "rewards", "terminals", "qpos", "qvel"):
        array = getattr(rows, key)
        if array is not None and not -_LARGEST < array.min(initial=0) <= array.max(initial=0) < _LARGEST:
            finite = np.isfinite(array).all()
            bad = ~(np.abs(array) < _LARGEST).reshape(rows.size, -1).all(axis=1)
            what = f"numbers beyond {_LARGEST:g}" if finite else "NaN or infinity"
            lines.append(f"{key} has {what} in {count_rows(bad)}: remove them")
    over = float(max(rows.actions.max(initial=0.0), -rows.actions.min(initial=0.0)))
    if over > 1.0 + _ACTION_SLACK:
        lines.append(f"actions reach {over:.3g}, the task takes [-1, 1]: scale them")
    if rows.qpos is None and rows.rewards is None:
        lines.append("neither qpos nor rewards: the task's rewards are unknown; OGBench sets need add_info's qpos")
    return lines or env.check_rows(rows)


def prepare(rows: Rows, env: Task) -> list[str]:
    """Drop, in place, what nothing can be learned from; return what makes ``rows`` unusable for ``env``.

    Every training begins with it, and ``data check``.
    """
    if not env.extra_size:
        rows.extra = None  # whatever another maker's file means by it
    lines = errors(rows, env)
    if not lines:
        drop_unknown(rows, env)
        if not rows.size:
            lines = [f"no transitions are left: {rows.notes.pop()}"]
    return lines


def inspect(rows: Rows, env: Task, config: Config, attributes: Mapping[str, Any], source: str) -> Findings:
    """Return everything that is found in ``rows``, which are prepared for ``env`` in place.

    Args:
        rows: as a reader made them.
        env: the task.
        config: the configuration to train with.
        attributes: the file's; ``env`` names the task that its rewards were made for.
        source: where the rows came from.
    """
    faults = prepare(rows, env)
    found = Findings(list(faults), remarks(rows, config))
    if rows.size:
        found.errors += unmet(rows, env, config)
        found.notes += _lengths(rows, env, config.skills.horizon)
    if not faults:  # what follows presumes right sizes and finite numbers
        found.errors += _order(rows, env)
        found.dataset = label(rows, env, source)
        found.notes += [*_sameness(found.dataset), *_recorded_before(rows, env)]
        _compare_rewards(rows, found.dataset, env, attributes, found)
    return found


def _lengths(rows: Rows, env: Task, horizon: int) -> list[str]:
    """Return notes on episodes that are too short for a segment, or longer than the task's."""
    lengths = np.diff(episode_bounds(rows.ends), axis=1)
    short, longest = int((lengths < horizon).sum()), int(lengths.max())
    lines = []
    if 0 < short < len(lengths):
        lines.append(f"{short} of {len(lengths)} episodes are shorter than {horizon} steps and give no segment")
    if longest > env.episode_length:
        lines.append(f"the longest episode has {longest} steps, {env.spec.name} ends after {env.episode_length}")
    return lines


def _sameness(dataset: Dataset) -> list[str]:
    """Return notes on what never changes, where there is more than one row."""
    if dataset.size < 2:
        return []
    what = {"observations": dataset.observations, "actions": dataset.actions}
    return [f"{name} are the same in every row" for name, array in what.items() if (array == array[0]).all()]


def _recorded_before(rows: Rows, env: Task) -> list[str]:
    """Return a note if things rest where MuJoCo before 3.5 let them rest.

    A walk lifts feet and lands on them, but the median height near the ground is that at rest, within 2 mm: over
    navigation, noise, falls and random actions, walked under the margins of then and of today.
    """
    if rows.qpos is None or (resting := env.resting(rows.qpos[:: -(-rows.size // _MOST_RESTING)])) is None:
        return []
    near = resting.heights[np.abs(resting.heights - resting.before) < _NEAR_GROUND]
    if len(near) < _LEAST_RESTING or abs(np.median(near) - resting.before) > 0.4 * (resting.today - resting.before):
        return []
    return [
        "recorded with MuJoCo before 3.5, where a contact's margin was the larger of two and not their sum: what rests "
        f"does so {1000 * resting.before:.0f} mm above the ground, today {1000 * resting.today:.0f} mm; rollouts from "
        "these states begin by rising"
    ]


def _sizes(rows: Rows, env: Task) -> list[str]:
    obs, act = env.observation_size, env.action_size
    widths = {"observations": obs, "next_observations": obs, "actions": act}
    widths |= {"qpos": env.engine.nq, "qvel": env.engine.nv, "extra": env.extra_size}
    numbers = rows.observations.shape[-1]
    if numbers in env.unfit:
        return [f"observations have {numbers} numbers, {env.spec.name} has {obs}: {env.unfit[numbers]}"]
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


def _compare_rewards(rows: Rows, dataset: Dataset, env: Task, attributes: Mapping[str, Any], found: Findings) -> None:
    if rows.qpos is None:
        found.notes.append("no simulator states: rewards and masks are the file's own, of whatever task that was")
        if (dataset.rewards == dataset.rewards[0]).all():
            found.notes.append(f"every reward is {dataset.rewards[0]:g}: no reward to learn from")
        return
    if (dataset.rewards == dataset.rewards[0]).all():
        at_goal = "every row is at the task's goal" if dataset.masks[0] == 0 else "no row is at the task's goal"
        found.notes.append(f"{at_goal}: no reward to learn from")
    if rows.rewards is None:
        return
    differ = env.file_rewards(rows.rewards) != dataset.rewards
    if not differ.any():
        return
    where, name = count_rows(differ), env.spec.full_name
    if attributes.get("env") == name:
        found.errors.append(f"rewards disagree with {name}, which they were made for, in {where}")
    else:
        found.notes.append(f"rewards of another task or goal in {where}; they are made anew for the task")
