#!/usr/bin/env bash
# Gymnasium-Robotics: the kitchen's compute_reward depends on what the current episode has done, not on its arguments alone.
#
# Versions: gymnasium-robotics 1.4.2 with mujoco 3.3.7, gymnasium 1.2.1, numpy 2.3.4. Behaviour: a goal environment's
# compute_reward(achieved_goal, desired_goal, info) is what hindsight and offline relabelling call on stored
# transitions. The kitchen's counts only the tasks that its current episode has still to complete: one stored transition
# with the microwave open earns 1 until the episode itself opens the microwave, 0 from then on, and 1 again after a
# reset, so that a replay relabelled while the environment plays holds one transition with two rewards. (Made with
# remove_task_when_completed=False it earns 1 always.)
# Output seen, one call with the same arguments:
#   before the episode opens the microwave: 1.0
#   after it: 0.0
#   after the next reset: 1.0
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "gymnasium-robotics==1.4.2" "mujoco==3.3.7" "gymnasium==1.2.1" "numpy==2.3.4"
"$work/venv/bin/python" -W ignore - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import gymnasium
import gymnasium_robotics
import numpy as np

gymnasium.register_envs(gymnasium_robotics)
env = gymnasium.make("FrankaKitchen-v1", tasks_to_complete=["microwave", "kettle"])
observation, _ = env.reset(seed=0)
model, data = env.unwrapped.model, env.unwrapped.data

goal = observation["desired_goal"]
stored = {"microwave": goal["microwave"].copy(), "kettle": observation["achieved_goal"]["kettle"].copy()}


def relabelled() -> float:
    """Return the reward of the stored transition, in which the microwave is open."""
    return env.unwrapped.compute_reward(stored, goal, {})


before = relabelled()
data.qpos[model.joint("microwave").qposadr[0]] = goal["microwave"][0]
_, reward, *_ = env.step(np.zeros(9, np.float32))
assert reward == 1, "the episode did not complete the microwave"
after = relabelled()
env.reset(seed=1)
again = relabelled()
print(f"before the episode opens the microwave: {before}")
print(f"after it: {after}")
print(f"after the next reset: {again}")
assert (before, after, again) == (1, 0, 1), "the reward is a function of its arguments: the release has changed"
PY
echo "as described"
