"""Steering of a body that turns in a curve: the circle by hand, paths on the map, walks of such a body."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes.maze import get_maze
from qdos_brax.collection.experts.steering import CellSteering, Navigator, maze_direction
from qdos_brax.collection.experts.turning import (
    GENTLE,
    RADIUS,
    CurvedSteering,
    gaps,
    grid_points,
    is_circled,
    points_ahead,
)

MEDIUM = get_maze("medium")


@pytest.fixture(scope="module")
def steering() -> CurvedSteering:
    return CurvedSteering(Navigator(MEDIUM))


def body(x: float, y: float, yaw: float) -> jax.Array:
    return jnp.zeros(28).at[:2].set(jnp.array([x, y])).at[3].set(np.cos(yaw / 2)).at[6].set(np.sin(yaw / 2))


def angle_between(direction: jax.Array, yaw: float) -> float:
    return float(np.angle(complex(*direction) * np.exp(-1j * yaw)))


@pytest.mark.parametrize(
    ("target", "circled"),
    [
        ((0.0, 1.0), True),  # beside it
        ((0.0, -2 * RADIUS + 0.01), True),  # the circle's other end
        ((0.0, 2 * RADIUS + 0.01), False),
        ((3.0, 0.0), False),  # ahead, and behind: a circle touches its course in one point alone
        ((-1.0, 0.0), False),
        ((RADIUS, RADIUS + 0.01), False),  # a quarter of the circle leads there
        ((RADIUS - 0.02, RADIUS), True),
    ],
)
def test_what_lies_in_the_turning_circle(target: tuple[float, float], circled: bool) -> None:
    assert bool(is_circled(jnp.array(target))) == circled


def test_gaps_by_hand() -> None:
    # Cell (1, 1) is centred at the origin, with walls at x = -2 and y = -2; cell (1, 3), at x = 8, is one too.
    np.testing.assert_allclose(gaps(MEDIUM, np.array([[0, 0], [-1.5, 0], [8, 0], [5.5, 0.0]])), [2, 0.5, 0, 0.5])


def test_paths_lead_ahead_keep_off_walls_and_end_at_the_goal() -> None:
    cells, points = points_ahead(MEDIUM)
    grid = grid_points(MEDIUM)
    free = gaps(MEDIUM, grid) > 0
    for cell, ahead in zip(cells, points, strict=True):
        centre = MEDIUM.index_to_xy(cell)
        far = np.linalg.norm(grid - centre, axis=-1) > 5
        moved = np.linalg.norm(ahead - grid, axis=-1)[free & far]
        assert moved.min() > 1.5 and moved.max() < 4.0  # 2.5 m along a path that bends, in steps of up to 1.1 m
        assert (gaps(MEDIUM, ahead[free]) >= 0.25).all()
        near = np.linalg.norm(grid - centre, axis=-1) < 1
        np.testing.assert_allclose(ahead[near], np.broadcast_to(centre, ahead[near].shape), atol=1e-6)
    # Along the wall of the corridor x = 0 to 4 of cells (1, 1) and (1, 2), the way to (1, 2) leads into its middle.
    row, column = 8 + 0, 8 + 4  # half a metre from the wall y = -2
    ahead = points[list(cells).index(MEDIUM.cell_index(np.array([4.0, 0.0])))][row, column]
    assert ahead[1] > grid[row, column, 1] + 0.4


def test_it_turns_gently_in_the_open_and_sharply_before_a_wall(steering: CurvedSteering) -> None:
    goal = jnp.array([20.0, 20.0])
    for yaw in np.linspace(-3, 3, 9):
        in_the_open = steering(body(2.0, 2.0, yaw), goal)  # four free cells meet there
        assert abs(angle_between(in_the_open, yaw)) <= GENTLE + 1e-4
    before_wall = steering(body(-1.0, 0.0, np.pi), goal)
    assert abs(angle_between(before_wall, np.pi)) > np.pi / 2


def test_a_goal_it_would_go_round_is_turned_to_sharply(steering: CurvedSteering) -> None:
    beside = steering(body(4.0, 0.7, 0.0), jnp.array([4.0, 0.0]))
    assert angle_between(beside, 0.0) == pytest.approx(-2.5, abs=1e-4)
    ahead = steering(body(2.5, 0.0, 0.0), jnp.array([4.0, 0.0]))
    np.testing.assert_allclose(ahead, [1.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("name", ["medium", "large"])
def test_a_body_that_turns_as_the_humanoid_does_comes_to_every_goal_clear_of_walls(name: str) -> None:
    """Measured of the walker: at 0.9 rad it turns by 1.2 rad/s, at 1.2 rad by 2.4, and walks at 1.3 and 0.9 m/s."""
    navigator = Navigator(get_maze(name))
    steer = CurvedSteering(navigator)
    goals = navigator.free_xy[jnp.arange(64) % len(navigator.free_xy)]
    starts = jnp.roll(goals, 5, axis=0)
    x, y = jax.vmap(maze_direction, in_axes=(None, 0, 0))(navigator, starts, goals).T
    yaws = jnp.arctan2(y, x) + jax.random.uniform(jax.random.key(0), (64,), minval=-1.5, maxval=1.5)

    def walk(start: jax.Array, yaw: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            xy, yaw = carry
            qpos = jnp.zeros(28).at[:2].set(xy).at[3].set(jnp.cos(yaw / 2)).at[6].set(jnp.sin(yaw / 2))
            x, y = steer(qpos, goal)
            angle = jnp.clip((jnp.arctan2(y, x) - yaw + jnp.pi) % (2 * jnp.pi) - jnp.pi, -1.2, 1.2)
            rate = jnp.interp(jnp.abs(angle), jnp.array([0, 0.9, 1.2]), jnp.array([0, 1.2, 2.4])) * jnp.sign(angle)
            speed = jnp.interp(jnp.abs(angle), jnp.array([0.9, 1.2]), jnp.array([1.3, 0.9]))
            xy = xy + 0.025 * speed * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
            return (xy, yaw + 0.025 * rate), xy

        path = jax.lax.scan(step, (start, yaw), None, 4000)[1]
        return path, jnp.linalg.norm(path - goal, axis=1)

    paths, left = map(np.asarray, jax.jit(jax.vmap(walk))(starts, yaws, goals))
    assert (left.min(axis=1) < 0.5).all()
    until = np.arange(4000) <= (left < 0.5).argmax(axis=1)[:, None]
    assert np.quantile(gaps(navigator.maze, paths[until]), 0.01) > 0.4


def test_an_ant_goes_from_cell_to_cell() -> None:
    navigator, goal = Navigator(MEDIUM), jnp.array([20.0, 20.0])
    qpos = jnp.zeros(15).at[:2].set(jnp.array([0.5, -0.5]))
    np.testing.assert_array_equal(CellSteering(navigator)(qpos, goal), maze_direction(navigator, qpos[:2], goal))
