"""What ``benchmarks/skills.py`` measures of macro steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import skills

from envs.body_frame import BodyFrame


def state(qpos: Any, observation: Any = None) -> Any:
    return SimpleNamespace(obs=observation, pipeline_state=SimpleNamespace(qpos=np.asarray(qpos)))


def test_an_outcome_counts_from_where_the_body_faces() -> None:
    """A body that moves along y gets 2 m ahead and 1 m to its right, whatever qpos holds beside its place."""
    truth = skills.MazeTruth(SimpleNamespace(body_frame=BodyFrame(course=2)))
    before = state([[1.0, 1.0, 0.0]], jnp.array([[1.0, 1.0, 0.0, 0.5]]))
    after = state([[[2.0, 3.0, 0.0]], [[1.0, 1.0, 0.0]]])
    np.testing.assert_allclose(truth.outcome(before, after), [[[2.0, -1.0]], [[0.0, 0.0]]], atol=1e-6)
