"""What the motions of getting up are sought for: how a candidate is decoded, and how good it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.base import Engine, PipelineState
from qdos_brax.collection.experts import policies, rising
from qdos_brax.collection.experts.poses import STANDING, humanoid_is_up
from qdos_brax.collection.experts.rising import STEP_SECONDS, Motion
from qdos_brax.collection.experts.symmetry import mirrored_action
from qdos_brax.collection.experts.views import forward_axis, uprightness
from qdos_brax.nn.vectors import unit_vector

Act = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""From the index of the control step, qpos[n, 28] and qvel[n, 27] to torques[n, 21]."""

SPAN = 2.0
"""Largest angle of a key pose, rad: further than most joints reach, which then push against what is in their way."""


class Score(NamedTuple):
    """Hold the outcome for c candidates from n bodies each.

    Attributes:
        value: float[c, n], the higher the better.
        reached: bool[c, n], whether the motion did what it is for.
    """

    value: jax.Array
    reached: jax.Array


class MotionGoal(Protocol):
    """Define what a motion is sought for.

    Attributes:
        name: name of the motion.
        stage: the stage of ``rising`` that it makes up.
        engine: the physics.
        size: numbers of a candidate.
    """

    name: str
    stage: int
    engine: Engine
    size: int

    def guess(self) -> np.ndarray:
        """Return the candidate[size] from which a search begins."""
        ...

    def motion(self, candidate: jax.Array) -> Motion:
        """Decode ``candidate[size]``."""
        ...

    def score(self, candidates: jax.Array, qpos: jax.Array, qvel: jax.Array, noise: jax.Array, key: jax.Array) -> Score:
        """Simulate ``candidates[c, size]`` from states qpos[n, 28], qvel[n, 27] with noise[n, 1] on the joints."""
        ...


