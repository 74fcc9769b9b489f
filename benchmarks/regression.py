"""How much of something a linear map of something else explains."""

from __future__ import annotations

import numpy as np

ROWS_PER_FEATURE = 10  # from which on least squares can be trusted
TAILS = (0.01, 0.99)  # quantiles of a feature
PENALTIES = np.logspace(-4, 4, 33)  # of ridge regression, per row
SMALLEST = 1e-8  # of a deviation and of a singular value


def r2(target: np.ndarray, *given: np.ndarray) -> float:
    """Return the share of ``target[n, z]``'s variance that a linear map of ``given`` explains, on the held-out half.

    The map is found by least squares; with fewer than ``ROWS_PER_FEATURE`` rows to each of its features, as for an arm,
    by ridge regression on features that end at their ``TAILS``: things that are seldom touched fly far, and with many
    features a few such rows decide the map, which is then worse than none.
    """
    inputs = np.concatenate([*given, np.ones((len(target), 1))], axis=1)
    half = np.random.default_rng(0).permutation(len(target)) < len(target) // 2
    fit = least_squares
    if half.sum() < ROWS_PER_FEATURE * inputs.shape[1]:
        fit, inputs = ridge, np.clip(inputs, *np.quantile(inputs[half], TAILS, axis=0))
    error = target[~half] - inputs[~half] @ fit(inputs[half], target[half])
    return float(1 - (error**2).mean() / target[~half].var(axis=0).mean())


def least_squares(inputs: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return weights[k, z] of the linear map from inputs[n, k] to target[n, z]."""
    return np.linalg.lstsq(inputs, target, rcond=None)[0]


def ridge(inputs: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the same by ridge regression on standardised inputs, whose last column is 1.

    The penalty is the one that predicts each row best from all the others (PRESS, Allen 1974).
    """
    mean, scale = inputs[:, :-1].mean(axis=0), inputs[:, :-1].std(axis=0)
    scale = np.where(scale < SMALLEST, np.inf, scale)  # what never changes gets no weight
    left, size, right = np.linalg.svd((inputs[:, :-1] - mean) / scale, full_matrices=False)
    centre = target.mean(axis=0)
    along, best = left.T @ (target - centre), (np.inf, np.zeros_like(size))
    for penalty in PENALTIES * len(inputs):
        kept = size**2 / (size**2 + penalty)
        known = 1 / len(inputs) + left**2 @ kept  # how far each row's own target decides what it is said to be
        error = (target - centre - left @ (kept[:, None] * along)) / (1 - known)[:, None]
        best = min(best, ((error**2).mean(), kept / np.maximum(size, SMALLEST)), key=lambda found: found[0])
    weights = (right.T @ (best[1][:, None] * along)) / scale[:, None]
    return np.concatenate([weights, (centre - mean @ weights)[None]])
