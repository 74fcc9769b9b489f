"""Cells, coordinates, shortest paths."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes.maze import Maze, get_maze
from tests.envs.ogbench_reference import ogbench_env

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("name", ["medium", "giant", "teleport"])
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
    assert np.isinf(maze.distance(np.array([0.0, 0.0]), np.array([4.0, 4.0])))
    assert np.isinf(maze.distance(np.array([1.9, 1.0]), np.array([2.5, 3.9])))
    # medium has such a corner between (4, 2) and (5, 3): the way leads round three corners of the wall (5, 2)
    medium = get_maze("medium")
    around = medium.distance(medium.ij_to_xy((4, 2)), medium.ij_to_xy((5, 3)))
    assert around == pytest.approx(2 * np.hypot(2, 2) + 4 + 4)


def test_teleporters() -> None:
    maze = get_maze("teleport")
    send = jax.jit(jax.vmap(maze.teleport))
    entrances = maze.ij_to_xy(np.array(maze.teleporters.entrances))
    exits = maze.ij_to_xy(np.array(maze.teleporters.exits))
    keys = jax.random.split(jax.random.key(0), 3000)
    out = np.asarray(send(jnp.tile(jnp.asarray(entrances[1] + np.array([1.0, 1.0]), jnp.float32), (3000, 1)), keys))
    shares = [(out == xy).all(axis=1).mean() for xy in exits]
    np.testing.assert_allclose(shares, 1 / 3, atol=0.04)
    outside = jnp.asarray(entrances + np.array([1.51, 0.0]), jnp.float32)
    np.testing.assert_array_equal(send(outside, keys[:2]), outside)
    # walls alone make distances: the corridor through the entrance (4, 6) is as long as it looks, the exit is a trap
    through = maze.distance(maze.ij_to_xy((6, 6)), maze.ij_to_xy((3, 6)))
    assert through == pytest.approx(12.0) and np.isinf(maze.distance(exits[0], exits[1]))


def test_unknown_maze_is_named() -> None:
    with pytest.raises(ValueError, match=r"huge.*arena, medium"):
        get_maze("huge")
