#!/usr/bin/env bash
# Gymnasium-Robotics: the noise of the kitchen's joint sensors is not only seen, it moves the arm.
#
# Versions: gymnasium-robotics 1.4.2 with mujoco 3.3.7, gymnasium 1.2.1, numpy 2.3.4. Behaviour: FrankaKitchen-v1 adds
# noise to the observed joint angles (robot_noise_ratio, 0.01 by default). An action's target is the last angle that was
# observed, noise included, plus the move, so that the noise is an input of the physics: under the same actions from the
# same state two seeds end in different poses, without the noise in the same one, bit for bit. It matters to whoever
# turns the noise off to evaluate (other dynamics, not only a cleaner view), replays logged actions, or restores a state
# from qpos and qvel, which lack the last noisy angles.
# Output seen, 200 steps of zeros from the same start, three seeds:
#   noise 0.00: true joint angles differ between seeds by 0.0000 rad
#   noise 0.01: true joint angles differ between seeds by 0.0133 rad
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


def end(noise: float, seed: int) -> np.ndarray:
    """Return the arm's true joint angles after 200 steps of zeros."""
    env = gymnasium.make(
        "FrankaKitchen-v1", tasks_to_complete=["kettle"], robot_noise_ratio=noise, object_noise_ratio=0.0
    )
    env.reset(seed=seed)
    for _ in range(200):
        env.step(np.zeros(9, np.float32))
    return env.unwrapped.robot_env.data.qpos[:7].copy()


differ = {}
for noise in (0.0, 0.01):
    differ[noise] = np.ptp([end(noise, seed) for seed in range(3)], axis=0).max()
    print(f"noise {noise:.2f}: true joint angles differ between seeds by {differ[noise]:.4f} rad")
assert differ[0.0] == 0.0, "the arm moves without noise, too: the release has changed"
assert differ[0.01] > 1e-3, "the noise does not move the arm: the release has changed"
PY
echo "as described"
