"""TensorBoard's event files: the numbers of metrics.csv, one folder per member."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

from qdos_brax.files import user_errors
from qdos_brax.runs.metrics import Row, measured, step_of


class TensorBoard:
    """Write the rows as scalars "phase/column", over environment steps online and over updates before.

    A resumed run writes its files again from the rows that it kept, so that no curve shows a step twice or is ahead of
    the run. TensorBoard's own ``purge_step`` would not do: it drops everything with a larger step, and phases count
    separately.

    Args:
        folder: the folder of all members' files; its content is replaced.
        members: the population; keys and values name the members' folders.
    """

    def __init__(self, folder: Path, members: Sequence[Mapping[str, Any]]) -> None:
        self._folder, self._members = folder, members
        self._names = ["-".join(f"{key}={value}" for key, value in member.items()) for member in members]
        self._writers: list[EventsWriter] = []

    def begin(self, rows: Sequence[Row]) -> None:
        """Write the rows so far."""
        with user_errors(self._folder):
            if self._folder.exists():
                shutil.rmtree(self._folder)
            for name in self._names:
                member = self._folder / name
                member.mkdir(parents=True)
                writer = EventsWriter(str(member / "events"))
                # Makes a TensorBoard that shows the run already forget what it has read.
                writer.write_event(Event(wall_time=time.time(), session_log=SessionLog(status=SessionLog.START)))
                self._writers.append(writer)
        self.append(rows)

    def append(self, rows: Sequence[Row]) -> None:
        """Write new rows."""
        now = time.time()
        with user_errors(self._folder):
            for row in rows:
                values = [
                    Summary.Value(tag=f"{row['phase']}/{name}", simple_value=number)
                    for name, number in measured(row, self._members).items()
                ]
                event = Event(wall_time=now, step=step_of(row), summary=Summary(value=values))
                self._writers[int(row["member"])].write_event(event)
            for writer in self._writers:
                writer.flush()

    def end(self) -> None:
        """Close the files."""
        for writer in self._writers:
            writer.close()
