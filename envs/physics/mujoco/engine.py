"""MuJoCo C, stepped in threads from inside jit: the exact engine, and the fast one where there is no accelerator.

One callback makes one control step of the whole batch (all ``vmap`` axes flattened). The full integration state of
MuJoCo, warm start included, and what the rig remembers travel through jax as the bits of their float64 numbers, so that
a rollout equals a plain loop of ``mujoco.mj_step`` bit for bit, and the callback stays a pure function of its
arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from envs.physics.base import PipelineState
from envs.physics.host_function import HostFunction
from envs.physics.mujoco.rig import Rig
from envs.physics.mujoco.simulations import Simulations
from envs.physics.mujoco.stepper import BatchStepper, with_changes

_SENSORS = 0x5E50
"""Folded into a start's key, for the sensors' errors: far from the counts of keys that the start itself splits off."""


class MujocoCarry(struct.PyTreeNode):
    """Hold the exact state.

    Attributes:
        bits: uint32[2 * (nstate + m)], the float64 row of ``mjSTATE_INTEGRATION`` and the rig's memory, seen as pairs
            of words.
        fresh: bool, True after ``init``: no row was made yet, the next step starts from qpos and qvel.
        key: what the sensors' errors are drawn from; None for rigs whose sensors do not err.
    """

    bits: jax.Array
    fresh: jax.Array
    key: jax.Array | None = None


class MujocoEngine:
    """Step a model on all cores.

    Args:
        model: the compiled model; no activation states and no plugins.
        rig: what connects actions, model and sensors to the task; None takes actions as controls.
        frame_skip: sub-steps per control step.
        threads: threads of the pool; None takes the cores this process may use.
    """

    name = "mujoco"

    def __init__(
        self, model: mujoco.MjModel, rig: Rig | None = None, frame_skip: int = 5, threads: int | None = None
    ) -> None:
        self.model = model
        self.frame_skip = frame_skip
        self._rig = rig or Rig()
        self.nq, self.nv = model.nq, model.nv
        self.action_size = model.nu if self._rig.action_size is None else self._rig.action_size
        self.extra_size = self._rig.extra_size
        self._stepper = BatchStepper(model, self._rig, frame_skip, threads)
        identity = self._stepper.identity() + self._rig.identity()
        self._step = HostFunction(self._step_batch, b"step" + identity)
        self._start = HostFunction(self._start_batch, b"start" + identity)

    def init(
        self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None = None, key: jax.Array | None = None
    ) -> PipelineState:
        """Return the state at (qpos[nq], qvel[nv], extra[e]), as after ``mj_resetData`` and ``set_state``.

        There is no warm start; None takes zeros as ``extra`` and a fixed ``key`` for the sensors' errors, if there are.
        """
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        extra = jnp.zeros(self.extra_size, jnp.int32) if extra is None else jnp.asarray(extra, jnp.int32)
        memory, sensed = jnp.zeros(2 * self._rig.memory_size, jnp.uint32), jnp.zeros(self._rig.sensed_size)
        noise, key = self._draw(None if key is None else jax.random.fold_in(key, _SENSORS))
        if self._rig.memory_size or self._rig.sensed_size:
            discrete = (extra,) if self.extra_size else ()
            memory, sensed = self._start((_shape_of(memory), _shape_of(sensed)), qpos, qvel, *discrete, *noise)
        bits = jnp.concatenate([jnp.zeros(2 * self._stepper.nstate, jnp.uint32), memory])
        carry = MujocoCarry(bits=bits, fresh=jnp.ones((), bool), key=key)
        return PipelineState(qpos, qvel, sensed, extra, carry, jnp.zeros((), jnp.int32))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """Return the state after one control step under ``action[act]`` (clamped by the model's control range).

        A number of qpos or qvel that is no longer the rounding of the exact one was changed by hand, and counts.
        """
        discrete = (state.extra,) if self.extra_size else ()  # an empty array would cost every call microseconds
        noise, key = self._draw(state.carry.key)
        qpos, qvel, sensed, bits, *extra = self._step(
            tuple(map(_shape_of, (state.qpos, state.qvel, state.sensed, state.carry.bits, *discrete))),
            state.qpos,
            state.qvel,
            state.carry.bits,
            state.carry.fresh,
            jnp.asarray(action, jnp.float32),
            *discrete,
            *noise,
        )
        carry = MujocoCarry(bits=bits, fresh=jnp.zeros_like(state.carry.fresh), key=key)
        return PipelineState(qpos, qvel, sensed, extra[0] if extra else state.extra, carry, state.steps + 1)

    def idle(self, state: PipelineState, over: jax.Array) -> PipelineState:
        """Return ``state``, not finite where ``over``: such simulations stay as they are, and cost no physics."""
        return state.replace(qpos=jnp.where(over, jnp.nan, state.qpos))

    def simulations(self, rng: np.random.Generator) -> Simulations:
        """Return simulations to be started and stepped outside jax; ``rng`` is what the sensors' errors come from."""
        return Simulations(self._stepper, self._rig, rng)

    def exact_state(self, state: PipelineState) -> tuple[np.ndarray, np.ndarray]:
        """Return the float64 (qpos[..., nq], qvel[..., nv]) behind a stepped state; for parity tests, outside jit."""
        qpos, qvel = self._stepper.positions(_numbers(state.carry.bits))
        return with_changes(qpos, np.asarray(state.qpos)), with_changes(qvel, np.asarray(state.qvel))

    def _draw(self, key: jax.Array | None) -> tuple[tuple[jax.Array, ...], jax.Array | None]:
        """Return a state's errors of the sensors, if there are, and the key for those after it."""
        if not self._rig.noise_size:
            return (), None
        now, later = jax.random.split(jax.random.key(_SENSORS) if key is None else key)
        return (jax.random.uniform(now, (self._rig.noise_size,), minval=-1.0),), later

    def _step_batch(
        self, qpos: jax.Array, qvel: jax.Array, bits: jax.Array, fresh: jax.Array, action: jax.Array, *more: jax.Array
    ) -> tuple[np.ndarray, ...]:
        """Make a step of the whole batch: NumPy only, since jax inside a callback can deadlock (jax issue 24255)."""
        lead = np.shape(fresh)
        n = math.prod(lead)
        extra, noise = self._optional(n, more)
        step = self._stepper.step(
            _numbers(bits).reshape(n, -1),
            np.asarray(fresh).reshape(n),
            np.asarray(qpos).reshape(n, -1),
            np.asarray(qvel).reshape(n, -1),
            extra,
            np.asarray(action).reshape(n, -1),
            noise,
        )
        new_qpos, new_qvel = (values.astype(np.float32) for values in self._stepper.positions(step.exact))
        outputs = (
            new_qpos,
            new_qvel,
            step.sensed,
            step.exact.view(np.uint32),
            *([step.extra] if self.extra_size else []),
        )
        return tuple(output.reshape(*lead, output.shape[1]) for output in outputs)

    def _optional(self, n: int, arrays: Sequence[jax.Array]) -> tuple[np.ndarray, np.ndarray]:
        """Return (extra int32[n, e], noise float32[n, k]) of the ``arrays`` that were passed, empty where none was."""
        passed = iter([np.asarray(array).reshape(n, -1) for array in arrays])
        extra = next(passed) if self.extra_size else np.zeros((n, 0), np.int32)
        return extra, next(passed) if self._rig.noise_size else np.zeros((n, 0), np.float32)

    def _start_batch(self, *arrays: jax.Array) -> tuple[np.ndarray, ...]:
        """Return what the rig remembers and senses at (qpos, qvel, extra), for the whole batch."""
        lead = np.shape(arrays[0])[:-1]
        n = math.prod(lead)
        qpos, qvel, *more = arrays
        memory, sensed = self._stepper.start(
            np.asarray(qpos).reshape(n, -1), np.asarray(qvel).reshape(n, -1), *self._optional(n, more)
        )
        outputs = (np.ascontiguousarray(memory, np.float64).view(np.uint32), sensed)
        return tuple(output.reshape(*lead, output.shape[1]) for output in outputs)


def _shape_of(array: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def _numbers(bits: jax.Array | np.ndarray) -> np.ndarray:
    """Return the float64[..., k] that ``bits`` (uint32[..., 2 k]) are."""
    return np.ascontiguousarray(np.asarray(bits)).view(np.float64)
