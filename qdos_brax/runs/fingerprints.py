"""Fingerprints of files: size and SHA-256, by which a later process recognises what was written or read."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file as 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_once(path: Path) -> str:
    """Return ``sha256``, without reading the file again in this process while its size and time of change stay.

    For data, which is large and is asked for by a run that continues, by each run of a comparison, and by each share.
    """
    status = path.stat()
    return _sha256_of(path.absolute(), status.st_size, status.st_mtime_ns)


@functools.cache
def _sha256_of(path: Path, size: int, changed: int) -> str:
    return sha256(path)


def fingerprints(folder: Path, without: str) -> dict[str, list[Any]]:
    """Return {relative path: [bytes, SHA-256]} of every file in a folder and below.

    Args:
        folder: the folder.
        without: a file name to leave out, that of the file which holds the fingerprints.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != without)
    return {path.relative_to(folder).as_posix(): [path.stat().st_size, sha256(path)] for path in files}


def difference(saved: Mapping[str, Any], found: Mapping[str, Any]) -> str | None:
    """Return what is wrong with the first file that is not as it was saved; None if all are as they were.

    Args:
        saved, found: ``fingerprints`` then and now. Files that were added since do not matter.
    """
    for file, fingerprint in saved.items():
        if file not in found:
            return f"{file} is missing"
        if found[file] != fingerprint:
            return f"{file} is truncated or altered"
    return None
