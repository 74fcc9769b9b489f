"""A run that several processes share: each trains some of the members in a run folder of its own, the first joins them.

``processes/0``, ``processes/1``, .. lie in the run's folder and are run folders themselves, with their own metrics and
checkpoints. Nobody waits for anybody before the end, and whoever was killed goes on alone.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from qdos_brax.errors import UserError
from qdos_brax.files import user_errors, write_text
from qdos_brax.runs.checkpoint import Artifacts, CheckpointStore, Position
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import Row, read_rows, write_rows

_PARTS = "processes"
_PATIENCE = 60.0  # seconds until a folder shows on another host's disk, or a process takes its part
_POLL = 0.5

T = TypeVar("T")


def create(folder: RunFolder, count: int, config: str) -> None:
    """Makes the parts of ``count`` processes; config.yaml of each is ``config``."""
    with user_errors(folder.path):
        for index in range(count):
            (folder.path / _PARTS / str(index)).mkdir(parents=True, exist_ok=True)
    for index in reversed(range(count)):  # whoever sees the first sees all
        write_text(RunFolder(folder.path / _PARTS / str(index)).config, config)


def parts_of(folder: RunFolder) -> list[RunFolder]:
    """The parts in order; none of a run that one process does alone."""
    count = len(list((folder.path / _PARTS).glob("[0-9]*")))
    return [RunFolder(folder.path / _PARTS / str(index)) for index in range(count)]


def await_creation(path: Path) -> RunFolder:
    """The folder of a run that the first process begins.

    Raises:
        UserError: it does not show.
    """
    folder = RunFolder(path)
    first = RunFolder(path / _PARTS / "0").config
    deadline = time.monotonic() + _PATIENCE
    while not first.exists():
        if time.monotonic() > deadline:
            raise UserError(f"{path} did not show within {_PATIENCE:.0f} seconds; it must lie on a disk of all hosts")
        time.sleep(_POLL)
    return folder


def share_of(members: Sequence[T], index: int, count: int) -> list[T]:
    """The members of part ``index``: a block, as even as can be."""
    size, more = divmod(len(members), count)
    first = index * size + min(index, more)
    return list(members[first : first + size + (index < more)])


def await_end(part: RunFolder) -> None:
    """Waits until the process that works on the part has ended it.

    Raises:
        UserError: nobody works on it, and it has not ended.
    """
    idle_since = time.monotonic()
    while part.read_summary() is None:
        if part.is_held():
            idle_since = time.monotonic()
        elif time.monotonic() - idle_since > _PATIENCE:
            raise UserError(f"the process of {part.path} has stopped before its end; go on with --resume")
        time.sleep(_POLL)


def merge(folder: RunFolder, parts: Sequence[tuple[RunFolder, str]], config: str) -> dict[str, Any]:
    """Joins parts that have ended into the run: metrics, summary, and what was learned.

    Args:
        folder: the run.
        parts: their folders and the hashes of their configurations.
        config: hash of the run's configuration.

    Returns:
        The summary, as written to summary.json.
    """
    summaries = [part.read_summary() or {} for part, _ in parts]
    columns, rows = _joined_rows([read_rows(part.metrics) for part, _ in parts])
    write_rows(folder.metrics, columns, rows)
    seconds = [summary["wall_seconds"] for summary in summaries]
    wall = {name: max(own[name] for own in seconds) for name in seconds[0]}
    stores = [CheckpointStore(part.checkpoints, own) for part, own in parts]
    ends = [store.position(store.newest_first()[0]).phase for store in stores]
    learned = [store.artifacts(end) for store, end in zip(stores, ends, strict=True)]
    joined: Artifacts = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *learned)
    store = CheckpointStore(folder.checkpoints, config)
    store.save_artifacts(ends[0], joined)
    store.save(Position(ends[0], 0, len(rows), tuple(columns), wall), None)
    members = [member for summary in summaries for member in summary["members"]]
    whole = {**summaries[0], "wall_seconds": wall, "members": members}
    write_text(folder.summary, json.dumps(whole, indent=2) + "\n")
    return whole


def _joined_rows(tables: Sequence[list[Row]]) -> tuple[list[str], list[Row]]:
    """(columns, rows) as one process writes them: all members of a log point, then those of the next."""
    columns = max((list(table[0]) for table in tables), key=len)
    points, offset = [], 0
    for table in tables:
        members = max(int(row["member"]) for row in table) + 1
        moved = [{**row, "member": str(int(row["member"]) + offset)} for row in table]
        points.append([moved[first : first + members] for first in range(0, len(moved), members)])
        offset += members
    return columns, [row for point in zip(*points, strict=True) for row in itertools.chain(*point)]
