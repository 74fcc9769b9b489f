"""Trained experts as policies: (qpos, qvel, commanded direction) to an action. Their weights are shipped, small.

``ant_walker`` and ``humanoid_walker`` walk along the direction, ``ant_dribbler`` takes the ball along it.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from qdos_brax.collection.experts.symmetry import HUMANOID_ACTUATED
from qdos_brax.collection.experts.views import ANT_NQ, ANT_NV, ball_view, body_view, forward_axis, turned, turned_back
from qdos_brax.errors import UserError
from qdos_brax.files import replacing
from qdos_brax.nn.networks import DiagonalGaussian
from qdos_brax.nn.vectors import unit_vector

RESIDUAL = 1.0
"""How much of a joint's range the dribbler can add to the walker's action."""

# Where a dribbler heads before it has learned anything: round the ball, then through it; lengths in m.
_CIRCLE = 1.3  # radius of the circle on which it goes round the ball
_PULL = 1.1  # turn towards the circle per m beside it
_LANE = 0.5  # half width of the lane behind the ball in which it pushes
_FUNNEL = 0.75  # the lane widens by this much per m behind the ball
_STEER = 2.0  # turn of the push per m of lateral offset
_OVERRIDE = 1.5  # what is learned can turn the heading to anywhere


# The humanoid's angular velocities run to 10 rad/s and more.
_SPIN_SCALE = 0.25  # of the root
_SWING_SCALE = 0.1  # of the joints
_RISING_SPAN = 2.0  # rad

SHARPEST = 0.7
"""How far from where it faces a humanoid is commanded at most, rad: the sharper it turns, the more often it falls."""


class Policy(Protocol):
    """Whatever acts on a state and a direction; ``params`` are the arrays that tell one from another."""

    params: Any

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """The deterministic action[..., nu] in [-1, 1] of a state [..., nq], [..., nv] for a unit vector[..., 2]."""
        ...


@runtime_checkable
class Dribbles(Policy, Protocol):
    """A policy that takes a ball along the direction; its ``walker`` moves the body alone."""

    walker: Policy


@dataclass(frozen=True)
class Actor:
    """A trained network.

    Attributes:
        hidden: hidden widths.
        dim: numbers it gives.
        params: its parameters.
        header: how it was trained and what it reaches.
    """

    hidden: tuple[int, ...]
    dim: int
    params: Any
    header: dict[str, Any]

    def mode(self, observation: jax.Array) -> jax.Array:
        """The squashed mean[..., dim] in [-1, 1]."""
        return jnp.tanh(DiagonalGaussian(self.hidden, self.dim).apply(self.params, observation)[0])


class AntWalker:
    """Walks the ant along the direction; qpos and qvel may go on behind the ant's own.

    Args:
        actor: what was trained.
    """

    def __init__(self, actor: Actor) -> None:
        self.actor, self.params = actor, actor.params

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """See ``Policy.act``."""
        return self.actor.mode(body_view(qpos[..., :ANT_NQ], qvel[..., :ANT_NV], direction))


class HumanoidWalker:
    """Walks the humanoid along the direction.

    Args:
        actor: what was trained.
        sharpest: see ``humanoid_heading``.
    """

    def __init__(self, actor: Actor, sharpest: float = SHARPEST) -> None:
        self.actor, self.params, self.sharpest = actor, actor.params, sharpest

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """See ``Policy.act``."""
        view = humanoid_view(qpos, qvel, humanoid_heading(qpos, direction, self.sharpest))
        return humanoid_joints(qpos, self.actor.mode(view))


def humanoid_heading(qpos: jax.Array, direction: jax.Array, sharpest: float) -> jax.Array:
    """The unit vector[..., 2] nearest to ``direction[..., 2]`` that is at most ``sharpest`` rad off where it faces.

    What lies behind is turned to in a curve: a body that has to change its course at once falls. The walker is trained
    without this (with it, it learns to walk at that angle and never to turn) and commanded with it.
    """
    facing = unit_vector(forward_axis(qpos)[..., :2])
    seen = turned(direction, facing)
    angle = jnp.clip(jnp.arctan2(seen[..., 1], seen[..., 0]), -sharpest, sharpest)
    return turned_back(jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1), facing)


def humanoid_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """[..., 55]: the body's view, its fast numbers scaled to be about one."""
    view = body_view(qpos, qvel, direction)
    still, spin, swing = jnp.split(view, [31, 34], axis=-1)
    return jnp.concatenate([still, spin * _SPIN_SCALE, swing * _SWING_SCALE], axis=-1)


def humanoid_joints(qpos: jax.Array, target: jax.Array) -> jax.Array:
    """Torques[..., 21], as shares of the motors' own, that pull each joint to its ``target[..., 21]`` in rad.

    Full torque at one rad off, so that a target of zero stands for a while where zero torque falls at once.
    """
    angles = qpos[..., 7:][..., HUMANOID_ACTUATED]
    return jnp.clip(target - angles, -1.0, 1.0)


