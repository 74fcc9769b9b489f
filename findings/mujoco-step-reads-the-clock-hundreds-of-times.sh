#!/usr/bin/env bash
# MuJoCo 4: an ant's control step reads the profiling clock 570 times, which no option turns off.
#
# Versions: mujoco 4.0.0, gymnasium 1.4.0 (for its ant), numpy 2.4.6. Behaviour: mj_step times its stages for MjData.timer
# whether or not anybody reads it. With gymnasium's ant (Runge-Kutta, five steps per control step) that is 570 calls of
# mjcb_time per control step, and the Python package installs a clock at import although get_mjcb_time() says
# None: there is no option that turns it off. mjcb_time wants a C function without arguments that returns a double, and
# set_mjcb_time takes one from ctypes. Python's stable interface has such a function, PyFloat_GetMin, whose constant
# leaves the durations at 0 and the positions as they were, bit for bit. It matters to whoever steps small models: 4 to
# 11 % of the time of an ant's step on the machine where we measured.
# Output seen (speeds vary):
#   mujoco 4.0.0: get_mjcb_time() None, duration of 50 steps > 0: True
#   clock read 570 times per control step
#   constant clock: same positions True, duration 0.0
#   11.78 -> 13.17 thousand steps/s
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "mujoco==4.0.0" "gymnasium==1.4.0" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY'
import ctypes
import statistics
import time
from pathlib import Path

import gymnasium
import mujoco

ant = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
model = mujoco.MjModel.from_xml_path(str(ant))
step = mujoco.mjtTimer.mjTIMER_STEP


def roll(count=50):
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.3
    began = time.perf_counter()
    for _ in range(count):
        mujoco.mj_step(model, data)
    return data.qpos.tobytes(), data.timer[step].duration, count / (time.perf_counter() - began)


positions, duration, _ = roll()
print(f"mujoco {mujoco.__version__}: get_mjcb_time() {mujoco.get_mjcb_time()}, duration of 50 steps > 0: {duration > 0}")
assert mujoco.get_mjcb_time() is None and duration > 0, "the release has changed"

calls = []
mujoco.set_mjcb_time(lambda: float(len(calls.append(1) or calls)))
roll(5)
print(f"clock read {len(calls)} times per control step")
assert len(calls) == 570, "the release has changed"

constant = ctypes.cast(ctypes.pythonapi.PyFloat_GetMin, ctypes.CFUNCTYPE(ctypes.c_double))
mujoco.set_mjcb_time(constant)
again, none, _ = roll()
print(f"constant clock: same positions {again == positions}, duration {none}")
assert again == positions and none == 0, "the release has changed"

speeds = [], []
for _ in range(9):
    for clock, found in zip((None, constant), speeds):
        mujoco.set_mjcb_time(clock)
        found.append(roll(2000)[2])
with_clock, without = (statistics.median(found) / 1000 for found in speeds)
print(f"{with_clock:.2f} -> {without:.2f} thousand steps/s")
PY
echo "as described"
