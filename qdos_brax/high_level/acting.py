"""Acting online: one macro step in every training environment, stored in the replay."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs.brax_base import Env, State
from qdos_brax.config import Config
from qdos_brax.data.device import Normaliser
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.macro_step import InnerStep, MacroStep, macro_step, reset_done
from qdos_brax.high_level.skill_learning import Played, SkillLearning
from qdos_brax.high_level.warm_up import WarmUp

NEVER = -1
"""``first_goal_step`` before the goal was reached."""


class ActingState(struct.PyTreeNode):
    """Hold one member's environments and what was played in them.

    Attributes:
        replay: macro transitions; observations are normalised.
        env_state: State of the training environments, [num_envs, ...].
        env_steps: int32, live environment steps so far, over all environments.
        first_goal_step: int32, ``env_steps`` when the goal was first reached, in training or evaluation; ``NEVER``.
        broken: int32, simulations that broke and were reset.
        guided: int32[num_envs], steps that the guide still takes in each episode; None without a guide.
        seen: what skills that learn have seen.
    """

    replay: replay_buffer.Replay
    env_state: State
    env_steps: jax.Array
    first_goal_step: jax.Array
    broken: jax.Array
    guided: Any
    seen: Any


class Acting:
    """Play macro steps with one member's agent; the first ones by the warm-up, or by the guide.

    Args:
        config: the run's configuration.
        env: the task.
        normaliser: of observations.
        capacity: macro transitions that the replay holds.
        warm_up: who acts in the first steps.
        guide: acts for an episode's first steps, or None; it acts step by step, so the horizon must be 1.
        skill_learning: how the skills are played, and what is kept of that.

    Raises:
        ValueError: there is a guide and the horizon is not 1.
    """

    def __init__(
        self,
        config: Config,
        env: Env,
        normaliser: Normaliser,
        capacity: int,
        warm_up: WarmUp,
        guide: JumpStart | None,
        skill_learning: SkillLearning,
    ) -> None:
        if guide is not None and config.skills.horizon != 1:
            raise ValueError("a guide acts step by step: the horizon must be 1")
        self._num_envs, self._horizon = config.high_level.num_envs, config.skills.horizon
        self._warm_up, self._capacity = warm_up, capacity
        self._env, self._normalise, self._guide, self._skill_learning = env, normaliser, guide, skill_learning

    def start(self, key: jax.Array, example: Transition) -> ActingState:
        """Return environments at their starts and an empty replay of rows like ``example``."""
        guide, keys = self._guide, jax.random.split(key, self._num_envs + 1)
        return ActingState(
            replay=replay_buffer.create(example, self._capacity),
            env_state=jax.vmap(self._env.reset)(keys[:-1]),
            env_steps=jnp.zeros((), jnp.int32),
            first_goal_step=jnp.full((), NEVER, jnp.int32),
            broken=jnp.zeros((), jnp.int32),
            guided=None if guide is None else guide.draw(keys[-1], self._num_envs),
            seen=self._skill_learning.start(),
        )

    def step(
        self, state: ActingState, key: jax.Array, agent: Agent, guide_params: Any, hyper: dict[str, jax.Array]
    ) -> tuple[ActingState, Transition, dict[str, jax.Array]]:
        """Play one macro step in every environment and start ended episodes anew.

        Returns:
            The state after, the rows[num_envs] that were stored, and counts of episodes that reached the goal
            ("reached") and that ended ("ended").
        """
        first_key, actor_key, after_key, guide_key, conduct_key = jax.random.split(key, 5)
        observation = self._normalise(state.env_state.obs)
        first = agent.low_level.first(agent.skills, first_key, observation, agent.box)
        action = agent.high_level.act(agent.actor, actor_key, observation)
        action = self._warm_up.action(state.env_steps, first, action)
        if self._guide is not None:
            guided = self._guide.sample(guide_params, guide_key, observation)
            guided = agent.low_level.to_action(agent.skills, guided, observation, agent.box)
            action = jnp.where(state.guided[:, None] > 0, guided, action)
        skill = agent.skill(action, observation)
        discount = hyper["high_level.discount"]

        def one(env_state: State, skill: jax.Array, conduct: Any) -> tuple[State, MacroStep]:
            player = self._skill_learning.player(agent, conduct)
            play = lambda obs, step: player(obs, skill, step)  # noqa: E731
            return macro_step(self._env, play, env_state, self._horizon, discount, self._record)

        conduct = self._skill_learning.conduct(state.seen, conduct_key, hyper)
        env_state, result = jax.vmap(one)(state.env_state, skill, conduct)
        rows = Transition(observation, action, result.reward, result.mask, self._normalise(result.next_observation))
        over = (env_state.done > 0.5) | ~result.finite
        state = self._after(state, env_state, Played(skill, rows, result, over, state.env_steps), after_key)
        return state, rows, {"reached": jnp.sum(result.success), "ended": jnp.sum(over)}

    def _record(self, step: InnerStep) -> Any:
        return self._skill_learning.record(step._replace(observation=self._normalise(step.observation)))

    def _after(self, state: ActingState, env_state: State, played: Played, key: jax.Array) -> ActingState:
        """Return the state with the rows stored, the steps counted, and ended episodes started anew."""
        result, over = played.result, played.over
        env_steps = state.env_steps + jnp.sum(result.steps)
        keys = jax.random.split(key, self._num_envs + 2)  # the environments', the guide's, that of what is seen
        if self._guide is not None:
            fresh = self._guide.draw(keys[-2], self._num_envs)
            state = state.replace(guided=jnp.where(over, fresh, jnp.maximum(state.guided - 1, 0)))
        state = state.replace(
            replay=replay_buffer.insert(
                state.replay, played.rows, result.finite & self._skill_learning.shown(state.seen)
            ),
            seen=self._skill_learning.observe(state.seen, keys[-1], played),
            env_state=jax.vmap(partial(reset_done, self._env))(env_state, ~result.finite, keys[:-2]),
            env_steps=env_steps,
            broken=state.broken + jnp.sum(~result.finite).astype(jnp.int32),
        )
        return with_first_goal(state, result.success)


def with_first_goal(state: ActingState, success: jax.Array) -> ActingState:
    """Return ``state`` with the step of the first goal, if one of ``success[n]`` is above 0 for the first time."""
    reached = jnp.any(success > 0) & (state.first_goal_step == NEVER)
    return state.replace(first_goal_step=jnp.where(reached, state.env_steps, state.first_goal_step))