class Turn:
    """Turn a body that lies on its front or side onto its back, and let it rest there.

    Score: how far the body's front faces up, at the end (weight 1), at its best and over the last half second (0.3
    each), minus a tenth of the speed at the end.
    """

    name, stage, size = "turn", rising.TURNS, 3 * 21

    SECONDS = (0.15, 0.25, 0.3)  # between the key poses
    REST = 20  # control steps held straight afterwards

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def guess(self) -> np.ndarray:
        """Return straight limbs."""
        return np.zeros(self.size)

    def motion(self, candidate: jax.Array) -> Motion:
        """Return three key poses; the times between them are given."""
        return Motion(SPAN * jnp.clip(candidate.reshape(3, 21), -1.0, 1.0), jnp.array(self.SECONDS))

    def score(self, candidates: jax.Array, qpos: jax.Array, qvel: jax.Array, noise: jax.Array, key: jax.Array) -> Score:
        """Return the score given in the class; it is reached where the body lies on its back at the end."""
        moving = round(sum(self.SECONDS) / STEP_SECONDS)

        def simulate(candidate: jax.Array) -> tuple[jax.Array, jax.Array]:
            motion = self.motion(candidate)

            def act(index: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
                target = jnp.where(index < moving, rising.pose_at(motion, index), 0.0)
                return rising.holding_torques(qpos, qvel, target)

            return _simulate(self.engine, act, moving + self.REST, qpos, qvel, noise, key)

        place, speed = jax.vmap(simulate)(candidates)
        facing = jnp.clip(forward_axis(place)[..., 2], -1.0, 0.95)  # [c, steps, n]
        still = jnp.minimum(jnp.mean(jnp.abs(speed[:, -1]), axis=-1), 3.0)
        value = facing[:, -1] + 0.3 * facing[:, -20:].mean(axis=1) + 0.3 * facing.max(axis=1) - 0.1 * still
        return Score(value, facing[:, -1] > 0.9)


class Crouch:
    """Take a body from its back onto its feet, left and right alike, so that the walker could get it upright.

    The walker takes over at the motion's end. Score: the mean after the first second of the torso's height as a share
    of the standing height, reduced by up to 0.4 for leaning; 0.3 for the highest of these; 0.5 for being up after the
    motion's end, and 0.5 times the share at the end of the simulation if the body is up there.
    """

    name, stage = "crouch", rising.CROUCHES

    POSES, SECONDS = 5, 0.35  # key poses, and the first guess of the time between them
    STEPS, MOVING = 110, 75  # control steps that are simulated, and after which the walker has taken over

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._walker = policies.humanoid_walker()
        self._symmetric = _symmetric_poses()
        self.size = self.POSES * (len(self._symmetric) + 1)

    def guess(self) -> np.ndarray:
        """Return knees drawn up, held so, and stretched again: by abdomen, hip and knee, in that order, in rad."""
        bends = [(-1.2, -1.9, -2.0), (-1.3, -1.9, -2.0), (-1.0, -1.9, -2.0), (-0.2, -0.8, -1.0), (0.0, 0.0, 0.0)]
        poses = np.zeros((self.POSES, 21))
        poses[:, [0, 5, 6]] = poses[:, [0, 11, 12]] = bends
        basis = self._symmetric
        angles = poses @ basis.T / np.sum(basis**2, axis=1) / SPAN
        return np.concatenate([angles.ravel(), np.zeros(self.POSES)])

    def motion(self, candidate: jax.Array) -> Motion:
        """Return five symmetric key poses, and the times between them: up to e times the first guess."""
        angles, times = jnp.split(candidate, [self.POSES * len(self._symmetric)])
        poses = SPAN * jnp.clip(angles.reshape(self.POSES, -1), -1.0, 1.0) @ jnp.asarray(self._symmetric, jnp.float32)
        return Motion(poses, self.SECONDS * jnp.exp(jnp.clip(times, -1.5, 1.0)))

    def score(self, candidates: jax.Array, qpos: jax.Array, qvel: jax.Array, noise: jax.Array, key: jax.Array) -> Score:
        """Return the score given in the class; it is reached where the body is up at the end."""

        def simulate(candidate: jax.Array) -> tuple[jax.Array, jax.Array]:
            motion = self.motion(candidate)
            end = jnp.minimum(rising.length(motion) + rising.HOLD, self.MOVING)

            def act(index: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
                walking = self._walker.act(qpos, qvel, unit_vector(forward_axis(qpos)[..., :2]))
                return jnp.where(
                    index < end, rising.holding_torques(qpos, qvel, rising.pose_at(motion, index)), walking
                )

            return _simulate(self.engine, act, self.STEPS, qpos, qvel, noise, key)

        place, _ = jax.vmap(simulate)(candidates)
        tall = jnp.clip(place[..., 2] / STANDING, 0.0, 1.0) * (0.6 + 0.4 * jnp.maximum(uprightness(place), 0.0))
        up = humanoid_is_up(place)  # [c, steps, n]
        value = tall[:, 40:].mean(axis=1) + 0.3 * tall.max(axis=1) + 0.5 * up[:, self.MOVING :].mean(axis=1)
        return Score(value + 0.5 * up[:, -1] * tall[:, -1], up[:, -1])


GOALS: dict[str, Callable[[Engine], MotionGoal]] = {"turn": Turn, "crouch": Crouch}
"""The goals by the names of their motions, in the order in which they are sought."""


def _simulate(
    engine: Engine, act: Act, steps: int, qpos: jax.Array, qvel: jax.Array, noise: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the states (qpos[steps, n, 28], qvel[steps, n, 27]) after each of ``steps`` control steps."""

    def step(state: PipelineState, given: tuple[jax.Array, jax.Array]) -> tuple[PipelineState, tuple[Any, Any]]:
        index, step_key = given
        torques = act(index, state.qpos, state.qvel)
        torques = torques + noise * jax.random.normal(step_key, torques.shape)
        state = jax.vmap(engine.step)(state, jnp.clip(torques, -1.0, 1.0))
        return state, (state.qpos, state.qvel)

    start = jax.vmap(engine.init)(qpos, qvel)
    places, speeds = jax.lax.scan(step, start, (jnp.arange(steps), jax.random.split(key, steps)))[1]
    return places, speeds


def _symmetric_poses() -> np.ndarray:
    """Return float[10, 21], a basis of the poses that are their own mirror image."""
    images = np.eye(21) + np.asarray(mirrored_action(jnp.eye(21)))
    rows: list[np.ndarray] = []
    for image in np.sign(images):
        if image.any() and not any(np.array_equal(np.abs(image), np.abs(row)) for row in rows):
            rows.append(image)
    return np.stack(rows)
