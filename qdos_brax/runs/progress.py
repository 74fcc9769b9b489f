"""What a run says while it works: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import Self, TextIO

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
    """

    def __init__(
        self, phase: str, total: int, done: int = 0, stream: TextIO | None = None, waiting_for: str = "compiling"
    ) -> None:
        self._phase, self._total, self._first, self._done = phase, total, done, done
        self._stream = stream or sys.stderr
        self._started = self._spoken = time.monotonic()
        self._bar = None
        if self._stream.isatty():
            self._bar = tqdm(
                total=total,
                initial=done,
                desc=phase,
                file=self._stream,
                dynamic_ncols=True,
                bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}",
            )
            self._bar.set_postfix_str(waiting_for)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def advance(self, rate: float, unit: str, success: float) -> None:
        """One chunk is done.

        Args:
            rate: steps per second in it.
            unit: what a step is ("updates", "env steps").
            success: mean latest success of the members, 0 to 1; nan if none was measured.
        """
        self._done += 1
        note = f"{rate:,.0f} {unit}/s" + ("" if math.isnan(success) else f", success {success:.2f}")
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update()
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
