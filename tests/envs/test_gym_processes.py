"""Gymnasium's environments in other processes: forked children refuse, spawned ones work."""

from __future__ import annotations

import subprocess
import sys

MEDIUM = "qdos/antmaze-medium-task1-v0"


def _async_reset(options: str) -> subprocess.CompletedProcess[str]:
    program = (
        "import gymnasium, envs.gym_api\n"
        "if __name__ == '__main__':\n"
        f"    options = dict(num_envs=2, vectorization_mode='async', physics='mujoco'{options})\n"
        f"    batch = gymnasium.make_vec({MEDIUM!r}, **options)\n"
        "    print(batch.reset(seed=0)[0].shape)\n"
        "    batch.close()\n"
    )
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)


def test_forked_children_refuse_instead_of_waiting_forever() -> None:
    ended = _async_reset("")
    assert ended.returncode and 'context="spawn"' in ended.stderr and "vector_entry_point" in ended.stderr


def test_a_bare_fork_of_a_process_that_has_stepped_refuses_too() -> None:
    program = (
        "import os, gymnasium, envs.gym_api\n"
        f"env = gymnasium.make({MEDIUM!r}, physics='mujoco')\n"
        "env.reset(seed=0), env.step(env.action_space.sample())\n"
        "if child := os.fork():\n"
        "    print(os.waitpid(child, 0)[1])\n"
        "else:\n"
        "    try:\n"
        "        env.step(env.action_space.sample())\n"
        "    except ValueError as error:\n"
        "        print(error, flush=True)\n"
        "    os._exit(0)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    line, code = ended.stdout.splitlines()
    assert line.startswith("this process was forked after jax was used") and code == "0"


def test_spawned_children_work() -> None:
    ended = _async_reset(", vector_kwargs={'context': 'spawn'}")
    assert ended.stdout == "(2, 29)\n", ended.stderr
