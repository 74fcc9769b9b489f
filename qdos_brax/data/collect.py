"""Collects a task's offline data: episodes of repeated navigation, a stated share of them degraded.

An episode starts at random free cells and runs for a fixed number of steps, whatever it reaches: the ant is sent to a
random free cell along a shortest path (soccer: it brings the ball there), and on arrival to another. It is the same
data for every task of a maze; only rewards and masks are the task's. A ball goes slowly and its goal is the
cheapest of a few random cells: short ways that are finished show more than long ones that are not.

Degraded episodes are as likely one of three kinds: ``noisy`` navigates under heavy action noise, ``wander`` walks in
random directions, ``fail`` turns round half-way and undoes what it did (soccer: brings the ball back).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.physics.base import PipelineState
from envs.soccer import BALL_QPOS
from envs.task import GOAL_TOLERANCE, START_NOISE, TaskEnv
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError
from qdos_brax.experts import walker
from qdos_brax.experts.steering import Navigator, dribble_cost, dribble_direction, maze_direction

RECIPE = 3
"""Version of what is collected; part of the cache's file names."""

_WALKER_FAMILIES = ("antmaze", "antsoccer")  # the shipped walker is an ant

HEAVY_NOISE = 1.0  # standard deviation of action noise in noisy episodes
WANDER_STEPS = 30  # mean steps between two draws of a wanderer's direction
CHUNK_STEPS = 50  # steps per call of the jitted program; the episode length is a multiple of it
SHORTEST_EPISODE = 200

# The stuck rule: looked at every CHECK_STEPS; a stuck ant walks to somewhere else for ESCAPE_STEPS, with a new goal.
CHECK_STEPS = 60
ESCAPE_STEPS = 30
STUCK_MOVE = 0.5  # m within CHECK_STEPS, of the ant, or of a ball it is at
AT_BALL = 2.0  # m
BALL_GOAL_DRAWS = 6  # a ball's goal is the cheapest of so many random free cells
TASK_SHARE = 0.5  # in soccer: of the starts, those near the task's goal; of the goals drawn, those that are the task's
NEAR_GOAL = 4.5  # m, from the goal's cell to its neighbours
PATIENCE = 200  # steps after which a failing attempt turns round in any case


Row = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""qpos, qvel, observation and action of a step, all before it."""


class Lane(struct.PyTreeNode):
    """One environment while collecting. The cargo is what has to reach the goal: the ant, or in soccer the ball.

    Attributes:
        pipeline: the simulator's state.
        observation: float32[obs], what the task shows of it.
        goal_xy, origin_xy: float32[2], where the cargo goes, and where it was when that goal was drawn.
        turned: bool, a failing attempt that is on its way back to the origin.
        attempt: int32, steps since the goal was drawn or the attempt turned.
        heading: float32[2], a wanderer's direction.
        away_xy: float32[2], escape: int32, where an ant that was stuck walks, and for how many steps more.
        clock: int32, steps in this episode; seen_ant, seen_cargo: float32[2], positions at the last stuck check.
    """

    pipeline: PipelineState
    observation: jax.Array
    goal_xy: jax.Array
    origin_xy: jax.Array
    turned: jax.Array
    attempt: jax.Array
    heading: jax.Array
    away_xy: jax.Array
    escape: jax.Array
    clock: jax.Array
    seen_ant: jax.Array
    seen_cargo: jax.Array


def collect(
    env: TaskEnv,
    transitions: int,
    degraded_share: float,
    noise: float,
    seed: int,
    num_envs: int = 64,
    progress: Callable[[int, int], None] | None = None,
    policy: walker.WalkerPolicy | None = None,
) -> dict[str, np.ndarray]:
    """Collects ``transitions`` rows; the same arguments on the same machine give the same rows.

    Args:
        env: the task; its engine does the steps.
        transitions: number of rows, at least SHORTEST_EPISODE.
        degraded_share: share of the episodes that are degraded, 0 to 1.
        noise: standard deviation of the Gaussian noise on every other episode's actions.
        seed: of everything random.
        num_envs: environments stepped at once (fewer when there are not enough episodes).
        progress: called as ``progress(rows so far, rows)`` after every chunk.
        policy: the walker; None takes the shipped one.

    Returns:
        Rows in D4RL's flat layout, keyed as in the file (``infos/qpos``), with true ``next_observations``. No row is
        terminal: episodes go on after a success and end by time.

    Raises:
        UserError: an argument out of range, or a body that no expert is shipped for.
    """
    check_expert(env)
    if transitions < SHORTEST_EPISODE:
        raise UserError(f"transitions must be at least {SHORTEST_EPISODE} (one episode), got {transitions}")
    if not 0.0 <= degraded_share <= 1.0:
        raise UserError(f"the degraded share must lie in [0, 1], got {degraded_share}")
    if noise < 0.0 or num_envs < 1 or seed < 0:
        raise UserError(f"noise and seed must be 0 or more, num_envs 1 or more; got {noise}, {seed}, {num_envs}")
    length = _episode_length(transitions, num_envs, env.episode_length)
    episodes = -(-transitions // length)
    rounds = -(-episodes // num_envs)
    lanes = -(-episodes // rounds)
    kinds = _episode_kinds(rounds * lanes, degraded_share, seed).reshape(rounds, lanes)
    collector = Collector(env, policy or walker.load(), noise)
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


def check_expert(env: TaskEnv) -> None:
    """Raises UserError unless an expert is shipped that moves the task's body."""
    if env.spec.family not in _WALKER_FAMILIES:
        raise UserError(
            f"no expert is shipped for {env.spec.family}, so no data can be collected; "
            f"train with --dataset FILE, such as OGBench's {env.spec.name}-navigate-v0.npz"
        )


