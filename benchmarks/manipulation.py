"""Measure the speed of the manipulation tasks: ``python benchmarks/manipulation.py [TASK ..] [--turns N] [--out F]``.

Control steps per second under random actions, resets included, of TASK (kitchen, cube-single, cube-double, scene)

    TASK              our 64 environments on MuJoCo C, inside jit
    TASK gymnasium    one environment of gymnasium-robotics (FrankaKitchen-v1) or OGBench (``*-singletask-v0``)
    TASK async        the same in gymnasium's AsyncVectorEnv, one worker per core

which take turns of about a second each, so that all meet the same load. The ratio is that of the medians, against the
better of gymnasium's two.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

BATCH = 64
SECONDS = 1.0  # of a turn
CORES = len(os.sched_getaffinity(0))


def franka_kitchen() -> Any:
    """Return FrankaKitchen-v1 with the subtasks of ``kitchen-mixed``, made to run on MuJoCo 4."""
    import gymnasium
    import gymnasium_robotics
    from gymnasium_robotics.envs.franka_kitchen import franka_env

    # MuJoCo 4's enums are not equal to NumPy's integers on their right, as in the look-up of the robot's joints.
    franka_env.robot_get_obs = lambda model, data, names: (data.qpos[:9].copy(), data.qvel[:9].copy())
    gymnasium.register_envs(gymnasium_robotics)
    subtasks = ["microwave", "kettle", "bottom burner", "light switch"]
    return gymnasium.make("FrankaKitchen-v1", tasks_to_complete=subtasks)


def ogbench(name: str) -> Any:
    """Return OGBench's environment of the variant's default task."""
    import gymnasium
    import ogbench.manipspace  # noqa: F401 - registers it

    return gymnasium.make(f"{name}-singletask-v0")


def ours(task: str, batch: int, control_steps: int = 10) -> Callable[[], int]:
    """Return a function that steps ``batch`` environments ``control_steps`` times in one program."""
    import jax

    import envs

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    env = envs.AutoReset(envs.make(task, physics="mujoco"))

    def body(state: Any, key: jax.Array) -> tuple[Any, None]:
        return jax.vmap(env.step)(state, jax.random.uniform(key, (batch, env.action_size), minval=-1.0)), None

    run = jax.jit(lambda state, key: jax.lax.scan(body, state, jax.random.split(key, control_steps))[0])
    held = [jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch)), jax.random.key(1)]

    def steps() -> int:
        held[1], key = jax.random.split(held[1])
        held[0] = jax.block_until_ready(run(held[0], key))
        return batch * control_steps

    return steps


def gymnasium_single(make: Callable[[], Any]) -> Callable[[], int]:
    """Return a function that steps one environment of ``make`` once."""
    env = make()
    env.reset(seed=0)
    rng = np.random.default_rng(0)

    def steps() -> int:
        _, _, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
        if terminated or truncated:
            env.reset()
        return 1

    return steps


def gymnasium_async(make: Callable[[], Any]) -> Callable[[], int]:
    """Return a function that steps an environment of ``make`` on each core once."""
    import gymnasium

    env = gymnasium.vector.AsyncVectorEnv([make] * CORES, context="spawn")
    env.reset(seed=0)
    rng = np.random.default_rng(0)

    def steps() -> int:
        env.step(rng.uniform(-1, 1, env.action_space.shape))
        return CORES

    return steps


def rate(steps: Callable[[], int], seconds: float = SECONDS) -> float:
    """Return the steps per second of a turn."""
    began, count = time.perf_counter(), 0
    while (passed := time.perf_counter() - began) < seconds:
        count += steps()
    return count / passed


REFERENCES: dict[str, Callable[[], Any]] = {
    "kitchen": franka_kitchen,
    **{name: partial(ogbench, name) for name in ("cube-single", "cube-double", "scene")},
}


def measure(task: str, turns: int) -> dict[str, Any]:
    """Return the median rates of a task, and our ratio to the better of gymnasium's."""
    reference = REFERENCES[task]
    kinds = {
        task: ours(task, BATCH),
        f"{task} gymnasium": gymnasium_single(reference),
        f"{task} async": gymnasium_async(reference),
    }
    for steps in kinds.values():
        rate(steps, 0.2)
    rates: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(turns):
        for name, steps in kinds.items():
            rates[name].append(rate(steps))
    found = {name: round(float(np.median(values)), 1) for name, values in rates.items()}
    best = max(found[f"{task} gymnasium"], found[f"{task} async"])
    return found | {f"{task} ratio": round(found[task] / best, 3), "cores": CORES, "turns": turns}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(REFERENCES)} (default: all)")
    parser.add_argument("--turns", type=int, default=10, help="turns of each (default 10)")
    parser.add_argument("--out", type=Path, help="JSON file to update")
    args = parser.parse_args()
    found = json.loads(args.out.read_text()) if args.out and args.out.exists() else {}
    for task in args.tasks or REFERENCES:
        found |= measure(task, args.turns)
    print(json.dumps(found, indent=1))
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
