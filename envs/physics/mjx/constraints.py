"""Make the constraints of a state, joint limits and the deepest contacts, as rows for ``envs.physics.mjx.solver``.

MuJoCo documentation, "Computation" (constraint model), for pyramidal cones. Everything that a pair of geoms decides
(friction, stiffness, which joints move the one against the other) is tabulated beforehand, so that a step finds the
contacts of all pairs, keeps the few deepest of each dimension, and makes rows of these alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from envs.physics.mjx.contacts import COLLIDERS


class ConstraintRows(NamedTuple):
    """Hold constraints a >= r on accelerations: rows of zeros stand for those that are not in force.

    Attributes:
        jacobian: float[n, nv].
        stiffness: float[n], D of each.
        reference: float[n], r of each.
    """

    jacobian: jax.Array
    stiffness: jax.Array
    reference: jax.Array


class _Table(NamedTuple):
    """Hold what is known beforehand about C possible constraints.

    Attributes:
        margin: float[C], a distance below it puts the constraint in force.
        gains: float[C, 2], restoring acceleration per m (or rad) of violation at full impedance, and damping per s.
        impedance: float[C, 5], MuJoCo's solimp.
        inverse_weight: float[C], inertia of one row, inverse.
    """

    margin: Any
    gains: Any
    impedance: Any
    inverse_weight: Any


class _Pairs(NamedTuple):
    """Hold all pairs of geoms whose contacts have the same dimension, in the order in which they are collided.

    Attributes:
        dimension: 1, 3, 4 or 6.
        keep: contacts that are kept.
        groups: (kinds of geoms, pairs of them int[., 2]) for each collision function.
        table: of the contacts.
        friction: float[C, dimension - 1].
        moves: float[C, nv], 1 for joints that carry the second geom, -1 for those of the first, 0 for both or neither.
    """

    dimension: int
    keep: int
    groups: list[tuple[collision_driver.FunctionKey, np.ndarray]]
    table: _Table
    friction: np.ndarray
    moves: np.ndarray


class Constraints:
    """Make the rows of a model.

    Args:
        model: MuJoCo's model, with pyramidal cones; only its joint limits and contacts count.
        mjx_model: the same on the device.
        most_contacts: by dimension, how many contacts are kept. MuJoCo C keeps all.

    Raises:
        ValueError: contacts of a dimension that ``most_contacts`` does not have.
    """

    def __init__(self, model: mujoco.MjModel, mjx_model: mjx.Model, most_contacts: Mapping[int, int]) -> None:
        self._model = model
        self._mjx_model = mjx_model
        self._limited = np.flatnonzero(model.jnt_limited)
        self._limits = _limit_table(model, self._limited)
        self._pairs = _tabulate_pairs(model, mjx_model, most_contacts)
        self._root = model.body_rootid[model.dof_bodyid]  # int[nv], whose centre of mass cdof is taken about

    @property
    def num_pairs(self) -> int:
        """Return the number of pairs of geoms that could touch."""
        return sum(len(geoms) for pairs in self._pairs for _, geoms in pairs.groups)

    @property
    def most_rows(self) -> int:
        """Return the number of rows of all limits and of the most contacts kept: a pyramid has two per tangent."""
        per_contact = (pairs.keep * max(1, 2 * (pairs.dimension - 1)) for pairs in self._pairs)
        return len(self._limited) + sum(per_contact)

    def rows(self, data: mjx.Data) -> ConstraintRows:
        """Return the rows of a state whose kinematics, centres of mass and ``qvel`` are in ``data``."""
        found = [self._limit_rows(data), *(self._contact_rows(data, pairs) for pairs in self._pairs)]
        jacobian, stiffness, stretch, damping = (jnp.concatenate(part) for part in zip(*found, strict=True))
        return ConstraintRows(jacobian, stiffness, -damping * (jacobian @ data.qvel) - stretch)

    def _limit_rows(self, data: mjx.Data) -> tuple[jax.Array, ...]:
        model, joints = self._model, self._limited
        angle = data.qpos[model.jnt_qposadr[joints]]
        above, below = angle - model.jnt_range[joints, 0], model.jnt_range[joints, 1] - angle
        violation = jnp.minimum(above, below) - self._limits.margin
        towards = jnp.where(violation < 0, jnp.where(above < below, 1.0, -1.0), 0.0)
        axes = np.eye(model.nv, dtype=np.float32)[model.jnt_dofadr[joints]]
        return towards[:, None] * axes, *_spring(self._limits, violation)

    def _contact_rows(self, data: mjx.Data, pairs: _Pairs) -> tuple[jax.Array, ...]:
        distance, position, frame = self._collide(data, pairs)
        violation = distance - pairs.table.margin
        if len(violation) > pairs.keep:
            depth, deepest = jax.lax.top_k(-violation, pairs.keep)
            violation, position, frame = -depth, position[deepest], frame[deepest]
            table = _Table(*(jnp.asarray(column)[deepest] for column in pairs.table))
            friction, moves = jnp.asarray(pairs.friction)[deepest], jnp.asarray(pairs.moves)[deepest]
        else:
            table, friction, moves = pairs.table, jnp.asarray(pairs.friction), jnp.asarray(pairs.moves)
        moves = jnp.where(violation < 0, moves.T, 0.0).T

        # Velocity of the contact point per joint velocity, [k, nv, 3], then along the axes of the frame, [k, 3, nv].
        turning, sliding = data.cdof[:, :3], data.cdof[:, 3:]
        arm = position[:, None] - data.subtree_com[self._root]
        axes = [_along(frame, (sliding + jnp.cross(turning, arm)) * moves[..., None])]
        if pairs.dimension > 3:
            axes.append(_along(frame, turning * moves[..., None]))
        normal, *tangents = jnp.concatenate(axes, axis=1)[:, : pairs.dimension].swapaxes(0, 1)
        if pairs.dimension == 1:
            jacobian = normal[:, None]
        else:
            slant = friction[..., None] * jnp.stack(tangents, axis=1)
            jacobian = jnp.stack([normal[:, None] + slant, normal[:, None] - slant], axis=2)
            jacobian = jacobian.reshape(len(violation), -1, self._model.nv)
        per_contact = jacobian.shape[1]
        springs = (jnp.repeat(part, per_contact) for part in _spring(table, violation))
        return jacobian.reshape(-1, self._model.nv), *springs

    def _collide(self, data: mjx.Data, pairs: _Pairs) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return distance [C], position [C, 3] and frame [C, 3, 3] of every possible contact."""
        found = [COLLIDERS[key.types](self._mjx_model, data, key, geoms) for key, geoms in pairs.groups]
        distance, position, frame = (jnp.concatenate(part) for part in zip(*found, strict=True))
        return distance, position, frame


