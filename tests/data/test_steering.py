"""Steering on states placed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.maze import get_maze
from qdos_brax.experts.steering import Navigator, dribble_cost, dribble_direction, maze_direction, slide_along_walls


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


def test_behind_the_ball_it_pushes_towards_the_goal(arena: Navigator) -> None:
    ball, goal = jnp.array([8.0, 8.0]), jnp.array([16.0, 8.0])
    np.testing.assert_allclose(dribble_direction(arena, jnp.array([7.0, 8.0]), ball, goal), [1.0, 0.0], atol=1e-6)
    from_left = dribble_direction(arena, jnp.array([7.0, 8.3]), ball, goal)
    assert from_left[0] > 0.8 and from_left[1] < 0.0  # turns back into the lane


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_in_front_of_the_ball_it_walks_round_it(arena: Navigator, side: float) -> None:
    ball, goal = jnp.array([8.0, 8.0]), jnp.array([16.0, 8.0])
    agent = jnp.array([9.0, 8.0 + 0.1 * side])
    closest = 10.0
    for _ in range(80):
        agent = agent + 0.15 * dribble_direction(arena, agent, ball, goal)
        if agent[0] < 7.0 and abs(agent[1] - 8.0) < 1.6:  # in the lane behind the ball
            break
        closest = min(closest, float(jnp.linalg.norm(agent - ball)))
    assert agent[0] < 7.0
    assert closest > 0.9
    onward = dribble_direction(arena, agent, ball, goal)
    assert onward[0] > 0.0 and onward[1] * side < 0.0  # forward, and into the middle of the lane


def test_costs_of_a_dribble(arena: Navigator) -> None:
    ball, goal = jnp.array([8.0, 8.0]), jnp.array([16.0, 8.0])
    behind, before = jnp.array([6.0, 8.0]), jnp.array([10.0, 8.0])
    np.testing.assert_allclose(dribble_cost(arena, behind, ball, goal), 8.0, atol=1e-5)
    assert dribble_cost(arena, before, ball, goal) > 11.0
    at_wall = jnp.array([8.0, -1.5])
    assert dribble_cost(arena, behind, at_wall, jnp.array([8.0, 8.0])) > 1000.0
    assert dribble_cost(arena, behind, ball, ball) > 1000.0


def test_walls_are_slid_along(arena: Navigator) -> None:
    slope = jnp.array([0.6, -0.8])
    np.testing.assert_allclose(slide_along_walls(arena, jnp.array([8.0, 8.0]), slope), slope, atol=1e-6)
    np.testing.assert_allclose(slide_along_walls(arena, jnp.array([8.0, -1.5]), slope), [1.0, 0.0], atol=2e-3)
    assert jnp.isfinite(slide_along_walls(arena, jnp.array([-1.5, -1.5]), jnp.array([-0.6, -0.8]))).all()


def test_far_from_the_ball_it_follows_the_maze(medium: Navigator) -> None:
    agent, ball, goal = jnp.zeros(2), jnp.array([20.0, 20.0]), jnp.array([0.0, 0.0])
    direction = dribble_direction(medium, agent, ball, goal)
    np.testing.assert_allclose(jnp.linalg.norm(direction), 1.0, atol=1e-6)
    step = np.asarray(agent + 4.0 * direction)
    ij = medium.maze.xy_to_ij(step)
    assert medium.maze.grid[ij[0], ij[1]] == 0
