"""Writing files so that they are never half there, and one clear line for what the file system refuses."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from qdos_brax.errors import UserError

_PARTIAL = ".partial"


def write_text(path: Path, text: str) -> None:
    """Replaces ``path`` by ``text`` at once: a reader, or a run that goes on after a kill, sees the old or the new."""
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an .npz atomically.

    Raises:
        UserError: the file cannot be written.
    """
    with replacing(path) as partial:
        np.savez_compressed(partial, allow_pickle=False, **arrays)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file of the same ending to write to, which takes ``path``'s place at the end; nothing changes on an error."""
    partial = path.with_name(f".{path.stem}{_PARTIAL}{path.suffix}")
    with user_errors(path):
        try:
            yield partial
            os.replace(partial, path)
        finally:
            with contextlib.suppress(OSError):  # of a folder that cannot be written, which is reported already
                partial.unlink()


def is_partial(path: Path) -> bool:
    """Whether it is a file that a kill left half written."""
    return path.name.startswith(".") and _PARTIAL in path.name


@contextlib.contextmanager
def user_errors(path: Path) -> Iterator[None]:
    """Turns what the file system refuses into one clear line."""
    try:
        yield
    except OSError as error:
        raise UserError(refusal(path, error)) from error


def refusal(path: Path, error: OSError) -> str:
    """The line for an OSError: what could not be written, why, and what helps."""
    mends = {
        errno.ENOSPC: "free some space and go on with --resume",
        errno.EDQUOT: "free some space and go on with --resume",
        errno.EROFS: "choose a folder that can be written, with --out",
        errno.EACCES: "choose a folder that can be written, with --out",
        errno.EPERM: "choose a folder that can be written, with --out",
        errno.ENOTDIR: "choose another folder with --out",
        errno.EEXIST: "choose another folder with --out",
    }
    mend = mends.get(error.errno or 0)
    return f"cannot write {path}: {error.strerror or error}" + (f"; {mend}" if mend else "")
