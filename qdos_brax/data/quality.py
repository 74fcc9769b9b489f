"""Measure how good a segment truly is, and how well scores separate good from bad. Never for training."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from envs.task import Task
from qdos_brax.data.dataset import Dataset

QUALITY = {"navigate": 0, "noisy": 1, "wander": 2, "fail": 3}
"""What produced a step; every code but 0 is degraded behaviour."""


class States(NamedTuple):
    """Hold simulator states.

    Attributes:
        qpos: float[N, nq].
        qvel: float[N, nv].
        extra: int[N, e], the discrete state; None for a task without.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray | None


def progress(env: Task, dataset: Dataset, starts: np.ndarray, horizon: int) -> np.ndarray | None:
    """Return float64[S], distance left at s_0 minus at s_H, of the segments that begin at ``starts``.

    ``env.distance_left`` is, in a maze, the shortest path to the task's goal (soccer: agent to ball plus ball to goal);
    None for a task that has no such measure. Positions are stored before the action, so a segment that ends its episode
    is measured at s_{H-1}, one step short. A teleporter may lose a segment infinitely much, by an exit without a way
    out.

    Raises:
        ValueError: the dataset has no qpos.
    """
    if dataset.qpos is None:
        raise ValueError(f"{dataset.source}: progress needs the simulator's qpos")
    after = _rows_after(dataset, starts, horizon)
    before_left, after_left = (_left(env, dataset, rows) for rows in (np.asarray(starts), after))
    if before_left is None or after_left is None:
        return None
    cut_off = np.isinf(before_left) & np.isinf(after_left)  # no way before, no way after: nothing gained or lost
    return np.where(cut_off, 0.0, before_left - np.where(cut_off, 0.0, after_left))


def changed_parts(
    env: Task, dataset: Dataset, starts: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return which part of the task was done or undone in the segments that begin at ``starts``.

    As in ``progress``, a segment that ends its episode is judged one step short.

    Returns:
        int8[S] codes and str[P + 2] names by their codes: "none", the parts in the task's order, "several". None for a
        task without parts, or data without the states that tell.
    """
    if dataset.qpos is None or dataset.qvel is None or (env.extra_size and dataset.extra is None):
        return None
    before, after = (
        env.parts(
            States(dataset.qpos[rows], dataset.qvel[rows], None if dataset.extra is None else dataset.extra[rows])
        )
        for rows in (np.asarray(starts), _rows_after(dataset, starts, horizon))
    )
    if before is None or after is None:
        return None
    changed = np.stack([np.asarray(before[name]) != np.asarray(after[name]) for name in before], axis=-1)
    codes = np.where(changed.any(axis=-1), 1 + changed.argmax(axis=-1), 0)
    codes = np.where(changed.sum(axis=-1) > 1, len(before) + 1, codes)
    return codes.astype(np.int8), np.asarray(["none", *before, "several"])


def _rows_after(dataset: Dataset, starts: np.ndarray, horizon: int) -> np.ndarray:
    """Return int[S], the rows that hold the states after segments, or their last where their episode ends with them."""
    last = np.asarray(starts) + horizon - 1
    return np.where(dataset.ends[last], last, np.minimum(last + 1, dataset.size - 1))


def _left(env: Task, dataset: Dataset, rows: np.ndarray) -> np.ndarray | None:
    """Return float64[S], the distance left at ``rows`` of the data: of these alone, since a path takes its time."""
    assert dataset.qpos is not None
    left = env.distance_left(dataset.qpos[rows], None if dataset.extra is None else dataset.extra[rows])
    return None if left is None else np.asarray(left, np.float64)


def auc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Return the ROC AUC: how likely a positive's score exceeds a negative's, ties counted half; NaN without both.

    Args:
        scores: float[S].
        positive: bool[S].
    """
    from scipy.stats import rankdata  # here, for training reads this module and loading this one takes long

    scores, positive = np.asarray(scores, np.float64), np.asarray(positive, bool)
    num_positive = int(positive.sum())
    num_negative = len(positive) - num_positive
    if num_positive == 0 or num_negative == 0:
        return float("nan")
    rank_sum = rankdata(scores)[positive].sum()
    return float((rank_sum - num_positive * (num_positive + 1) / 2) / (num_positive * num_negative))


def report(
    scores: np.ndarray, weights: np.ndarray, gains: np.ndarray, margin: float, degraded: np.ndarray | None = None
) -> dict[str, float]:
    """Return how well ``scores`` (advantages) rank segments, and what ``weights`` made of them.

    Args:
        scores: float[S], higher should mean better.
        weights: float[S], non-negative training weights of the same segments.
        gains: float[S], ``progress``.
        margin: gain that counts as progress, or lost as a setback, such as the task's ``distance_margin``.
        degraded: bool[S], behaviour known to be bad, or None.

    Returns:
        auc_progress: gains > margin against gains < -margin. auc_degraded: undegraded against degraded.
        effective_share: effective sample size (sum w)^2 / sum w^2, as a share of S. losing_share, gaining_share: share
        of all segments that lose or gain more than ``margin``. losing_weight, gaining_weight: their shares of the
        weight.
    """
    weights = np.asarray(weights, np.float64)
    losing, gaining = gains < -margin, gains > margin
    decided = losing | gaining
    total = weights.sum()
    numbers = {
        "auc_progress": auc(scores[decided], gaining[decided]),
        "effective_share": float(total**2 / (np.square(weights).sum() * len(weights))),
        "losing_share": float(losing.mean()),
        "losing_weight": float(weights[losing].sum() / total),
        "gaining_share": float(gaining.mean()),
        "gaining_weight": float(weights[gaining].sum() / total),
    }
    if degraded is not None:
        numbers["auc_degraded"] = auc(scores, ~np.asarray(degraded, bool))
    return numbers
