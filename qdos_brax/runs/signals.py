"""SIGINT and SIGTERM: a run ends where it loses nothing, and says how to go on."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

_STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def collected() -> Iterator[list[int]]:
    """Collects the signals instead of dying of the first one; a second one kills."""
    caught: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        signal.signal(number, signal.SIG_DFL)
        say("stopping after this chunk; once more stops at once")

    with _handled_by(handle):
        yield caught


@contextlib.contextmanager
def stops_at_once(path: Path) -> Iterator[None]:
    """For what keeps nothing of its own under way (data, compilation, the report): the first signal ends it.

    Args:
        path: of the run, which is named in the line that says how to go on.

    Raises:
        SystemExit: a signal came; the code is 130 or 143.
    """
    caught: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        raise SystemExit(128 + number)

    with _handled_by(handle):
        try:
            yield
        except BaseException:
            if not caught:
                raise
            # A callback of a compiled program may have turned the exit into an error of its own.
            stop(caught[0], "stopped", path)


def stop(number: int, how: str, path: Path) -> None:
    """Ends the program with the code of a signal, and says how to go on."""
    say(f"{how}; go on with: python train.py --resume {path}")
    raise SystemExit(128 + number) from None


def say(line: str) -> None:
    """A line to the user that is no result."""
    print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    handlers = {number: signal.signal(number, handle) for number in _STOPPING}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
