#!/usr/bin/env bash
# OGBench: the arm of the cube tasks sinks to the table when it is told to stay where it is.
#
# Versions: ogbench 1.2.2 with mujoco 4.0.0, gymnasium 1.4.0, numpy 2.4.6. Behaviour: an action is a relative move of the
# effector, so that zeros should keep it in place. The control law turns "where the effector is, plus the move" into joint
# targets by one step of inverse kinematics; the arm hangs a little below its targets, and the next targets start from
# there. Under zeros alone it sinks by some 25 cm in 100 steps, 5 seconds, until it is at the table. It matters to skills,
# action chunks and policies that idle by small actions (and to a baseline that does nothing): hovering takes an action.
# Output seen:
#   height of the effector after   0 steps of zeros: 0.291 m
#   height of the effector after  25 steps of zeros: 0.226 m
#   height of the effector after 100 steps of zeros: 0.042 m
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "ogbench==1.2.2" "mujoco==4.0.0" "gymnasium==1.4.0" "numpy==2.4.6"
"$work/venv/bin/python" -W ignore - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import gymnasium
import numpy as np
import ogbench  # noqa: F401 registers the tasks

env = gymnasium.make("cube-single-singletask-task2-v0")
_, info = env.reset(seed=0)
heights = {0: info["proprio/effector_pos"][2]}
for step in range(1, 101):
    info = env.step(np.zeros(5, np.float32))[-1]
    heights[step] = info["proprio/effector_pos"][2]
for step in (0, 25, 100):
    print(f"height of the effector after {step:3} steps of zeros: {heights[step]:.3f} m")
assert heights[0] - heights[100] > 0.1, "the arm stays up: the release has changed"
PY
echo "as described"
