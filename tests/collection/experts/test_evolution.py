"""CMA-ES on functions whose maximum and shape are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from qdos_brax.collection.experts.evolution import Evolution, Search

CURVATURE = np.array([1.0, 4.0, 25.0, 100.0])
BEST = np.array([0.5, -1.0, 2.0, 0.0])


def bowl(x: np.ndarray) -> np.ndarray:
    return -((x - BEST) ** 2) @ CURVATURE


def searched(value: Callable[[np.ndarray], np.ndarray], generations: int, start: Search | None = None) -> Search:
    evolution = Evolution(4, population=10, seed=3)
    search = start or evolution.begin(np.zeros(4), 0.5)
    for _ in range(generations):
        candidates = evolution.ask(search)
        search = evolution.tell(search, candidates, value(candidates))
    return search


def test_it_finds_the_maximum_and_the_shape_of_a_bowl() -> None:
    search = searched(bowl, 200)
    np.testing.assert_allclose(search.mean, BEST, atol=1e-5)
    lengths = np.diag(search.covariance) * CURVATURE  # the covariance becomes the inverse of the curvature
    assert lengths.max() / lengths.min() < 4.0  # 100 where it stays round
    assert search.generation == 200


def test_only_the_order_of_the_values_counts() -> None:
    once, other = searched(bowl, 20), searched(lambda x: np.exp(bowl(x) / 50) - 7, 20)
    for a, b in zip(once, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_search_that_was_stopped_goes_on_exactly() -> None:
    whole, half = searched(bowl, 20), searched(bowl, 12)
    for a, b in zip(whole, searched(bowl, 8, half), strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_generation_by_hand() -> None:
    evolution = Evolution(2, population=4, seed=0)
    begun = evolution.begin(np.zeros(2), 1.0)
    candidates = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 2.0], [-5.0, -5.0]])
    after = evolution.tell(begun, candidates, np.array([3.0, 1.0, 2.0, 0.0]))
    raw = np.log(2.5) - np.log([1, 2])  # the tutorial's weights of the better half
    first, second = raw / raw.sum()
    np.testing.assert_allclose(after.mean, [first, 2 * second])
    effective = 1 / (first**2 + second**2)
    rate = (effective + 2) / (2 + effective + 5)
    np.testing.assert_allclose(after.scale_path, np.sqrt(rate * (2 - rate) * effective) * after.mean)
