"""Choose what a demonstrator does next: anything, as in OGBench's play data, or what a task's goal asks for."""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.manipulation.manipspace import NEAR, ManipSpaceTask
from qdos_brax.collection.scripted.table import DRAWER_SPOT, Table, Target

LYING = 0.02  # m, of the centre of a cube on the table
_CUBE_SIZE = 0.04  # m
_ROOM = 0.08  # m, between the centres of cubes that do not get in each other's way
_STACKED = 0.125  # mean share of cubes that go on top of another
_INTO_DRAWER = 0.3  # share of cubes that go into an open drawer
_DRAWER_OPEN, _WINDOW_OPEN = -0.16, 0.2  # m
_LOCKED_WEIGHT = 0.25  # of moving what is locked; 1 for everything else


def any_target(env: ManipSpaceTask, table: Table, rng: np.random.Generator) -> Target:
    """Return a random thing to do, by the shares of OGBench's play data."""
    cubes = table.top_cubes()
    kinds = {"cube": float(bool(cubes))}
    if len(table.buttons):
        locked = np.where(table.buttons == 0, _LOCKED_WEIGHT, 1.0)
        kinds |= {"button": 1.0, "drawer": locked[0], "window": locked[1]}
    weights = np.array(list(kinds.values()))
    kind = str(rng.choice(list(kinds), p=weights / weights.sum()))
    if kind == "cube":
        return _any_cube(env, table, cubes, rng)
    if kind == "button":
        button = int(rng.integers(len(table.buttons)))
        return Target("button", button, value=1 - table.buttons[button])
    if kind == "drawer":
        return Target("drawer", value=_DRAWER_OPEN if table.slides[0] >= _DRAWER_OPEN / 2 else 0.0)
    return Target("window", value=_WINDOW_OPEN if table.slides[1] <= _WINDOW_OPEN / 2 else 0.0)


def _any_cube(env: ManipSpaceTask, table: Table, cubes: list[int], rng: np.random.Generator) -> Target:
    cube, yaw = int(rng.choice(cubes)), float(rng.uniform(0, 2 * np.pi))
    others = [other for other in cubes if other != cube]
    if len(table.slides) and table.slides[0] < 0.75 * _DRAWER_OPEN and rng.uniform() < _INTO_DRAWER:
        return Target("cube", cube, _drawer_spot(rng), yaw)
    if others and rng.uniform() < _STACKED:
        return Target("cube", cube, table.cubes[rng.choice(others)] + [0.0, 0.0, _CUBE_SIZE], yaw)
    return Target("cube", cube, np.array([*rng.uniform(*env.space.object_bounds), LYING]), yaw)


def _drawer_spot(rng: np.random.Generator) -> np.ndarray:
    return DRAWER_SPOT + np.array([*rng.uniform(-0.005, 0.005, 2), 0.0])


class GoalSeeker:
    """Choose the next thing to do on the way to the goal of one task of a variant.

    Args:
        env: any task of the variant.
        description: OGBench's description of the task.
    """

    def __init__(self, env: ManipSpaceTask, description: dict[str, Any]) -> None:
        self._env = env
        self.goal = env.goal_state(description)
        self._slides = self.goal.fixtures[len(self.goal.extra) :]
        # A place that high is in the drawer, unless it is on another cube.
        self._into_drawer = env.extra_size > 0 and self.goal.cubes[0, 2] > 2 * LYING

    def feasible(self, table: Table) -> bool:
        """Return whether it can be reached: no oracle takes a cube out of the drawer."""
        return self._into_drawer or not table.in_drawer(0)

    def next_target(self, table: Table, rng: np.random.Generator) -> Target | None:
        """Return the next thing to do; None where everything is in place."""
        if not len(table.slides):
            return self._next_cube(table, rng)
        if self._into_drawer and not table.in_drawer(0):
            ready = table.slides[0] < 0.75 * _DRAWER_OPEN
            return (
                Target("cube", 0, _drawer_spot(rng), rng.uniform(0, 2 * np.pi))
                if ready
                else self._slide(table, 0, _DRAWER_OPEN)
            )
        if not self._into_drawer and not self._placed(table)[0]:
            return Target("cube", 0, self.goal.cubes[0], rng.uniform(0, 2 * np.pi))
        for index, value in enumerate(self._slides):
            if abs(table.slides[index] - value) > NEAR / 2:
                return self._slide(table, index, value)
        wrong = np.flatnonzero(table.buttons != self.goal.extra)
        return Target("button", int(wrong[0]), value=int(self.goal.extra[wrong[0]])) if len(wrong) else None

    def _placed(self, table: Table) -> np.ndarray:
        return np.asarray(np.linalg.norm(table.cubes - self.goal.cubes, axis=1) <= NEAR)

    def _slide(self, table: Table, index: int, value: float) -> Target:
        """Return the move of the drawer or the window, or the button that has to be pressed before."""
        if table.buttons[index] == 0:
            return Target("button", index, value=1)
        return Target(("drawer", "window")[index], value=float(value))

    def _next_cube(self, table: Table, rng: np.random.Generator) -> Target | None:
        placed = self._placed(table)
        if placed.all():
            return None
        waiting = [cube for cube in table.top_cubes() if not placed[cube]]
        for cube in sorted(waiting, key=lambda cube: self.goal.cubes[cube, 2]):
            if self._is_ready(table, cube, placed):
                return Target("cube", cube, self.goal.cubes[cube], rng.uniform(0, 2 * np.pi))
        free = waiting or table.top_cubes()
        return Target("cube", int(rng.choice(free)), self._free_place(table, rng), rng.uniform(0, 2 * np.pi))

    def _is_ready(self, table: Table, cube: int, placed: np.ndarray) -> bool:
        """Return whether nothing lies where the cube has to be, and what it has to lie on is there."""
        place, others = self.goal.cubes[cube], np.arange(len(placed)) != cube
        if place[2] > 2 * LYING:
            return bool(placed[others].all())
        return bool((np.linalg.norm(table.cubes[others, :2] - place[:2], axis=1) > 1.5 * _CUBE_SIZE).all())

    def _free_place(self, table: Table, rng: np.random.Generator) -> np.ndarray:
        """Return a place on the table that is not in the way."""
        taken = np.concatenate([table.cubes[:, :2], self.goal.cubes[:, :2]])
        for _ in range(50):
            place = rng.uniform(*self._env.space.object_bounds)
            if (np.linalg.norm(taken - place, axis=1) > _ROOM).all():
                break
        return np.array([*place, LYING])
