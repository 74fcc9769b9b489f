"""Transitions of any number of environment steps, as learners read them."""

from __future__ import annotations

from typing import NamedTuple

import jax

from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import macro_return, window


class Transition(NamedTuple):
    """Hold transitions (or one, without the axis B); observations are normalised.

    Attributes:
        observation: float32[B, obs].
        action: float32[B, act], of whoever decides: an action, or the high level's u.
        reward: float32[B]; of a macro step the discounted sum over its live steps.
        mask: float32[B], 0 where the value of ``next_observation`` must not be bootstrapped.
        next_observation: float32[B, obs].
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array
    next_observation: jax.Array


def macro_transitions(
    data: DeviceData, starts: jax.Array, horizon: int, discount: jax.Array | float, action: jax.Array
) -> Transition:
    """Return the windows of ``horizon`` steps that begin at ``starts[B]`` as macro transitions.

    Args:
        data: the data set.
        starts: int32[B], from ``data.starts``.
        horizon: environment steps per window.
        discount: per environment step.
        action: float32[B, width], the high level's action that each window is labelled with.
    """
    reward, mask = macro_return(*window((data.rewards, data.masks), starts, horizon), discount)
    return Transition(data.observations[starts], action, reward, mask, data.next_observations[starts + horizon - 1])
