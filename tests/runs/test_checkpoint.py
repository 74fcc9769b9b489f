"""What a checkpoint refuses: casts, foreign structures, disks that are full or read-only."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from qdos_brax.errors import UserError
from qdos_brax.runs.checkpoint import BrokenCheckpoint, CheckpointStore, Position

pytestmark = pytest.mark.quick

HERE = Position(0, 1, 4, ("member", "sps"), {"total": 1.0})


def store_with(tmp_path: Path, state: Any) -> CheckpointStore:
    store = CheckpointStore(tmp_path, "c")
    store.save(HERE, state)
    return store


def test_round_trip_of_every_kind_of_leaf(tmp_path: Path) -> None:
    state = {
        "keys": jax.random.split(jax.random.key(3), 2),
        "f": jnp.asarray([jnp.nan, -0.0, 1e-42]),
        "i": jnp.asarray(2**31 - 1),
        "u": jnp.asarray([0xFFFFFFFF], jnp.uint32),
        "b": jnp.asarray([True, False]),
        "none": None,
        "empty": jnp.zeros((0, 3)),
        "tuple": (jnp.ones(2), [jnp.zeros(())]),
    }
    store = store_with(tmp_path, state)
    assert store.position("00-000001") == HERE
    restored = store.restore("00-000001", jax.tree.map(jnp.copy, state))
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(restored), jax.tree.leaves(state), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.parametrize(
    "like",
    [{"x": jnp.zeros(3, jnp.float32)}, {"x": jnp.zeros(4, jnp.int32)}, {"y": jnp.zeros(3, jnp.int32)}, {}],
    ids=["dtype", "shape", "name", "fewer"],
)
def test_another_structure_is_refused_not_cast(tmp_path: Path, like: Any) -> None:
    store = store_with(tmp_path, {"x": jnp.arange(3)})
    with pytest.raises(BrokenCheckpoint, match=r"where this program has"):
        store.restore("00-000001", like)


def test_artifacts_come_back_as_nested_dicts(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, "c")
    store.save_artifacts(1, {"a": {"b": np.arange(3, dtype=np.int32), "key": jax.random.key(0)}, "n": 0.5})
    restored = store.artifacts(1)
    np.testing.assert_array_equal(restored["a"]["b"], [0, 1, 2])
    assert restored["a"]["key"] == jax.random.key(0)
    assert float(restored["n"]) == 0.5


def test_artifacts_must_be_dicts_of_arrays(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="a is a list"):
        CheckpointStore(tmp_path, "c").save_artifacts(1, {"a": [jnp.ones(2)]})


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device; free some space"),
        (OSError(errno.EROFS, "Read-only file system"), "Read-only file system; choose a folder"),
        (ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [type=x]"), "free some space"),
    ],
)
def test_refused_save_is_one_line_and_keeps_the_older(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    state = {"x": jnp.arange(3)}
    store = store_with(tmp_path, state)

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise error

    monkeypatch.setattr(ocp.Checkpointer, "save", refuse)
    with pytest.raises(UserError, match=words) as caught:
        store.save(Position(0, 2, 8, ("member", "sps"), {"total": 2.0}), state)
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    assert store.newest_first() == ["00-000001"]
    assert not list(tmp_path.glob(".partial*"))
    np.testing.assert_array_equal(store.restore("00-000001", state)["x"], [0, 1, 2])
