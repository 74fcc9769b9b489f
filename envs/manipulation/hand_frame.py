"""What a kitchen's arm cannot read off its joints' angles: where its finger tips are, and the handles from there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

TIP = 0.255  # m along link 7's z, where the finger tips are
HAND = "panda0_link7"
HANDLES = {
    "bottom burner": "knob2_site",
    "top burner": "knob4_site",
    "light switch": "light_site",
    "slide cabinet": "slide_site",
    "hinge cabinet": "hinge_site2",
    "microwave": "microhandle_site",
    "kettle": "kettle_site",
}
"""Sites of the model at which the hand moves things, by subtask."""

_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class HandFrame:
    """Show the kitchen from the finger tips, by the kinematics of what the arm's and the things' sensors say.

    A pose is the place of the tips (m). Nothing is read that is not in the observation.

    Args:
        model: the kitchen's.
        observed_qpos: int[nq], where in an observation the numbers of qpos are.
    """

    pose_size = 3

    def __init__(self, model: mujoco.MjModel, observed_qpos: np.ndarray) -> None:
        self._observed = observed_qpos
        self._hand, sites = model.body(HAND).id, [model.site(name) for name in HANDLES.values()]
        self._sites = [(int(site.bodyid[0]), site.pos.copy()) for site in sites]
        needed = {body for end in (self._hand, *(body for body, _ in self._sites)) for body in _ancestors(model, end)}
        # In this order: a parent's number is below its children's.
        self._bodies = {body: _Body(model, body) for body in sorted(needed)}

    def size(self, observation_size: int) -> int:
        """Return the numbers of ``see``."""
        return observation_size + self.pose_size + 9 + 3 * len(self._sites)

    def pose(self, observation: jax.Array) -> jax.Array:
        """Return where the tips are, [..., 3], at ``observation[..., obs]``, in its own units."""
        tips, _, _ = self._places(observation)
        return tips

    def see(self, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return float[..., obs + 12 + 3 handles] in a skill that began with the tips at ``pose[..., 3]``.

        Behind the observation stand the way of the tips since then, the hand's rotation, and where each of ``HANDLES``
        is as seen from the tips.
        """
        tips, beside = self._look(observation)
        return jnp.concatenate([observation, tips - pose, beside], axis=-1)

    def beside(self, observation: jax.Array) -> jax.Array:
        """Return float[..., 9 + 3 handles], the hand's rotation and the handles as seen from the tips."""
        return self._look(observation)[1]

    def _look(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the tips [..., 3], and what ``beside`` returns."""
        tips, rotation, handles = self._places(observation)
        return tips, jnp.concatenate([rotation, *(place - tips for place in handles)], axis=-1)

    def _places(self, observation: jax.Array) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
        """Return the tips [..., 3], link 7's rotation [..., 9], and the handles' places, [..., 3] each."""
        qpos = observation[..., self._observed].reshape(-1, len(self._observed)).T
        found = {0: (jnp.zeros((3, 1)), jnp.eye(3)[:, :, None])}
        for number, body in self._bodies.items():
            # Without the barrier XLA fuses the chain, and finds a body's parents anew for each of its twelve numbers.
            found[number] = jax.lax.optimization_barrier(body.place(qpos, *found[body.parent]))

        def rows(numbers: jax.Array) -> jax.Array:
            shape = (*observation.shape[:-1], len(numbers))
            return jnp.broadcast_to(numbers, (len(numbers), qpos.shape[1])).T.reshape(shape)

        place, rotation = found[self._hand]
        handles = [rows(found[body][0] + _apply(found[body][1], offset)) for body, offset in self._sites]
        return rows(place + TIP * rotation[:, 2]), rows(rotation.reshape(9, -1)), handles


class _Body:
    """Place a body by its parent's place and its joints, as ``mj_kinematics`` does, of n states at once.

    The states are the last axis: few numbers of many states, which one vector instruction takes.

    Args:
        model: which it is part of.
        body: its number.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self.parent = int(model.body_parentid[body])
        self._offset, self._turn = model.body_pos[body].copy(), _matrix(model.body_quat[body])
        first = int(model.body_jntadr[body])
        self._joints = [_Joint(model, joint) for joint in range(first, first + int(model.body_jntnum[body]))]

    def place(self, qpos: jax.Array, place: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (place[3, n], rotation[3, 3, n]) at ``qpos[nq, n]``, for those of the parent."""
        place, rotation = place + _apply(rotation, self._offset), _times(rotation, self._turn[:, :, None])
        for joint in self._joints:
            place, rotation = joint.move(qpos, place, rotation)
        return place, rotation


class _Joint:
    """Move a body by a hinge, a slide, or to where it is when it is free.

    Args:
        model: which it is part of.
        joint: its number.
    """

    def __init__(self, model: mujoco.MjModel, joint: int) -> None:
        self._kind, self._address = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
        self._axis, self._anchor = model.jnt_axis[joint].copy(), model.jnt_pos[joint].copy()
        self._rest = float(model.qpos0[self._address])
        self._cross = np.cross(np.eye(3), self._axis)  # times a vector: the axis cross it

    def move(self, qpos: jax.Array, place: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the body's place and rotation after the joint."""
        if self._kind == _FREE:
            at = self._address
            return qpos[at : at + 3], _rotation(qpos[at + 3 : at + 7])
        by = qpos[self._address] - self._rest
        if self._kind == _SLIDE:
            return place + by * _apply(rotation, self._axis), rotation
        fixed = place + _apply(rotation, self._anchor)
        once, twice = self._cross[:, :, None], (self._cross @ self._cross)[:, :, None]
        rotation = _times(rotation, np.eye(3)[:, :, None] + jnp.sin(by) * once + (1 - jnp.cos(by)) * twice)
        return fixed - _apply(rotation, self._anchor), rotation


def _times(first: jax.Array, then: jax.Array | np.ndarray) -> jax.Array:
    """Return the products [3, 3, n] of matrices first[3, 3, n] and then[3, 3, n]."""
    return (first[:, :, None] * then[None]).sum(axis=1)


def _apply(rotation: jax.Array, vector: np.ndarray) -> jax.Array:
    """Return ``vector[3]`` turned by ``rotation[3, 3, n]``: [3, n]."""
    return (rotation * vector[:, None]).sum(axis=1)


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and those that carry it, without the world."""
    found = []
    while body:
        found.append(body)
        body = int(model.body_parentid[body])
    return found


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _rotation(quaternion: jax.Array) -> jax.Array:
    """Return the rotations [3, 3, n] of ``quaternion[4, n]``, which sensors leave short of length 1."""
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
