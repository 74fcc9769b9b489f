"""MJX: the physics on an accelerator, whatever the size of the maze.

MJX pays for every pair of geoms that could touch, so a maze of a hundred boxes is out of the question. Within a cell
the ant can touch three walls only: the neighbour in the half of the cell where it stands along x, the one along y, and
the diagonal one between. Three boxes are moved there before each control step. In MuJoCo C that is the same step as
with the whole maze, to rounding. The ball has three boxes of its own, kept apart by collision bits.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs.maze import UNIT, WALL_HALF_SIZE, Maze
from envs.models import near_walls_model
from envs.physics.base import PipelineState
from envs.physics.contacts import exact_contacts
from envs.physics.solver import solve

_SUNK = -10.0  # height of a box that stands for no wall: below the floor, out of reach
_BALL_QPOS = 15

# Runge-Kutta of order 4: where each stage is evaluated, its share, and whether it is the sub-step's last.
_STAGES = np.array([[0.0, 1 / 6, 0], [0.5, 1 / 3, 0], [0.5, 1 / 3, 0], [1.0, 1 / 6, 1]], np.float32)


class _Stage(NamedTuple):
    """A sub-step under way.

    Attributes:
        qpos: float[nq], where it began.
        qvel: float[nv], likewise.
        warmstart: float[nv], the last acceleration of the sub-step before.
        rate: float[nv], qvel of the stage before, with corrected rotations.
        qacc: float[nv], acceleration of the stage before.
        mean_rate: float[nv], the stages' weighted mean so far.
        mean_qacc: float[nv], likewise.
    """

    qpos: jax.Array
    qvel: jax.Array
    warmstart: jax.Array
    rate: jax.Array
    qacc: jax.Array
    mean_rate: jax.Array
    mean_qacc: jax.Array



class MjxEngine:
    """Steps the ant, with or without ball, in a maze.

    The Runge-Kutta stages run in a loop around one ``mjx.forward`` (``mjx.step`` unrolls four of them, which takes
    four times as long to compile), and positions are taken relative to the ant's cell, where float32 is finest.

    Args:
        layout: the maze.
        ball: with the soccer ball.
        frame_skip: sub-steps per control step.
    """

    name = "mjx"

    def __init__(self, layout: Maze, ball: bool = False, frame_skip: int = 5) -> None:
        self.model = near_walls_model(ball)
        self.nq, self.nv, self.nu = self.model.nq, self.model.nv, self.model.nu
        self._layout = layout
        self._grid = np.asarray(layout.grid)
        self._bodies = (0, _BALL_QPOS) if ball else (0,)
        self._frame_skip = frame_skip
        self._mjx_model = mjx.put_model(self.model, impl="jax")
        self._data = mjx.make_data(self.model, impl="jax")

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        """The state at (qpos[nq], qvel[nv]) without warm start."""
        qvel = jnp.asarray(qvel, jnp.float32)
        return PipelineState(jnp.asarray(qpos, jnp.float32), qvel, jnp.zeros(0), jnp.zeros_like(qvel))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """One control step under ``action[nu]`` (clamped by the model's control range)."""
        origin = self._layout.ij_to_xy(self._layout.xy_to_ij(state.qpos[:2])).astype(jnp.float32)
        walls = jnp.concatenate([self._near_walls(state.qpos[b : b + 2], origin) for b in self._bodies])
        shift = jnp.zeros(self.nq)
        for b in self._bodies:
            shift = shift.at[b : b + 2].set(origin)

        def stage(carry: _Stage, coefficients: jax.Array) -> tuple[_Stage, None]:
            return self._stage(carry, coefficients, walls, action), None

        zero = jnp.zeros_like(state.qvel)
        start = _Stage(state.qpos - shift, state.qvel, state.carry, zero, zero, zero, zero)
        coefficients = jnp.tile(jnp.asarray(_STAGES), (self._frame_skip, 1))
        end = jax.lax.scan(stage, start, coefficients)[0]
        return PipelineState(end.qpos + shift, end.qvel, state.sensed, end.warmstart)

    def _near_walls(self, xy: jax.Array, origin: jax.Array) -> jax.Array:
        """Centres float[3, 3] of the boxes around ``xy[2]``, relative to ``origin[2]``; free cells' boxes are sunk."""
        cell = self._layout.xy_to_ij(xy)
        centre = self._layout.ij_to_xy(cell)
        side = jnp.where(xy > centre, 1, -1)  # along x and y
        steps = jnp.stack([side * jnp.array([1, 0]), side * jnp.array([0, 1]), side])  # [3, 2] in (x, y)
        near = cell + steps[:, ::-1]
        is_wall = jnp.asarray(self._grid)[near[:, 0], near[:, 1]] == 1
        height = jnp.where(is_wall, WALL_HALF_SIZE[2], _SUNK)
        return jnp.concatenate([centre - origin + UNIT * steps, height[:, None]], axis=1)

    def _stage(self, carry: _Stage, coefficients: jax.Array, walls: jax.Array, action: jax.Array) -> _Stage:
        """One stage of a sub-step, and the sub-step's end where it is the last one.

        As MuJoCo C from 4.0 on, which turns quaternions by Munthe-Kaas' method: the rotation over the step is the
        integral of the angular velocity with a correction for the change of its axis. (``mjx.step`` 3.17 has the plain
        integral, and misses C by 1e-5 to 1e-2 in a control step.)
        """
        dt = self.model.opt.timestep
        at, share, last = coefficients
        motion = at * dt * carry.rate
        qvel = carry.qvel + at * dt * carry.qacc
        qacc = self._acceleration(self._integrate(carry.qpos, motion), qvel, carry.warmstart, walls, action)
        rate = self._correct_rotations(motion, qvel)
        mean_rate, mean_qacc = carry.mean_rate + share * rate, carry.mean_qacc + share * qacc

        going = _Stage(carry.qpos, carry.qvel, carry.warmstart, rate, qacc, mean_rate, mean_qacc)
        zero = jnp.zeros_like(qvel)
        qpos = self._integrate(carry.qpos, dt * mean_rate)
        done = _Stage(qpos, carry.qvel + dt * mean_qacc, qacc, zero, zero, zero, zero)
        return jax.tree.map(lambda new, old: jnp.where(last > 0, new, old), done, going)

    def _correct_rotations(self, motion: jax.Array, qvel: jax.Array) -> jax.Array:
        """``qvel[nv]`` with each free joint's angular velocity w made the rate of the rotation vector u in ``motion``.

        The inverse derivative of the exponential map, w + [u, w] / 2 + [u, [u, w]] / 12, up to terms of fourth order.
        """
        free = self.model.jnt_dofadr[self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        for dof in free + 3:
            u, w = motion[dof : dof + 3], qvel[dof : dof + 3]
            bracket = jnp.cross(u, w)
            qvel = qvel.at[dof : dof + 3].set(w + bracket / 2 + jnp.cross(u, bracket) / 12)
        return qvel

    def _acceleration(
        self, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, walls: jax.Array, action: jax.Array
    ) -> jax.Array:
        model = self._mjx_model
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=action, mocap_pos=walls)
        with exact_contacts(), jax.default_matmul_precision("highest"):  # never TF32
            for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
                data = stage(model, data)
            efc = data._impl
            return solve(efc.M, data.qacc_smooth, efc.efc_J, efc.efc_D, efc.efc_aref, warmstart)

    def _integrate(self, qpos: jax.Array, motion: jax.Array) -> jax.Array:
        """``qpos[nq]`` moved by ``motion[nv]`` (velocity times time), quaternions on their sphere."""
        parts = []
        for kind, q, v in zip(self.model.jnt_type, self.model.jnt_qposadr, self.model.jnt_dofadr, strict=True):
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                parts += [qpos[q : q + 3] + motion[v : v + 3], _rotate(qpos[q + 3 : q + 7], motion[v + 3 : v + 6])]
            else:
                parts.append(qpos[q : q + 1] + motion[v : v + 1])
        return jnp.concatenate(parts)


def _rotate(quat: jax.Array, turn: jax.Array) -> jax.Array:
    """``quat[4]`` turned by the rotation vector ``turn[3]`` (body frame, radians), normalised."""
    angle = jnp.sqrt(jnp.sum(turn * turn))
    axis = turn / jnp.where(angle > 0, angle, 1.0)
    w, (x, y, z) = jnp.cos(angle / 2), axis * jnp.sin(angle / 2)
    a, b, c, d = quat
    product = jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )
    return product / jnp.sqrt(jnp.sum(product * product))
