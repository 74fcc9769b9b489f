"""Where a body goes while data is collected: its goals, its detours when it is stuck, and the way back of a failure."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.mazes.maze_task import GOAL_TOLERANCE, START_NOISE, MazeTask
from envs.mazes.soccer import BALL_QPOS
from envs.render import steps_per_second
from qdos_brax.collection.experts.steering import Navigator
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.collection.recipes import CollectionRecipe
from qdos_brax.collection.rollout_state import Draws, RolloutState
from qdos_brax.data.quality import QUALITY

WANDER_SECONDS = 3.0  # mean time between two draws of a wandering body's direction, unless the recipe sets it

# The stuck rule: checked every CHECK_SECONDS; a stuck body takes a new goal and first walks elsewhere for
# ESCAPE_SECONDS.
CHECK_SECONDS = 6.0
ESCAPE_SECONDS = 3.0
STUCK_MOVE = 0.5  # m within CHECK_SECONDS, of the body, or of a ball next to it
AT_BALL = 2.0  # m
WITH_BALL = 0.5  # share of soccer's short episodes (stitch) that involve the ball
PATIENCE_SECONDS = 20.0  # after this time a failing attempt turns round wherever it is


class Planner:
    """Apply the rules that choose goals and headings, for one environment at a time.

    Args:
        env: the task.
        recipe: what is collected.
        has_dribbler: whether the expert can move a ball, which then is the target object.

    Attributes:
        navigator: the maze's shortest paths.
    """

    def __init__(self, env: MazeTask, recipe: CollectionRecipe, has_dribbler: bool) -> None:
        self.recipe, self.has_dribbler = recipe, has_dribbler
        self.navigator = Navigator(env.layout)
        self._action_size = env.action_size
        rate = steps_per_second(env)
        self._check_every, self._escape_steps = round(CHECK_SECONDS * rate), round(ESCAPE_SECONDS * rate)
        self._wander_steps, self._patience = round(WANDER_SECONDS * rate), round(PATIENCE_SECONDS * rate)
        self._heading_steps = recipe.heading_seconds and round(recipe.heading_seconds * rate)

    def draw(self, key: jax.Array) -> Draws:
        """Draw all random numbers that one step of one environment may need."""
        plan_key, noise_key, teleport_key = jax.random.split(key, 3)
        goal_key, escape_key, turn_key, heading_key = jax.random.split(plan_key, 4)
        return Draws(
            goal_xy=self.navigator.random_free_xy(goal_key),
            escape_xy=self.navigator.random_free_xy(escape_key),
            turn=jax.random.uniform(turn_key),
            heading=random_direction(heading_key),
            noise=jax.random.normal(noise_key, (self._action_size,)),
            teleport=teleport_key,
        )

    def start_xy(self, key: jax.Array) -> jax.Array:
        """Draw a start position[2]: a free cell's centre plus the task's start noise."""
        cell_key, shift_key = jax.random.split(key)
        shift = jax.random.uniform(shift_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
        return self.navigator.random_free_xy(cell_key) + shift

    def ball_start(self, key: jax.Array, body: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw (the ball's start position[2], bool: the episode is about the ball) for a body at ``body[2]``.

        A short episode leaves no time to fetch the ball, so in a share WITH_BALL of them it starts next to the body and
        the other episodes are about the body alone.
        """
        share_key, ball_key = jax.random.split(key)
        ball_xy = self.start_xy(ball_key)
        if self.recipe.goal_cells is None:
            return ball_xy, jnp.ones((), bool)
        has_ball = jax.random.uniform(share_key) < WITH_BALL
        shift = jax.random.uniform(ball_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
        beside = self.navigator.centre(self.navigator.cell(body)) + shift
        return jnp.where(has_ball, beside, ball_xy), has_ball

    def first_goal(self, key: jax.Array, object_xy: jax.Array) -> jax.Array:
        """Draw an episode's first goal: a free cell's centre[2], at the recipe's distance from ``object_xy[2]``."""
        if self.recipe.goal_cells is None:
            return self.navigator.random_free_xy(key)
        return self.navigator.random_xy_at(key, self.navigator.cell(object_xy), self.recipe.goal_cells)

    def positions(self, state: RolloutState) -> tuple[jax.Array, jax.Array]:
        """Return the xy[2] of the body and of the target object."""
        qpos = state.pipeline.qpos
        body = qpos[:2]
        if not self.has_dribbler:
            return body, body
        return body, jnp.where(state.has_ball, qpos[BALL_QPOS : BALL_QPOS + 2], body)

    def plan(self, state: RolloutState, kind: jax.Array, draws: Draws) -> RolloutState:
        """Update the plan before a step: new goals and headings, ways back, and detours of stuck bodies.

        Args:
            state: the environment.
            kind: int8, the episode's behaviour, see ``recipes.BEHAVIOURS``.
            draws: the step's random numbers.
        """
        body, target_object = self.positions(state)
        gap = jnp.linalg.norm(target_object - state.goal_xy)
        turns, undone = self._failing(state, kind, target_object, gap)
        checks = (state.episode_steps % self._check_every == 0) & (state.episode_steps > 0)
        stuck = checks & _is_stuck(state, body, target_object)
        arrived = ~state.returning & (gap < GOAL_TOLERANCE)
        redraw = undone | stuck | arrived if self.recipe.goal_cells is None else jnp.zeros((), bool)
        return state.replace(
            goal_xy=jnp.where(redraw, draws.goal_xy, state.goal_xy),
            origin_xy=jnp.where(redraw, target_object, state.origin_xy),
            returning=jnp.where(redraw, False, state.returning | turns),
            attempt_steps=jnp.where(redraw | turns, 0, state.attempt_steps),
            heading=jnp.where(self._heads_anew(state, draws), draws.heading, state.heading),
            escape_xy=jnp.where(stuck, draws.escape_xy, state.escape_xy),
            escape_steps=jnp.where(stuck, self._escape_steps, state.escape_steps),
            arrivals=state.arrivals + (arrived & redraw),
            checked_body=jnp.where(checks, body, state.checked_body),
            checked_object=jnp.where(checks, target_object, state.checked_object),
        )

    def _failing(
        self, state: RolloutState, kind: jax.Array, target_object: jax.Array, gap: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return whether a failing attempt turns round now, and whether one is back where it began."""
        half_way = gap < 0.5 * jnp.linalg.norm(state.origin_xy - state.goal_xy)
        impatient = state.attempt_steps >= self._patience
        turns = (kind == QUALITY["fail"]) & ~state.returning & (half_way | impatient)
        is_back = jnp.linalg.norm(target_object - state.origin_xy) < 2 * GOAL_TOLERANCE
        return turns, state.returning & (is_back | impatient)

    def _heads_anew(self, state: RolloutState, draws: Draws) -> jax.Array:
        """Return whether a wandering body takes a new direction."""
        if self._heading_steps is None:
            return draws.turn < 1 / self._wander_steps
        return state.episode_steps % self._heading_steps == 0


def _is_stuck(state: RolloutState, body: jax.Array, target_object: jax.Array) -> jax.Array:
    """Return whether the body hardly moved since the last check, or stayed at a ball that hardly moved."""
    still = jnp.linalg.norm(body - state.checked_body) < STUCK_MOVE
    ball_still = jnp.linalg.norm(target_object - state.checked_object) < STUCK_MOVE
    at_ball = (jnp.linalg.norm(body - target_object) < AT_BALL) & (
        jnp.linalg.norm(state.checked_body - state.checked_object) < AT_BALL
    )
    return still | (ball_still & at_ball & state.has_ball)
