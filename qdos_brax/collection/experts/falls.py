"""Bodies that fell: dropped as the humanoid's task drops them, and where a stage of getting up, or walking, begins."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.mazes.locomotion import dropped_humanoid, dropped_poses
from envs.physics.base import Engine, PipelineState
from qdos_brax.collection.experts.rising import LIES, WALKS, Motions, Rising, motion_torques, next_stage
from qdos_brax.errors import UserError

STEPS = 240
"""Control steps within which a dropped body lies, turns if it has to, crouches, and rises."""


class Arrivals(NamedTuple):
    """Hold where n bodies were when they began a stage.

    Attributes:
        qpos: float32[n, 28].
        qvel: float32[n, 27].
        arrived: bool[n], False where the stage was not reached; qpos and qvel are then those of the start.
    """

    qpos: jax.Array
    qvel: jax.Array
    arrived: jax.Array

    def some(self) -> Arrivals:
        """Return them, of whom at least one arrived.

        Raises:
            UserError: none did, and episodes would have nowhere to begin.
        """
        if not bool(self.arrived.any()):
            raise UserError(
                f"none of {len(self.arrived)} fallen humanoids got as far as this expert begins; train the motions and "
                "the riser first, or put their shipped weights back"
            )
        return self


def dropped(engine: Engine, key: jax.Array, count: int) -> PipelineState:
    """Draw ``count`` humanoids as the task's reset drops them, at the origin of an open floor."""
    pose_key, qvel_key = jax.random.split(key)
    poses = dropped_poses()
    rest = jax.vmap(lambda key: dropped_humanoid(key, poses))(jax.random.split(pose_key, count))
    qpos = jnp.concatenate([jnp.zeros((count, 2)), rest], axis=1)
    return jax.vmap(engine.init)(qpos, 0.1 * jax.random.normal(qvel_key, (count, engine.nv)))


@partial(jax.jit, static_argnums=(0, 1))
def arrivals(
    engine: Engine, stage: int, motions: Motions, state: PipelineState, noise: jax.Array, key: jax.Array
) -> Arrivals:
    """Simulate STEPS control steps of n bodies that fall and get up; return where each first began ``stage``.

    Args:
        engine: the physics.
        stage: LIES, TURNS, CROUCHES or RISES; from RISES on a riser would have to act (``hand_overs``).
        motions: the motions.
        state: n states.
        noise: float[n, 1], standard deviation of the noise on the torques.
        key: random key of the noise.
    """
    return _arrivals(engine, stage, motions, partial(motion_torques, motions), state, noise, key)


@partial(jax.jit, static_argnums=(0, 1))
def hand_overs(engine: Engine, recovery: Rising, state: PipelineState, key: jax.Array) -> Arrivals:
    """Simulate STEPS control steps of n bodies that fall and get up; return where the walker first takes over.

    Args:
        engine: the physics.
        recovery: gets them up, without noise as in data.
        state: n states.
        key: random key.
    """
    act = partial(recovery.act, action=jnp.zeros(21))
    quiet = jnp.zeros((state.qpos.shape[0], 1))
    return _arrivals(engine, WALKS, recovery.motions, act, state, quiet, key)


def _arrivals(
    engine: Engine,
    stage: int,
    motions: Motions,
    act: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
    state: PipelineState,
    noise: jax.Array,
    key: jax.Array,
) -> Arrivals:
    def step(carry: tuple[PipelineState, jax.Array, Arrivals], key: jax.Array) -> tuple[tuple, None]:
        state, memory, first = carry
        memory = jax.vmap(partial(next_stage, motions))(memory, state.qpos, state.qvel)
        arrives = (memory[:, 0] == stage) & ~first.arrived
        qpos, qvel = (
            jnp.where(arrives[:, None], now, before)
            for now, before in ((state.qpos, first.qpos), (state.qvel, first.qvel))
        )
        torques = jax.vmap(act)(memory, state.qpos, state.qvel)
        torques = jnp.clip(torques + noise * jax.random.normal(key, torques.shape), -1.0, 1.0)
        state = jax.vmap(engine.step)(state, torques)
        return (state, memory, Arrivals(qpos, qvel, first.arrived | arrives)), None

    memory = jnp.tile(jnp.array([LIES, 0], jnp.int32), (state.qpos.shape[0], 1))
    none = Arrivals(state.qpos, state.qvel, jnp.zeros(state.qpos.shape[0], bool))
    return jax.lax.scan(step, (state, memory, none), jax.random.split(key, STEPS))[0][2]
