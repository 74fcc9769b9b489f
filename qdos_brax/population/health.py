"""A member whose numbers are no longer finite is frozen: what it has learned stays as it last was when finite.

Its health is handed from phase to phase among the artifacts, so that a member that broke early stays marked.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")
KEY = "healthy"  # among the artifacts: bool[members]


def inherited(artifacts: Mapping[str, Any], members: int) -> jax.Array:
    """Return bool[members], False for whom an earlier phase froze."""
    return jnp.array(artifacts.get(KEY, np.ones(members, bool)))  # a copy: phases donate their states


def keep_finite(healthy: jax.Array, new: T, old: T) -> tuple[T, jax.Array]:
    """Return one member's state after a step, and whether the member is still healthy.

    Args:
        healthy: bool, whether it was so before.
        new: the state after the step.
        old: the state before it, which stays if ``new`` holds a number that is not finite, now or at an earlier step.
    """
    numbers = [leaf for leaf in jax.tree.leaves(new) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    healthy = healthy & jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in numbers]))
    return jax.tree.map(lambda a, b: jnp.where(healthy, a, b), new, old), healthy
