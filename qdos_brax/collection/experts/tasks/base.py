"""The interface of a task that an expert is trained on.

Every function takes one environment; the trainer maps it over many.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
from flax import struct

from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.data.transitions import Transition


class EnvState(struct.PyTreeNode):
    """Hold one environment of the training.

    Attributes:
        pipeline: the simulator's state.
        direction: float[2], the commanded direction, a unit vector.
        steps: int, control steps since the episode began.
    """

    pipeline: PipelineState
    direction: jax.Array
    steps: jax.Array


class StepResult(NamedTuple):
    """Hold the outcome of a control step.

    Attributes:
        reward: float.
        alive: bool, False where the body fell, which terminates the episode.
        truncated: bool, the episode is cut off because going on is of no use; the value of the next state still counts.
        measures: scalars whose means are reported.
    """

    reward: jax.Array
    alive: jax.Array
    truncated: jax.Array
    measures: dict[str, jax.Array]


class ExpertTask(Protocol):
    """Define a body and what it learns.

    Attributes:
        name: name of the expert and of its weights.
        engine: the physics.
        observation_dim, action_dim: sizes of the policy's input and output.
        discount: per control step.
        episode_steps: an episode is cut off after this many control steps.
        direction_steps: mean number of steps between two draws of the direction.
        action_noise: standard deviation of the noise on ``torques`` during training, which the policy learns to resist.
    """

    name: str
    engine: MujocoEngine
    observation_dim: int
    action_dim: int
    discount: float
    episode_steps: int
    direction_steps: int
    action_noise: float

    def reset(self, key: jax.Array) -> EnvState:
        """Draw the first state of an episode."""
        ...

    def observe(self, state: EnvState) -> jax.Array:
        """Return the policy's observation, float[observation_dim]."""
        ...

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Map the policy's ``action[action_dim]`` to float[nu] in [-1, 1], shares of the motors' largest torques."""
        ...

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        """Evaluate the step from ``before`` to ``after`` under ``torques[nu]``."""
        ...

    def mirror(self, batch: Transition) -> Transition:
        """Return the transitions as a mirror shows them, or ``batch`` itself for a body without this symmetry."""
        ...
