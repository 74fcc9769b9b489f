"""MuJoCo's profiling clock, which every step reads hundreds of times and nobody here reads after it."""

from __future__ import annotations

import ctypes
import os
from functools import cache
from pathlib import Path

import mujoco


def stop() -> None:
    """Makes MuJoCo's clock of this process a function that costs nothing: 7 % of an ant's step, bit for bit the same.

    ``MjData.timer`` means nothing from here on; ``mujoco.set_mjcb_time(None)`` brings the clock back. A clock that is
    somebody's own is left alone.

    The clock is a C function without arguments that returns a number (``mjcb_time``). A Python one would need the
    interpreter's lock in every thread, and MuJoCo's library has none without arguments; its ``mju_sign`` finds some
    number where an argument would be and returns -1, 0 or 1, which any calling convention in use lets it do.
    """
    clock = _no_clock()
    if clock is not None and mujoco.get_mjcb_time() is None:
        mujoco.set_mjcb_time(clock)


@cache
def _no_clock() -> ctypes._FuncPointer | None:
    """Kept for good, since MuJoCo holds its bare address; None where the library is not found, and the clock stays."""
    folder = Path(mujoco.__file__).parent
    library = next(folder.glob("mujoco.dll" if os.name == "nt" else "libmujoco.*"), None)
    if library is None:
        return None
    return ctypes.cast(ctypes.CDLL(str(library)).mju_sign, ctypes.CFUNCTYPE(ctypes.c_double))
