"""What a batch holds: rows of labelled data and rows of experience, in fixed shares or as one buffer has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp

from qdos_brax.config import Config, asks_auto
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level import replay as replay_buffer

Offline = Callable[[jax.Array, int], Transition]
"""Gives labelled segments for a key and their number."""


class Batches(Protocol):
    """Define how batches are put together.

    Attributes:
        offline: most rows of a batch that are labelled data; 0 if none ever is.
        online: most rows that are experience.
    """

    offline: int
    online: int

    def draw(
        self, key: jax.Array, replay: replay_buffer.Replay, segments: int, offline: Offline
    ) -> tuple[Transition, jax.Array]:
        """Return a batch, and which of its rows are data.

        Args:
            key: typed key.
            replay: experience.
            segments: rows that the data has.
            offline: gives them, labelled.
        """
        ...


class Shares:
    """Take a fixed number of rows from either (RLPD's symmetric sampling at a half, Ball et al. 2023).

    Args:
        offline: rows of data, which come first.
        online: rows of experience.
    """

    def __init__(self, offline: int, online: int) -> None:
        self.offline, self.online = offline, online

    def draw(
        self, key: jax.Array, replay: replay_buffer.Replay, segments: int, offline: Offline
    ) -> tuple[Transition, jax.Array]:
        """Return a batch, the rows of data first, and which they are."""
        online_key, offline_key = jax.random.split(key)
        rows = replay_buffer.sample(replay, online_key, self.online)
        if self.offline:
            rows = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), offline(offline_key, self.offline), rows)
        return rows, jnp.arange(self.offline + self.online) < self.offline


class OneBuffer:
    """Draw each row from all environment steps there are, logged or played (Q-chunking, FQL: experience is put into
    the data's buffer).

    A macro step of experience stands for the H steps in it, because the data has a segment for each of its steps.

    Args:
        size: rows of a batch.
        horizon: H, environment steps per macro step.
    """

    def __init__(self, size: int, horizon: int) -> None:
        self.offline = self.online = size
        self._horizon = horizon

    def draw(
        self, key: jax.Array, replay: replay_buffer.Replay, segments: int, offline: Offline
    ) -> tuple[Transition, jax.Array]:
        """Return a batch, and which of its rows are data."""
        online_key, offline_key, which_key = jax.random.split(key, 3)
        share = segments / (segments + self._horizon * replay.size)
        logged = jax.random.uniform(which_key, (self.online,)) < share
        data, played = offline(offline_key, self.offline), replay_buffer.sample(replay, online_key, self.online)

        def chosen(a: jax.Array, b: jax.Array) -> jax.Array:
            return jnp.where(logged.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        return jax.tree.map(chosen, data, played), logged


def make_batches(config: Config) -> Batches:
    """Return what ``high_level.offline_fraction`` asks for."""
    size, fraction = config.high_level.batch_size, config.high_level.offline_fraction
    if asks_auto(fraction):
        return OneBuffer(size, config.skills.horizon)
    offline = round(size * float(fraction))
    return Shares(offline, size - offline)
