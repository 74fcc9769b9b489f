"""Atomic writing of files and folders, and one clear line for what the file system refuses."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from qdos_brax.errors import UserError

_PARTIAL = ".partial"


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by ``text`` at once: a reader, or a run that continues after a kill, sees the old or the new.

    Raises:
        UserError: the file system refuses; ``path`` is as it was.
    """
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


def parse_json(text: str | bytes) -> Any:
    """Return what JSON text holds.

    Raises:
        ValueError: it is no JSON, or nested deeper than Python follows, where ``json`` itself raises a RecursionError.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def try_to_write(path: Path) -> None:
    """Make the folder of ``path`` and, for a moment, a file in it: before long work whose result it is to take.

    Raises:
        UserError: the file system refuses, or ``path`` is a folder.
    """
    with user_errors(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        _partial(path).touch()
        _partial(path).unlink()


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a file name of the same ending to write to; rename it to ``path`` at the end, or remove it on an error.

    Raises:
        UserError: the file system refuses; ``path`` is as it was.
    """
    partial = _partial(path)
    with user_errors(path):
        try:
            yield partial
            os.replace(partial, path)
        finally:
            with contextlib.suppress(OSError):  # of a folder that cannot be written, which is reported already
                partial.unlink()


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder to fill; rename it to ``path`` at the end, or remove it on an error.

    A folder that is at ``path`` already is replaced with everything in it.

    Raises:
        UserError: the file system refuses.
    """
    partial = path.with_name(f".{path.name}{_PARTIAL}")
    with user_errors(path):
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            yield partial
            if path.exists():
                shutil.rmtree(path)
            os.replace(partial, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.stem}{_PARTIAL}{path.suffix}")


def is_partial(path: Path) -> bool:
    """Return whether the name is that of a file or folder that a kill left incomplete."""
    return path.name.startswith(".") and _PARTIAL in path.name


@contextlib.contextmanager
def user_errors(path: Path) -> Iterator[None]:
    """Turn what the file system refuses into a UserError of one clear line."""
    try:
        yield
    except OSError as error:
        raise UserError(refusal(path, error)) from error


def refusal(path: Path, error: OSError) -> str:
    """Return the line for an OSError: which file could not be written, why, and what helps."""
    remedies = {
        errno.ENOSPC: "free some space and continue with --resume",
        errno.EDQUOT: "free some space and continue with --resume",
        errno.EROFS: "choose a folder that can be written, with --out",
        errno.EACCES: "choose a folder that can be written, with --out",
        errno.EPERM: "choose a folder that can be written, with --out",
        errno.ENOTDIR: "choose another folder with --out",
        errno.EEXIST: "choose another folder with --out",
        errno.EISDIR: "give the name of a file with --out",
    }
    remedy = remedies.get(error.errno or 0)
    return f"cannot write {path}: {error.strerror or error}" + (f"; {remedy}" if remedy else "")
