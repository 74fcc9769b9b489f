"""What a run says while it works: a line that moves on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import Self, TextIO

from rich import progress
from rich.console import Console, Group, RenderableType
from rich.live import Live
from tqdm import tqdm

_QUIET_SECONDS = 10.0


class Progress:
    """One phase's progress: its name, its rate, the time left, the latest success.

    Args:
        phase: the phase's name.
        total: its chunks.
        done: chunks that an earlier process has done.
        stream: where to write; a bar if it is a terminal, else a line every ten seconds and at the end.
        waiting_for: what the bar says until the first chunk is done.
        below: what a terminal shows below the bar until the phase ends, drawn anew with it.
    """

    def __init__(
        self,
        phase: str,
        total: int,
        done: int = 0,
        stream: TextIO | None = None,
        waiting_for: str = "compiling",
        below: RenderableType = "",
    ) -> None:
        self._phase, self._total, self._first, self._done = phase, total, done, done
        self._stream = stream or sys.stderr
        self._started = self._spoken = time.monotonic()
        self._live = None
        if self._stream.isatty():
            self._bar = progress.Progress(
                progress.TextColumn("{task.description}"),
                progress.TaskProgressColumn(),
                progress.BarColumn(),
                progress.TimeElapsedColumn(),
                progress.TimeRemainingColumn(),
                progress.TextColumn("{task.fields[note]}"),
            )
            self._task = self._bar.add_task(phase, total=total, completed=done, note=waiting_for)
            self._live = Live(Group(self._bar, below), console=Console(file=self._stream), refresh_per_second=4)
            self._live.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.update(self._bar)  # only the line stays
            self._live.stop()

    def advance(self, rate: float, unit: str, success: float) -> None:
        """One chunk is done.

        Args:
            rate: steps per second in it.
            unit: what a step is ("updates", "env steps").
            success: mean latest success of the members, 0 to 1; nan if none was measured.
        """
        self._done += 1
        note = f"{rate:,.0f} {unit}/s" + ("" if math.isnan(success) else f", success {success:.2f}")
        if self._live is not None:
            self._bar.update(self._task, completed=self._done, note=note)
            self._live.refresh()
            return
        now = time.monotonic()
        if self._done == self._total or now - self._spoken >= _QUIET_SECONDS:
            self._spoken = now
            spent = now - self._started
            left = spent / (self._done - self._first) * (self._total - self._done)
            clock = f"{tqdm.format_interval(spent)}<{tqdm.format_interval(left)}"
            print(
                f"{self._phase} {100 * self._done / self._total:3.0f}% {clock}, {note}", file=self._stream, flush=True
            )
