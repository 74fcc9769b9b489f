"""Statistics for few seeds, from scipy.

The measures are those of Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021):
interquartile mean, probability of improvement, stratified bootstrap (seeds are resampled within each task). Their
package ``rliable`` (1.2.0) depends on pandas, seaborn, statsmodels, arch and patsy; here it is one call of scipy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
_RESAMPLES = 5_000
_TRIM = 0.25


class Estimate(NamedTuple):
    """Hold a number with the interval around it; nan where there are too few scores.

    Attributes:
        value: the estimate.
        low: lower end of its bootstrap interval (95 %).
        high: upper end.
    """

    value: float
    low: float
    high: float


def mean_std(scores: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation over seeds, with n - 1, as in the paper's tables; nan for too few scores."""
    numbers = _finite(scores)
    mean = float(numbers.mean()) if numbers.size else math.nan
    return mean, float(numbers.std(ddof=1)) if numbers.size > 1 else math.nan


def interquartile_mean(tasks: Sequence[Sequence[float]]) -> Estimate:
    """Return the mean of the middle half of all scores.

    For three seeds on one task this is the mean, because scipy trims whole scores and a quarter of three is none.

    Args:
        tasks: the scores of each task's seeds.
    """

    def statistic(*groups: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.asarray(stats.trim_mean(np.concatenate(groups, axis=axis), _TRIM, axis=axis))

    return _bootstrapped([_finite(scores) for scores in tasks], statistic)


def probability_of_improvement(better: Sequence[Sequence[float]], reference: Sequence[Sequence[float]]) -> Estimate:
    """Return the probability that a seed of one method beats a seed of another (ties count half), mean over tasks.

    Args:
        better: the scores of each task's seeds.
        reference: the scores of the other method's seeds, on the same tasks.
    """
    count = len(better)

    def statistic(*groups: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean([_chance(groups[i], groups[count + i], axis) for i in range(count)], axis=0)

    return _bootstrapped([_finite(scores) for scores in (*better, *reference)], statistic)


def mean_curve(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the mean over seeds at every point, and the ends of its bootstrap interval.

    Args:
        values: float[seeds, points], finite.

    Returns:
        float[points] each; the interval is nan for a single seed.
    """
    mean = values.mean(axis=0)
    if len(values) < 2 or not values.size:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    interval = _bootstrap((values,), np.mean, axis=0).confidence_interval
    return mean, interval.low, interval.high


def _chance(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
    """Return P(x > y) + P(x = y) / 2: Mann and Whitney's U over the number of pairs."""
    with np.errstate(invalid="ignore", divide="ignore"):  # from the unused p-value if all tie
        u = stats.mannwhitneyu(x, y, axis=axis, method="asymptotic").statistic
    return np.asarray(u / (x.shape[axis] * y.shape[axis]))


def _bootstrapped(groups: Sequence[np.ndarray], statistic: Callable[..., np.ndarray]) -> Estimate:
    if any(group.size == 0 for group in groups):
        return Estimate(math.nan, math.nan, math.nan)
    value = float(statistic(*groups))
    if any(group.size < 2 for group in groups):
        return Estimate(value, math.nan, math.nan)
    interval = _bootstrap(tuple(groups), statistic).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def _bootstrap(data: tuple[np.ndarray, ...], statistic: Callable[..., Any], axis: int = 0) -> Any:
    """Return percentile intervals, as rliable does; the seed is fixed, so that equal data have equal intervals."""
    return stats.bootstrap(
        data,
        statistic,
        n_resamples=_RESAMPLES,
        axis=axis,
        vectorized=True,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    )


def _finite(scores: Sequence[float]) -> np.ndarray:
    numbers = np.asarray(scores, np.float64)
    return numbers[~np.isnan(numbers)]
