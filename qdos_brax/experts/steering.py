"""Where to walk: from (state, goal) to a direction, cell by cell through a maze, or round a ball and through it.

Pure functions of a single state, for use inside jit and under vmap. A ``Navigator`` holds the maze's paths as device
tables, so that a shortest path costs one look-up per step.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.maze import UNIT, Maze

_CORRIDOR = 1.2  # m to either side of a straight line that must be free: the reach of the ant's legs

# The dribble: round the ball on a circle that the legs do not touch it from, then through it; lengths in m.
_CIRCLE = 2.0  # radius of the circle
_PULL = 1.1  # turn towards the circle per m beside it
_LANE = 0.8  # half width of the lane behind the ball in which the ant pushes
_FUNNEL = 0.75  # the lane widens by this much per m behind the ball
_STEER = 2.0  # turn of the push per m of lateral offset


class Navigator:
    """A maze's shortest paths as device tables over cell indices (C = number of cells).

    Args:
        maze: the layout.
    """

    def __init__(self, maze: Maze) -> None:
        self.maze = maze
        self.next_cell = jnp.asarray(maze.next_step_table)  # int32[C, C], the neighbour to enter, from row to column
        self.sight_cell = jnp.asarray(_farthest_in_sight(maze))  # int32[C, C], the last cell a straight walk reaches
        self._free = jnp.asarray(maze.grid.reshape(-1) == 0)
        indices = maze.cell_index(maze.ij_to_xy(maze.free_cells))
        leads_on = (maze.next_step_table[indices] != indices[:, None]).any(axis=1)  # not walled in on all sides
        self.free_xy = jnp.asarray(maze.ij_to_xy(maze.free_cells[leads_on]), jnp.float32)  # float32[F, 2]

    def cell(self, xy: jax.Array) -> jax.Array:
        """int32[...], the index of the cell that holds ``xy[..., 2]``."""
        return self.maze.cell_index(xy)

    def centre(self, cell: jax.Array) -> jax.Array:
        """float32[..., 2], the centre of ``cell[...]``."""
        return self.maze.index_to_xy(cell)

    def is_free(self, xy: jax.Array) -> jax.Array:
        """bool[...], whether ``xy[..., 2]`` lies in a free cell."""
        return self._free[self.cell(xy)]

    def random_free_xy(self, key: jax.Array) -> jax.Array:
        """The centre[2] of a free cell, uniformly drawn."""
        return jax.random.choice(key, self.free_xy)


def maze_direction(maze: Navigator, xy: jax.Array, goal_xy: jax.Array) -> jax.Array:
    """Unit vector[2] from ``xy`` towards the centre of the next cell on a shortest path, or the goal in its cell."""
    here, there = maze.cell(xy), maze.cell(goal_xy)
    return unit_vector(jnp.where(here == there, goal_xy, maze.centre(maze.next_cell[here, there])) - xy)


def dribble_direction(maze: Navigator, agent_xy: jax.Array, ball_xy: jax.Array, goal_xy: jax.Array) -> jax.Array:
    """Unit vector[2] in which an ant at ``agent_xy`` walks to bring the ball to ``goal_xy``.

    Far from the ball it follows a shortest path; near it, it walks round the ball to a spot behind it and then through
    it, turning against its lateral offset. The ball is pushed straight at the farthest cell of its path in sight.
    """
    here, ball, goal = maze.cell(agent_xy), maze.cell(ball_xy), maze.cell(goal_xy)
    waypoint = maze.sight_cell[ball, goal]
    target = jnp.where((ball == goal) | (waypoint == goal), goal_xy, maze.centre(waypoint))
    forward = unit_vector(target - ball_xy)
    left = jnp.stack([-forward[1], forward[0]])
    offset = agent_xy - ball_xy
    along, aside = offset @ forward, offset @ left

    push = unit_vector(forward - _STEER * aside * left)
    distance = jnp.linalg.norm(offset)
    outward = unit_vector(offset)
    side = jnp.where(aside >= 0, 1.0, -1.0)
    round_it = side * jnp.stack([-outward[1], outward[0]])  # the way along the circle that leads behind the ball
    approach = unit_vector(round_it + _PULL * (_CIRCLE - distance) * outward)
    behind = (along < 0.0) & (jnp.abs(aside) < _LANE - _FUNNEL * along)
    near = jnp.where(behind, push, slide_along_walls(maze, agent_xy, approach))

    meeting = maze.sight_cell[here, ball]
    in_sight = (here == ball) | (meeting == ball)
    return jnp.where(in_sight, near, unit_vector(maze.centre(meeting) - agent_xy))


def dribble_cost(maze: Navigator, agent_xy: jax.Array, ball_xy: jax.Array, goal_xy: jax.Array) -> jax.Array:
    """How far, in m, the ant walks to the spot behind the ball and then with it; much more where a wall is in the way.

    A goal at which the ball lies already costs as much as one that needs a spot inside a wall.
    """
    way = goal_xy - ball_xy
    spot = ball_xy - _CIRCLE * unit_vector(way)
    gap = jnp.linalg.norm(way)
    useless = ~maze.is_free(spot) | (gap < 1.0)
    return gap + jnp.linalg.norm(spot - agent_xy) + jnp.where(useless, 1e3, 0.0)


def slide_along_walls(maze: Navigator, xy: jax.Array, direction: jax.Array) -> jax.Array:
    """``direction[2]`` without its component into a wall that the legs would touch."""
    probes = xy + _CORRIDOR * jnp.diag(jnp.sign(direction))
    return unit_vector(jnp.where(maze.is_free(probes), direction, 0.0) + 1e-3 * direction)


def unit_vector(vector: jax.Array) -> jax.Array:
    """``vector[2]`` at length one; zero stays zero."""
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)


def _farthest_in_sight(maze: Maze) -> np.ndarray:
    """int32[C, C]: the last cell of each shortest path that, like all before it, a straight free corridor reaches."""
    table = maze.next_step_table.copy()
    free = maze.cell_index(maze.ij_to_xy(maze.free_cells))
    for start in free:
        reachable = {goal: _is_free_corridor(maze, start, goal) for goal in free}
        for goal in free:
            cell = farthest = maze.next_step_table[start, goal]
            if cell == start:  # it is the goal, or cut off from it
                continue
            while cell != goal and reachable[cell := maze.next_step_table[cell, goal]]:
                farthest = cell
            table[start, goal] = farthest
    return table


def _is_free_corridor(maze: Maze, start: int, goal: int) -> bool:
    """Whether no wall lies within the corridor between two cells' centres, by samples an eighth of a cell apart."""
    a, b = maze.index_to_xy(start), maze.index_to_xy(goal)
    length = float(np.linalg.norm(b - a))
    if length == 0:
        return True
    along = np.linspace(0.0, 1.0, int(np.ceil(8 * length / UNIT)) + 1)[:, None, None]
    across = np.array([-_CORRIDOR, 0.0, _CORRIDOR])[None, :, None]
    normal = np.array([-(b - a)[1], (b - a)[0]]) / length
    ij = maze.xy_to_ij(a + along * (b - a) + across * normal)
    return not maze.grid[ij[..., 0], ij[..., 1]].any()
