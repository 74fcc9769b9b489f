#!/usr/bin/env bash
# Brax: the training wrappers count an episode in info["steps"], and halve it where the environment counts there too.
#
# Versions: brax 0.14.2, jax 0.10.2. Behaviour: an environment that keeps its own step count in state.info["steps"] (a
# natural name) is wrapped by brax.envs.wrappers.training.wrap with episode_length=50. EpisodeWrapper adds 1 to the same
# entry after every step, so both counts add up: the episode is truncated at step 25, without an error or a warning.
# The entry of the same environment under any other name gives 50.
# Output seen:
#   counter named steps: done at step 25, truncation 1
#   counter named own_steps: done at step 50, truncation 1
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "brax==0.14.2" "jax==0.10.2" "flax==0.12.8" "mujoco==4.0.0" "mujoco-mjx==3.17.0" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY' 2> /dev/null | grep '^counter' | tee "$work/seen.txt"
import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from brax.envs.wrappers.training import wrap


class Line(Env):
    observation_size, action_size, backend = 1, 1, "toy"

    def __init__(self, name):
        self.counter = name

    def reset(self, rng):
        return State(None, jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), {}, {self.counter: jnp.zeros(())})

    def step(self, state, action):
        return state.replace(obs=state.obs + 1, info=state.info | {self.counter: state.info[self.counter] + 1})


for name in ("steps", "own_steps"):
    env = wrap(Line(name), episode_length=50, action_repeat=1)
    step, state, count = jax.jit(env.step), env.reset(jax.random.split(jax.random.PRNGKey(0), 2)), 0
    while not state.done.any() and count < 200:
        state, count = step(state, jnp.zeros((2, 1))), count + 1
    print(f"counter named {name}: done at step {count}, truncation {int(state.info['truncation'][0])}")
PY
diff "$work/seen.txt" - <<'SEEN'
counter named steps: done at step 25, truncation 1
counter named own_steps: done at step 50, truncation 1
SEEN
echo "as described"
