"""Define what plays scripted demonstrations: many simulations at once, in NumPy."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class SimStates(NamedTuple):
    """Hold n simulations before a control step.

    Attributes:
        qpos: float64[n, nq].
        qvel: float64[n, nv].
        extra: int32[n, e], the discrete state.
        sensed: float32[n, k], what the rig senses.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray


class Demonstrator(Protocol):
    """Play episodes in n simulations at once."""

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        """Return where the episodes start; the caller fills ``sensed``.

        Args:
            kinds: int8[n], codes of ``qdos_brax.data.quality.QUALITY``.
            rng: for the starts and what is planned.
        """
        ...

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return (actions float32[n, act] within [-1, 1], noise included; quality int8[n] of this very step)."""
        ...
