"""Measure steered experts in a maze: ``python benchmarks/steered.py TASK [--noise 0 0.2] [--goal task random]``.

Episodes begin as the task begins them and have its length; the collector's own navigation leads the body to the task's
goal, or to random ones as in data, and gets it up when it falls. Prints for each: the share of episodes that reach the
goal (to random goals: arrivals per episode) and after how many steps, the share up after 5 and 8 s, falls per 1,000
steps of walking, the share of steps on the floor after 8 s, and how far from a wall the falls begin.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from table import write_rows

import envs
from envs.mazes.maze import Maze
from qdos_brax.collection import recipes
from qdos_brax.collection.collector import Collector
from qdos_brax.collection.experts.poses import humanoid_is_up
from qdos_brax.collection.experts.rising import LIES, WALKS
from qdos_brax.collection.experts.turning import gaps
from qdos_brax.collection.profiles import profile_of

RATE = 40  # control steps of a humanoid per second
AT_WALL = 1.0  # m from a wall's face


class Played(NamedTuple):
    """Hold whole episodes, [episodes, steps, ..]: states before each action, stages, and goals reached."""

    qpos: np.ndarray
    stage: np.ndarray
    arrivals: np.ndarray


def play(env: Any, noise: float, goal: str, count: int, seed: int) -> Played:
    """Steer ``count`` bodies for an episode, to the task's goal or to random ones."""
    # Both lead an expert alike; stitch keeps its goal.
    recipe = recipes.named("stitch" if goal == "task" else "navigate", profile_of(env), noise)
    collector = Collector(env, recipe)
    start_key, task_key, step_key = jax.random.split(jax.random.key(seed), 3)
    states = collector.reset(jax.random.split(start_key, count))
    if goal == "task":
        begun = jax.jit(jax.vmap(env.reset))(jax.random.split(task_key, count))
        xy = begun.pipeline_state.qpos[:, :2]
        states = states.replace(
            pipeline=begun.pipeline_state,
            observation=begun.obs,
            goal_xy=jnp.tile(env.goal_xy, (count, 1)),
            **dict.fromkeys(("origin_xy", "escape_xy", "checked_body", "checked_object"), xy),
        )
    rows, states = collector.run(states, np.zeros(count, np.int8), env.episode_length, step_key)
    qpos, qvel = (rows[name].reshape(count, env.episode_length, -1) for name in ("infos/qpos", "infos/qvel"))
    return Played(qpos, stages(collector, qpos, qvel), np.asarray(states.arrivals))


def stages(collector: Collector, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return int[episodes, steps], what the recovery did, followed again along the states."""
    follow = jax.vmap(collector.recovery.follow)

    def step(memory: jax.Array, row: Any) -> tuple[jax.Array, jax.Array]:
        memory = follow(memory, *row)
        return memory, memory[:, 0]

    memory = jnp.tile(collector.recovery.begin(), (len(qpos), 1))
    along = np.swapaxes(qpos, 0, 1), np.swapaxes(qvel, 0, 1)
    return np.asarray(jax.jit(lambda rows: jax.lax.scan(step, memory, rows)[1])(along)).T


def on_foot(layout: Maze, played: Played, steps: np.ndarray) -> dict[str, float]:
    """Return how walking goes from 8 s on, in the first ``steps[episodes]`` control steps of each."""
    stage, is_up = played.stage[:, :-1], np.asarray(humanoid_is_up(played.qpos))
    index = np.arange(stage.shape[1])
    late = (index >= 8 * RATE) & (index < steps[:, None])
    walks = late & (stage == WALKS)
    falls = walks & (played.stage[:, 1:] == LIES)
    near = gaps(layout, played.qpos[:, :-1, :2]) < AT_WALL
    return {
        "up_5s": is_up[:, 5 * RATE - 1].mean(),
        "up_8s": is_up[:, 8 * RATE - 1].mean(),
        "falls": falls.sum(),
        "falls_per_1000": 1000 * falls.sum() / walks.sum(),
        "down": 1 - is_up[:, :-1][late].mean(),
        "falls_at_walls": near[falls].mean() if falls.any() else np.nan,
        "walking_at_walls": near[walks].mean(),
    }


def measure(env: Any, noise: float, goal: str, count: int, seed: int) -> dict[str, Any]:
    """Return one row of the table."""
    played = play(env, noise, goal, count, seed)
    row = {"task": env.spec.name, "goal": goal, "noise": noise, "episodes": count, "seed": seed}
    steps = np.full(count, env.episode_length)
    found = {"arrivals": played.arrivals.mean()}
    if goal == "task":
        success = env.success(played.qpos, env.goal_xy)
        reached = success.any(axis=1)
        steps = np.where(reached, success.argmax(axis=1), steps)
        found = {"reached": reached.mean(), "steps_median": np.median(steps), "steps_90": np.quantile(steps, 0.9)}
    return row | {k: round(float(v), 3) for k, v in (found | on_foot(env.layout, played, steps)).items()}


def main() -> None:
    """Print a line for each noise and kind of goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="a task of humanoidmaze")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.2], help="of the actions (default 0 0.2)")
    parser.add_argument("--goal", nargs="+", choices=["task", "random"], default=["task"], help="(default task)")
    parser.add_argument("--episodes", type=int, default=64, help="of each (default 64)")
    parser.add_argument("--seed", type=int, default=0, help="(default 0)")
    parser.add_argument("--out", metavar="FILE", type=Path, help="a CSV to write")
    args = parser.parse_args()
    env = envs.make(args.task, physics="mujoco")
    rows = []
    for goal in args.goal:
        for noise in args.noise:
            rows.append(measure(env, noise, goal, args.episodes, args.seed))
            print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if args.out:
        write_rows(args.out, rows)


if __name__ == "__main__":
    main()