def rising_joints(qpos: jax.Array, action: jax.Array) -> jax.Array:
    """Torques[..., 21] of one that gets up: ``humanoid_joints`` with targets as far off as crouching needs."""
    return humanoid_joints(qpos, _RISING_SPAN * action)


def dribbler_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """[..., 35]: what a dribbler sees, the ant and the ball."""
    body = body_view(qpos[..., :ANT_NQ], qvel[..., :ANT_NV], direction)
    return jnp.concatenate([body, ball_view(qpos, qvel, direction)], axis=-1)


def dribbler_joints(
    walker: Policy, qpos: jax.Array, qvel: jax.Array, direction: jax.Array, command: jax.Array
) -> jax.Array:
    """The ant's action[..., 8] for a dribbler's ``command[..., 10]``: the walker's along a heading, and corrections.

    Args:
        walker: walks the ant.
        qpos: [..., 22].
        qvel: [..., 20].
        direction: [..., 2].
        command: [..., 10]; the first two are added to the heading of ``push_heading``.
    """
    offset = ball_view(qpos, qvel, direction)[..., :2]
    heading = unit_vector(push_heading(offset) + _OVERRIDE * command[..., :2])
    steps = walker.act(qpos, qvel, turned_back(heading, direction))
    return jnp.clip(steps + RESIDUAL * command[..., 2:], -1.0, 1.0)


def push_heading(offset: jax.Array) -> jax.Array:
    """Unit vector[..., 2] round a ball at ``offset[..., 2]`` to behind it, then through it along +x."""
    ahead, beside = offset[..., :1], offset[..., 1:]
    push = unit_vector(jnp.concatenate([jnp.ones_like(ahead), _STEER * beside], axis=-1))
    outward = -unit_vector(offset)
    side = jnp.where(beside <= 0, 1.0, -1.0)
    round_it = side * jnp.concatenate([-outward[..., 1:], outward[..., :1]], axis=-1)
    gap = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    around = unit_vector(round_it + _PULL * (_CIRCLE - gap) * outward)
    return jnp.where((ahead > 0) & (jnp.abs(beside) < _LANE + _FUNNEL * ahead), push, around)


class Dribbler:
    """Takes the ball along the direction: a steering of the walker, and corrections of its steps.

    Args:
        actor: what was trained.
        walker: what it was trained with.
    """

    def __init__(self, actor: Actor, walker: Policy) -> None:
        self.actor, self.walker = actor, walker
        self.params = (actor.params, walker.params)

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """See ``Policy.act``."""
        command = self.actor.mode(dribbler_view(qpos, qvel, direction))
        return dribbler_joints(self.walker, qpos, qvel, direction, command)


def walker_of(policy: Policy) -> Policy:
    """What moves the body alone: a dribbler's walker, or the policy itself."""
    return policy.walker if isinstance(policy, Dribbles) else policy


def ant_walker(path: Path | None = None) -> AntWalker:
    """The walking ant, shipped or in ``path``; errors as ``read_actor``."""
    return AntWalker(read_actor(path or shipped("ant_walker")))


def humanoid_walker(path: Path | None = None, sharpest: float = SHARPEST) -> HumanoidWalker:
    """The walking humanoid, shipped or in ``path``; errors as ``read_actor``."""
    return HumanoidWalker(read_actor(path or shipped("humanoid_walker")), sharpest)


def ant_dribbler(path: Path | None = None) -> Dribbler:
    """The dribbling ant, shipped or in ``path``; errors as ``read_actor``."""
    return Dribbler(read_actor(path or shipped("ant_dribbler")), ant_walker())


def shipped(name: str) -> Path:
    """Where the weights called ``name`` lie in this package."""
    return Path(str(resources.files("qdos_brax.collection.experts") / f"{name}.npz"))


def digest(policy: Policy) -> str:
    """Eight hex digits that tell one policy's weights from another's."""
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves(policy.params):
        sha.update(np.asarray(leaf).tobytes())
    return sha.hexdigest()[:8]


def write_actor(path: Path, actor: Actor) -> None:
    """Writes the weights as plain arrays with a JSON header, atomically."""
    flat = {"/".join(k): np.asarray(v) for k, v in traverse_util.flatten_dict(actor.params).items()}
    header = {**actor.header, "hidden": list(actor.hidden)}
    write_arrays(path, {**flat, "header": np.frombuffer(json.dumps(header).encode(), np.uint8)})


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an .npz, whole or not at all."""
    with replacing(path) as partial:
        np.savez_compressed(partial, allow_pickle=False, **arrays)


def read_actor(path: Path) -> Actor:
    """The weights in ``path``.

    Raises:
        UserError: the file is missing or holds no weights.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            flat = {tuple(k.split("/")): jnp.asarray(file[k]) for k in file.files if k != "header"}
        params = traverse_util.unflatten_dict(flat)
        last = max(params["params"]["MLP_0"])  # Dense_0, Dense_1, ..
        dim = params["params"]["MLP_0"][last]["bias"].shape[0] // 2
        return Actor(tuple(header.pop("hidden")), dim, params, header)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise UserError(
            f"cannot read the expert's weights in {path} ({error}); "
            "train them with `python -m qdos_brax.collection.experts.train`"
        ) from error
