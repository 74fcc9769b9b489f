#!/usr/bin/env bash
# OGBench and Gymnasium-Robotics: "antmaze large" is two ants, of other torques and another length of a step.
#
# Versions: ogbench 1.2.2 and gymnasium-robotics 1.4.2, with mujoco 3.3.7, gymnasium 1.2.1, numpy 2.3.4. Behaviour: both
# have the body of Gymnasium's Ant, 8 actions in [-1, 1] and 5 physics steps per action. OGBench's antmaze gives an action
# of 1 a torque of 30 N m and lasts 0.1 s per step; AntMaze_Large-v5 gives it 150 N m and lasts 0.05 s. A policy, data, or
# a horizon in steps from one is another in the other: actions five times as strong, a step half as long. Names and shapes
# of actions do not tell. Besides, AntMaze_Large-v5's metadata claims 50 frames per second where it makes 20, so that
# recorded videos run 2.5 times too fast; OGBench's 10 are right.
# Output seen:
#   antmaze-large-v0: 8 actions, torque 30 N m, 0.100 s per step, 10 steps/s, metadata 10
#   AntMaze_Large-v5: 8 actions, torque 150 N m, 0.050 s per step, 20 steps/s, metadata 50
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "ogbench==1.2.2" "gymnasium-robotics==1.4.2" "mujoco==3.3.7" "gymnasium==1.2.1" \
  "numpy==2.3.4"
"$work/venv/bin/python" -W ignore - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import gymnasium
import gymnasium_robotics
import ogbench  # registers its tasks

gymnasium.register_envs(gymnasium_robotics)


def facts(name: str) -> tuple[int, float, float, float, int]:
    """Return the number of actions, the torque of an action of 1, seconds and steps per second, and the metadata's."""
    env = gymnasium.make(name).unwrapped
    ant = getattr(env, "ant_env", env)
    torque = float(ant.model.actuator_gear[0, 0] * env.action_space.high[0])
    return env.action_space.shape[0], torque, ant.dt, 1 / ant.dt, env.metadata["render_fps"]


found = {}
for name in ("antmaze-large-v0", "AntMaze_Large-v5"):
    found[name] = actions, torque, seconds, rate, frames = facts(name)
    print(f"{name}: {actions} actions, torque {torque:.0f} N m, {seconds:.3f} s per step, {rate:.0f} steps/s, metadata {frames}")
one, other = found.values()
assert other[1] == 5 * one[1] and abs(one[2] - 2 * other[2]) < 1e-9, "the ants are alike: a release has changed"
assert one[4] == round(one[3]) and other[4] != round(other[3]), "the metadata are right, or wrong for both: a release has changed"
PY
echo "as described"
