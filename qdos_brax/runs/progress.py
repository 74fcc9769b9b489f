"""Progress of long work: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import Self, TextIO

from rich import progress
from rich.console import Console, Group, RenderableType
from rich.live import Live

_QUIET_SECONDS = 10.0


class Progress:
    """Show the progress of a phase or another long work: its name, rate, time left, latest success and return.

    Args:
        phase: name of the work.
        total: its size, in chunks or any other unit.
        done: how much of it an earlier process has done.
        stream: where to write (default stderr); a bar if it is a terminal, else a line every ten seconds and one at
            the end.
        waiting_for: note beside the bar until there is a rate.
        below: what a terminal shows below the bar until the work ends, drawn again whenever the bar is.
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
        self._started = self._printed = time.monotonic()
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
            self._live.update(self._bar)  # only the bar stays
            self._live.stop()

    def advance(self, rate: float, unit: str, success: float = math.nan, episode_return: float = math.nan) -> None:
        """Show that one more chunk is done.

        Args:
            rate: steps per second in it.
            unit: name of a step ("updates", "env steps").
            success: mean success of the members at their latest evaluation, 0 to 1; nan if there was none.
            episode_return: mean return there.
        """
        found = "" if math.isnan(success) else f", success {success:.2f}, return {episode_return:.0f}"
        note = f"{rate:,.0f} {unit}/s{found}"
        self._show(self._done + 1, note)

    def advance_to(self, done: int, unit: str) -> None:
        """Show how much is done, and the mean rate so far.

        Args:
            done: amount that is done, of ``total``.
            unit: name of what is counted ("steps").
        """
        rate = (done - self._first) / max(time.monotonic() - self._started, 1e-3)
        self._show(done, f"{rate:,.0f} {unit}/s")

    def _show(self, done: int, note: str) -> None:
        self._done = done
        if self._live is not None:
            self._bar.update(self._task, completed=self._done, note=note)
            self._live.refresh()
            return
        now = time.monotonic()
        if self._done == self._total or now - self._printed >= _QUIET_SECONDS:
            self._printed = now
            spent = now - self._started
            left = spent / max(self._done - self._first, 1) * (self._total - self._done)
            share = f"{100 * self._done / self._total:3.0f}%"
            print(f"{self._phase} {share} {_clock(spent)}<{_clock(left)}, {note}", file=self._stream, flush=True)


def _clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, "07:30", with hours in front where there are any."""
    minutes, second = divmod(int(seconds), 60)
    hour, minute = divmod(minutes, 60)
    return (f"{hour}:" if hour else "") + f"{minute:02d}:{second:02d}"
