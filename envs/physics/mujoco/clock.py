"""MuJoCo's profiling clock: a step reads it hundreds of times, and nobody here reads what it adds up."""

from __future__ import annotations

import ctypes

import mujoco

# A C function without arguments that returns a number, as mjcb_time has to be (mjtNum (*mjfTime)(void)), and that costs
# nothing: of Python's stable interface, the least positive float. A Python function would take the interpreter's lock
# in every thread. Kept for good, since MuJoCo holds its bare address.
_CONSTANT = ctypes.cast(ctypes.pythonapi.PyFloat_GetMin, ctypes.CFUNCTYPE(ctypes.c_double))


def stop() -> None:
    """Make MuJoCo's clock of this process stand still, unless somebody has set one: 4 to 8 % of an ant's step.

    Steps are the same bit for bit; the durations in ``MjData.timer`` stay 0. ``mujoco.set_mjcb_time(None)`` brings
    the clock back.
    """
    if mujoco.get_mjcb_time() is None:
        mujoco.set_mjcb_time(_CONSTANT)
