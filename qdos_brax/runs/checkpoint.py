"""Checkpoints: a run may be killed while one is written, and one that cannot be trusted is never used.

A checkpoint is a folder ``<phase>-<chunk>`` that is written aside and renamed when it is complete: the phase's state in
Orbax's format, and ``manifest.json`` with the run's position, the description of every array, and size and SHA-256 of
every file. What a finished phase hands to the next ones does not change any more; it is saved once, in
``artifacts-<phase>``.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from qdos_brax.errors import UserError
from qdos_brax.files import is_partial, parse_json, replacing_folder, write_text
from qdos_brax.runs import arrays, fingerprints

_FORMAT = 1
_KEPT = 2
_MANIFEST = "manifest.json"
_ARRAYS = "arrays"

T = TypeVar("T")
Artifacts = dict[str, Any]  # nested dicts with text keys, arrays at the leaves


class BrokenCheckpoint(Exception):
    """Report a checkpoint that cannot be used; the message gives the reason."""


@dataclasses.dataclass(frozen=True)
class Position:
    """Hold the position of a run when it was saved.

    Attributes:
        phase: index of the phase; as many as there are phases once the run is complete.
        chunk: number of its chunks that were done.
        rows: number of rows of metrics.csv.
        columns: columns of metrics.csv.
        wall_seconds: seconds spent so far, by part of the run.
    """

    phase: int
    chunk: int
    rows: int
    columns: tuple[str, ...]
    wall_seconds: dict[str, float]


class CheckpointStore:
    """Save and restore the checkpoints of one run; keep the last two.

    Args:
        folder: the folder of the checkpoints.
        config: hash of the configuration; checkpoints of another one are not used.
    """

    def __init__(self, folder: Path, config: str) -> None:
        self._folder = folder
        self._config = config

    def save(self, position: Position, state: Any | None) -> None:
        """Save the state of a phase in progress.

        Args:
            position: the run's position.
            state: any pytree of arrays; None at the start of a phase, whose ``init`` makes it again.

        Raises:
            UserError: the disk refuses; the checkpoints before this one are untouched.
        """
        manifest: dict[str, Any] = dataclasses.asdict(position)
        leaves: list[jax.Array] = []
        if state is not None:
            manifest["arrays"], leaves = arrays.flatten_state(state)
        self._write(_name(position.phase, position.chunk), manifest, leaves)
        self._prune()

    def save_artifacts(self, phase: int, artifacts: Artifacts) -> None:
        """Save what the phases before ``phase`` hand on to it.

        Raises:
            UserError: the disk refuses.
            TypeError: ``artifacts`` are not nested dicts with text keys and arrays at the leaves.
        """
        described, leaves = arrays.flatten_dicts(artifacts)
        self._write(f"artifacts-{phase:02d}", {"arrays": described}, leaves)

    def newest_first(self) -> list[str]:
        """Return the names of the checkpoints in the folder, usable or not."""
        return sorted((path.name for path in self._folder.glob("[0-9][0-9]-*")), reverse=True)

    def position(self, name: str) -> Position:
        """Verify the files of a checkpoint and return the position it was taken at.

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
        """Return the state of a verified checkpoint, in the structure and on the devices of ``like``.

        Raises:
            BrokenCheckpoint: the saved arrays are not those of ``like`` (Orbax alone would cast them silently).
        """
        described = self._manifest(name)["arrays"]
        expected, leaves = arrays.flatten_state(like)
        difference = arrays.difference(described, expected)
        if difference:
            raise BrokenCheckpoint(difference)
        return jax.tree.unflatten(jax.tree.structure(like), self._read(name, leaves))

    def is_phase_start(self, name: str) -> bool:
        """Return whether the checkpoint holds no state because its phase had not begun."""
        return "arrays" not in self._manifest(name)

    def artifacts(self, phase: int) -> Artifacts:
        """Return what the phases before ``phase`` handed on to it; empty for the first.

        Raises:
            BrokenCheckpoint: its files are missing, truncated or altered.
        """
        if phase == 0:
            return {}
        name = f"artifacts-{phase:02d}"
        described = self._verified(name)["arrays"]
        return arrays.nest(described, self._read(name, [arrays.blank(entry) for entry in described]))

    def discard_after(self, name: str) -> None:
        """Remove the checkpoints newer than ``name``, and what a kill left incomplete."""
        for path in self._folder.glob(".*"):
            if is_partial(path):
                shutil.rmtree(path)
        for newer in self.newest_first():
            if newer > name:
                shutil.rmtree(self._folder / newer)

    def _write(self, name: str, manifest: Mapping[str, Any], leaves: Sequence[jax.Array]) -> None:
        final = self._folder / name
        with replacing_folder(final) as partial:
            arrays.save(partial / _ARRAYS, leaves)
            files = fingerprints.fingerprints(partial, _MANIFEST)
            content = {"format": _FORMAT, "config": self._config, **manifest, "files": files}
            write_text(partial / _MANIFEST, json.dumps(content, indent=1))

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
            content = parse_json((self._folder / name / _MANIFEST).read_text(encoding="utf-8"))
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
        found = fingerprints.fingerprints(self._folder / name, _MANIFEST)
        difference = fingerprints.difference(manifest["files"], found)
        if difference:
            raise BrokenCheckpoint(difference)
        return manifest

    def _read(self, name: str, like: Sequence[Any]) -> list[jax.Array]:
        try:
            return arrays.read(self._folder / name / _ARRAYS, like)
        except (OSError, ValueError, KeyError) as error:
            raise BrokenCheckpoint(f"Orbax cannot read it ({arrays.first_line(error)})") from error


def choose(store: CheckpointStore, attempt: Callable[[str], T], report: Callable[[str], None]) -> T | None:
    """Return the result of ``attempt`` on the newest checkpoint that can be used; discard the newer ones.

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
            report(f"{reason}; continuing from {name}")
        store.discard_after(name)
        return result
    if reasons:
        raise UserError(f"no checkpoint can be used ({'; '.join(reasons)}); start a new run")
    store.discard_after("")
    return None


def final_artifacts(folder: Path, config: str) -> Artifacts:
    """Return what the phases before the newest checkpoint handed on: everything that a finished run learned.

    Args:
        folder: the run's folder of checkpoints, which is only read.
        config: hash of the configuration.

    Raises:
        UserError: there is no checkpoint, or it cannot be used.
    """
    store = CheckpointStore(folder, config)
    names = store.newest_first()
    if not names:
        raise UserError(f"{folder} holds no checkpoint; the run saved none yet")
    try:
        return store.artifacts(store.position(names[0]).phase)
    except BrokenCheckpoint as error:
        raise UserError(f"checkpoint {names[0]} in {folder} cannot be used: {error}") from error


def as_device_arrays(artifacts: Mapping[str, Any]) -> Artifacts:
    """Return the artifacts with every leaf on the device, as they are after a save and a restore."""
    return {
        key: as_device_arrays(value) if isinstance(value, Mapping) else jnp.asarray(value)
        for key, value in artifacts.items()
    }


def _name(phase: int, chunk: int) -> str:
    return f"{phase:02d}-{chunk:06d}"
