"""A direction-conditioned ant: the policy, its canonical view of the world, and its shipped weights.

Walking along a direction looks the same for every direction once the world is turned so that the direction is +x.
The policy sees only that turned world, so what it learns for one direction it knows for all.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from qdos_brax.errors import UserError
from qdos_brax.networks import DiagonalGaussian

OBSERVATION_DIM = 29
ACTION_DIM = 8
WEIGHTS = "ant_walker.npz"


def canonical_observation(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """The ant's proprioception, seen in a frame whose x axis is the commanded direction.

    Args:
        qpos: [..., >=15] positions of the ant (x, y, z, quaternion, 8 joints), more is ignored.
        qvel: [..., >=14] velocities (linear in the world frame, angular in the body frame, 8 joints).
        direction: [..., 2] unit vector in the world frame.

    Returns:
        [..., 29]: height, two columns of the turned rotation matrix, joints, turned linear velocity, angular
        velocity, joint velocities. No position: a walker does not know where it is.
    """
    cos, sin = direction[..., 0:1], direction[..., 1:2]
    quat = qpos[..., 3:7]
    w, x, y, z = jnp.moveaxis(quat / (jnp.linalg.norm(quat, axis=-1, keepdims=True) + 1e-8), -1, 0)
    forward = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    upward = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)

    def turn(vector: jax.Array) -> jax.Array:
        vx, vy, vz = vector[..., 0:1], vector[..., 1:2], vector[..., 2:3]
        return jnp.concatenate([cos * vx + sin * vy, cos * vy - sin * vx, vz], axis=-1)

    return jnp.concatenate(
        [
            qpos[..., 2:3],
            turn(forward),
            turn(upward),
            qpos[..., 7:15],
            turn(qvel[..., :3]),
            qvel[..., 3:6],
            qvel[..., 6:14],
        ],
        axis=-1,
    )


def upright(qpos: jax.Array) -> jax.Array:
    """bool[...]: the torso's height is within [0.2, 1.0] m and its own z axis points up."""
    quat = qpos[..., 3:7]
    x, y = quat[..., 1], quat[..., 2]
    up = 1 - 2 * (x * x + y * y) / (jnp.sum(quat**2, axis=-1) + 1e-8)
    return (qpos[..., 2] > 0.2) & (qpos[..., 2] < 1.0) & (up > 0.0)


@dataclass(frozen=True)
class WalkerPolicy:
    """The trained walker.

    Attributes:
        hidden: hidden widths of the actor.
        params: the actor's parameters.
    """

    hidden: tuple[int, ...]
    params: Any

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """The deterministic action[..., 8] in [-1, 1] that walks along ``direction`` (see canonical_observation)."""
        actor = DiagonalGaussian(self.hidden, ACTION_DIM)
        return jnp.tanh(actor.apply(self.params, canonical_observation(qpos, qvel, direction))[0])


def save(path: Path, hidden: tuple[int, ...], params: Any, facts: dict[str, Any]) -> None:
    """Writes the weights as plain arrays with a JSON header (how they were trained, what they reach), atomically."""
    flat = {"/".join(k): np.asarray(v) for k, v in traverse_util.flatten_dict(params).items()}
    flat["header"] = np.frombuffer(json.dumps({"hidden": list(hidden), **facts}).encode(), np.uint8)
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **flat)
    temporary.replace(path)


def load(path: Path | None = None) -> WalkerPolicy:
    """The walker in ``path``, or the shipped one.

    Raises:
        UserError: the file is missing or is not a walker's.
    """
    source = path or Path(str(resources.files("qdos_brax.experts") / WEIGHTS))
    try:
        with np.load(source, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            flat = {tuple(k.split("/")): jnp.asarray(file[k]) for k in file.files if k != "header"}
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"cannot read the walker's weights in {source} ({error}); retrain them with "
            "`python -m qdos_brax.experts.train_walker --out FILE`"
        ) from error
    return WalkerPolicy(tuple(header["hidden"]), traverse_util.unflatten_dict(flat))
