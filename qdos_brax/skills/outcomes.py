"""What a skill leads to: how far the slow features of what it sees got while it played."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.data.device import DeviceData
from qdos_brax.skills.information import logged_path
from qdos_brax.skills.slow_features import slow_directions
from qdos_brax.skills.vae import SkillModel

_SLOW = 0.75  # least autocorrelation over half a skill: where a body is and faces, a ball, a drawer; no legs
_SEGMENTS = 4_000  # that outcomes are taken from, about
_SMALLEST_CHANGE = 1e-6  # root mean square; of what never changes in the data


class Outcomes(NamedTuple):
    """Map two states, as a view shows them, to the change between them.

    Attributes:
        directions: float32[seen, F], the features' directions, by whose root mean square change over a segment of the
            data an outcome counts.
    """

    directions: jax.Array

    def between(self, start: jax.Array, end: jax.Array) -> jax.Array:
        """Return outcome[..., F] of a skill from start[..., seen] to end[..., seen]."""
        return (end - start) @ self.directions


def seen_paths(model: SkillModel, view: Mapping[str, Any], data: DeviceData, horizon: int) -> np.ndarray:
    """Return float32[B, H + 1, seen], what the model's view shows along evenly spaced segments of the data.

    Args:
        model: the skills.
        view: what the view knows of the data (``fit_view``).
        data: the data set.
        horizon: H.
    """
    starts = data.starts[:: max(1, len(data.starts) // _SEGMENTS)]
    return np.asarray(model.see_along({"view": view}, logged_path(data, starts, horizon)))


def fit_outcomes(seen: np.ndarray) -> Outcomes:
    """Return the outcomes of segments: the features that are slow over half a segment (see ``slow_features``), the
    slowest in any case.

    Args:
        seen: float[B, H + 1, seen], what a view shows along segments of the data.
    """
    seen = np.asarray(seen, np.float64)
    middle, end = seen[:, seen.shape[1] // 2], seen[:, -1]
    mean = (middle.mean(axis=0) + end.mean(axis=0)) / 2
    middle, end = middle - mean, end - mean
    covariance = (middle.T @ middle + end.T @ end) / (2 * len(seen))
    lagged = (middle.T @ end + end.T @ middle) / (2 * len(seen))
    autocorrelation, directions = slow_directions(covariance, lagged)
    directions = directions[:, autocorrelation >= min(_SLOW, autocorrelation[0])]
    change = np.sqrt(np.mean(((seen[:, -1] - seen[:, 0]) @ directions) ** 2, axis=0))
    return Outcomes(jnp.asarray(directions / np.maximum(change, _SMALLEST_CHANGE), jnp.float32))
