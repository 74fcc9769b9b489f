"""MuJoCo C, stepped in threads from inside jit: the exact engine, and the fast one where there is no accelerator.

One callback makes one control step of the whole batch (all ``vmap`` axes flattened). The full integration state of
MuJoCo, warm start included, travels through jax as the bits of its float64 numbers, so that a rollout equals a plain
loop of ``mujoco.mj_step`` bit for bit, and the callback stays a pure function of its arguments.
"""

from __future__ import annotations

import os
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco.batch import Batch

from envs.physics.base import PipelineState


class MujocoCarry(struct.PyTreeNode):
    """The exact state.

    Attributes:
        bits: uint32[2 * nstate], the float64 row of ``mjSTATE_INTEGRATION``, seen as pairs of words.
        fresh: bool, True after ``init``: no row was made yet, the next step starts from qpos and qvel.
    """

    bits: jax.Array
    fresh: jax.Array


class MujocoEngine:
    """Steps ``model`` on all cores.

    Args:
        model: the compiled model; no activation states and no plugins (the ant and humanoid tasks have none).
        frame_skip: sub-steps per control step.
        threads: threads of the pool; None takes the cores this process may use.
    """

    name = "mujoco"

    def __init__(self, model: mujoco.MjModel, frame_skip: int = 5, threads: int | None = None) -> None:
        self.model = model
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self._frame_skip = frame_skip
        self._threads = threads or len(os.sched_getaffinity(0))
        self._nstate = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        self._rest = _integration_state(model)
        self._batches: dict[int, Batch] = {}
        self._lock = threading.Lock()  # a Batch must not be used from two threads at once

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        """The state at (qpos[nq], qvel[nv]) without warm start, as after ``mj_resetData`` and ``set_state``."""
        carry = MujocoCarry(bits=jnp.zeros(2 * self._nstate, jnp.uint32), fresh=jnp.ones((), bool))
        return PipelineState(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), carry)

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """One control step under ``action[nu]`` (clamped by the model's control range)."""
        shapes = (
            jax.ShapeDtypeStruct((self.nq,), jnp.float32),
            jax.ShapeDtypeStruct((self.nv,), jnp.float32),
            jax.ShapeDtypeStruct((2 * self._nstate,), jnp.uint32),
        )
        qpos, qvel, bits = jax.pure_callback(
            self._step_batch,
            shapes,
            state.qpos,
            state.qvel,
            state.carry.bits,
            state.carry.fresh,
            jnp.asarray(action, jnp.float32),
            vmap_method="broadcast_all",
        )
        return PipelineState(qpos, qvel, MujocoCarry(bits=bits, fresh=jnp.zeros_like(state.carry.fresh)))

    def exact_state(self, state: PipelineState) -> tuple[np.ndarray, np.ndarray]:
        """The float64 (qpos[..., nq], qvel[..., nv]) behind a stepped state; for parity tests, outside jit."""
        rows = np.ascontiguousarray(np.asarray(state.carry.bits)).view(np.float64)
        return rows[..., 1 : 1 + self.nq], rows[..., 1 + self.nq : 1 + self.nq + self.nv]

    def _step_batch(
        self, qpos: jax.Array, qvel: jax.Array, bits: jax.Array, fresh: jax.Array, action: jax.Array
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The callback: NumPy only, since jax inside a callback can deadlock (jax issue 24255)."""
        lead = np.shape(fresh)
        n = int(np.prod(lead, dtype=int))
        starts = np.asarray(fresh).reshape(n)
        rows = np.ascontiguousarray(np.asarray(bits).reshape(n, -1)).view(np.float64)
        with self._lock:
            batch = self._batch(n)
            np.copyto(batch.state, rows)
            if starts.any():
                batch.state[starts] = self._rest
                batch.bind("qpos")[starts] = np.asarray(qpos).reshape(n, -1)[starts]
                batch.bind("qvel")[starts] = np.asarray(qvel).reshape(n, -1)[starts]
            batch.bind("ctrl")[:] = np.asarray(action).reshape(n, -1)
            batch.step(nstep=self._frame_skip)
            new_rows = batch.state.copy()
        new_qpos = new_rows[:, 1 : 1 + self.nq].astype(np.float32)
        new_qvel = new_rows[:, 1 + self.nq : 1 + self.nq + self.nv].astype(np.float32)
        return (
            new_qpos.reshape(*lead, -1),
            new_qvel.reshape(*lead, -1),
            new_rows.view(np.uint32).reshape(*lead, -1),
        )

    def _batch(self, n: int) -> Batch:
        if n not in self._batches:
            self._batches[n] = Batch(self.model, nsim=n, nthread=min(self._threads, n))
        return self._batches[n]


def _integration_state(model: mujoco.MjModel) -> np.ndarray:
    """float64[nstate], the integration state of a freshly made MjData."""
    data = mujoco.MjData(model)
    row = np.empty(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION)))
    mujoco.mj_getState(model, data, row, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    return row
