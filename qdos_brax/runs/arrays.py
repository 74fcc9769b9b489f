"""Arrays on disk: Orbax's format, and descriptions by which they are checked before they are read."""

from __future__ import annotations

import contextlib
import errno
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

Description = dict[str, Any]  # "path": keys from the root of the tree, "shape", "dtype"


def flatten_state(tree: Any) -> tuple[list[Description], list[jax.Array]]:
    """Return descriptions and leaves of any pytree, in jax's order."""
    entries, _ = jax.tree_util.tree_flatten_with_path(tree)
    leaves = [jnp.asarray(leaf) for _, leaf in entries]
    paths = [[jax.tree_util.keystr(path)] for path, _ in entries]
    return [_describe(path, leaf) for path, leaf in zip(paths, leaves, strict=True)], leaves


def flatten_dicts(tree: Mapping[str, Any]) -> tuple[list[Description], list[jax.Array]]:
    """Return descriptions and leaves of nested dicts, in the dicts' order; ``nest`` is the inverse.

    Raises:
        TypeError: a key is no text, or a leaf is no array or number.
    """
    entries = list(_walk(tree, []))
    return [_describe(path, leaf) for path, leaf in entries], [leaf for _, leaf in entries]


def nest(described: Sequence[Description], leaves: Sequence[jax.Array]) -> dict[str, Any]:
    """Return the nested dicts that ``flatten_dicts`` took apart."""
    tree: dict[str, Any] = {}
    for entry, leaf in zip(described, leaves, strict=True):
        *groups, last = entry["path"]
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = leaf
    return tree


def difference(saved: Sequence[Description], expected: Sequence[Description]) -> str | None:
    """Return how the saved arrays differ from the expected ones; None if path, shape and dtype of all agree."""
    for old, new in zip(saved, expected, strict=False):
        if old != new:
            return f"it holds {_words(old)} where this program has {_words(new)}"
    if len(saved) != len(expected):
        return f"it holds {len(saved)} arrays where this program has {len(expected)}"
    return None


def blank(entry: Description) -> jax.ShapeDtypeStruct:
    """Return an array without numbers, of the shape and dtype that a description names."""
    return jax.ShapeDtypeStruct(tuple(entry["shape"]), _dtype(entry["dtype"]))


def save(path: Path, leaves: Sequence[jax.Array]) -> None:
    """Save arrays in a new folder ``path``; make no folder if none has elements.

    Raises:
        OSError: the disk does not take them.
    """
    # Orbax refuses arrays without elements; their descriptions are all there is to them.
    full = {_label(i): leaf for i, leaf in enumerate(leaves) if leaf.size}
    if not full:
        return
    try:
        with _no_log():
            _checkpointer().save(path.resolve(), args=ocp.args.StandardSave(full))
    except ValueError as error:  # as tensorstore reports a full disk
        if "No space left on device" in str(error):
            raise OSError(errno.ENOSPC, "No space left on device") from error
        raise OSError(first_line(error)) from error


def read(path: Path, like: Sequence[Any]) -> list[jax.Array]:
    """Return the arrays that ``save`` wrote, each with shape, dtype and device of its counterpart in ``like``.

    Orbax casts silently: compare the descriptions first.

    Raises:
        OSError, ValueError, KeyError: the folder does not hold them.
    """
    targets = {
        _label(i): jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=_sharding(leaf))
        for i, leaf in enumerate(like)
        if leaf.size
    }
    restored: dict[str, jax.Array] = {}
    if targets:
        restored = _checkpointer().restore(path.resolve(), args=ocp.args.StandardRestore(targets))
    return [restored[_label(i)] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype) for i, leaf in enumerate(like)]


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its class where it has none."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def _checkpointer() -> ocp.Checkpointer:
    return ocp.Checkpointer(ocp.StandardCheckpointHandler())


@contextlib.contextmanager
def _no_log() -> Iterator[None]:
    """Silence Orbax's threads: they print tracebacks of errors that are raised here anyway and become one line."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _walk(node: Any, path: list[str]) -> Iterator[tuple[list[str], jax.Array]]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            if not isinstance(key, str):
                raise TypeError(f"artifacts must have text keys, not {key!r} at {'/'.join(path) or 'the top'}")
            yield from _walk(value, [*path, key])
    elif isinstance(node, jax.Array | np.ndarray | np.generic | int | float):
        yield path, jnp.asarray(node)
    else:
        raise TypeError(f"artifacts must be nested dicts of arrays; {'/'.join(path)} is a {type(node).__name__}")


def _describe(path: list[str], leaf: jax.Array) -> Description:
    return {"path": path, "shape": list(leaf.shape), "dtype": str(leaf.dtype)}


def _dtype(name: str) -> Any:
    """Return the dtype of a description; typed PRNG keys have names of their own."""
    default_key = jax.eval_shape(lambda: jax.random.key(0)).dtype
    return default_key if name == str(default_key) else jnp.dtype(name)


def _sharding(leaf: Any) -> jax.sharding.Sharding:
    return leaf.sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def _label(index: int) -> str:
    return f"{index:05d}"


def _words(entry: Description) -> str:
    return f"{'/'.join(entry['path'])} {entry['dtype']}{entry['shape']}"
