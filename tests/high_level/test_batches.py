"""What a batch holds: fixed shares, or what one buffer of data and experience would give."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.data.transitions import Transition
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.batches import OneBuffer, Shares, make_batches
from tests.point import point_config

DATA, PLAYED = 1.0, 2.0


def rows(n: int, mark: float) -> Transition:
    return Transition(jnp.full((n, 3), mark), jnp.full((n, 2), mark), *[jnp.full(n, mark)] * 2, jnp.full((n, 3), mark))


def replay_of(played: int) -> replay_buffer.Replay:
    empty = replay_buffer.create(jax.tree.map(lambda leaf: leaf[0], rows(1, PLAYED)), 1_000)
    return replay_buffer.insert(empty, rows(played, PLAYED)) if played else empty


def offline(key: jax.Array, n: int) -> Transition:
    return rows(n, DATA)


def test_shares_take_as_many_of_each_data_first():
    batch, logged = Shares(3, 5).draw(jax.random.key(0), replay_of(10), 100, offline)
    assert batch.reward.tolist() == [DATA] * 3 + [PLAYED] * 5
    assert logged.tolist() == [True] * 3 + [False] * 5


def test_shares_without_data_ask_for_none():
    def never(key: jax.Array, n: int) -> Transition:
        raise AssertionError

    batch, logged = Shares(0, 4).draw(jax.random.key(0), replay_of(10), 100, never)
    assert batch.reward.tolist() == [PLAYED] * 4 and not logged.any()


@pytest.mark.parametrize(("played", "horizon", "share"), [(100, 1, 0.1), (100, 5, 500 / 1_400), (300, 3, 0.5)])
def test_one_buffer_draws_experience_by_its_environment_steps(played: int, horizon: int, share: float):
    """900 segments of data: a row is experience with probability H n / (900 + H n), within five standard errors."""
    n = 20_000
    batch, logged = OneBuffer(n, horizon).draw(jax.random.key(1), replay_of(played), 900, offline)
    for leaf in jax.tree.leaves(batch):
        np.testing.assert_array_equal(leaf.reshape(n, -1)[:, 0] == DATA, logged)
        assert leaf.reshape(n, -1).std(axis=1).max() == 0  # a row is from one place, whole
    assert abs(float(jnp.mean(~logged)) - share) < 5 * np.sqrt(share * (1 - share) / n)


def test_one_buffer_has_data_alone_before_anything_was_played():
    batch, logged = OneBuffer(64, 5).draw(jax.random.key(2), replay_of(0), 900, offline)
    assert logged.all() and (batch.observation == DATA).all()  # none of the empty slots' NaN


def test_the_fraction_says_which():
    config = point_config(**{"high_level.offline_fraction": 0.25, "high_level.batch_size": 64})
    shares = make_batches(config)
    assert isinstance(shares, Shares) and (shares.offline, shares.online) == (16, 48)
    one = make_batches(point_config(**{"high_level.offline_fraction": "auto", "high_level.batch_size": 64}))
    assert isinstance(one, OneBuffer) and (one.offline, one.online) == (64, 64)
