"""Step batches of simulations in threads: NumPy in, NumPy out."""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.physics.mujoco import clock
from envs.physics.mujoco.rig import Rig

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_MOST_KEPT = 256  # simulations whose MjData are kept: each takes the model's arena of address space
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_TINY = float(np.finfo(np.float32).tiny)  # XLA takes float32 numbers below it for 0


class BatchStep(NamedTuple):
    """Hold n simulations after a control step.

    Attributes:
        exact: float64[n, nstate + m], rows of ``mjSTATE_INTEGRATION``, and after them the rig's memory.
        extra: int32[n, e], the discrete state.
        sensed: float32[n, k], what the rig reads of the state.
    """

    exact: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray


class BatchStepper:
    """Step any number of simulations of a model; several threads may call it at once.

    Args:
        model: the compiled model; no activation states and no plugins.
        rig: what connects actions, model and sensors to the task.
        frame_skip: sub-steps per control step.
        threads: threads of a batch; None takes the cores this process may use. Calls at once share them.
    """

    def __init__(self, model: mujoco.MjModel, rig: Rig, frame_skip: int, threads: int | None = None) -> None:
        self.nstate = mujoco.mj_stateSize(model, INTEGRATION)
        self._model, self._rig, self._frame_skip = model, rig, frame_skip
        self._positions = slice(1, 1 + model.nq)
        self._velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
        self._threads = threads or len(os.sched_getaffinity(0))
        self._rest = _rest_row(model)
        self._exact_qpos = rig.exact_qpos
        self._idle: dict[tuple[int, int], list[Batch]] = defaultdict(list)
        clock.stop()

    def identity(self) -> bytes:
        """Return all that decides what a step computes, but for the rig's share."""
        content = np.empty(mujoco.mj_sizeModel(self._model), np.uint8)
        mujoco.mj_saveModel(self._model, None, content)
        return content.tobytes() + repr((mujoco.__version__, self._frame_skip, self._threads)).encode()

    def start(
        self, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rig's (memory float64[n, m], sensed float32[n, k]) at rest rows with (qpos, qvel, extra).

        Args:
            qpos: float32[n, nq].
            qvel: float32[n, nv].
            extra: int32[n, e].
            noise: float32[n, rig.noise_size].
        """
        with self._batch(len(qpos)) as batch:
            batch.state[:] = self._rest
            batch.bind("qpos")[:] = self._fresh_qpos(qpos)
            batch.bind("qvel")[:] = qvel
            batch.forward(stage=int(self._rig.stage))
            return self._disturbed(*self._rig.start(batch, extra), noise)

    def step(
        self,
        exact: np.ndarray,
        fresh: np.ndarray,
        qpos: np.ndarray,
        qvel: np.ndarray,
        extra: np.ndarray,
        action: np.ndarray,
        noise: np.ndarray,
    ) -> BatchStep:
        """Return n simulations after one control step.

        Args:
            exact: float64[n, nstate + m], as the last step returned it.
            fresh: bool[n], where no step was made yet: there the row starts from rest, qpos and qvel.
            qpos: float32[n, nq]; a number that is no longer the rounding of the exact one was changed by hand, and
                counts.
            qvel: float32[n, nv], likewise.
            extra: int32[n, e].
            action: float32[n, act].
            noise: float32[n, rig.noise_size].
        """
        rig, memory = self._rig, exact[:, self.nstate :]
        with self._batch(len(exact)) as batch:
            np.copyto(batch.state, exact[:, : self.nstate])
            self._begin(batch, fresh, qpos, qvel)
            # A state that is not finite stays as it is, for the task to see; MuJoCo would spend long on it.
            finite = np.isfinite(batch.state)
            ids = None if finite.all() else np.flatnonzero(finite.all(axis=1))
            rig.before(batch, extra)
            qpos_before = batch.bind("qpos").copy()
            batch.bind("ctrl")[:] = rig.ctrl(qpos_before, batch.bind("qvel"), memory, extra, action)
            self._sub_steps(batch, ids)
            rows = np.empty_like(exact)
            memory, extra, sensed = rig.after(batch, qpos_before, memory, extra)
            rows[:, self.nstate :], sensed = self._disturbed(memory, sensed, noise)
            rows[:, : self.nstate] = batch.state
        return BatchStep(rows, extra, sensed)

    def _sub_steps(self, batch: Batch, ids: np.ndarray | None) -> None:
        """Make a control step's sub-steps, with sensors in the last alone if that is all that can be read.

        They cost an arm 5 % of its step: a force that is sensed asks for those on all bodies. Where the forward pass
        after the step is gone on from, a model must not change in between.
        """
        first = self._frame_skip - 1
        if first and self._model.nsensor and self._rig.stage == mujoco.mjtStage.mjSTAGE_NONE:
            flags = batch.expand("opt.disableflags")
            flags |= _NO_SENSORS
            batch.step(ids=ids, nstep=first)
            flags[:] = self._model.opt.disableflags
            batch.step(ids=ids)
        else:
            batch.step(ids=ids, nstep=self._frame_skip, stage=int(self._rig.stage))

    def _begin(self, batch: Batch, fresh: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put fresh rows of ``batch`` at rest at (qpos, qvel), and the others where they were changed by hand."""
        held, moving = batch.bind("qpos"), batch.bind("qvel")
        # Most steps have neither, and small batches pay for every call of NumPy.
        if not fresh.any() and _rounds_to(held, qpos) and _rounds_to(moving, qvel):
            return
        batch.state[fresh] = self._rest
        held[:] = np.where(fresh[:, None], self._fresh_qpos(qpos), with_changes(held, qpos))
        moving[:] = np.where(fresh[:, None], qvel, with_changes(moving, qvel))

    def _fresh_qpos(self, qpos: np.ndarray) -> np.ndarray:
        """Return where fresh states at ``qpos`` (float32[n, nq]) start: there, or at the float64 that it stands for."""
        if self._exact_qpos is None:
            return qpos
        there = (self._exact_qpos.astype(np.float32) == qpos).all(axis=1, keepdims=True)
        return np.where(there, self._exact_qpos, qpos)

    def _disturbed(self, memory: np.ndarray, sensed: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (memory, sensed float32[n, k]) as sensors with errors have them."""
        if self._rig.noise_size:
            memory, sensed = self._rig.disturb(memory, sensed, noise)
        return memory, sensed.astype(np.float32, copy=False)

    def positions(self, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the float64 views (qpos[..., nq], qvel[..., nv]) of ``exact[..., nstate + m]``."""
        return exact[..., self._positions], exact[..., self._velocities]

    @contextmanager
    def _batch(self, n: int) -> Iterator[Batch]:
        """Yield a batch of n that no other thread uses: programs on several devices call the engine at once."""
        with _calls.one_more() as calls:
            threads = min(n, max(1, self._threads // calls))
            idle = self._idle[n, threads]
            batch = idle.pop() if idle else self._new_batch(n, threads)
            yield batch
            idle.append(batch)

    def _new_batch(self, n: int, threads: int) -> Batch:
        # Where each simulation keeps its MjData, a step goes on from the forward pass after the one before, if neither
        # state nor model were changed in between; the bits are the same.
        kept = self._rig.stage != mujoco.mjtStage.mjSTAGE_NONE and n <= _MOST_KEPT
        batch = _ViewKeepingBatch(self._model, nsim=n, nthread=threads, persistent=kept)
        for name in self._rig.fields:  # a field is filled from the first call after it was bound
            batch.bind(name)
        return batch


class _Calls:
    """Count the calls that step at once: members of a scan on two cores would wake four threads."""

    def __init__(self) -> None:
        self._lock, self._count = threading.Lock(), 0

    @contextmanager
    def one_more(self) -> Iterator[int]:
        """Yield how many there are, this one included."""
        with self._lock:
            self._count += 1
            count = self._count
        try:
            yield count
        finally:
            with self._lock:
                self._count -= 1


_calls = _Calls()


class _ViewKeepingBatch(Batch):
    """Keep every view that was asked for: ``Batch`` makes those of state fields anew at each call, six a step."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._views: dict[str, np.ndarray] = {}

    def bind(self, name: str) -> np.ndarray:
        """Return the live array of a field."""
        if name not in self._views:
            self._views[name] = super().bind(name)
        return self._views[name]


def _rounds_to(exact: np.ndarray, values: np.ndarray) -> bool:
    """Return whether ``values`` (float32) are the roundings of ``exact`` (float64), bit for bit."""
    return exact.astype(np.float32).tobytes() == values.tobytes()


def with_changes(exact: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``exact`` (float64), but ``values`` (float32) where they are not its rounding.

    A 0 may be what compiled programs made of a number that is too small for them.
    """
    same = (exact.astype(np.float32) == values) | ((values == 0) & (np.abs(exact) < _TINY))
    return np.where(same, exact, values)


def _rest_row(model: mujoco.MjModel) -> np.ndarray:
    """Return float64[nstate], the integration state of a freshly made MjData."""
    data = mujoco.MjData(model)
    row = np.empty(mujoco.mj_stateSize(model, INTEGRATION))
    mujoco.mj_getState(model, data, row, INTEGRATION)
    return row