def _along(frame: jax.Array, vectors: jax.Array) -> jax.Array:
    """Return components [k, 3, nv] of ``vectors[k, nv, 3]`` along the rows of ``frame[k, 3, 3]``."""
    x, y, z = (frame[:, :, i, None] * vectors[:, None, :, i] for i in range(3))
    return x + y + z


def _spring(table: _Table, violation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return stiffness D, and the reference acceleration's two parts: from the violation, and per unit of velocity."""
    violation = jnp.minimum(violation, 0.0)
    impedance = _impedance(jnp.asarray(table.impedance), violation)
    softness = jnp.maximum(table.inverse_weight * (1 - impedance) / impedance, mujoco.mjMINVAL)
    gains = jnp.asarray(table.gains)
    return jnp.where(violation < 0, 1 / softness, 0.0), gains[:, 0] * impedance * violation, gains[:, 1]


def _impedance(solimp: jax.Array, violation: jax.Array) -> jax.Array:
    """Return d(r) in (0, 1), [C], from ``solimp[C, 5]``: least, most, width, midpoint, power (two power laws)."""
    least, most, width, middle, power = solimp.T
    x = jnp.minimum(jnp.abs(violation) / width, 1.0)
    early = x**power / middle ** (power - 1)
    late = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    return least + jnp.where(x < middle, early, late) * (most - least)


# --- Tables ---


def _limit_table(model: mujoco.MjModel, joints: np.ndarray) -> _Table:
    solimp = _allowed(model.jnt_solimp[joints])
    gains = _gains(model, model.jnt_solref[joints], solimp)
    weight = model.dof_invweight0[model.jnt_dofadr[joints]]
    return _Table(model.jnt_margin[joints], gains, solimp, weight)


def _tabulate_pairs(model: mujoco.MjModel, mjx_model: mjx.Model, most_contacts: Mapping[int, int]) -> list[_Pairs]:
    groups: dict[int, list[tuple[collision_driver.FunctionKey, mjx.Contact]]] = {}
    for key, contact in collision_driver._contact_groups(mjx_model, mjx.make_data(model, impl="jax")).items():
        groups.setdefault(key.condim, []).append((key, contact))
    found = []
    for dimension, members in sorted(groups.items()):
        if dimension not in most_contacts:
            raise ValueError(f"the model has contacts of dimension {dimension}; say how many of them to keep")
        parts = [_repeat(contact, COLLIDERS[key.types].ncon) for key, contact in members]
        geoms, margin, friction, solref, solimp = (np.concatenate(part) for part in zip(*parts, strict=True))
        pairs = [(key, np.asarray(contact.geom)) for key, contact in members]
        bodies = model.geom_bodyid[geoms]
        carried = _carried(model)
        solimp = _allowed(solimp)
        weight = _contact_weight(model, bodies, friction, dimension)
        table = _Table(margin, _gains(model, solref, solimp), solimp, weight)
        moves = carried[bodies[:, 1]] - carried[bodies[:, 0]]
        found.append(_Pairs(dimension, most_contacts[dimension], pairs, table, friction[:, : dimension - 1], moves))
    return found


def _repeat(contact: mjx.Contact, times: int) -> tuple[np.ndarray, ...]:
    """Return one row per contact that a collision function gives, instead of one per pair."""
    parts = (contact.geom, contact.includemargin, contact.friction, contact.solref, contact.solimp)
    return tuple(np.repeat(np.asarray(part), times, axis=0) for part in parts)


def _carried(model: mujoco.MjModel) -> np.ndarray:
    """Return float32[bodies, nv], 1 where a degree of freedom moves a body: it is the body's own, or its ancestor's."""
    carried = np.zeros((model.nbody, model.nv), np.float32)
    for body in range(1, model.nbody):
        carried[body] = carried[model.body_parentid[body]]
        carried[body, model.dof_bodyid == body] = 1.0
    return carried


def _contact_weight(model: mujoco.MjModel, bodies: np.ndarray, friction: np.ndarray, dimension: int) -> np.ndarray:
    """Return float[C]: translational inverse weights of both bodies; all edges of a pyramid share one."""
    weight = model.body_invweight0[bodies, 0].sum(axis=1)
    if dimension == 1:
        return weight
    square = friction[:, 0] ** 2
    return 2 * square / model.opt.impratio * (1 + square) * weight


def _allowed(solimp: np.ndarray) -> np.ndarray:
    """Return ``solimp[C, 5]`` within MuJoCo's bounds."""
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    return np.clip(solimp, [low, low, mujoco.mjMINVAL, low, 1.0], [high, high, np.inf, high, np.inf])


def _gains(model: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> np.ndarray:
    """Return float[C, 2], stiffness and damping from ``solref``: (time constant, damping ratio), or both negated."""
    most = solimp[:, 1]
    least_time = 0.0 if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE else 2 * model.opt.timestep
    direct = solref[:, 0] <= 0
    time, ratio = np.where(direct, 1.0, np.maximum(solref[:, 0], least_time)), np.where(direct, 1.0, solref[:, 1])
    stiffness = np.where(direct, -solref[:, 0] / most**2, 1 / (most * time * ratio) ** 2)
    damping = np.where(direct, -solref[:, 1] / most, 2 / (most * time))
    return np.stack([stiffness, damping], axis=1)
