"""Measure the cost of collecting: ``python benchmarks/collection.py [--tasks TASK ..] [--out FILE]``.

Compare collected steps per second (experts, steering, observation, transfer to the host: everything but writing the
file) with the bare engine: the same starts and actions, stepped in jit with nothing around it. The two take turns,
chunk by chunk, so that a machine whose speed varies slows down both; the share is the median over the turns.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from qdos_brax.collection.collector import CHUNK_STEPS, Collector
from qdos_brax.collection.profiles import profile_of
from qdos_brax.collection.recipes import degraded, episode_kinds
from qdos_brax.files import write_text

TASKS = ("antmaze-large", "antsoccer-arena", "humanoidmaze-medium")


def measure(task: str, num_envs: int, turns: int) -> dict[str, Any]:
    """Return steps per second of both, and the share, over ``turns`` chunks of CHUNK_STEPS steps per environment."""
    env = envs.make(task, physics="mujoco")
    recipe = degraded(0.5, profile_of(env))
    collector = Collector(env, recipe)
    kinds = jnp.asarray(episode_kinds(recipe.mix, num_envs, seed=0))
    states = collector.reset(jax.random.split(jax.random.key(0), num_envs))

    @partial(jax.jit, donate_argnums=0)
    def bare(pipeline: Any, actions: jax.Array) -> Any:
        def step(pipeline: Any, actions: jax.Array) -> tuple[Any, None]:
            return jax.vmap(env.engine.step)(pipeline, actions), None

        return jax.lax.scan(step, pipeline, jnp.swapaxes(actions, 0, 1))[0]

    collecting, stepping = [], []
    for turn in range(turns + 1):  # the first compiles
        keys = jax.random.split(jax.random.fold_in(jax.random.key(1), turn), num_envs)
        start = jax.tree.map(jnp.copy, states.pipeline)
        began = time.perf_counter()
        states, rows = collector.chunk(states, kinds, keys)
        rows = jax.device_get(rows)
        halfway = time.perf_counter()
        jax.block_until_ready(bare(start, rows.action))
        collecting.append(halfway - began)
        stepping.append(time.perf_counter() - halfway)
    steps = num_envs * CHUNK_STEPS
    return {
        "task": task,
        "num_envs": num_envs,
        "collected_per_second": round(steps / statistics.median(collecting[1:]), 1),
        "bare_per_second": round(steps / statistics.median(stepping[1:]), 1),
        "share": round(statistics.median(b / a for a, b in zip(collecting[1:], stepping[1:], strict=True)), 3),
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help=f"tasks (default {' '.join(TASKS)})")
    parser.add_argument("--num-envs", type=int, default=64, help="environments stepped at once (default 64)")
    parser.add_argument("--turns", type=int, default=10, help="chunks measured (default 10)")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    rows = []
    for task in args.tasks:
        rows.append(measure(task, args.num_envs, args.turns))
        print(json.dumps(rows[-1]), flush=True)
    if args.out:
        write_text(args.out, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
