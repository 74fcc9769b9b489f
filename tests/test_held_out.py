"""What ``benchmarks/held_out.py`` measures."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import held_out
from qdos_brax.data.device import Normaliser
from qdos_brax.data.quality import QUALITY
from qdos_brax.skills.vae import Segments


class Known:
    """The latent is the segment's first action; a skill plays it, a tenth more at every step."""

    reach = None

    def posterior(self, params: Any, segments: Segments, after: Any) -> Any:
        return SimpleNamespace(mean=segments.actions[:, 0])

    def begin(self, params: Any, latent: Any, observation: Any) -> Any:
        return latent

    def act(self, params: Any, observation: Any, skill: Any, step: int) -> Any:
        return skill + 0.1 * step


def test_the_error_is_that_of_what_the_posterior_plays() -> None:
    actions = jnp.array([[[0.2], [0.3], [0.4]], [[0.0], [0.0], [0.0]]])
    error = held_out.squared_error(Known(), {}, Segments(jnp.zeros((2, 3, 4)), actions), jnp.zeros((2, 4)))
    np.testing.assert_allclose(error, [0.0, (0.01 + 0.04) / 3], atol=1e-7)


def test_good_segments_are_told_apart() -> None:
    """Two episodes of four rows: the good one repeats an action that grows, the other one stands still."""
    good, rest = np.array([[0.1], [0.2], [0.3], [0.4]]), np.zeros((4, 1))
    rows = np.zeros((8, 2), np.float32)
    data = SimpleNamespace(
        observations=rows, next_observations=rows, actions=np.concatenate([good, rest]).astype(np.float32),
        rewards=rows[:, 0], masks=rows[:, 0], ends=np.arange(8) % 4 == 3, qpos=None, qvel=None, extra=None,
        quality=np.repeat([QUALITY["navigate"], QUALITY["fail"]], 4),
    )  # fmt: skip
    normaliser = Normaliser(jnp.zeros(2), jnp.ones(2))
    found = held_out.errors(data, normaliser, Known(), {}, horizon=3, count=10)
    assert found == {"all": pytest.approx((0.01 + 0.04) / 3 / 2), "good": pytest.approx(0.0, abs=1e-7)}
