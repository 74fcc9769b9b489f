"""Slow features: what of an observation changes little while a segment lasts.

Time-lagged independent component analysis (Molgedey and Schuster 1994; for kinetic models Perez-Hernandez et al. 2013):
the linear combinations of the observation with the largest autocorrelation at a lag. Where a body is changes slowly,
how its legs stand does not. Each feature is scaled to a root mean square change of 1 over the lag, which is the commute
map of Noe et al. (2016) up to a factor: distances then count in lags, the time that the data needs for such a change.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import scipy.linalg

_BLOCK = 50_000  # rows
_SMALLEST_VARIANCE = 1e-6  # of a principal direction, relative to the largest: below it lie copies of other columns
_SMALLEST_CHANGE = 1e-4  # 1 - autocorrelation: what never changes within an episode must not become infinitely far


class SlowFeatures(NamedTuple):
    """Hold a linear map to slow features, each with mean square change 1 over the lag.

    Attributes:
        mean: float64[obs].
        directions: float64[obs, F], slowest first.
    """

    mean: np.ndarray
    directions: np.ndarray

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the features float32[N, F] of observations[N, obs], in blocks."""
        features = np.empty((len(observations), self.directions.shape[1]), np.float32)
        for rows in _blocks(len(observations)):
            features[rows] = (observations[rows] - self.mean) @ self.directions
        return features


def fit_slow_features(
    observations: np.ndarray, next_observations: np.ndarray, starts: np.ndarray, lag: int, slowness: float
) -> SlowFeatures:
    """Find the features whose autocorrelation over ``lag`` steps is at least ``slowness``; the slowest one in
    any case, and a line says so if none other is left.

    Args:
        observations: float[N, obs], normalised per column.
        next_observations: float[N, obs]; both together not constant over the windows (``data.requirements``).
        starts: int[S], S >= 1, first rows of the windows of ``lag`` rows inside one episode.
        lag: steps.
        slowness: 0 to 1.
    """
    mean, covariance, lagged = _moments(observations, next_observations, starts, lag)
    autocorrelation, directions = slow_directions(covariance, lagged)
    largest = autocorrelation[0]
    if largest < slowness:
        print(
            f"values    no feature of the observations has an autocorrelation of values.slowness={slowness:g} over "
            f"{lag} steps: the slowest alone is used, with {largest:.2f}; --set values.slowness=N lowers the bound",
            file=sys.stderr,
            flush=True,
        )
    slow = autocorrelation >= min(slowness, largest)
    change = 2 * np.maximum(1 - autocorrelation[slow], _SMALLEST_CHANGE)  # mean square, of a feature of variance 1
    return SlowFeatures(mean, directions[:, slow] / np.sqrt(change))


def slow_directions(covariance: np.ndarray, lagged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (autocorrelation[F], directions[obs, F]) of uncorrelated features of variance 1, slowest first.

    Args:
        covariance: float64[obs, obs].
        lagged: float64[obs, obs], symmetric, covariance of each state with the one a lag later.
    """
    variance, axes = scipy.linalg.eigh(covariance)
    kept = variance > _SMALLEST_VARIANCE * variance[-1]
    whiten = axes[:, kept] / np.sqrt(variance[kept])
    autocorrelation, rotation = scipy.linalg.eigh(whiten.T @ lagged @ whiten)
    return autocorrelation[::-1], (whiten @ rotation)[:, ::-1]


def _moments(
    observations: np.ndarray, next_observations: np.ndarray, starts: np.ndarray, lag: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (mean[obs], covariance[obs, obs], symmetric lagged covariance[obs, obs]) of the windows' two ends.

    In blocks, so that no float64 copy of the data is needed.
    """
    size = observations.shape[1]
    total, covariance, lagged = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
    for rows in _blocks(len(starts)):
        before, after = _ends(observations, next_observations, starts[rows], lag)
        total += before.sum(axis=0) + after.sum(axis=0)
    mean = total / (2 * len(starts))
    for rows in _blocks(len(starts)):
        before, after = (end - mean for end in _ends(observations, next_observations, starts[rows], lag))
        covariance += before.T @ before + after.T @ after
        lagged += before.T @ after + after.T @ before
    return mean, covariance / (2 * len(starts)), lagged / (2 * len(starts))


def _ends(
    observations: np.ndarray, next_observations: np.ndarray, starts: np.ndarray, lag: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the windows' first and last states, float64[B, obs] each."""
    return observations[starts].astype(np.float64), next_observations[starts + lag - 1].astype(np.float64)


def _blocks(total: int) -> list[slice]:
    return [slice(first, first + _BLOCK) for first in range(0, total, _BLOCK)]
