"""Output that outlives its reader: a pipe or a terminal that goes away, and characters that it cannot show."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any

from qdos_brax.errors import UserError

_GONE = (errno.EPIPE, errno.EIO)  # the reader of a pipe, the terminal


class _LastingStream:
    """Write to a text stream until its reader is gone, and nowhere from then on.

    Raises:
        UserError: the stream refuses for another reason, such as a full disk; once.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write ``text``; return its length."""
        with self._kept():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        with self._kept():
            self._stream.flush()

    @contextlib.contextmanager
    def _kept(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # takes what is buffered too, at the interpreter's end at last
            os.close(nowhere)
            if error.errno not in _GONE:
                raise UserError(f"cannot write the output: {error.strerror}") from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def lasting_streams() -> Iterator[None]:
    """Keep stdout and stderr past the end of their readers, and show "?" for characters that they cannot encode.

    A run goes on without output, and saves as ever; a command that only prints ends quietly.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_lasting, before)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before


def _lasting(stream: Any) -> Any:
    if stream is None:  # closed when the program was started
        return open(os.devnull, "w", encoding="utf-8")
    if hasattr(stream, "reconfigure") and stream.errors == "strict":
        stream.reconfigure(errors="replace")
    return _LastingStream(stream)
