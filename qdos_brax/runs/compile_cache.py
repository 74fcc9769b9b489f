"""The persistent compilation cache: a second run does not compile again what the first one compiled."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
from pathlib import Path

import jax
import jaxlib

LARGEST = 2 * 2**30
"""Bytes that the folder of compiled programs may hold when a process starts to use it."""


def cache_folder() -> Path:
    """Return the folder of compiled programs: ``JAX_COMPILATION_CACHE_DIR``, or one per machine in the user's cache.

    Programs are compiled for one processor; a home folder shared by several machines must keep them apart, or each
    rejects the others' entries (jax issue 38445).
    """
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if given:
        return Path(given)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "qdos_brax" / "xla" / _machine()


def enable() -> Path | None:
    """Turn the cache on for every later program and return its folder; None if that cannot be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        trim(folder, LARGEST)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # A run compiles some hundred programs of one operation each: 40 ms apiece, and 4 ms to read.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder


def trim(folder: Path, largest: int) -> None:
    """Remove the programs that were not used for longest until the rest take at most ``largest`` bytes.

    jax's own bound (``jax_compilation_cache_max_size``) reads the whole folder at every write. A program that another
    process is about to read may go: that process compiles it.
    """
    found = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # two processes trim at once
            status = path.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= largest:
            return
        path.unlink(missing_ok=True)
        total -= size


def _machine() -> str:
    """Return 12 hex digits that name the processor and the compiler's version."""
    cpu = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu += "".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    except OSError:
        pass  # not Linux: the processor's name has to do
    text = f"{platform.machine()} {cpu} jaxlib {jaxlib.__version__}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]
