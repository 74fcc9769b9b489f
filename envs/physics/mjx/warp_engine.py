"""Step with MuJoCo Warp through MJX: NVIDIA's kernels for the sub-steps, for large batches on a CUDA device.

Walls, coordinates and sensors are those of ``MjxEngine``; the sub-steps are ``mjx.step`` with ``impl="warp"``: Warp's
own contacts and solver. Against MuJoCo C a control step agrees to 1e-6 (median) in free flight; in contact, with the
floor or a wall, it is off by 1e-3 and up to 1e-2. ``MjxEngine`` is the exact one.

Warp stores the contacts of all worlds of a batch in one buffer, and what does not fit is dropped with a printed line.
Here the buffer has a place for every pair of geoms that could touch, in each world: the search for pairs cannot outgrow
it, and contacts, at most two for each of a few pairs, do not. Constraint rows, which every world has for itself, have
room for as many contacts as ``MjxEngine`` keeps. A world in which something was dropped all the same gets a qpos of
NaN: ``envs.AutoReset`` ends its episode and counts it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from envs.physics.mjx.engine import MjxEngine
from envs.physics.mjx.integrators import Motion

# Of mujoco_warp's OverflowType: constraint rows (two kinds), pairs, contacts, convex collisions; not the iterations'.
_DROPPED = 1 | 2 | 4 | 8 | 16


class MjxWarpEngine(MjxEngine):
    """Step as ``MjxEngine``, but for the sub-steps; all ``vmap`` axes become one batch of worlds.

    It runs on a CPU too (slowly; for tests). ``envs.physics.why_not`` returns where it may be chosen.
    """

    name = "mjx-warp"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._warp_model = mjx.put_model(self.model, impl="warp")
        self._worlds: dict[int, mjx.Data] = {}

    def _move(self, start: Motion, mocap: jax.Array, action: jax.Array) -> Motion:
        return _as_one_batch(self._move_batch)(*start, mocap, action)

    def _move_batch(
        self, qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, mocap: jax.Array, action: jax.Array
    ) -> Motion:
        """Make all sub-steps of n worlds; arguments and results have n rows."""
        blank = jax.tree.map(_constant, self._blank_worlds(len(qpos)))

        def world(
            qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, mocap: jax.Array, action: jax.Array
        ) -> Motion:
            data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, mocap_pos=mocap, ctrl=action)
            data, _ = jax.lax.scan(lambda d, _: (mjx.step(self._warp_model, d), None), data, None, self.frame_skip)
            dropped = (data._impl.overflow & _DROPPED) != 0
            return jnp.where(dropped, jnp.nan, data.qpos), data.qvel, data.qacc_warmstart

        return jax.vmap(world)(qpos, qvel, warmstart, mocap, action)

    def _blank_worlds(self, n: int) -> mjx.Data:
        """Return MJX's data of one world, with buffers for ``n``, in NumPy."""
        if n not in self._worlds:
            contacts = n * self._constraints.num_pairs
            with jax.ensure_compile_time_eval():
                data = mjx.make_data(self.model, impl="warp", naconmax=contacts, njmax=self._constraints.most_rows)
            self._worlds[n] = jax.tree.map(np.asarray, data)
        return self._worlds[n]


def _constant(leaf: np.ndarray) -> jax.Array:
    """Return ``leaf`` inside a program; buffers that are all one number are made there, for they are large."""
    if leaf.size and (leaf == leaf.flat[0]).all():
        return jnp.full(leaf.shape, leaf.flat[0], leaf.dtype)
    return jnp.asarray(leaf)


def _as_one_batch(batched: Callable[..., Motion]) -> Callable[..., Motion]:
    """Return a function of single rows from one of n rows, that any number of ``vmap`` s call once, with all rows."""

    @jax.custom_batching.custom_vmap
    def rows(*args: jax.Array) -> Motion:
        return batched(*args)

    @rows.def_vmap
    def more_rows(size: int, is_batched: list[bool], *args: jax.Array) -> tuple[Motion, Any]:
        spread = [a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(args, is_batched, strict=True)]
        out = rows(*(a.reshape(-1, *a.shape[2:]) for a in spread))
        return jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), out), (True, True, True)

    def single(*args: jax.Array) -> Motion:
        qpos, qvel, warmstart = rows(*(a[None] for a in args))
        return qpos[0], qvel[0], warmstart[0]

    return single
