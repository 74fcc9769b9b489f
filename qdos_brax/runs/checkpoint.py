"""Checkpoints that a run can be killed in the middle of, and that say when they cannot be trusted.

A checkpoint is a folder ``<phase>-<chunk>`` made aside and renamed when it is whole: the phase's state in Orbax's
format, and ``manifest.json`` with where the run was, what every array is, and size and SHA-256 of every file. What a
finished phase hands to the next ones does not change any more; it lies beside, in ``artifacts-<phase>``, once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from qdos_brax.errors import UserError
from qdos_brax.files import refusal

_FORMAT = 1
_KEPT = 2
_MANIFEST = "manifest.json"
_ARRAYS = "arrays"

T = TypeVar("T")
Artifacts = dict[str, Any]  # nested dicts with text keys, arrays at the leaves


class BrokenCheckpoint(Exception):
    """A checkpoint that cannot be used; the message says why."""


@dataclasses.dataclass(frozen=True)
class Position:
    """Where a run was when it was saved.

    Attributes:
        phase: index of the phase; as many as there are phases once the run is complete.
        chunk: chunks of it that were done.
        rows: rows of metrics.csv.
        columns: its columns.
        wall_seconds: seconds spent so far, by part of the run.
    """

    phase: int
    chunk: int
    rows: int
    columns: tuple[str, ...]
    wall_seconds: dict[str, float]


class CheckpointStore:
    """The checkpoints of one run; the last two are kept.

    Args:
        folder: where they lie.
        config: hash of the configuration; checkpoints of another one are not used.
    """

    def __init__(self, folder: Path, config: str) -> None:
        self._folder = folder
        self._config = config

    def save(self, position: Position, state: Any | None) -> None:
        """Saves the state of a phase under way; None at the start of a phase, which ``init`` makes again.

        Raises:
            UserError: the disk refuses; the checkpoints before this one are untouched.
        """
        manifest: dict[str, Any] = dataclasses.asdict(position)
        arrays = None
        if state is not None:
            paths, leaves = _paths_and_leaves(state)
            manifest["arrays"] = [_describe(path, leaf) for path, leaf in zip(paths, leaves, strict=True)]
            arrays = leaves
        self._write(_name(position.phase, position.chunk), manifest, arrays)
        self._prune()

    def save_artifacts(self, phase: int, artifacts: Artifacts) -> None:
        """Saves what the phases before ``phase`` leave to it."""
        paths, leaves = _flatten_artifacts(artifacts)
        described = [_describe(path, leaf) for path, leaf in zip(paths, leaves, strict=True)]
        self._write(f"artifacts-{phase:02d}", {"arrays": described}, leaves)

    def newest_first(self) -> list[str]:
        """The names of the checkpoints that are there, usable or not."""
        return sorted((path.name for path in self._folder.glob("[0-9][0-9]-*")), reverse=True)

    def position(self, name: str) -> Position:
        """Where the checkpoint was taken, once its files were verified.

        Raises:
            BrokenCheckpoint: a file is missing, truncated or altered, or belongs to another configuration.
        """
        manifest = self._verified(name)
        try:
            return Position(
                phase=int(manifest["phase"]),
                chunk=int(manifest["chunk"]),
                rows=int(manifest["rows"]),
                columns=tuple(manifest["columns"]),
                wall_seconds=dict(manifest["wall_seconds"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise BrokenCheckpoint(f"its manifest lacks {error}") from error

    def restore(self, name: str, like: Any) -> Any:
        """The state of a verified checkpoint, in the structure and on the devices of ``like``.

        Raises:
            BrokenCheckpoint: the saved arrays are not those of ``like`` (Orbax alone would cast them silently).
        """
        described = self._manifest(name)["arrays"]
        paths, leaves = _paths_and_leaves(like)
        expected = [_describe(path, leaf) for path, leaf in zip(paths, leaves, strict=True)]
        for saved, wanted in zip(described, expected, strict=False):
            if saved != wanted:
                raise BrokenCheckpoint(f"it holds {_words(saved)} where this program has {_words(wanted)}")
        if len(described) != len(expected):
            raise BrokenCheckpoint(f"it holds {len(described)} arrays where this program has {len(expected)}")
        restored = self._read(name, leaves)
        return jax.tree.unflatten(jax.tree.structure(like), restored)

    def is_phase_start(self, name: str) -> bool:
        """Whether the checkpoint holds no state, because its phase had not begun."""
        return "arrays" not in self._manifest(name)

    def artifacts(self, phase: int) -> Artifacts:
        """What the phases before ``phase`` left to it; empty for the first.

        Raises:
            BrokenCheckpoint: its files are missing, truncated or altered.
        """
        if phase == 0:
            return {}
        name = f"artifacts-{phase:02d}"
        described = self._verified(name)["arrays"]
        leaves = self._read(name, [_abstract(entry) for entry in described])
        tree: Artifacts = {}
        for entry, leaf in zip(described, leaves, strict=True):
            *groups, last = entry["path"]
            node = tree
            for group in groups:
                node = node.setdefault(group, {})
            node[last] = leaf
        return tree

    def discard_after(self, name: str) -> None:
        """Removes the checkpoints newer than ``name``, and what a kill left half written."""
        for path in self._folder.glob(".partial-*"):
            shutil.rmtree(path)
        for newer in self.newest_first():
            if newer > name:
                shutil.rmtree(self._folder / newer)

    def _write(self, name: str, manifest: Mapping[str, Any], arrays: Sequence[jax.Array] | None) -> None:
        partial, final = self._folder / f".partial-{name}", self._folder / name
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            if arrays is not None:
                _save_arrays(partial / _ARRAYS, arrays)
            content = {"format": _FORMAT, "config": self._config, **manifest, "files": _fingerprints(partial)}
            (partial / _MANIFEST).write_text(json.dumps(content, indent=1), encoding="utf-8")
            if final.exists():
                shutil.rmtree(final)
            partial.rename(final)
        except (OSError, ValueError) as error:
            shutil.rmtree(partial, ignore_errors=True)
            raise UserError(_refusal(final, error)) from error

    def _prune(self) -> None:
        kept, old = self.newest_first()[:_KEPT], self.newest_first()[_KEPT:]
        for name in old:
            shutil.rmtree(self._folder / name, ignore_errors=True)
        needed = {f"artifacts-{name[:2]}" for name in kept}
        for path in self._folder.glob("artifacts-*"):
            # Those of a later phase are about to be referred to by its first checkpoint.
            if path.name not in needed and path.name < max(needed):
                shutil.rmtree(path, ignore_errors=True)

    def _manifest(self, name: str) -> dict[str, Any]:
        try:
            content = json.loads((self._folder / name / _MANIFEST).read_text(encoding="utf-8"))
        except OSError as error:
            raise BrokenCheckpoint(f"its manifest cannot be read ({error.strerror})") from error
        except ValueError as error:
            raise BrokenCheckpoint("its manifest is truncated") from error
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise BrokenCheckpoint("its manifest is of another format")
        return content

    def _verified(self, name: str) -> dict[str, Any]:
        manifest = self._manifest(name)
        if manifest.get("config") != self._config:
            raise BrokenCheckpoint("it belongs to another configuration")
        found = _fingerprints(self._folder / name)
        for file, fingerprint in manifest["files"].items():
            if file not in found:
                raise BrokenCheckpoint(f"{file} is missing")
            if found[file] != fingerprint:
                raise BrokenCheckpoint(f"{file} is truncated or altered")
        return manifest

    def _read(self, name: str, like: Sequence[Any]) -> list[jax.Array]:
        """The arrays of a verified checkpoint, in order; each as ``like`` says."""
        targets = {
            _label(i): jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=_sharding(leaf))
            for i, leaf in enumerate(like)
            if leaf.size
        }
        restored: dict[str, jax.Array] = {}
        if targets:
            try:
                restored = _checkpointer().restore(
                    (self._folder / name / _ARRAYS).resolve(), args=ocp.args.StandardRestore(targets)
                )
            except (OSError, ValueError, KeyError) as error:
                raise BrokenCheckpoint(f"Orbax cannot read it ({_first_line(error)})") from error
        return [restored[_label(i)] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype) for i, leaf in enumerate(like)]


def choose(store: CheckpointStore, attempt: Callable[[str], T], report: Callable[[str], None]) -> T | None:
    """The result of ``attempt`` on the newest checkpoint that can be used.

    Args:
        store: the checkpoints.
        attempt: restores one by name, or raises BrokenCheckpoint.
        report: takes one line for each checkpoint that was passed over.

    Returns:
        None if there is no checkpoint at all.

    Raises:
        UserError: there are checkpoints and none can be used.
    """
    reasons = []
    for name in store.newest_first():
        try:
            result = attempt(name)
        except (BrokenCheckpoint, OSError, KeyError, TypeError, AttributeError) as error:  # or what it holds is absurd
            reasons.append(f"checkpoint {name} cannot be used: {error}")
            continue
        for reason in reasons:
            report(f"{reason}; going on from {name}")
        store.discard_after(name)
        return result
    if reasons:
        raise UserError(f"no checkpoint can be used ({'; '.join(reasons)}); start a new run")
    store.discard_after("")
    return None


def final_artifacts(folder: Path, config: str) -> Artifacts:
    """What the newest checkpoint's phases had left: of a run that has ended, everything that was learned.

    Args:
        folder: the run's folder of checkpoints, which is only read.
        config: hash of the configuration.

    Raises:
        UserError: there is no checkpoint, or it cannot be used.
    """
    store = CheckpointStore(folder, config)
    names = store.newest_first()
    if not names:
        raise UserError(f"{folder} holds no checkpoint; the run has not come that far")
    try:
        return store.artifacts(store.position(names[0]).phase)
    except BrokenCheckpoint as error:
        raise UserError(f"checkpoint {names[0]} in {folder} cannot be used: {error}") from error


def as_device_arrays(artifacts: Mapping[str, Any]) -> Artifacts:
    """The artifacts with every leaf on the device, as they are after a save and a restore."""
    return {
        key: as_device_arrays(value) if isinstance(value, Mapping) else jnp.asarray(value)
        for key, value in artifacts.items()
    }


# --- Arrays ----------------------------------------------------------------------------------------------------


def _checkpointer() -> ocp.Checkpointer:
    return ocp.Checkpointer(ocp.StandardCheckpointHandler())


def _save_arrays(path: Path, arrays: Sequence[jax.Array]) -> None:
    # Orbax refuses arrays without elements; the manifest's shape and dtype are all there is to them.
    full = {_label(i): leaf for i, leaf in enumerate(arrays) if leaf.size}
    if full:
        with _no_log():
            _checkpointer().save(path.resolve(), args=ocp.args.StandardSave(full))


@contextlib.contextmanager
def _no_log() -> Iterator[None]:
    """Silences Orbax's threads: they print tracebacks of what is raised here anyway, and becomes one line."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _paths_and_leaves(tree: Any) -> tuple[list[list[str]], list[jax.Array]]:
    entries, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [[jax.tree_util.keystr(path)] for path, _ in entries], [jnp.asarray(leaf) for _, leaf in entries]


