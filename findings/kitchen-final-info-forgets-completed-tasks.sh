#!/usr/bin/env bash
# Gymnasium-Robotics: what a kitchen episode completed is gone from its last info once the environment is reset.
#
# Versions: gymnasium-robotics 1.4.2 with mujoco 3.3.7, gymnasium 1.2.1, numpy 2.3.4. Behaviour: FrankaKitchen-v1 puts
# its own list into info["episode_task_completions"] (its two neighbours in info are copies) and empties that list in
# reset. A batch that resets within the step in which an episode ends (AutoresetMode.SAME_STEP) therefore hands out a
# final_info without any completed task, though the reward of that very step is 1: an evaluation that counts subtasks
# there finds a score of 0. With AutoresetMode.NEXT_STEP, or one environment, the list is right until the next reset.
# Output seen, an episode that ends with the microwave open:
#   one environment, at its end: ['microwave']
#   the same info after the next reset: []
#   final_info of a batch: []
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
from gymnasium.vector import AutoresetMode, SyncVectorEnv

gymnasium.register_envs(gymnasium_robotics)
STAY = np.zeros(9, np.float32)
DONE = "episode_task_completions"


def make() -> gymnasium.Env:
    """Return a kitchen whose one task is the microwave."""
    return gymnasium.make("FrankaKitchen-v1", tasks_to_complete=["microwave"])


def open_door(env: gymnasium.Env) -> None:
    """Put the microwave's hinge where the task wants it."""
    model, data = env.unwrapped.model, env.unwrapped.data
    data.qpos[model.joint("microwave").qposadr[0]] = -0.75


env = make()
env.reset(seed=0)
open_door(env)
_, reward, terminated, _, info = env.step(STAY)
assert terminated and reward == 1
at_the_end = list(info[DONE])
env.reset(seed=1)

batch = SyncVectorEnv([make], autoreset_mode=AutoresetMode.SAME_STEP)
batch.reset(seed=0)
open_door(batch.envs[0])
_, rewards, ended, _, infos = batch.step(STAY[None])
assert ended[0] and rewards[0] == 1
final = list(infos["final_info"][DONE][0])

print(f"one environment, at its end: {at_the_end}")
print(f"the same info after the next reset: {info[DONE]}")
print(f"final_info of a batch: {final}")
assert at_the_end == ["microwave"], "the task is not reported as completed: the release has changed"
assert info[DONE] == [] and final == [], "the list outlives the reset: the release has changed"
PY
echo "as described"
