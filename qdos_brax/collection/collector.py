"""The compiled program that runs the experts in many environments at once and returns what they did.

The walker goes to the goal, or to the ball; close to the ball the dribbler takes over.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes.maze_task import MazeTask
from envs.mazes.soccer import BALL_QPOS
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.rising import Recovery
from qdos_brax.collection.experts.steering import approach, dribble_direction
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.collection.planning import Planner
from qdos_brax.collection.profiles import profile_of
from qdos_brax.collection.recipes import CollectionRecipe
from qdos_brax.collection.rollout_state import Draws, RolloutState, Row
from qdos_brax.data.quality import QUALITY

CHUNK_STEPS = 50  # steps per call of the compiled program; episode lengths are multiples of it
DRIBBLE_REACH = 3.0  # m from the ball at which the dribbler takes over


class Collector:
    """Run a recipe's behaviours in many environments at once.

    Args:
        env: the task; its engine makes the steps. In ``antsoccer`` the target object is the ball, elsewhere the body.
        recipe: what is collected.
        expert: the body's expert (soccer: a dribbler); None loads the shipped one.
        recovery: gets the body up; None loads the shipped one.

    Attributes:
        version: of the rows, raised when the same arguments give others; part of the default sets' names.
        chunk_steps: what the length of an episode is a multiple of.
        at_once: one call of ``episodes``; it is a program that uses all cores.

    Raises:
        UserError: no expert is shipped for the body.
    """

    chunk_steps = CHUNK_STEPS
    at_once = 1

    def __init__(
        self,
        env: MazeTask,
        recipe: CollectionRecipe,
        expert: policies.Expert | None = None,
        recovery: Recovery | None = None,
    ) -> None:
        self.env, self.recipe, profile = env, recipe, profile_of(env)
        self.version = profile.version
        self.expert, self.recovery = expert or profile.expert(), recovery or profile.recovery()
        self._dribbler = self.expert if isinstance(self.expert, policies.DribblingExpert) else None
        self._walker = policies.walker_of(self.expert)
        self.planner = Planner(env, recipe, self._dribbler is not None)
        self._steer = profile.steering(self.planner.navigator)

    @property
    def expert_id(self) -> str:
        """Return eight hex digits that identify the weights of the expert and of what gets the body up."""
        return policies.digest(self.expert, self.recovery)

    def episodes(
        self, kinds: np.ndarray, length: int, seed: int, turn: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the rows of n episodes from random starts, one after another; see ``EpisodeCollector``.

        The body is sent along a shortest path to a random free cell (soccer: it brings the ball there), and on arrival
        to another, unless the recipe wants something else.
        """
        reset_key, step_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), turn))
        states = self.reset(jax.random.split(reset_key, len(kinds)))
        return self.run(states, kinds, length, step_key, progress)[0]

    def run(
        self,
        states: RolloutState,
        kinds: np.ndarray,
        length: int,
        key: jax.Array,
        progress: Callable[[int], None] | None = None,
    ) -> tuple[dict[str, np.ndarray], RolloutState]:
        """Step ``n`` environments ``length`` times and return their rows, one environment after another.

        Args:
            states: n environments at the start of an episode, such as from ``reset``.
            kinds: int8[n], the behaviour in each, see ``recipes.BEHAVIOURS``.
            length: control steps, a multiple of CHUNK_STEPS.
            key: random key of the steps.
            progress: called with the number of rows so far after every chunk.

        Returns:
            rows: arrays[n * length, ..] by their name in the file. Each environment's rows are one episode.
            states: the environments after the last step.
        """
        n, chunks = len(kinds), []
        for index in range(length // CHUNK_STEPS):
            keys = jax.random.split(jax.random.fold_in(key, index), n)
            states, rows = self.chunk(states, jnp.asarray(kinds), keys)
            chunks.append(jax.device_get(rows))
            if progress is not None:
                progress((index + 1) * CHUNK_STEPS * n)
        return self._file_arrays(chunks, kinds), states

    def _file_arrays(self, chunks: list[Row], kinds: np.ndarray) -> dict[str, np.ndarray]:
        """Join chunks[.., n, CHUNK_STEPS, ...] along time and name the arrays as in the file."""
        steps = Row(*(np.concatenate(part, axis=1) for part in zip(*chunks, strict=True)))
        n, length = steps.action.shape[:2]
        ends = np.zeros((n, length), bool)
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
        return {name: value.reshape(n * length, *value.shape[2:]) for name, value in rows.items()}

    @partial(jax.jit, static_argnums=0)
    def reset(self, keys: jax.Array) -> RolloutState:
        """Start an episode in each of n environments: all positions at random free cells, the first goal drawn.

        Args:
            keys: random keys[n].
        """
        return jax.vmap(self._reset_one)(keys)

    @partial(jax.jit, static_argnums=0)
    def chunk(self, states: RolloutState, kinds: jax.Array, keys: jax.Array) -> tuple[RolloutState, Row]:
        """Step every environment CHUNK_STEPS times; return (states, rows[n, CHUNK_STEPS, ...]).

        Args:
            states: n environments.
            kinds: int8[n], the behaviour in each.
            keys: random keys[n].
        """
        split = jax.vmap(lambda key: jax.random.split(key, CHUNK_STEPS), out_axes=1)(keys)
        draws = jax.vmap(jax.vmap(self.planner.draw))(split)

        def step(states: RolloutState, draws: Draws) -> tuple[RolloutState, Row]:
            return jax.vmap(self._step_one)(states, kinds, draws)

        states, rows = jax.lax.scan(step, states, draws)
        return states, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), rows)

    def _reset_one(self, key: jax.Array) -> RolloutState:
        reset_key, body_key, ball_key, goal_key, heading_key = jax.random.split(key, 5)
        body = target_object = self.planner.start_xy(body_key)
        has_ball = jnp.zeros((), bool)
        if self._dribbler is not None:
            ball_xy, has_ball = self.planner.ball_start(ball_key, body)
            target_object = jnp.where(has_ball, ball_xy, body)
        goal_xy = self.planner.first_goal(goal_key, target_object)
        start = self.env.reset(reset_key).pipeline_state
        qpos = start.qpos.at[:2].set(body)
        if self._dribbler is not None:
            qpos = qpos.at[BALL_QPOS : BALL_QPOS + 2].set(ball_xy)
        pipeline = self.env.engine.init(qpos, start.qvel)
        return RolloutState(
            pipeline=pipeline,
            observation=self.env.observe(pipeline),
            memory=self.recovery.begin(),
            has_ball=has_ball,
            goal_xy=goal_xy,
            origin_xy=target_object,
            returning=jnp.zeros((), bool),
            attempt_steps=jnp.zeros((), jnp.int32),
            heading=random_direction(heading_key),
            escape_xy=body,
            escape_steps=jnp.zeros((), jnp.int32),
            arrivals=jnp.zeros((), jnp.int32),
            episode_steps=jnp.zeros((), jnp.int32),
            checked_body=body,
            checked_object=target_object,
        )

    def _step_one(self, state: RolloutState, kind: jax.Array, draws: Draws) -> tuple[RolloutState, Row]:
        """Make one control step in one environment."""
        state = self.planner.plan(state, kind, draws)
        qpos, qvel = state.pipeline.qpos, state.pipeline.qvel
        sigma = jnp.where(kind == QUALITY["noisy"], self.recipe.heavy_noise, self.recipe.noise)
        action = jnp.clip(self._action(state, kind) + sigma * draws.noise, -1.0, 1.0)
        memory = self.recovery.follow(state.memory, qpos, qvel)
        action = self.recovery.act(memory, qpos, qvel, action)
        pipeline = self.env.engine.step(state.pipeline, action)
        after = self.env.observe(pipeline)
        row = Row(qpos, qvel, state.observation, action, after)
        state = state.replace(
            pipeline=self.env.teleport(pipeline, draws.teleport),
            memory=memory,
            observation=after,  # still at the entrance, as the task's own step shows it
            attempt_steps=state.attempt_steps + 1,
            episode_steps=state.episode_steps + 1,
            escape_steps=jnp.maximum(state.escape_steps - 1, 0),
        )
        return state, row

    def _action(self, state: RolloutState, kind: jax.Array) -> jax.Array:
        """Return the experts' action[nu], without noise."""
        navigator, pipeline = self.planner.navigator, state.pipeline
        body, target_object = self.planner.positions(state)
        target = jnp.where(state.returning, state.origin_xy, state.goal_xy)
        away, on_foot = self._steer(pipeline.qpos, state.escape_xy), self._steer(pipeline.qpos, target)
        if self._dribbler is not None:
            to_ball, in_sight = approach(navigator, body, target_object)
            on_foot = jnp.where(state.has_ball, to_ball, on_foot)
        direction = jnp.where(state.escape_steps > 0, away, on_foot)
        direction = jnp.where(kind == QUALITY["wander"], state.heading, direction)
        action = self._walker.act(pipeline.qpos, pipeline.qvel, direction)
        if self._dribbler is None:
            return action
        near = in_sight & (jnp.linalg.norm(target_object - body) < DRIBBLE_REACH)
        dribbles = state.has_ball & near & (state.escape_steps == 0) & (kind != QUALITY["wander"])
        push = dribble_direction(navigator, target_object, target)
        return jnp.where(dribbles, self._dribbler.act(pipeline.qpos, pipeline.qvel, push), action)
