"""Cells, coordinates, shortest paths."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.maze import Maze, get_maze
from tests.envs.ogbench_reference import ogbench_env


@pytest.mark.parametrize("name", ["medium", "giant"])
def test_next_step_table_equals_ogbench(name: str) -> None:
    maze = get_maze(name)
    reference = ogbench_env(f"antmaze-{name}-task1").unwrapped
    rng = np.random.default_rng(0)
    cells = maze.ij_to_xy(maze.free_cells)
    for _ in range(60):
        start, goal = cells[rng.integers(len(cells), size=2)] + rng.uniform(-1.9, 1.9, (2, 2))
        subgoal, _ = reference.get_oracle_subgoal(start, goal)
        ours = maze.next_step_table[maze.cell_index(start), maze.cell_index(goal)]
        np.testing.assert_array_equal(maze.index_to_xy(ours), subgoal)
        assert tuple(maze.xy_to_ij(start)) == reference.xy_to_ij(start)


def test_coordinates_work_in_jit() -> None:
    maze = get_maze("large")
    ij = maze.free_cells
    xy = jax.jit(maze.ij_to_xy)(jnp.asarray(ij))
    np.testing.assert_array_equal(xy, maze.ij_to_xy(ij))
    np.testing.assert_array_equal(jax.jit(maze.xy_to_ij)(xy + 1.9), ij)
    indices = jax.jit(maze.cell_index)(xy)
    np.testing.assert_array_equal(jax.jit(maze.index_to_xy)(indices), xy)
    assert maze.grid.reshape(-1)[np.asarray(indices)].sum() == 0


def test_distance_in_the_open_is_straight() -> None:
    maze = get_maze("arena")
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-2, 22, (2, 50, 2))
    np.testing.assert_allclose(maze.distance(a, b), np.linalg.norm(a - b, axis=-1), rtol=1e-12)


def test_distance_bends_at_corners() -> None:
    # a U-turn around a wall one cell thick: cells (1,1) and (3,1), wall (2,1), way through (2,2)
    grid = np.array([[1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]])
    maze = Maze("toy", grid)
    a, b = np.array([0.0, 0.0]), np.array([0.0, 8.0])
    # straight to the corner (2, 2), down along the wall to (2, 6), straight to b
    assert maze.distance(a, b) == pytest.approx(np.hypot(2, 2) + 4 + np.hypot(2, 2))
    assert maze.distance(a, np.array([4.0, 0.0])) == pytest.approx(4.0)
    # one bend: around (2, 2) to (4, 4)
    assert maze.distance(a, np.array([3.0, 5.0])) == pytest.approx(np.hypot(2, 2) + np.hypot(1, 3))
    # a point in the wall counts as the nearest free one
    assert maze.distance(np.array([0.0, 2.5]), a) == pytest.approx(2.0)


def test_distance_is_a_metric_and_sees_the_maze() -> None:
    maze = get_maze("giant")
    rng = np.random.default_rng(2)
    cells = maze.ij_to_xy(maze.free_cells)
    a, b, c = cells[rng.integers(len(cells), size=(3, 40))] + rng.uniform(-1.9, 1.9, (3, 40, 2))
    ab, bc, ac = maze.distance(a, b), maze.distance(b, c), maze.distance(a, c)
    np.testing.assert_allclose(ab, maze.distance(b, a), rtol=1e-9)
    assert (ac <= ab + bc + 1e-9).all()
    assert (ab >= np.linalg.norm(a - b, axis=-1) - 1e-9).all()
    # one goal for many points is the same as the pairs one by one
    np.testing.assert_allclose(maze.distance(a, b[0]), maze.distance(a, np.tile(b[:1], (40, 1))))


def test_distance_never_passes_between_touching_walls() -> None:
    # two walls that touch only at a corner close the way: from (1,1) to (2,2) around is impossible
    grid = np.array([[1, 1, 1, 1], [1, 0, 1, 1], [1, 1, 0, 1], [1, 1, 1, 1]])
    maze = Maze("toy", grid)
    corner = maze.distance(np.array([0.0, 0.0]), np.array([4.0, 4.0]))
    assert corner == pytest.approx(np.hypot(4, 4)) or np.isinf(corner)


def test_unknown_maze_is_named() -> None:
    with pytest.raises(ValueError, match=r"huge.*arena, medium"):
        get_maze("huge")
