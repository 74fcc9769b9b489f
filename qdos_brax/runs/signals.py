"""SIGINT, SIGTERM, SIGHUP: a run stops where it loses nothing, and prints how to continue it."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from qdos_brax.runs.hints import resume_command

_STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextlib.contextmanager
def collected() -> Iterator[list[int]]:
    """Yield a list that collects the signals; a second one ends the process at once."""
    caught: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        # A session that ends sends more than one SIGHUP: from the shell, and from the terminal itself.
        signal.signal(number, signal.SIG_IGN if _is_hang_up(number) else signal.SIG_DFL)
        warn("stopping after this chunk; a second signal stops at once")

    with _handled_by(handle):
        yield caught


@contextlib.contextmanager
def stops_at_once(path: Path) -> Iterator[None]:
    """End the program at the first signal, in work that has nothing to save (data, compilation, the report).

    Args:
        path: the run's folder, for the line that tells how to continue it.

    Raises:
        SystemExit: a signal arrived; the code is 129, 130 or 143.
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
    """End the program with the code of a signal, and print how to continue the run.

    Args:
        number: the signal.
        how: first words of the line.
        path: the run's folder.
    """
    warn(f"{how}; continue with: {resume_command(path)}")
    raise SystemExit(128 + number) from None


def warn(line: str) -> None:
    """Print a line that is no result to stderr."""
    print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    numbers = [number for number in _STOPPING if not (_is_hang_up(number) and _is_ignored(number))]
    handlers = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _is_hang_up(number: int) -> bool:
    return number == getattr(signal, "SIGHUP", None)


def _is_ignored(number: int) -> bool:
    """Return whether whoever started the program had the signal ignored, as ``nohup`` does."""
    return signal.getsignal(number) == signal.SIG_IGN
