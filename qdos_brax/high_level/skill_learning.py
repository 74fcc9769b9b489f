"""What becomes of the skills online: they stay frozen, or learn too.

The online phase asks one part, whichever it is: how training episodes play the skills, what is kept of them, what is
learned of it, and which skills an evaluation plays and the run hands on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.actor_critic import Reference
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.macro_step import InnerStep, MacroStep, no_record

Play = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]  # (observation[obs], skill[s], step) -> action[act]


class Played(NamedTuple):
    """Hold a macro step of every training environment.

    Attributes:
        skill: [num_envs, s], what was played.
        rows: the same as transitions of the high level; observations are normalised.
        result: with the track that ``record`` asked for.
        over: bool[num_envs], whether the episode ended with it.
        env_steps: int32, environment steps before it.
    """

    skill: jax.Array
    rows: Transition
    result: MacroStep
    over: jax.Array
    env_steps: jax.Array


class Lesson(NamedTuple):
    """Hold what one member's skills learn from, and do not change.

    Attributes:
        skills: parameters of the frozen skills.
        seen: what was played.
        high_level: the state of the high level.
        reference: the density that its actor is held against, or None.
        env_steps: int32, environment steps so far.
        hyper: numbers by dotted key.
    """

    skills: Any
    seen: Any
    high_level: Any
    reference: Reference | None
    env_steps: jax.Array
    hyper: dict[str, jax.Array]


class SkillLearning(Protocol):
    """Define what becomes of one member's skills. What learns ("learned") is kept apart from what was played ("seen"):
    a member whose numbers break is frozen in the former.
    """

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> Any:
        """Return what learns, a pytree of arrays."""
        ...

    def start(self) -> Any:
        """Return what is seen before the first macro step, a pytree of arrays."""
        ...

    def record(self, step: InnerStep) -> Any:
        """Return what is kept of an environment step, whose observation is normalised."""
        ...

    def training_skills(self, learned: Any, skills: Any) -> Any:
        """Return the parameters that training plays, of the frozen ones."""
        ...

    def conduct(self, seen: Any, key: jax.Array, hyper: dict[str, jax.Array]) -> Any:
        """Return how each environment plays the next macro step, leaves [num_envs, ...]."""
        ...

    def player(self, agent: Agent, conduct: Any) -> Play:
        """Return what plays a macro step in one environment, with the conduct of that one."""
        ...

    def shown(self, seen: Any) -> jax.Array | bool:
        """Return which environments' macro steps the high level learns from, bool[num_envs] or one for all."""
        ...

    def observe(self, seen: Any, key: jax.Array, played: Played) -> Any:
        """Return what is seen after a macro step in every environment."""
        ...

    def learn(self, learned: Any, key: jax.Array, lesson: Lesson) -> tuple[Any, dict[str, jax.Array]]:
        """Learn for one macro step of experience: (what learns, scalars for metrics.csv)."""
        ...

    def final_skills(self, learned: Any, seen: Any, skills: Any) -> Any:
        """Return the parameters that evaluations play and that are handed on, of the frozen ones."""
        ...


class FrozenSkills:
    """Keep the skills as they are."""

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> tuple[()]:
        """Return nothing."""
        return ()

    def start(self) -> tuple[()]:
        """Return nothing."""
        return ()

    def record(self, step: InnerStep) -> None:
        """Keep nothing."""
        return no_record(step)

    def training_skills(self, learned: tuple[()], skills: Any) -> Any:
        """Return the frozen ones."""
        return skills

    def conduct(self, seen: tuple[()], key: jax.Array, hyper: dict[str, jax.Array]) -> tuple[()]:
        """Return nothing: all play alike."""
        return ()

    def player(self, agent: Agent, conduct: tuple[()]) -> Play:
        """Return the agent's own play."""
        return agent.play

    def shown(self, seen: tuple[()]) -> bool:
        """Return True."""
        return True

    def observe(self, seen: tuple[()], key: jax.Array, played: Played) -> tuple[()]:
        """Return nothing."""
        return seen

    def learn(self, learned: tuple[()], key: jax.Array, lesson: Lesson) -> tuple[tuple[()], dict[str, jax.Array]]:
        """Learn nothing."""
        return learned, {}

    def final_skills(self, learned: tuple[()], seen: tuple[()], skills: Any) -> Any:
        """Return the frozen ones."""
        return skills
