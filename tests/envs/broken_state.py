"""What happens to a batch in which one simulation breaks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np


def assert_reset_alone(states: Any, step: Callable[[Any, np.ndarray], Any], action_size: int) -> None:
    """Break the second of three states of an environment that starts anew by itself; the others go on."""
    broken = states.pipeline_state.replace(qpos=states.pipeline_state.qpos.at[1, 0].set(jnp.nan))
    after = step(states.replace(pipeline_state=broken), np.ones((3, action_size), np.float32))
    np.testing.assert_array_equal(after.metrics["nan"], [0, 1, 0])
    assert bool(jnp.isfinite(after.obs).all()) and after.pipeline_state.steps.tolist() == [1, 0, 1]
