"""The folder of data sets that this machine collected or fetched, and the locks on its files."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from qdos_brax.errors import UserError


def folder() -> Path:
    """Return the folder of the data sets: ``$QDOS_DATA``, else ``~/.cache/qdos_brax/data``."""
    return Path(os.environ.get("QDOS_DATA") or "~/.cache/qdos_brax/data").expanduser()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of ``path``; the system releases it when the process ends, however it ends.

    Raises:
        UserError: its folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = open(path.with_suffix(".lock"), "wb")  # noqa: SIM115 (closed below)
    except OSError as error:
        raise UserError(
            f"{path.parent} cannot be written ({error.strerror}); set QDOS_DATA to another folder"
        ) from None
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
