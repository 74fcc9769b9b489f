"""Measure the speed of the physics: ``python benchmarks/physics.py [--out results/physics.json]``.

Measures environment steps per second (one step is one control step of one environment under random actions), seconds
from an empty compilation cache to the end of the first step, and peak memory, of

    stock-mjx     OGBench's own model, all walls, on unmodified MJX (without observation, reward or reset)
    mjx           our environment on MJX, reset included
    mjx-warp      our environment on MuJoCo Warp, reset included (CUDA only; only if --kinds names it)
    mujoco        our environment on MuJoCo C, inside jit, reset included
    bare          OGBench's model, all walls, in a plain thread pool (without observation, reward or reset)
    gymnasium     one environment of OGBench
    async         environments of OGBench in gymnasium's AsyncVectorEnv, one worker per core

Each cell runs in a process of its own, without a compilation cache, one after the other. A cell that does not finish
in ``--limit`` seconds is reported as such. The table goes to standard output, all results to the JSON file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TASKS = ("antmaze-medium", "antmaze-large", "antmaze-giant", "antsoccer-arena", "humanoidmaze-medium")
BATCHES = (1, 16, 64, 256)
KINDS = ("stock-mjx", "mjx", "mjx-warp", "mujoco", "bare", "gymnasium", "async")
FRAME_SKIP = 5
CORES = len(os.sched_getaffinity(0))


# --- One cell: a function that steps all environments some times -------------------------------------------------


def ours(task: str, batch: int, physics: str, control_steps: int) -> Callable[[], int]:
    """Return a function that steps our environment with auto-reset, ``control_steps`` in one program."""
    import jax

    import envs

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    env = envs.AutoReset(envs.make(task, physics=physics))

    def body(state: Any, key: Any) -> tuple[Any, None]:
        actions = jax.random.uniform(key, (batch, env.action_size), minval=-1.0)
        return jax.vmap(env.step)(state, actions), None

    @jax.jit
    def run(state: Any, key: Any) -> Any:
        return jax.lax.scan(body, state, jax.random.split(key, control_steps))[0]

    held = [jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch)), jax.random.key(1)]

    def steps() -> int:
        held[1], key = jax.random.split(held[1])
        held[0] = jax.block_until_ready(run(held[0], key))
        return batch * control_steps

    return steps


def stock_mjx(task: str, batch: int) -> Callable[[], int]:
    """Return a function that calls ``mjx.step`` on OGBench's unmodified model."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    model = ogbench_env(task).unwrapped.model
    mjx_model = mjx.put_model(model, impl="jax")
    data = jax.vmap(lambda _: mjx.make_data(model, impl="jax"))(jnp.arange(batch))

    @jax.jit
    def run(data: Any, key: Any) -> Any:
        actions = jax.random.uniform(key, (batch, model.nu), minval=-1.0)

        def substep(data: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(lambda d, a: mjx.step(mjx_model, d.replace(ctrl=a)))(data, actions), None

        return jax.lax.scan(substep, data, None, length=FRAME_SKIP)[0]

    held = [data, jax.random.key(0)]

    def steps() -> int:
        held[1], key = jax.random.split(held[1])
        held[0] = jax.block_until_ready(run(held[0], key))
        return batch

    return steps


def bare(task: str, batch: int, control_steps: int) -> Callable[[], int]:
    """Return a function that calls MuJoCo's batch stepper on the task's model, all walls, with prepared actions."""
    import jax
    from mujoco.batch import Batch

    import envs

    env = envs.make(task, physics="mujoco")
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch)).pipeline_state
    model = env.whole_model()
    stepper = Batch(model, nsim=batch, nthread=min(CORES, batch))
    stepper.bind("qpos")[:], stepper.bind("qvel")[:] = starts.qpos, starts.qvel
    actions = np.random.default_rng(0).uniform(-1, 1, (control_steps, batch, model.nu))
    ctrl = stepper.bind("ctrl")

    def steps() -> int:
        for action in actions:
            ctrl[:] = action
            stepper.step(nstep=FRAME_SKIP)
        return batch * control_steps

    return steps


def gymnasium_single(task: str, control_steps: int) -> Callable[[], int]:
    """Return a function that steps one environment of OGBench in a Python loop."""
    env = ogbench_env(task)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (control_steps, *env.action_space.shape)).astype(np.float32)

    def steps() -> int:
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return control_steps

    return steps


def gymnasium_async(task: str, control_steps: int) -> Callable[[], int]:
    """Return a function that steps environments of OGBench in one worker process per core."""
    import gymnasium

    env = gymnasium.vector.AsyncVectorEnv([lambda: ogbench_env(task)] * CORES)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (control_steps, *env.action_space.shape)).astype(np.float32)

    def steps() -> int:
        for action in actions:
            env.step(action)
        return control_steps * CORES

    return steps


def ogbench_env(task: str) -> Any:
    """Return OGBench's single-task environment of the same name."""
    import gymnasium
    import ogbench  # noqa: F401  (registers the environments)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(f"{task}-singletask-v0")


