"""MJX: the physics on an accelerator.

MJX pays for every pair of geoms that could touch, so a scene of a hundred boxes is out of the question: only what is in
reach is there, mocap bodies that the task moves before each control step (for mazes ``envs.mazes.walls.NearWalls``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

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

Surroundings = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""From qpos[nq]: a shift[nq] of positions towards the origin, where float32 is finest, and where the mocap bodies are
relative to it, [k, 3]."""


class MjxEngine:
    """Step simulations in jax.

    Args:
        model: the moving bodies and the mocap bodies around them. All its constraints have to be one-sided (limits,
            pyramidal contacts), see ``envs.physics.mjx.solver``.
        surroundings: places the mocap bodies before each control step.
        most_contacts: by dimension, how many contacts are kept, the deepest ones.
        frame_skip: sub-steps per control step.
        sensors: what to read after each control step, from the kinematics of the new state; None reads nothing.

    Raises:
        ValueError: the model has constraints of another kind.
    """

    name = "mjx"
    extra_size = 0

    def __init__(
        self,
        model: mujoco.MjModel,
        surroundings: Surroundings,
        most_contacts: Mapping[int, int],
        frame_skip: int = 5,
        sensors: Sensors | None = None,
    ) -> None:
        if model.neq or model.dof_frictionloss.any() or model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
            raise ValueError("the MJX engine wants a model without equalities and friction loss, with pyramidal cones")
        self.model = model
        self.nq, self.nv, self.action_size = model.nq, model.nv, model.nu
        self.frame_skip = frame_skip
        self._surroundings = surroundings
        self._sensors = sensors
        self._mjx_model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")
        self._constraints = Constraints(model, self._mjx_model, most_contacts)

    def init(
        self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None = None, key: jax.Array | None = None
    ) -> PipelineState:
        """Return the state at (qpos[nq], qvel[nv]) without warm start; there are no ``extra`` and no chances here."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        sensed, none = self._sense(qpos, qvel), jnp.zeros(0, jnp.int32)
        return PipelineState(qpos, qvel, sensed, none, jnp.zeros_like(qvel), jnp.zeros((), jnp.int32))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """Return the state after one control step under ``action[act]`` (clamped by the model's control range)."""
        shift, mocap = self._surroundings(state.qpos)
        qpos, qvel, warmstart = self._move((state.qpos - shift, state.qvel, state.carry), mocap, action)
        qpos = qpos + shift
        sensed = self._sense(qpos, qvel)
        return state.replace(qpos=qpos, qvel=qvel, sensed=sensed, carry=warmstart, steps=state.steps + 1)

    def idle(self, state: PipelineState, over: jax.Array) -> PipelineState:
        """Return ``state``: a batch steps as one."""
        return state

    def _move(self, start: Motion, mocap: jax.Array, action: jax.Array) -> Motion:
        """Make all sub-steps, with the mocap bodies at ``mocap[k, 3]``."""

        def dynamics(qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array) -> tuple[jax.Array, jax.Array]:
            return self._acceleration(qpos, qvel, warmstart, mocap, action)

        return integrate(self.model, dynamics, start, self.frame_skip)

    def _acceleration(
        self, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, mocap: jax.Array, action: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the constrained acceleration[nv] and the joint-space inertia[nv, nv]."""
        data = self._data.replace(qpos=qpos, qvel=qvel, ctrl=action, mocap_pos=mocap)
        with jax.default_matmul_precision("highest"):  # never TF32
            for stage in _STAGES:
                data = stage(self._mjx_model, data)
            mass = mjx.full_m(self._mjx_model, data)
            force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
            return solve(mass, force, *self._constraints.rows(data), warmstart), mass

    def _sense(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return float[k], what the body senses in this state."""
        if self._sensors is None:
            return jnp.zeros(0)
        data = self._data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel, mjx.sensor_vel):
                data = stage(self._mjx_model, data)
        return self._sensors.read(self.model, data.xpos, data.xmat, data.sensordata)
