"""A test that never ends must not hold the run of all tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

WAITS_IN_C = """
import ctypes

def test_waits_for_ever():
    lock, library = ctypes.create_string_buffer(64), ctypes.PyDLL(None)
    for _ in range(2):
        library.pthread_mutex_lock(lock)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a lock of zeros is an open one in glibc")
def test_a_test_that_waits_within_a_library_is_ended_and_named(tmp_path: Path) -> None:
    """The second lock waits for the first, with the interpreter's own lock held: no signal is answered there."""
    (tmp_path / "test_waiting.py").write_text(WAITS_IN_C, encoding="utf-8")
    flags = f"-p tests.conftest -p no:xdist -p no:cacheprovider -o timeout=2 --rootdir {tmp_path} {tmp_path}"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *flags.split()], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert done.returncode == 1
    assert "test_waiting.py" in done.stderr and "in test_waits_for_ever" in done.stderr
