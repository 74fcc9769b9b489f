#!/usr/bin/env bash
# Brax: with action_repeat an episode that ends within the repetitions is played on, paid for, and may not end at all.
#
# Versions: brax 0.14.2, jax 0.10.2 (CPU). Behaviour: action_repeat of brax.envs.wrappers.training.wrap (and of PPO and
# SAC, which pass it on) always makes all its steps, and takes the end from the last one alone. Frame skips elsewhere
# (Gymnasium's MaxAndSkipObservation) stop at the end. An environment that ends at 3, with a reward of 1 per step, gives
# a return of 3; with two repetitions it gives 4, for the step after the end counts. Where the end is an event ("is on
# the goal") and not a state that lasts, the episode goes through it: it stops at the time limit, marked as truncated,
# with a return of 20.
# It matters to whoever compares returns between values of action_repeat, or has goals that end an episode. What helps:
# an end that stays once reached and no reward after it, inside the environment. Brax's automatic reset sets done back
# to 0 before the next step. A relative, still open: metrics are those of the last repetition alone
# (https://github.com/google/brax/issues/610).
# Output seen (brax 0.14.2, an end in step 3, a limit of 20 steps):
#   an end that lasts, action_repeat 1: return 3, length 3, truncation 0
#   an end that lasts, action_repeat 2: return 4, length 4, truncation 0
#   an end that passes, action_repeat 1: return 3, length 3, truncation 0
#   an end that passes, action_repeat 2: return 20, length 20, truncation 1
#   an end kept by the environment, action_repeat 1: return 3, length 3, truncation 0
#   an end kept by the environment, action_repeat 2: return 3, length 4, truncation 0
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "brax==0.14.2" "jax==0.10.2" "jaxlib==0.10.2" "flax==0.12.8" "mujoco==4.0.0" \
  "mujoco-mjx==3.17.0" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY' 2> "$work/errors" > "$work/all.txt" || { cat "$work/errors"; exit 1; }
from importlib.metadata import version

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from brax.envs.wrappers.training import wrap


class Walk(Env):
    """One step further each time; the end is at 3."""

    observation_size, action_size, backend = 1, 1, "toy"

    def __init__(self, end):
        self.end = end

    def reset(self, rng):
        return State(None, jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state, action):
        place = state.obs + 1
        done = jnp.where(place[0] >= 3 if self.end == "lasts" else place[0] == 3, 1.0, 0.0)
        reward = jnp.ones(())
        if self.end == "kept":
            reward, done = 1 - state.done, jnp.maximum(state.done, done)
        return state.replace(obs=place, reward=reward, done=done)


print(f"brax {version('brax')}, jax {version('jax')}")
for end, words in (("lasts", "that lasts"), ("passes", "that passes"), ("kept", "kept by the environment")):
    for repeat in (1, 2):
        env = wrap(Walk(end), episode_length=20, action_repeat=repeat)
        step, state, total = jax.jit(env.step), env.reset(jax.random.split(jax.random.PRNGKey(0), 1)), 0.0
        for _ in range(20):
            state = step(state, jnp.zeros((1, 1)))
            total += float(state.reward[0])
            if state.done[0]:
                break
        length, truncation = int(state.info["steps"][0]), int(state.info["truncation"][0])
        print(f"an end {words}, action_repeat {repeat}: return {total:.0f}, length {length}, truncation {truncation}")
PY
grep -E '^(brax|an end) ' "$work/all.txt" | tee "$work/seen.txt"
diff <(grep '^an end' "$work/seen.txt") <(sed -n '/^# Output seen/,/^set/s/^#   //p' "$0")
echo "as described"
