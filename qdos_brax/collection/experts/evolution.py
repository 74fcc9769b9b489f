"""CMA-ES, the evolution strategy with covariance matrix adaptation.

Source: Hansen 2016, "The CMA Evolution Strategy: A Tutorial" (arXiv 1604.00772). It maximises a function of a few dozen
numbers from its values alone, which may be noisy. NumPy in float64; a generation's random numbers depend on the seed
and the generation alone, so that a search continues exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Search(NamedTuple):
    """Hold a search's state over n numbers.

    Attributes:
        mean: float64[n], the centre of the distribution.
        scale: float64, its overall standard deviation.
        covariance: float64[n, n], its shape.
        path: float64[n], the evolution path of the mean ("p_c").
        scale_path: float64[n], the conjugate evolution path ("p_sigma").
        generation: int, generations made.
    """

    mean: np.ndarray
    scale: np.ndarray
    covariance: np.ndarray
    path: np.ndarray
    scale_path: np.ndarray
    generation: np.ndarray


class Evolution:
    """Hold the tutorial's constants for n numbers and a population; ``ask`` for candidates, ``tell`` their values.

    Args:
        size: n.
        population: candidates per generation, at least 4.
        seed: seed of all random numbers.
    """

    def __init__(self, size: int, population: int, seed: int) -> None:
        self.size, self.population, self.seed = size, population, seed
        parents = population // 2
        weights = np.log((population + 1) / 2) - np.log(np.arange(1, parents + 1))
        self.weights = weights / weights.sum()
        effective = 1 / np.sum(self.weights**2)
        self.path_rate = (4 + effective / size) / (size + 4 + 2 * effective / size)
        self.scale_rate = (effective + 2) / (size + effective + 5)
        self.rank_one = 2 / ((size + 1.3) ** 2 + effective)
        self.rank_mu = min(1 - self.rank_one, 2 * (effective - 2 + 1 / effective) / ((size + 2) ** 2 + effective))
        self.scale_damping = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (size + 1)) - 1) + self.scale_rate
        self.effective = effective
        self.expected_norm = np.sqrt(size) * (1 - 1 / (4 * size) + 1 / (21 * size**2))

    def begin(self, mean: np.ndarray, scale: float) -> Search:
        """Return a search around ``mean[n]`` with standard deviation ``scale`` in every direction."""
        zeros = np.zeros(self.size)
        return Search(np.array(mean, float), np.array(scale), np.eye(self.size), zeros, zeros, np.array(0))

    def ask(self, search: Search) -> np.ndarray:
        """Return the generation's candidates[population, n]."""
        normal = np.random.default_rng((self.seed, int(search.generation))).normal(size=(self.population, self.size))
        lengths, axes = _axes(search.covariance)
        return search.mean + search.scale * (normal * lengths) @ axes.T

    def tell(self, search: Search, candidates: np.ndarray, values: np.ndarray) -> Search:
        """Return the search after the generation of ``candidates[population, n]`` with ``values[population]``."""
        best = np.argsort(-values, kind="stable")[: len(self.weights)]
        steps = (candidates[best] - search.mean) / search.scale
        step = self.weights @ steps
        lengths, axes = _axes(search.covariance)
        whitened = axes @ ((axes.T @ step) / lengths)
        scale_path = (1 - self.scale_rate) * search.scale_path + _gain(self.scale_rate, self.effective) * whitened
        norm = np.linalg.norm(scale_path)
        settled = np.sqrt(1 - (1 - self.scale_rate) ** (2 * (search.generation + 1)))
        moves = norm / settled < (1.4 + 2 / (self.size + 1)) * self.expected_norm
        path = (1 - self.path_rate) * search.path + moves * _gain(self.path_rate, self.effective) * step
        kept = 1 - self.rank_one - self.rank_mu + (not moves) * self.rank_one * self.path_rate * (2 - self.path_rate)
        covariance = kept * search.covariance
        covariance = covariance + self.rank_one * np.outer(path, path) + self.rank_mu * (steps.T * self.weights) @ steps
        return Search(
            mean=search.mean + search.scale * step,
            scale=search.scale * np.exp(self.scale_rate / self.scale_damping * (norm / self.expected_norm - 1)),
            covariance=(covariance + covariance.T) / 2,
            path=path,
            scale_path=scale_path,
            generation=search.generation + 1,
        )


def _axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths[n] of the principal axes, and the axes as columns[n, n]."""
    variances, axes = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(variances, 1e-20)), axes


def _gain(rate: float, effective: float) -> float:
    """Return the factor that keeps a path's variance at 1."""
    return float(np.sqrt(rate * (2 - rate) * effective))