def _flatten_artifacts(artifacts: Mapping[str, Any]) -> tuple[list[list[str]], list[jax.Array]]:
    entries = list(_walk(artifacts, []))
    return [path for path, _ in entries], [leaf for _, leaf in entries]


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


def _describe(path: list[str], leaf: jax.Array) -> dict[str, Any]:
    return {"path": path, "shape": list(leaf.shape), "dtype": str(leaf.dtype)}


def _abstract(entry: Mapping[str, Any]) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(tuple(entry["shape"]), _dtype(entry["dtype"]))


def _dtype(name: str) -> Any:
    """The dtype of a manifest; typed PRNG keys have names of their own."""
    default_key = jax.eval_shape(lambda: jax.random.key(0)).dtype
    return default_key if name == str(default_key) else jnp.dtype(name)


def _sharding(leaf: Any) -> jax.sharding.Sharding:
    return leaf.sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def _label(index: int) -> str:
    return f"{index:05d}"


def _words(entry: Mapping[str, Any]) -> str:
    return f"{'/'.join(entry['path'])} {entry['dtype']}{entry['shape']}"


# --- Files -----------------------------------------------------------------------------------------------------


def _name(phase: int, chunk: int) -> str:
    return f"{phase:02d}-{chunk:06d}"


def _fingerprints(folder: Path) -> dict[str, list[Any]]:
    """{relative path: [bytes, SHA-256]} of every file but the manifest."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != _MANIFEST)
    return {path.relative_to(folder).as_posix(): [path.stat().st_size, _sha256(path)] for path in files}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _refusal(path: Path, error: OSError | ValueError) -> str:
    """The line for a failed save; tensorstore reports a full disk as a ValueError."""
    if isinstance(error, OSError):
        return refusal(path, error)
    full = "No space left on device" in str(error)
    reason = "No space left on device; free some space and go on with --resume" if full else _first_line(error)
    return f"cannot write {path}: {reason}"
