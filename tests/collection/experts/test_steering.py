"""Steering on states placed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes.maze import get_maze
from qdos_brax.collection.experts.steering import Navigator, approach, dribble_direction, maze_direction


@pytest.fixture(scope="module")
def medium() -> Navigator:
    return Navigator(get_maze("medium"))


@pytest.fixture(scope="module")
def arena() -> Navigator:
    return Navigator(get_maze("arena"))


def test_next_cell_then_the_goal_itself(medium: Navigator) -> None:
    # Cell (1, 1) is at (0, 0); its only ways out are (1, 2) at (4, 0) and (2, 1) at (0, 4).
    direction = maze_direction(medium, jnp.zeros(2), jnp.array([20.0, 20.0]))
    assert direction.tolist() in ([1.0, 0.0], [0.0, 1.0])
    inside = maze_direction(medium, jnp.array([1.0, 1.0]), jnp.array([-0.5, 1.0]))
    np.testing.assert_allclose(inside, [-1.0, 0.0], atol=1e-6)


def test_following_the_direction_reaches_every_free_cell(medium: Navigator) -> None:
    goals = medium.free_xy

    def walk(goal: jax.Array) -> jax.Array:
        def step(xy: jax.Array, _: None) -> tuple[jax.Array, None]:
            return xy + 0.2 * maze_direction(medium, xy, goal), None

        return jax.lax.scan(step, jnp.array([0.5, -0.5]), None, 400)[0]

    ends = jax.jit(jax.vmap(walk))(goals)
    assert float(jnp.linalg.norm(ends - goals, axis=-1).max()) < 0.3


def test_standing_on_the_goal_gives_no_nan(medium: Navigator) -> None:
    assert jnp.isfinite(maze_direction(medium, jnp.zeros(2), jnp.zeros(2))).all()


def test_sight_reaches_across_the_arena_but_not_through_walls(medium: Navigator, arena: Navigator) -> None:
    def far(navigator: Navigator, start: tuple[int, int], goal: tuple[int, int]) -> list[float]:
        a, b = (navigator.cell(navigator.maze.ij_to_xy(np.array(ij))) for ij in (start, goal))
        return navigator.centre(navigator.sight_cell[a, b]).tolist()

    assert far(arena, (1, 1), (6, 4)) == [12.0, 20.0]
    assert far(medium, (1, 1), (6, 6)) != [20.0, 20.0]


def test_the_ball_goes_straight_to_what_is_in_sight(medium: Navigator, arena: Navigator) -> None:
    ball, goal = jnp.array([8.0, 8.0]), jnp.array([16.0, 14.0])
    np.testing.assert_allclose(dribble_direction(arena, ball, goal), [0.8, 0.6], atol=1e-6)
    np.testing.assert_allclose(dribble_direction(arena, ball + 0.3, ball), [-(0.5**0.5)] * 2, atol=1e-6)


def test_a_ball_that_follows_gets_there_without_touching_walls(medium: Navigator) -> None:
    goal = jnp.array([20.0, 20.0])

    def roll(xy: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        xy = xy + 0.2 * dribble_direction(medium, xy, goal)
        return xy, xy

    end, path = jax.lax.scan(roll, jnp.zeros(2), None, 400)
    assert jnp.linalg.norm(end - goal) < 0.3
    ij = medium.maze.xy_to_ij(np.asarray(path))
    assert not medium.maze.grid[ij[:, 0], ij[:, 1]].any()


def test_a_ball_is_led_away_from_walls(arena: Navigator) -> None:
    # Cell (1, 1) is centred at the origin, its walls at x = -2 and y = -2; the berth is 3 m.
    np.testing.assert_allclose(arena.off_walls(jnp.zeros(2)), [1 / 3, 1 / 3], atol=1e-6)
    np.testing.assert_allclose(arena.off_walls(jnp.array([-1.5, 0.0])), [5 / 6, 1 / 3], atol=1e-6)
    np.testing.assert_allclose(arena.off_walls(jnp.array([0.0, 20.0])), [1 / 3, -1 / 3], atol=1e-6)
    np.testing.assert_allclose(arena.off_walls(jnp.array([1.5, 9.0])), [0.0, 0.0], atol=1e-6)
    along = dribble_direction(arena, jnp.array([0.0, 8.0]), jnp.array([0.0, 20.0]))
    np.testing.assert_allclose(along, np.array([0.5, 1.0]) / np.sqrt(1.25), atol=1e-6)


def test_a_ball_from_corner_to_corner_goes_in_an_arc(arena: Navigator) -> None:
    def roll(xy: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        xy = xy + 0.1 * dribble_direction(arena, xy, jnp.array([0.0, 20.0]))
        return xy, xy

    _, path = jax.lax.scan(roll, jnp.array([-1.0, -1.0]), None, 300)
    gap = np.asarray(path)[:, 0] + 2.0
    assert gap[50:150].min() > 2.5  # m from the wall on its way
    assert jnp.linalg.norm(path - jnp.array([0.0, 20.0]), axis=1).min() < 0.5


def test_the_way_to_the_ball(medium: Navigator, arena: Navigator) -> None:
    direction, in_sight = approach(arena, jnp.array([4.0, 4.0]), jnp.array([8.0, 7.0]))
    assert in_sight
    np.testing.assert_allclose(direction, [0.8, 0.6], atol=1e-6)
    direction, in_sight = approach(medium, jnp.zeros(2), jnp.array([20.0, 20.0]))
    assert not in_sight
    ij = medium.maze.xy_to_ij(4.0 * np.asarray(direction))
    assert medium.maze.grid[ij[0], ij[1]] == 0


def test_goals_so_many_cells_away(medium: Navigator, arena: Navigator) -> None:
    keys = jax.random.split(jax.random.key(0), 200)
    corner = arena.cell(jnp.zeros(2))  # in an open field the cells 4 away from the corner lie on one diagonal
    drawn = jax.vmap(lambda key: arena.random_xy_at(key, corner, 4))(keys)
    assert {tuple(xy) for xy in np.asarray(drawn).tolist()} == {(4.0 * k, 16.0 - 4.0 * k) for k in range(5)}
    near = medium.cell(jnp.zeros(2))  # in the maze they lie along the corridors: counted by hand on the map
    drawn = jax.vmap(lambda key: medium.random_xy_at(key, near, 2))(keys)
    assert {tuple(xy) for xy in np.asarray(drawn).tolist()} == {(4.0, 4.0)}
    nowhere = medium.random_xy_at(keys[0], near, 60)
    np.testing.assert_array_equal(nowhere, [0.0, 0.0])