def data_name(env: TaskEnv) -> str:
    """What a default set is called: soccer's depends on the task, a maze's does not."""
    return env.spec.full_name if env.spec.family == "antsoccer" else env.spec.name


class Collector:
    """The jitted program that runs many lanes.

    Args:
        env: the task; ``antsoccer`` tasks move the ball, all others the ant.
        policy: the walker.
        noise: standard deviation of the action noise of undegraded episodes.
    """

    def __init__(self, env: TaskEnv, policy: walker.WalkerPolicy, noise: float) -> None:
        self.env, self.policy, self.noise = env, policy, noise
        self.navigator = Navigator(env.layout)
        self.has_ball = env.spec.family == "antsoccer"

    def episodes(
        self, key: jax.Array, kinds: np.ndarray, length: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        """One episode of ``length`` steps (a multiple of CHUNK_STEPS) per entry of ``kinds[L]``, one after another."""
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
        qpos, qvel, observations, actions = (np.concatenate(part, axis=1) for part in zip(*chunks, strict=True))
        after = np.asarray(lanes.observation)
        ends = np.zeros((n, length), bool)
        ends[:, -1] = True
        rows = {
            "observations": observations,
            "actions": actions,
            "next_observations": np.concatenate([observations[:, 1:], after[:, None]], axis=1),
            "timeouts": ends,
            "infos/qpos": qpos,
            "infos/qvel": qvel,
            "infos/quality": np.repeat(kinds[:, None], length, axis=1),
        }
        return {name: value.reshape(n * length, *value.shape[2:]) for name, value in rows.items()}

    @partial(jax.jit, static_argnums=0)
    def _reset(self, keys: jax.Array) -> Lane:
        return jax.vmap(self._reset_lane)(keys)

    @partial(jax.jit, static_argnums=0)
    def _chunk(self, lanes: Lane, kinds: jax.Array, keys: jax.Array) -> tuple[Lane, Row]:
        """CHUNK_STEPS steps of every lane; rows as [L, CHUNK_STEPS, ...]."""

        def step(lanes: Lane, keys: jax.Array) -> tuple[Lane, Row]:
            return jax.vmap(self._step_lane)(lanes, kinds, keys)

        by_step = jax.vmap(lambda key: jax.random.split(key, CHUNK_STEPS), out_axes=1)(keys)
        lanes, rows = jax.lax.scan(step, lanes, by_step)
        return lanes, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), rows)

    def _reset_lane(self, key: jax.Array) -> Lane:
        """Everything at random free cells, with the task's reset noise; the first goal is drawn."""
        reset_key, ant_key, ball_key, goal_key, heading_key = jax.random.split(key, 5)
        start = self.env.reset(reset_key).pipeline_state
        qpos = start.qpos.at[:2].set(self._start_xy(ant_key))
        if self.has_ball:
            qpos = qpos.at[BALL_QPOS : BALL_QPOS + 2].set(self._ball_xy(ball_key))
        ant, cargo = self._positions(qpos)
        pipeline = self.env.engine.init(qpos, start.qvel)
        return Lane(
            pipeline=pipeline,
            observation=self.env.observe(pipeline),
            goal_xy=self._goal_xy(goal_key, ant, cargo),
            origin_xy=cargo,
            turned=jnp.zeros((), bool),
            attempt=jnp.zeros((), jnp.int32),
            heading=_random_direction(heading_key),
            away_xy=ant,
            escape=jnp.zeros((), jnp.int32),
            clock=jnp.zeros((), jnp.int32),
            seen_ant=ant,
            seen_cargo=cargo,
        )

    def _start_xy(self, key: jax.Array) -> jax.Array:
        cell_key, shift_key = jax.random.split(key)
        shift = jax.random.uniform(shift_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
        return self.navigator.random_free_xy(cell_key) + shift

    def _ball_xy(self, key: jax.Array) -> jax.Array:
        """Where a ball starts: TASK_SHARE of them in the task's goal's cell or beside it, the others anywhere."""
        share_key, cell_key, shift_key, anywhere_key = jax.random.split(key, 4)
        gap = jnp.linalg.norm(self.navigator.free_xy - self.env.goal_xy, axis=-1)
        beside = self.navigator.free_xy[jax.random.categorical(cell_key, jnp.where(gap < NEAR_GOAL, 0.0, -jnp.inf))]
        near = beside + jax.random.uniform(shift_key, (2,), minval=-START_NOISE, maxval=START_NOISE)
        return jnp.where(jax.random.uniform(share_key) < TASK_SHARE, near, self._start_xy(anywhere_key))

    def _goal_xy(self, key: jax.Array, ant: jax.Array, cargo: jax.Array) -> jax.Array:
        """The centre[2] of a random free cell; of a ball the task's goal, or the cheapest of several (dribble_cost)."""
        if not self.has_ball:
            return self.navigator.random_free_xy(key)
        share_key, draw_key = jax.random.split(key)
        draws = jax.vmap(self.navigator.random_free_xy)(jax.random.split(draw_key, BALL_GOAL_DRAWS))
        cheapest = draws[jnp.argmin(jax.vmap(partial(dribble_cost, self.navigator, ant, cargo))(draws))]
        is_there = jnp.linalg.norm(cargo - self.env.goal_xy) < 2 * GOAL_TOLERANCE
        takes_the_tasks = (jax.random.uniform(share_key) < TASK_SHARE) & ~is_there
        return jnp.where(takes_the_tasks, self.env.goal_xy, cheapest)

    def _positions(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """xy[2] of the ant and of the cargo."""
        cargo = BALL_QPOS if self.has_ball else 0
        return qpos[:2], qpos[cargo : cargo + 2]

    def _step_lane(self, lane: Lane, kind: jax.Array, key: jax.Array) -> tuple[Lane, Row]:
        plan_key, noise_key, teleport_key = jax.random.split(key, 3)
        lane = self._plan(lane, kind, plan_key)
        qpos, qvel = lane.pipeline.qpos, lane.pipeline.qvel
        action = self.policy.act(qpos, qvel, self._direction(lane, kind))
        sigma = jnp.where(kind == QUALITY["noisy"], HEAVY_NOISE, self.noise)
        action = jnp.clip(action + sigma * jax.random.normal(noise_key, action.shape), -1.0, 1.0)
        row = (qpos, qvel, lane.observation, action)
        pipeline = self.env.engine.step(lane.pipeline, action)
        lane = lane.replace(
            pipeline=self.env.teleport(pipeline, teleport_key),
            observation=self.env.observe(pipeline),  # still at the entrance, as the task's own step shows it
            attempt=lane.attempt + 1,
            clock=lane.clock + 1,
            escape=jnp.maximum(lane.escape - 1, 0),
        )
        return lane, row

    def _plan(self, lane: Lane, kind: jax.Array, key: jax.Array) -> Lane:
        """Turns a failing attempt, draws a new goal on arrival or when stuck, sends a stuck ant elsewhere."""
        goal_key, away_key, turn_key, heading_key = jax.random.split(key, 4)
        ant, cargo = self._positions(lane.pipeline.qpos)
        gap = jnp.linalg.norm(cargo - lane.goal_xy)
        half_way = gap < 0.5 * jnp.linalg.norm(lane.origin_xy - lane.goal_xy)
        impatient = lane.attempt >= PATIENCE
        turns = (kind == QUALITY["fail"]) & ~lane.turned & (half_way | impatient)
        undone = lane.turned & ((jnp.linalg.norm(cargo - lane.origin_xy) < 2 * GOAL_TOLERANCE) | impatient)

        checks = (lane.clock % CHECK_STEPS == 0) & (lane.clock > 0)
        stuck = checks & self._is_stuck(lane, ant, cargo)
        redraw = undone | stuck | (~lane.turned & (gap < GOAL_TOLERANCE))
        wander_turns = jax.random.uniform(turn_key) < 1 / WANDER_STEPS
        return lane.replace(
            goal_xy=jnp.where(redraw, self._goal_xy(goal_key, ant, cargo), lane.goal_xy),
            origin_xy=jnp.where(redraw, cargo, lane.origin_xy),
            turned=jnp.where(redraw, False, lane.turned | turns),
            attempt=jnp.where(redraw | turns, 0, lane.attempt),
            heading=jnp.where(wander_turns, _random_direction(heading_key), lane.heading),
            away_xy=jnp.where(stuck, self.navigator.random_free_xy(away_key), lane.away_xy),
            escape=jnp.where(stuck, ESCAPE_STEPS, lane.escape),
            seen_ant=jnp.where(checks, ant, lane.seen_ant),
            seen_cargo=jnp.where(checks, cargo, lane.seen_cargo),
        )

    def _is_stuck(self, lane: Lane, ant: jax.Array, cargo: jax.Array) -> jax.Array:
        """bool: since the last check the ant hardly moved, or the ball did not though the ant was at it all along."""
        still = jnp.linalg.norm(ant - lane.seen_ant) < STUCK_MOVE
        ball_still = jnp.linalg.norm(cargo - lane.seen_cargo) < STUCK_MOVE
        at_ball = (jnp.linalg.norm(ant - cargo) < AT_BALL) & (
            jnp.linalg.norm(lane.seen_ant - lane.seen_cargo) < AT_BALL
        )
        return still | (ball_still & at_ball) if self.has_ball else still

    def _direction(self, lane: Lane, kind: jax.Array) -> jax.Array:
        ant, cargo = self._positions(lane.pipeline.qpos)
        target = jnp.where(lane.turned, lane.origin_xy, lane.goal_xy)
        if self.has_ball:
            direction = dribble_direction(self.navigator, ant, cargo, target)
        else:
            direction = maze_direction(self.navigator, ant, target)
        direction = jnp.where(lane.escape > 0, maze_direction(self.navigator, ant, lane.away_xy), direction)
        return jnp.where(kind == QUALITY["wander"], lane.heading, direction)


def _episode_length(transitions: int, num_envs: int, cap: int) -> int:
    """As long as the task's cap, shorter for small sets so that all environments are used; a multiple of the chunk."""
    return min(max(transitions // num_envs, SHORTEST_EPISODE), cap) // CHUNK_STEPS * CHUNK_STEPS


def _episode_kinds(episodes: int, degraded_share: float, seed: int) -> np.ndarray:
    """int8[episodes], a quality code per episode in random order, the degraded kinds in equal parts."""
    degraded = [code for code in QUALITY.values() if code != QUALITY["navigate"]]
    kinds = np.full(episodes, QUALITY["navigate"], np.int8)
    count = round(degraded_share * episodes)
    kinds[:count] = np.resize(degraded, count)
    return np.random.default_rng(seed).permutation(kinds)


def _offset(progress: Callable[[int, int], None], done: int, total: int) -> Callable[[int], None]:
    return lambda rows: progress(min(done + rows, total), total)


def _random_direction(key: jax.Array) -> jax.Array:
    angle = jax.random.uniform(key, (), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])
