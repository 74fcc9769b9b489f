"""Count how often data of cubes, scene or kitchen reach their goals: ``python benchmarks/goal_visits.py TASK FILE``.

Goals are the five tasks' of cubes and scene, and a kitchen's subtasks, one by one and all four of the task. A visit is
a step at the goal after one that was not, or the first of an episode; degraded behaviour counts as well, and once more
without it where the file says what is.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from table import aligned, write_rows

import envs
from envs.manipulation.manipspace import ManipSpaceTask
from qdos_brax.data import formats
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError, guarded


def at_goals(env: Any, rows: Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, bool[N]) of each goal, whether the rows are at it.

    Raises:
        UserError: the task has no such goals, or the file no simulator states.
    """
    if rows.qpos is None:
        raise UserError("the file has no simulator states, which tell where things are")
    if isinstance(env, ManipSpaceTask):
        for description in env.descriptions:
            goal = env.goal_of(description)
            yield description["task_name"], env.in_place(rows.qpos, goal, rows.extra).all(axis=1)
        return
    parts = env.parts(rows)
    if not parts:
        raise UserError("the task has no parts; give a cube's, a scene's or a kitchen's")
    yield from parts.items()
    yield "all of them", np.all(list(parts.values()), axis=0)


def visits(at_goal: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return bool[N], the rows ``at_goal`` (bool[N]) after one that was not, or first in an episode."""
    return at_goal & ~(np.roll(at_goal, 1) & ~np.roll(ends, 1))


def counts(env: Any, rows: Dataset) -> list[dict[str, Any]]:
    """Return a row per goal."""
    episodes = np.cumsum(np.roll(rows.ends, 1)) - 1
    found = []
    for name, at_goal in at_goals(env, rows):
        begun = visits(at_goal, rows.ends)
        row = {"task": env.spec.full_name, "goal": name, "visits": int(begun.sum())}
        if rows.quality is not None:
            row["visits in good rows"] = int((begun & (rows.quality == QUALITY["navigate"])).sum())
        row |= {"steps": int(at_goal.sum()), "episodes": len(np.unique(episodes[at_goal]))}
        found.append(row | {"of episodes": int(rows.ends.sum()), "transitions": rows.size})
    return found


def main() -> None:
    """Print a line per goal, and write a CSV if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="cube-single, cube-double, scene, kitchen-mixed ..")
    parser.add_argument("file", type=Path, help="a data set with simulator states")
    parser.add_argument("--out", metavar="FILE", type=Path, help="a CSV to write")
    args = parser.parse_args()
    rows = counts(envs.make(args.task, physics="mujoco"), formats.load(args.file))
    print(aligned([list(rows[0]), *([str(value) for value in row.values()] for row in rows)]), end="")
    if args.out:
        write_rows(args.out, rows)


if __name__ == "__main__":
    raise SystemExit(guarded(main))