def make_cell(kind: str, task: str, batch: int) -> Callable[[], int]:
    """Return the function whose calls are timed; it returns the number of environment steps it made."""
    if kind in ("mjx", "mjx-warp", "mujoco"):
        return ours(task, batch, kind, control_steps=50 if kind == "mujoco" else 5)
    if kind == "stock-mjx":
        return stock_mjx(task, batch)
    if kind == "bare":
        return bare(task, batch, control_steps=50)
    return gymnasium_single(task, 300) if kind == "gymnasium" else gymnasium_async(task, 300)


def measure(kind: str, task: str, batch: int, seconds: float) -> dict[str, Any]:
    """Call the cell once, then repeatedly for ``seconds``; return the rate over that time, first step and memory."""
    began = time.perf_counter()
    steps = make_cell(kind, task, batch)
    steps()
    first = time.perf_counter() - began
    made, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds or made == 0:
        made += steps()
    rate = made / (time.perf_counter() - began)
    memory = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    numbers = {"steps_per_second": round(rate, 1), "first_step_seconds": round(first, 1), "peak_mib": memory // 1024}
    return numbers | ({"device": sys.modules["jax"].devices()[0].device_kind} if "jax" in sys.modules else {})


# --- All cells ---------------------------------------------------------------------------------------------------


def run_cell(kind: str, task: str, batch: int, seconds: float, limit: float) -> dict[str, Any]:
    """Run ``measure`` in a process of its own; an error or a time limit is part of the result."""
    head = {"kind": kind, "task": task, "batch": batch}
    command = [sys.executable, __file__, "--cell", kind, task, str(batch), "--seconds", str(seconds)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=True)
    except subprocess.TimeoutExpired:
        return {**head, "error": f"did not finish in {limit:.0f} s"}
    except subprocess.CalledProcessError as error:
        return {**head, "error": (error.stderr.strip().splitlines() or [f"exit {error.returncode}"])[-1]}
    return {**head, **json.loads(done.stdout.splitlines()[-1])}


def cells(tasks: list[str], kinds: list[str], batches: list[int]) -> list[tuple[str, str, int]]:
    """Return all (kind, task, batch); the batch of gymnasium's environments is fixed."""
    fixed = {"gymnasium": [1], "async": [CORES]}
    return [(kind, task, batch) for task in tasks for kind in kinds for batch in fixed.get(kind, batches)]


def ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the speed of our 64 environments as ratios to the references, by task."""
    speed = {(row["kind"], row["task"], row["batch"]): row.get("steps_per_second") for row in rows}
    found = []
    for task in dict.fromkeys(row["task"] for row in rows):
        gyms = [speed.get(("gymnasium", task, 1)), speed.get(("async", task, CORES))]
        known = [rate for rate in gyms if rate]
        row = {
            "task": task,
            "mujoco / best gymnasium": _ratio(speed.get(("mujoco", task, 64)), max(known, default=None)),
            "mujoco / bare": _ratio(speed.get(("mujoco", task, 64)), speed.get(("bare", task, 64))),
            "mjx / stock-mjx": _ratio(speed.get(("mjx", task, 64)), speed.get(("stock-mjx", task, 64))),
        }
        found.append(row)
    return found


def _ratio(a: float | None, b: float | None) -> float | None:
    return round(a / b, 2) if a and b else None


def write(path: Path, rows: list[dict[str, Any]], seconds: float) -> None:
    """Write the JSON file, as a whole or not at all."""
    import jax
    import mujoco

    from qdos_brax.files import write_text

    machine = {"processor": platform.processor() or platform.machine(), "cores": CORES}
    versions = {"python": platform.python_version(), "jax": jax.__version__, "mujoco": mujoco.__version__}
    content = {"machine": machine | versions, "seconds": seconds, "cells": rows, "ratios": ratios(rows)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1) + "\n")


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=[kind for kind in KINDS if kind != "mjx-warp"])
    parser.add_argument("--batches", nargs="+", type=int, default=list(BATCHES))
    parser.add_argument("--seconds", type=float, default=5.0, help="length of one measurement (default: 5)")
    parser.add_argument("--limit", type=float, default=300.0, help="most seconds that a cell may take (default: 300)")
    parser.add_argument("--out", type=Path, help="JSON file for the result")
    parser.add_argument("--cell", nargs=3, metavar=("KIND", "TASK", "BATCH"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.cell:
        kind, task, batch = args.cell
        print(json.dumps(measure(kind, task, int(batch), args.seconds)))
        return
    rows = []
    print(f"{'task':20s} {'kind':10s} {'batch':>5s} {'steps/s':>9s} {'first, s':>8s} {'MiB':>6s}")
    for kind, task, batch in cells(args.tasks, args.kinds, args.batches):
        row = run_cell(kind, task, batch, args.seconds, args.limit)
        rows.append(row)
        numbers = (
            row["error"]
            if "error" in row
            else f"{row['steps_per_second']:9.1f} {row['first_step_seconds']:8.1f} {row['peak_mib']:6d}"
        )
        print(f"{task:20s} {kind:10s} {batch:5d} {numbers}", flush=True)
        if args.out:
            write(args.out, rows, args.seconds)
    for row in ratios(rows):
        print("  ".join(f"{key} {value}" for key, value in row.items() if value is not None))


if __name__ == "__main__":
    main()
