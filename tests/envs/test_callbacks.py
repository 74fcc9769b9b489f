"""MuJoCo C called from jit must not deadlock (jax issues 24255 and 25861), asynchronous dispatch or not.

The rollouts run in a process of their own, under a watchdog: a deadlock would take the whole test session with it.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

WATCHDOG_SECONDS = 240

ROLLOUT = """
import jax, jax.numpy as jnp, sys
jax.config.update("jax_cpu_enable_async_dispatch", sys.argv[1] == "on")
import envs

env = envs.AutoReset(envs.make("antmaze-medium", physics="mujoco"))

@jax.jit
def rollout(state, key):
    def body(state, key):
        after = jax.vmap(jax.vmap(env.step))(state, jax.random.uniform(key, (2, 128, 8), minval=-1.0))
        return after, after.reward.mean()
    return jax.lax.scan(body, state, jax.random.split(key, 10))

# Two populations, dispatched one upon the other without waiting, with work on the device in between.
keys = jax.random.split(jax.random.key(0), (2, 128))
states = [jax.jit(jax.vmap(jax.vmap(env.reset)))(keys) for _ in range(2)]
total = jnp.zeros(())
for k in range(2):
    for i, state in enumerate(states):
        states[i], rewards = rollout(state, jax.random.key(k))
        total += rewards.sum() + (jnp.ones((500, 500)) @ jnp.ones((500, 500))).mean()
print(float(total))
"""


@pytest.mark.parametrize("dispatch", ["on", "off"])
def test_rollouts_end(dispatch: str) -> None:
    command = [sys.executable, "-c", ROLLOUT, dispatch]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WATCHDOG_SECONDS, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) == pytest.approx(2 * 2 * (500 - 10))
