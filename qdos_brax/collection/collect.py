"""Collects a task's offline data: episodes of repeated navigation, by a recipe (``qdos_brax.collection.recipes``).

An episode starts at random free cells and runs for a fixed number of steps, whatever it reaches: the body is sent to a
random free cell along a shortest path (soccer: it brings the ball there), and on arrival to another. It is the same
data for every task of a maze; only rewards and masks are the task's.

Which experts act where: the walker goes to the goal, or to the ball; near the ball the dribbler takes over.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.mazes.maze_task import GOAL_TOLERANCE, START_NOISE, MazeTask
from envs.mazes.soccer import BALL_QPOS
from envs.physics.base import PipelineState
from envs.render import steps_per_second
from qdos_brax.collection import bodies
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.steering import Navigator, approach, dribble_direction, maze_direction
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.collection.recipes import Recipe, episode_kinds, named
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

RECIPE = 5
"""Version of what is collected; part of the cache's file names, as are the experts' weights."""

WANDER_SECONDS = 3.0  # mean time between two draws of a wanderer's direction, where the recipe does not say
CHUNK_STEPS = 50  # steps per call of the jitted program; the episode length is a multiple of it
SHORTEST_EPISODE = 200

# The stuck rule: looked at every CHECK_SECONDS; a stuck body walks to somewhere else for ESCAPE_SECONDS, with a new
# goal.
CHECK_SECONDS = 6.0
ESCAPE_SECONDS = 3.0
STUCK_MOVE = 0.5  # m within CHECK_SECONDS, of the body, or of a ball it is at
AT_BALL = 2.0  # m
DRIBBLE_REACH = 3.0  # m from the ball at which the dribbler takes over
WITH_BALL = 0.5  # share of soccer's short episodes (stitch) that have anything to do with the ball
PATIENCE_SECONDS = 20.0  # after which a failing attempt turns round in any case


class Row(NamedTuple):
    """A control step, or many: arrays of jax, or on the host NumPy's.

    Attributes:
        qpos, qvel, observation, action: before it.
        next_observation: after it.
        fell: bool, it brought the body down for good, and the next row is another episode's.
    """

    qpos: Any
    qvel: Any
    observation: Any
    action: Any
    next_observation: Any
    fell: Any


class Draws(NamedTuple):
    """What chance gives a lane for one step, wanted or not.

    They are drawn for many steps at once: between two calls of the engine a draw is dozens of tiny operations.

    Attributes:
        goal_xy, away_xy: float32[2], centres of free cells.
        turn: float32, uniform in [0, 1).
        heading: float32[2], a unit vector.
        noise: float32[nu], standard normal.
        teleport: key of the teleporters.
    """

    goal_xy: jax.Array
    away_xy: jax.Array
    turn: jax.Array
    heading: jax.Array
    noise: jax.Array
    teleport: jax.Array


class Lane(struct.PyTreeNode):
    """One environment while collecting. The cargo is what has to reach the goal: the body itself, or the ball.

    Attributes:
        pipeline: the simulator's state.
        observation: float32[obs], what the task shows of it.
        has_ball: bool, whether the cargo is the ball.
        goal_xy, origin_xy: float32[2], where the cargo goes, and where it was when that goal was drawn.
        turned: bool, a failing attempt that is on its way back to the origin.
        attempt: int32, steps since the goal was drawn or the attempt turned.
        heading: float32[2], a wanderer's direction.
        away_xy: float32[2], escape: int32, where a body that was stuck walks, and for how many steps more.
        arrivals: int32, goals that the cargo was brought to, in all episodes of the lane.
        clock: int32, steps in this episode; seen_body, seen_cargo: float32[2], positions at the last stuck check.
    """

    pipeline: PipelineState
    observation: jax.Array
    has_ball: jax.Array
    goal_xy: jax.Array
    origin_xy: jax.Array
    turned: jax.Array
    attempt: jax.Array
    heading: jax.Array
    away_xy: jax.Array
    escape: jax.Array
    arrivals: jax.Array
    clock: jax.Array
    seen_body: jax.Array
    seen_cargo: jax.Array


def collect(
    env: MazeTask,
    transitions: int,
    recipe: Recipe,
    seed: int,
    num_envs: int = 64,
    progress: Callable[[int, int], None] | None = None,
    policy: policies.Policy | None = None,
) -> dict[str, np.ndarray]:
    """Collects ``transitions`` rows; the same arguments on the same machine give the same rows.

    Args:
        env: the task; its engine does the steps.
        transitions: number of rows, at least SHORTEST_EPISODE.
        recipe: what is done.
        seed: of everything random.
        num_envs: environments stepped at once (fewer when there are not enough episodes).
        progress: called as ``progress(rows so far, rows)`` after every chunk.
        policy: the body's expert (soccer: a dribbler); None takes the shipped one.

    Returns:
        Rows in D4RL's flat layout, keyed as in the file (``infos/qpos``), with true ``next_observations``. No row is
        terminal: episodes go on after a success and end by time, or where the body fell for good
        (``infos/fell``, of bodies that can).

    Raises:
        UserError: an argument out of range, or a body that no expert is shipped for.
    """
    check_size(transitions, seed, num_envs)
    expert = policy or bodies.conduct_of(env).expert()
    length = recipe.episode_steps or _episode_length(transitions, num_envs, env.episode_length)
    episodes = -(-transitions // length)
    rounds = -(-episodes // num_envs)
    lanes = -(-episodes // rounds)
    kinds = episode_kinds(recipe.mix, rounds * lanes, seed).reshape(rounds, lanes)
    collector = Collector(env, expert, recipe)
    parts: list[dict[str, np.ndarray]] = []
    for index in range(rounds):
        key = jax.random.fold_in(jax.random.key(seed), index)
        done = index * lanes * length
        report = None if progress is None else _offset(progress, done, transitions)
        parts.append(collector.episodes(key, kinds[index], length, report))
    rows = {name: np.concatenate([part[name] for part in parts])[:transitions] for name in parts[0]}
    rows["timeouts"][-1] = True
    success = np.asarray(env.success(rows["infos/qpos"], env.goal_xy))
    rows["rewards"] = success.astype(np.float32) - 1.0
    rows["terminals"] = np.zeros(transitions, bool)
    return rows


def check_size(transitions: int, seed: int, num_envs: int) -> None:
    """Raises UserError if ``collect`` cannot take one of these."""
    if transitions < SHORTEST_EPISODE:
        raise UserError(f"transitions must be at least {SHORTEST_EPISODE} (one episode), got {transitions}")
    if num_envs < 1 or seed < 0:
        raise UserError(f"seed must be 0 or more, num_envs 1 or more; got {seed}, {num_envs}")


def goals_per_1000(env: MazeTask, policy: policies.Policy, noise: float, seed: int, episodes: int = 64) -> float:
    """Goals reached per 1,000 steps, by episodes of the ``navigate`` recipe (soccer: by the ball), on average.

    As in OGBench's script, a goal is a random free cell, and on arrival another is drawn.

    Args:
        env: the task.
        policy: the body's expert.
        noise: standard deviation of the action noise.
        seed: of everything random.
        episodes: how many, of 1,000 steps each.
    """
    collector = Collector(env, policy, named("navigate", bodies.conduct_of(env), noise))
    kinds = np.full(episodes, QUALITY["navigate"], np.int8)
    return float(np.mean(collector.run(jax.random.key(seed), kinds, 1000)[1].arrivals))


class Collector:
    """The jitted program that runs many lanes.

    Args:
        env: the task; ``antsoccer`` tasks move the ball, all others the body.
        policy: the expert; of soccer a dribbler, which has a ``walker``.
        recipe: what is done.
    """

    def __init__(self, env: MazeTask, policy: policies.Policy, recipe: Recipe) -> None:
        self.env, self.recipe, self.body = env, recipe, bodies.conduct_of(env)
        self.dribbler = policy if isinstance(policy, policies.Dribbles) else None
        self.walker = policies.walker_of(policy)
        self.navigator = Navigator(env.layout)
        rate = steps_per_second(env)
        self.check_steps, self.escape_steps = round(CHECK_SECONDS * rate), round(ESCAPE_SECONDS * rate)
        self.wander_steps, self.patience = round(WANDER_SECONDS * rate), round(PATIENCE_SECONDS * rate)
        self.heading_steps = recipe.heading_seconds and round(recipe.heading_seconds * rate)

    def episodes(
        self, key: jax.Array, kinds: np.ndarray, length: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        """The rows of ``run``, one episode after another."""
        return self.run(key, kinds, length, progress)[0]

    def run(
        self, key: jax.Array, kinds: np.ndarray, length: int, progress: Callable[[int], None] | None = None
    ) -> tuple[dict[str, np.ndarray], Lane]:
        """``length`` steps (a multiple of CHUNK_STEPS) per entry of ``kinds[L]``: rows, last states.

        They are one episode, or as many more as falls ended, all of the same kind.
        """
        n = len(kinds)
        reset_key, chunk_key = jax.random.split(key)
        lanes = self._reset(jax.random.split(reset_key, n))
        chunks = []
        for index in range(length // CHUNK_STEPS):
            keys = jax.random.split(jax.random.fold_in(chunk_key, index), n)
            lanes, rows = self._chunk(lanes, jnp.asarray(kinds), keys)
            chunks.append(jax.device_get(rows))
            if progress is not None:
                progress((index + 1) * CHUNK_STEPS * n)
        steps = Row(*(np.concatenate(part, axis=1) for part in zip(*chunks, strict=True)))
        ends = steps.fell.copy()
        ends[:, -1] = True
        rows = {
            "observations": steps.observation,
            "actions": steps.action,
            "next_observations": steps.next_observation,
            "timeouts": ends,
            "infos/qpos": steps.qpos,
            "infos/qvel": steps.qvel,
            "infos/quality": np.repeat(kinds[:, None], length, axis=1),
        }
        if self.body.is_down is not None:
            rows["infos/fell"] = steps.fell
        return {name: value.reshape(n * length, *value.shape[2:]) for name, value in rows.items()}, lanes

    @partial(jax.jit, static_argnums=0)
    def _reset(self, keys: jax.Array) -> Lane:
        return jax.vmap(self._reset_lane)(keys)

    @partial(jax.jit, static_argnums=0)
    def _chunk(self, lanes: Lane, kinds: jax.Array, keys: jax.Array) -> tuple[Lane, Row]:
        """CHUNK_STEPS steps of every lane; rows as [L, CHUNK_STEPS, ...].

        A lane whose body falls goes on from a start that is drawn once a chunk: a call of the engine for every fall
        would be felt. One that falls twice within a chunk, which takes a second, begins at the same place again.
        """
        split = jax.vmap(lambda key: jax.random.split(key, CHUNK_STEPS + 1), out_axes=1)(keys)
        draws = jax.vmap(jax.vmap(self._draw))(split[:-1])
        starts = None if self.body.is_down is None else jax.vmap(self._reset_lane)(split[-1])

        def step(lanes: Lane, draws: Draws) -> tuple[Lane, Row]:
            lanes, row = jax.vmap(self._step_lane)(lanes, kinds, draws)
            return _restarted(lanes, starts, row.fell), row

        lanes, rows = jax.lax.scan(step, lanes, draws)
        return lanes, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), rows)

    def _reset_lane(self, key: jax.Array) -> Lane:
        """Everything at random free cells, with the body's reset noise; the first goal is drawn."""
        reset_key, body_key, ball_key, goal_key, heading_key = jax.random.split(key, 5)
        body = cargo = self._start_xy(body_key)
        has_ball = jnp.asarray(self.dribbler is not None)
        if self.dribbler is not None:
            share_key, ball_key = jax.random.split(ball_key)
            ball_xy = self._start_xy(ball_key)
            if self.recipe.goal_cells is not None:  # a short episode: about the ball if it begins at it
                has_ball = jax.random.uniform(share_key) < WITH_BALL
                shift = jax.random.uniform(ball_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
                beside = self.navigator.centre(self.navigator.cell(body)) + shift
                ball_xy = jnp.where(has_ball, beside, ball_xy)
            cargo = jnp.where(has_ball, ball_xy, body)
        goal_xy = self._goal_xy(goal_key, cargo)
        qpos, qvel = self.body.start(self.env, maze_direction(self.navigator, body, goal_xy), reset_key)
        qpos = qpos.at[:2].set(body)
        if self.dribbler is not None:
            qpos = qpos.at[BALL_QPOS : BALL_QPOS + 2].set(ball_xy)
        pipeline = self.env.engine.init(qpos, qvel)
        return Lane(
            pipeline=pipeline,
            observation=self.env.observe(pipeline),
            has_ball=has_ball,
            goal_xy=goal_xy,
            origin_xy=cargo,
            turned=jnp.zeros((), bool),
            attempt=jnp.zeros((), jnp.int32),
            heading=random_direction(heading_key),
            away_xy=body,
            escape=jnp.zeros((), jnp.int32),
            arrivals=jnp.zeros((), jnp.int32),
            clock=jnp.zeros((), jnp.int32),
            seen_body=body,
            seen_cargo=cargo,
        )

    def _start_xy(self, key: jax.Array) -> jax.Array:
        cell_key, shift_key = jax.random.split(key)
        shift = jax.random.uniform(shift_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
        return self.navigator.random_free_xy(cell_key) + shift

    def _goal_xy(self, key: jax.Array, cargo: jax.Array) -> jax.Array:
        """The centre[2] of a random free cell, or of one as far from the cargo as the recipe says."""
        if self.recipe.goal_cells is None:
            return self.navigator.random_free_xy(key)
        return self.navigator.random_xy_at(key, self.navigator.cell(cargo), self.recipe.goal_cells)

    def _positions(self, qpos: jax.Array, has_ball: jax.Array) -> tuple[jax.Array, jax.Array]:
        """xy[2] of the body and of the cargo."""
        body = qpos[:2]
        if self.dribbler is None:
            return body, body
        return body, jnp.where(has_ball, qpos[BALL_QPOS : BALL_QPOS + 2], body)

    def _draw(self, key: jax.Array) -> Draws:
        """All that a step of one lane may need."""
        plan_key, noise_key, teleport_key = jax.random.split(key, 3)
        goal_key, away_key, turn_key, heading_key = jax.random.split(plan_key, 4)
        return Draws(
            goal_xy=self.navigator.random_free_xy(goal_key),
            away_xy=self.navigator.random_free_xy(away_key),
            turn=jax.random.uniform(turn_key),
            heading=random_direction(heading_key),
            noise=jax.random.normal(noise_key, (self.env.action_size,)),
            teleport=teleport_key,
        )

    def _step_lane(self, lane: Lane, kind: jax.Array, draws: Draws) -> tuple[Lane, Row]:
        """A control step."""
        lane = self._plan(lane, kind, draws)
        qpos, qvel = lane.pipeline.qpos, lane.pipeline.qvel
        action = self._action(lane, kind)
        sigma = jnp.where(kind == QUALITY["noisy"], self.recipe.heavy_noise, self.recipe.noise)
        action = jnp.clip(action + sigma * draws.noise, -1.0, 1.0)
        pipeline = self.env.engine.step(lane.pipeline, action)
        after = self.env.observe(pipeline)
        fell = jnp.zeros((), bool) if self.body.is_down is None else self.body.is_down(pipeline.qpos)
        row = Row(qpos, qvel, lane.observation, action, after, fell)
        lane = lane.replace(
            pipeline=self.env.teleport(pipeline, draws.teleport),
            observation=after,  # still at the entrance, as the task's own step shows it
            attempt=lane.attempt + 1,
            clock=lane.clock + 1,
            escape=jnp.maximum(lane.escape - 1, 0),
        )
        return lane, row

    def _plan(self, lane: Lane, kind: jax.Array, draws: Draws) -> Lane:
        """Turns a failing attempt, takes a new goal on arrival or when stuck, sends a stuck body elsewhere."""
        body, cargo = self._positions(lane.pipeline.qpos, lane.has_ball)
        gap = jnp.linalg.norm(cargo - lane.goal_xy)
        half_way = gap < 0.5 * jnp.linalg.norm(lane.origin_xy - lane.goal_xy)
        impatient = lane.attempt >= self.patience
        turns = (kind == QUALITY["fail"]) & ~lane.turned & (half_way | impatient)
        undone = lane.turned & ((jnp.linalg.norm(cargo - lane.origin_xy) < 2 * GOAL_TOLERANCE) | impatient)

        checks = (lane.clock % self.check_steps == 0) & (lane.clock > 0)
        stuck = checks & self._is_stuck(lane, body, cargo)
        arrived = ~lane.turned & (gap < GOAL_TOLERANCE)
        redraw = undone | stuck | arrived if self.recipe.goal_cells is None else jnp.zeros((), bool)
        if self.heading_steps is None:
            heads_anew = draws.turn < 1 / self.wander_steps
        else:
            heads_anew = lane.clock % self.heading_steps == 0
        return lane.replace(
            goal_xy=jnp.where(redraw, draws.goal_xy, lane.goal_xy),
            origin_xy=jnp.where(redraw, cargo, lane.origin_xy),
            turned=jnp.where(redraw, False, lane.turned | turns),
            attempt=jnp.where(redraw | turns, 0, lane.attempt),
            heading=jnp.where(heads_anew, draws.heading, lane.heading),
            away_xy=jnp.where(stuck, draws.away_xy, lane.away_xy),
            escape=jnp.where(stuck, self.escape_steps, lane.escape),
            arrivals=lane.arrivals + (arrived & redraw),
            seen_body=jnp.where(checks, body, lane.seen_body),
            seen_cargo=jnp.where(checks, cargo, lane.seen_cargo),
        )

    def _is_stuck(self, lane: Lane, body: jax.Array, cargo: jax.Array) -> jax.Array:
        """bool: since the last check the body hardly moved, or the ball did not though it was at it all along."""
        still = jnp.linalg.norm(body - lane.seen_body) < STUCK_MOVE
        ball_still = jnp.linalg.norm(cargo - lane.seen_cargo) < STUCK_MOVE
        at_ball = (jnp.linalg.norm(body - cargo) < AT_BALL) & (
            jnp.linalg.norm(lane.seen_body - lane.seen_cargo) < AT_BALL
        )
        return still | (ball_still & at_ball & lane.has_ball)

    def _action(self, lane: Lane, kind: jax.Array) -> jax.Array:
        """The experts' action[nu], without noise."""
        qpos, qvel = lane.pipeline.qpos, lane.pipeline.qvel
        body, cargo = self._positions(qpos, lane.has_ball)
        target = jnp.where(lane.turned, lane.origin_xy, lane.goal_xy)
        away = maze_direction(self.navigator, body, lane.away_xy)
        on_foot = maze_direction(self.navigator, body, target)
        if self.dribbler is not None:
            to_ball, in_sight = approach(self.navigator, body, cargo)
            on_foot = jnp.where(lane.has_ball, to_ball, on_foot)
        direction = jnp.where(lane.escape > 0, away, on_foot)
        direction = jnp.where(kind == QUALITY["wander"], lane.heading, direction)
        action = self.walker.act(qpos, qvel, direction)
        if self.dribbler is None:
            return action
        near = in_sight & (jnp.linalg.norm(cargo - body) < DRIBBLE_REACH)
        dribbles = lane.has_ball & near & (lane.escape == 0) & (kind != QUALITY["wander"])
        push = dribble_direction(self.navigator, cargo, target)
        return jnp.where(dribbles, self.dribbler.act(qpos, qvel, push), action)


def _restarted(lanes: Lane, starts: Lane | None, fell: jax.Array) -> Lane:
    """``lanes``, but where ``fell[L]`` the new episodes that ``starts`` holds; without starts none falls."""
    if starts is None:
        return lanes
    starts = starts.replace(arrivals=lanes.arrivals)
    choose = jax.vmap(jnp.where)  # by lane
    return jax.tree.map(lambda new, old: choose(fell, new, old), starts, lanes)


def _episode_length(transitions: int, num_envs: int, cap: int) -> int:
    """As long as the task's cap, shorter for small sets so that all environments are used; a multiple of the chunk."""
    return min(max(transitions // num_envs, SHORTEST_EPISODE), cap) // CHUNK_STEPS * CHUNK_STEPS


def _offset(progress: Callable[[int, int], None], done: int, total: int) -> Callable[[int], None]:
    return lambda rows: progress(min(done + rows, total), total)
