"""Count how often data of cubes or scene reach their goals: ``python benchmarks/goal_visits.py TASK FILE``.

A visit is a step at the goal after one that was not, or the first of an episode; degraded episodes count as well.
"""

from __future__ import annotations

import argparse

import numpy as np

import envs
from envs.manipulation.manipspace import ManipSpaceTask
from qdos_brax.data import formats


def main() -> None:
    """Print one line per goal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", help="cube-single, cube-double or scene")
    parser.add_argument("file", help="a data set with simulator states")
    args = parser.parse_args()
    env, rows = envs.make(args.task), formats.load(args.file)
    assert isinstance(env, ManipSpaceTask) and rows.qpos is not None
    episodes = np.cumsum(np.roll(rows.ends, 1)) - 1
    for description in env.descriptions:
        at_goal = env.in_place(rows.qpos, env.goal_of(description), rows.extra).all(axis=1)
        before = np.roll(at_goal, 1) & ~np.roll(rows.ends, 1)
        visits, seen = (at_goal & ~before).sum(), len(np.unique(episodes[at_goal]))
        times = f"{visits} visits, {at_goal.sum()} steps, in {seen} of {rows.ends.sum()} episodes"
        print(f"{description['task_name']}: {times}")


if __name__ == "__main__":
    main()
