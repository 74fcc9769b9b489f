"""The ring buffer."""

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.high_level import replay


def rows(*values):
    return {"x": jnp.array(values, jnp.float32), "n": jnp.array(values, jnp.int32)}


def test_wraps_around_and_overwrites_the_oldest():
    buffer = replay.create({"x": jnp.zeros(()), "n": jnp.zeros((), jnp.int32)}, 4)
    buffer = replay.insert(buffer, rows(1, 2, 3))
    buffer = replay.insert(buffer, rows(4, 5, 6))
    np.testing.assert_array_equal(buffer.data["x"], [5, 6, 3, 4])
    assert int(buffer.size) == 4 and int(buffer.position) == 2


def test_invalid_rows_leave_no_hole():
    buffer = replay.create({"x": jnp.zeros(()), "n": jnp.zeros((), jnp.int32)}, 4)
    buffer = replay.insert(buffer, rows(1, 2, 3), jnp.array([True, False, True]))
    np.testing.assert_array_equal(buffer.data["n"][:2], [1, 3])
    assert np.isnan(buffer.data["x"][2]) and int(buffer.size) == 2 and int(buffer.position) == 2


def test_samples_only_what_was_written_and_all_of_it():
    buffer = replay.create({"x": jnp.zeros(()), "n": jnp.zeros((), jnp.int32)}, 100)
    buffer = replay.insert(buffer, rows(*range(7)))
    sampled = replay.sample(buffer, jax.random.key(0), 500)
    assert set(np.asarray(sampled["n"]).tolist()) == set(range(7))
    assert np.all(np.isfinite(sampled["x"]))


def test_reading_an_empty_buffer_is_loud():
    buffer = replay.create({"x": jnp.zeros(())}, 3)
    assert np.all(np.isnan(replay.sample(buffer, jax.random.key(0), 2)["x"]))
