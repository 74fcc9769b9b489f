"""The statistics of a report against numbers worked out by hand or by another formula."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from qdos_brax.report.statistics import interquartile_mean, mean_curve, mean_std, probability_of_improvement

pytestmark = pytest.mark.quick


def test_standard_deviation_is_the_papers() -> None:
    """Table 2 of the paper: 13,334 ± 5,774 and 5,834 ± 1,443 are three seeds at its evaluation steps, with n - 1."""
    mean, std = mean_std([10_000, 10_000, 20_000])
    assert round(std) == 5_774 and math.ceil(mean) == 13_334
    mean, std = mean_std([5_000, 5_000, 7_500])
    assert round(std) == 1_443 and math.ceil(mean) == 5_834


def test_what_was_not_measured_is_left_out() -> None:
    assert mean_std([0.25, math.nan, 0.75]) == pytest.approx((0.5, math.sqrt(0.125)))
    mean, std = mean_std([0.25])
    assert mean == 0.25 and math.isnan(std)
    assert all(math.isnan(number) for number in mean_std([]))


def test_interquartile_mean_by_hand() -> None:
    # Of eight scores the lowest two and the highest two go: (3 + 4 + 5 + 6) / 4.
    assert interquartile_mean([[100, 1, 7, 2, 6, 3, 5, 4]]).value == 4.5
    # Two tasks of four are the same eight scores.
    assert interquartile_mean([[100, 1, 7, 2], [6, 3, 5, 4]]).value == 4.5
    assert interquartile_mean([[0.1, 0.2, 0.9]]).value == pytest.approx(0.4)  # a quarter of three is no score


def test_interval_against_every_resample() -> None:
    """Three scores have 27 equally likely resamples; the interval's ends are quantiles of their means."""
    scores = [0.0, 0.4, 1.0]
    estimate = interquartile_mean([scores])
    means = np.sort([np.mean(draw) for draw in itertools.product(scores, repeat=3)])
    assert estimate.value == pytest.approx(np.mean(scores))
    # 1/27 = 0.037 of the resamples are all 0, so that the 2.5 % quantile is 0, and likewise at the top.
    assert (estimate.low, estimate.high) == (means[0], means[-1]) == (0.0, 1.0)
    nine = np.asarray([0.3, 0.1, 0.2, 0.5, 0.4, 0.9, 0.8, 0.6, 0.7])
    _, low, high = mean_curve(nine[:, None])
    rng = np.random.default_rng(1)
    drawn = nine[rng.integers(0, 9, (200_000, 9))].mean(axis=1)
    assert [low[0], high[0]] == pytest.approx(np.quantile(drawn, [0.025, 0.975]), abs=0.01)


def test_seeds_are_drawn_within_their_task() -> None:
    """No spread within any task leaves none in the interval, however far the tasks are apart."""
    estimate = interquartile_mean([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    assert estimate == pytest.approx((0.5, 0.5, 0.5))


def test_probability_of_improvement_by_enumeration() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 4, 5) / 4, rng.integers(0, 4, 7) / 4  # with ties
    pairs = [(a > b) + 0.5 * (a == b) for a in ours for b in theirs]
    assert probability_of_improvement([ours], [theirs]).value == pytest.approx(np.mean(pairs))
    # By hand: 1 beats 0; 2 ties with two and beats 0; 3 beats all: (1 + 2 + 3) / 9.
    first = probability_of_improvement([[1, 2, 3]], [[2, 2, 0]])
    assert first.value == pytest.approx(6 / 9)
    # A second task, lost throughout, halves it.
    assert probability_of_improvement([[1, 2, 3], [0, 0]], [[2, 2, 0], [1, 1]]).value == pytest.approx(3 / 9)
    assert 0 <= first.low < first.value < first.high <= 1


def test_equal_scores_improve_with_even_chance() -> None:
    assert probability_of_improvement([[1, 1, 1]], [[1, 1, 1]]) == (0.5, 0.5, 0.5)


def test_one_seed_has_no_interval() -> None:
    estimate = interquartile_mean([[0.7]])
    assert estimate.value == 0.7 and math.isnan(estimate.low) and math.isnan(estimate.high)
    mean, low, _ = mean_curve(np.asarray([[0.1, 0.2]]))
    assert mean.tolist() == [0.1, 0.2] and np.isnan(low).all()
    assert math.isnan(interquartile_mean([[]]).value)
