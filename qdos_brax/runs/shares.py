"""A run that several processes share: each trains some of the members in its own run folder, the first joins them.

``processes/0``, ``processes/1``, .. in the run's folder are run folders themselves, with their own metrics and
checkpoints. No process waits for another before the end, and one that was killed continues alone.
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

_SHARES = "processes"
_PATIENCE = 60.0  # seconds until a folder appears on another host's disk, or a process takes its share
_POLL = 0.5

T = TypeVar("T")


def create(folder: RunFolder, count: int, config: str) -> None:
    """Create the folders of ``count`` shares; config.yaml of each is ``config``.

    Raises:
        UserError: they cannot be written.
    """
    with user_errors(folder.path):
        for index in range(count):
            (folder.path / _SHARES / str(index)).mkdir(parents=True, exist_ok=True)
    for index in reversed(range(count)):  # a process that sees the first share sees all of them
        write_text(RunFolder(folder.path / _SHARES / str(index)).config, config)


def shares_of(folder: RunFolder) -> list[RunFolder]:
    """Return the folders of a run's shares in order; none if one process trains alone."""
    count = len(list((folder.path / _SHARES).glob("[0-9]*")))
    return [RunFolder(folder.path / _SHARES / str(index)) for index in range(count)]


def await_creation(path: Path) -> RunFolder:
    """Wait until the first process has created the run in ``path``; return its folder.

    Raises:
        UserError: it does not appear within a minute.
    """
    folder = RunFolder(path)
    first = RunFolder(path / _SHARES / "0").config
    deadline = time.monotonic() + _PATIENCE
    while not first.exists():
        if time.monotonic() > deadline:
            raise UserError(f"{path} did not appear within {_PATIENCE:.0f} seconds; it must lie on a disk of all hosts")
        time.sleep(_POLL)
    return folder


def members_of(members: Sequence[T], index: int, count: int) -> list[T]:
    """Return the members of share ``index`` of ``count``: a block; the blocks' sizes differ by one at most."""
    size, more = divmod(len(members), count)
    first = index * size + min(index, more)
    return list(members[first : first + size + (index < more)])


def await_end(share: RunFolder) -> None:
    """Wait until the process that works on the share has finished it.

    Raises:
        UserError: no process works on it, and it has not finished.
    """
    idle_since = time.monotonic()
    while share.read_summary() is None:
        if share.is_held():
            idle_since = time.monotonic()
        elif time.monotonic() - idle_since > _PATIENCE:
            raise UserError(f"the process of {share.path} has stopped before its end; continue with --resume")
        time.sleep(_POLL)


def merge(folder: RunFolder, shares: Sequence[tuple[RunFolder, str]], config: str) -> tuple[dict[str, Any], Artifacts]:
    """Join finished shares into the run: metrics, summary, and what was learned.

    Args:
        folder: the run.
        shares: folders of the shares and the hashes of their configurations.
        config: hash of the run's configuration.

    Returns:
        The summary, as written to summary.json, and the artifacts of the last phase.
    """
    summaries = [share.read_summary() or {} for share, _ in shares]
    columns, rows = _joined_rows([read_rows(share.metrics) for share, _ in shares])
    write_rows(folder.metrics, columns, rows)
    seconds = [summary["wall_seconds"] for summary in summaries]
    wall = {name: max(own[name] for own in seconds) for name in seconds[0]}
    stores = [CheckpointStore(share.checkpoints, own) for share, own in shares]
    ends = [store.position(store.newest_first()[0]).phase for store in stores]
    learned = [store.artifacts(end) for store, end in zip(stores, ends, strict=True)]
    joined: Artifacts = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *learned)
    store = CheckpointStore(folder.checkpoints, config)
    store.save_artifacts(ends[0], joined)
    store.save(Position(ends[0], 0, len(rows), tuple(columns), wall), None)
    members = [member for summary in summaries for member in summary["members"]]
    whole = {**summaries[0], "wall_seconds": wall, "members": members}
    write_text(folder.summary, json.dumps(whole, indent=2) + "\n")
    return whole, joined


def _joined_rows(tables: Sequence[list[Row]]) -> tuple[list[str], list[Row]]:
    """Return (columns, rows) as one process writes them: all members of a log point, then those of the next."""
    columns = max((list(table[0]) for table in tables), key=len)
    points, offset = [], 0
    for table in tables:
        members = max(int(row["member"]) for row in table) + 1
        moved = [{**row, "member": str(int(row["member"]) + offset)} for row in table]
        points.append([moved[first : first + members] for first in range(0, len(moved), members)])
        offset += members
    return columns, [row for point in zip(*points, strict=True) for row in itertools.chain(*point)]
