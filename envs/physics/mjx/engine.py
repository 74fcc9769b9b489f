"""MJX: the physics on an accelerator, whatever the size of the maze.

MJX pays for every pair of geoms that could touch, so a maze of a hundred boxes is out of the question: only the walls
in reach are there, boxes that are moved before each control step (``envs.mazes.walls``). The ball has boxes of its
own, kept apart by collision bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from envs.mazes.maze import WALL_HALF_SIZE, Maze
from envs.mazes.walls import cells_in_reach
from envs.physics.base import PipelineState, Sensors
from envs.physics.mjx.constraints import Constraints
from envs.physics.mjx.integrators import Motion, integrate
from envs.physics.mjx.solver import solve

# Of mjx.forward: without its factorisation of M, its contacts and its solver.
_STAGES = (
    mjx.kinematics,
    mjx.com_pos,
    mjx.tendon,
    mjx.crb,
    mjx.transmission,
    mjx.fwd_velocity,
    mjx.fwd_actuation,
)
_SUNK = -10.0  # height of a box that stands for no wall: below the floor, out of reach


class MjxEngine:
    """Steps bodies in a maze; positions are taken relative to the first body's cell, where float32 is finest.

    Args:
        model: the bodies on an open floor, with mocap boxes for the walls around each, in the order of ``bodies``.
            All its constraints have to be one-sided (limits, pyramidal contacts), see ``envs.physics.mjx.solver``.
        layout: the maze.
        most_contacts: by dimension, how many contacts are kept, the deepest ones.
        bodies: where in qpos the x of each body lies.
        frame_skip: sub-steps per control step.
        sensors: what to read after each control step, from the kinematics of the new state; None reads nothing.

    Raises:
        ValueError: the model has constraints of another kind.
    """

    name = "mjx"

    def __init__(
        self,
        model: mujoco.MjModel,
        layout: Maze,
        most_contacts: Mapping[int, int],
        bodies: Sequence[int] = (0,),
        frame_skip: int = 5,
        sensors: Sensors | None = None,
    ) -> None:
        if model.neq or model.dof_frictionloss.any() or model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
            raise ValueError("the MJX engine wants a model without equalities and friction loss, with pyramidal cones")
        self.model = model
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.frame_skip = frame_skip
        self._layout = layout
        self._bodies = tuple(bodies)
        self._sensors = sensors
        self._mjx_model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")
        self._constraints = Constraints(model, self._mjx_model, most_contacts)

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        """The state at (qpos[nq], qvel[nv]) without warm start."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        return PipelineState(qpos, qvel, self._sense(qpos, qvel), jnp.zeros_like(qvel))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """One control step under ``action[nu]`` (clamped by the model's control range)."""
        origin = self._layout.ij_to_xy(self._layout.xy_to_ij(state.qpos[:2])).astype(jnp.float32)
        walls = jnp.concatenate([self._near_walls(state.qpos[b : b + 2], origin) for b in self._bodies])
        shift = jnp.zeros(self.nq)
        for b in self._bodies:
            shift = shift.at[b : b + 2].set(origin)

        start = (state.qpos - shift, state.qvel, state.carry)
        qpos, qvel, warmstart = self._move(start, walls, action)
        qpos = qpos + shift
        return PipelineState(qpos, qvel, self._sense(qpos, qvel), warmstart)

    def _move(self, start: Motion, walls: jax.Array, action: jax.Array) -> Motion:
        """All sub-steps, with boxes at ``walls[k, 3]``."""

        def dynamics(qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array) -> tuple[jax.Array, jax.Array]:
            return self._acceleration(qpos, qvel, warmstart, walls, action)

        return integrate(self.model, dynamics, start, self.frame_skip)

    def _near_walls(self, xy: jax.Array, origin: jax.Array) -> jax.Array:
        """Centres float[3, 3] of the boxes around ``xy[2]``, relative to ``origin[2]``; free cells' boxes are sunk."""
        cells, is_wall = cells_in_reach(self._layout, xy)
        height = jnp.where(is_wall, WALL_HALF_SIZE[2], _SUNK)
        centres = jnp.concatenate([self._layout.ij_to_xy(cells) - origin, height[:, None]], axis=1)
        return centres[1:]  # a body whose middle is inside a wall is left to MuJoCo C

    def _acceleration(
        self, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, walls: jax.Array, action: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The constrained acceleration[nv] and the joint-space inertia[nv, nv]."""
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=action, mocap_pos=walls)
        with jax.default_matmul_precision("highest"):  # never TF32
            for stage in _STAGES:
                data = stage(self._mjx_model, data)
            mass = mjx.full_m(self._mjx_model, data)
            force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
            return solve(mass, force, *self._constraints.rows(data), warmstart), mass

    def _sense(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """float[k]: what the body senses in this state."""
        if self._sensors is None:
            return jnp.zeros(0)
        data = self._data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel, mjx.sensor_vel):
                data = stage(self._mjx_model, data)
        return self._sensors.read(self.model, data.xpos, data.xmat, data.sensordata)
