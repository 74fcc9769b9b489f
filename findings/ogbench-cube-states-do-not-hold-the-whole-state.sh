#!/usr/bin/env bash
# OGBench: a step of the cube tasks cannot be repeated from qpos and qvel, which is what its data files store.
#
# Versions: ogbench 1.2.2 with mujoco 4.0.0, gymnasium 1.4.0, numpy 2.4.6. Behaviour: the control law starts from the
# effector's pose in MjData, which is the one before the last of the 25 sub-steps, for mj_step moves the joints after the
# pose is computed. Setting qpos and qvel and computing the poses anew gives a slightly different pose, and with it other
# joint targets: the same action then leads elsewhere. Restoring MuJoCo's whole integration state with mj_setState alone
# does not help either, once a forward pass has refreshed the poses: the stale pose is not part of that state. It matters to
# whoever starts rollouts from logged states or compares simulators step by step: carry the effector's pose as well.
# Output seen:
#   qpos and qvel set:           qpos differs by 7.9e-04
#   whole integration state set: qpos differs by 7.9e-04
#   and the stale poses kept:    qpos differs by 0.0e+00
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "ogbench==1.2.2" "mujoco==4.0.0" "gymnasium==1.4.0" "numpy==2.4.6"
"$work/venv/bin/python" -W ignore - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import copy

import gymnasium
import mujoco
import numpy as np
import ogbench  # noqa: F401 registers the tasks

WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION
env = gymnasium.make("cube-single-singletask-task2-v0").unwrapped
env.reset(seed=0)
rng = np.random.default_rng(0)
for _ in range(20):
    env.step(rng.uniform(-1, 1, 5))
model, data, action = env._model, env._data, rng.uniform(-1, 1, 5)
row = np.empty(mujoco.mj_stateSize(model, WHOLE))
mujoco.mj_getState(model, data, row, WHOLE)
qpos, qvel, before = data.qpos.copy(), data.qvel.copy(), copy.copy(data)
env.step(action)
after = data.qpos.copy()


def difference():
    env.step(action)
    return float(np.abs(data.qpos - after).max())


env.set_state(qpos, qvel)
from_positions = difference()
mujoco.mj_setState(model, data, row, WHOLE)
mujoco.mj_forward(model, data)
mujoco.mj_setState(model, data, row, WHOLE)
from_row = difference()
mujoco.mj_copyData(data, model, before)
from_everything = difference()
print(f"qpos and qvel set:           qpos differs by {from_positions:.1e}")
print(f"whole integration state set: qpos differs by {from_row:.1e}")
print(f"and the stale poses kept:    qpos differs by {from_everything:.1e}")
assert from_positions > 1e-5 and from_row > 1e-5 and from_everything == 0, "the release has changed"
PY
echo "as described"
