"""Make sub-steps as MuJoCo C makes them, around any function that gives the acceleration.

``mjx.step`` unrolls the four stages of its Runge-Kutta method, which takes four times as long to compile, and turns
quaternions otherwise than MuJoCo C from 4.0 on. Here all sub-steps and stages of a control step are one loop around one
copy of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.mjx.solver import solve_positive

Motion = tuple[jax.Array, jax.Array, jax.Array]
"""qpos[nq], qvel[nv], and the acceleration[nv] found last, which the next one starts from (warm start)."""

Dynamics = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""(qpos, qvel, warm start) -> acceleration[nv] and the joint-space inertia[nv, nv]."""


def integrate(model: mujoco.MjModel, dynamics: Dynamics, start: Motion, substeps: int) -> Motion:
    """Make ``substeps`` sub-steps by the integrator that the model asks for.

    Raises:
        ValueError: the model asks for another than Euler or RK4.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(model, dynamics, start, substeps)
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return _euler(model, dynamics, start, substeps)
    raise ValueError("the model's integrator must be Euler or RK4")


def _euler(model: mujoco.MjModel, dynamics: Dynamics, start: Motion, substeps: int) -> Motion:
    """Integrate by semi-implicit Euler; joint damping is implicit, as in C: (M + dt D) a' = M a."""
    dt = model.opt.timestep
    damping = jnp.asarray(model.dof_damping, jnp.float32)

    def substep(motion: Motion, _: None) -> tuple[Motion, None]:
        qpos, qvel, warmstart = motion
        qacc, mass = dynamics(qpos, qvel, warmstart)
        qvel = qvel + dt * solve_positive(mass + jnp.diag(dt * damping), mass @ qacc)
        return (_move(model, qpos, dt * qvel), qvel, qacc), None

    return jax.lax.scan(substep, start, None, length=substeps)[0]


# Runge-Kutta of order 4: where each stage is evaluated, its share, and whether it is the sub-step's last.
_STAGES = np.array([[0.0, 1 / 6, 0], [0.5, 1 / 3, 0], [0.5, 1 / 3, 0], [1.0, 1 / 6, 1]], np.float32)


class _Stage(NamedTuple):
    """Hold a Runge-Kutta sub-step under way.

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


def _runge_kutta(model: mujoco.MjModel, dynamics: Dynamics, start: Motion, substeps: int) -> Motion:
    """Integrate by RK4 as MuJoCo C from 4.0 on, which turns quaternions by Munthe-Kaas' method.

    The rotation over a sub-step is the integral of the angular velocity with a correction for the change of its axis.
    (``mjx.step`` 3.17 has the plain integral, and misses C by 1e-5 to 1e-2 in a control step of the ant.) Stages and
    sub-steps are one flat loop: nested ones run slower on a CPU.
    """
    dt = model.opt.timestep

    def stage(carry: _Stage, coefficients: jax.Array) -> tuple[_Stage, None]:
        at, share, last = coefficients
        motion = at * dt * carry.rate
        qvel = carry.qvel + at * dt * carry.qacc
        qacc, _ = dynamics(_move(model, carry.qpos, motion), qvel, carry.warmstart)
        rate = _correct_rotations(model, motion, qvel)
        mean_rate, mean_qacc = carry.mean_rate + share * rate, carry.mean_qacc + share * qacc

        under_way = _Stage(carry.qpos, carry.qvel, carry.warmstart, rate, qacc, mean_rate, mean_qacc)
        qpos = _move(model, carry.qpos, dt * mean_rate)
        ended = _Stage(qpos, carry.qvel + dt * mean_qacc, qacc, zero, zero, zero, zero)
        return jax.tree.map(lambda new, old: jnp.where(last > 0, new, old), ended, under_way), None

    zero = jnp.zeros_like(start[1])
    coefficients = jnp.tile(jnp.asarray(_STAGES), (substeps, 1))
    end = jax.lax.scan(stage, _Stage(*start, zero, zero, zero, zero), coefficients)[0]
    return end.qpos, end.qvel, end.warmstart


def _correct_rotations(model: mujoco.MjModel, motion: jax.Array, qvel: jax.Array) -> jax.Array:
    """Return ``qvel[nv]``, each free joint's angular velocity w made the rate of the rotation vector u in ``motion``.

    The inverse derivative of the exponential map, w + [u, w] / 2 + [u, [u, w]] / 12, up to terms of fourth order.
    """
    free = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    for dof in free + 3:
        u, w = motion[dof : dof + 3], qvel[dof : dof + 3]
        bracket = jnp.cross(u, w)
        qvel = qvel.at[dof : dof + 3].set(w + bracket / 2 + jnp.cross(u, bracket) / 12)
    return qvel


def _move(model: mujoco.MjModel, qpos: jax.Array, motion: jax.Array) -> jax.Array:
    """Return ``qpos[nq]`` moved by ``motion[nv]`` (velocity times time), quaternions on their sphere."""
    parts = []
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            parts += [qpos[q : q + 3] + motion[v : v + 3], _rotate(qpos[q + 3 : q + 7], motion[v + 3 : v + 6])]
        else:
            parts.append(qpos[q : q + 1] + motion[v : v + 1])
    return jnp.concatenate(parts)


def _rotate(quat: jax.Array, turn: jax.Array) -> jax.Array:
    """Return ``quat[4]`` turned by the rotation vector ``turn[3]`` (body frame, radians), normalised."""
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
