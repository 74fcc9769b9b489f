"""Getting up: a humanoid that fell lies straight until it is calm, turns onto its back, and rises by a fixed motion.

A body held straight comes to rest in one of a few poses, whichever way it fell, and on its back always in the same one.
From there one motion of few key poses gets it up, found by evolution (``train_motions``). What it is doing, and since
when, is remembered from step to step, because a lying body does not show it. Functions take a single state, for use
inside jit and under vmap.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.collection.experts.policies import humanoid_torques, humanoid_view
from qdos_brax.collection.experts.symmetry import HUMANOID_ACTUATED
from qdos_brax.collection.experts.views import forward_axis, uprightness
from qdos_brax.collection.experts.weights import Actor, read_actor, shipped
from qdos_brax.errors import UserError
from qdos_brax.files import write_arrays
from qdos_brax.nn.vectors import unit_vector

WALKS, LIES, TURNS, CROUCHES, RISES = range(5)
"""What a humanoid is doing: the first number of the memory; the second counts control steps since it began that."""

STEP_SECONDS = 0.025

HOLD = 16
"""Control steps for which the last pose of crouching is held."""

_CALM = 0.3  # mean speed of the root (m/s, rad/s) and the joints (rad/s) below which a lying body has come to rest
_SHORTEST_REST, _LONGEST_REST = 20, 60  # control steps
_ON_BACK = 0.9  # height of the tip of the body's forward axis, a unit vector
_BALANCING = 40  # control steps after which a body that rises has to be on its feet
_SOONEST, _TALL, _STRAIGHT = 30, 1.2, 0.97  # steps, height (m) and cosine from which on it is
_DOWN, _TILTED = 0.6, 0.3  # height of the torso (m), or cosine to the vertical, below which walking is given up

# Ankles and arms are light: as stiff as the other joints they would swing at 40 control steps per second.
_LIGHT = np.isin(HUMANOID_ACTUATED, [7, 8, 13, 14, *range(15, 21)])
_STIFFNESS = np.where(_LIGHT, 0.5, 1.0).astype(np.float32)  # share of the largest torque per rad
_DAMPING = np.where(_LIGHT, 0.01, 0.02).astype(np.float32)  # share of it per rad/s


class Motion(NamedTuple):
    """Hold a motion through k key poses, the joints' targets linear in time between them, from straight limbs.

    Attributes:
        poses: float[k, 21], targets of the joints in the motors' order, rad.
        seconds: float[k], the time from one to the next.
    """

    poses: Any
    seconds: Any


class Motions(NamedTuple):
    """Hold what evolution finds.

    Attributes:
        turn: takes a body that lies on its front or side onto its back.
        crouch: takes it from its back onto its feet, crouching.
    """

    turn: Motion
    crouch: Motion


class Recovery(Protocol):
    """Define what brings a body back to where its expert can go on.

    Attributes:
        params: the arrays that distinguish one from another.
    """

    params: Any

    def begin(self) -> jax.Array:
        """Return the memory at the start of an episode, int32[m]."""
        ...

    def follow(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return the memory[m] before the action in the state (qpos[nq], qvel[nv])."""
        ...

    def act(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array, action: jax.Array) -> jax.Array:
        """Return the action[nu]: the expert's ``action``, or another while the body recovers."""
        ...


class NoRecovery:
    """Return the expert's action as it is: the body never stays down."""

    params: Any = ()

    def begin(self) -> jax.Array:
        """Return no numbers."""
        return jnp.zeros(0, jnp.int32)

    def follow(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return ``memory``."""
        return memory

    def act(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array, action: jax.Array) -> jax.Array:
        """Return ``action``."""
        return action


class Rising:
    """Take the humanoid to its feet whenever it fell, and hand over to the walker: see the module.

    Args:
        motions: take it from the floor into a crouch.
        riser: gets it up from there and balances.
    """

    def __init__(self, motions: Motions, riser: Actor) -> None:
        self.motions, self.riser = motions, riser
        self.params = (motions, riser.params)

    def begin(self) -> jax.Array:
        """Return int32[2], a body that walks: one that lies shows it at once."""
        return jnp.array([WALKS, 0], jnp.int32)

    def follow(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return int32[2], see ``next_stage``."""
        return next_stage(self.motions, memory, qpos, qvel)

    def act(self, memory: jax.Array, qpos: jax.Array, qvel: jax.Array, action: jax.Array) -> jax.Array:
        """Return the walker's ``action[21]``, or the torques of getting up."""
        ahead = unit_vector(forward_axis(qpos)[:2])
        rising = humanoid_torques(qpos, self.riser.mode(humanoid_view(qpos, qvel, ahead)))
        crouching = motion_torques(self.motions, memory, qpos, qvel)
        doing = memory[0]
        return jnp.where(doing == WALKS, action, jnp.where(doing == RISES, rising, crouching))


def next_stage(motions: Motions, memory: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Return int32[2], what the humanoid does next, and for how many steps it has; ``memory`` is of the step before."""
    doing, steps = memory[0], memory[1]
    calm = (steps >= _SHORTEST_REST) & (jnp.mean(jnp.abs(qvel)) < _CALM)
    rested = calm | (steps >= _LONGEST_REST)
    on_back = forward_axis(qpos)[2] > _ON_BACK
    is_down = (qpos[2] < _DOWN) | (uprightness(qpos) < _TILTED)
    # The riser walks on where it faces, the walker can turn off a wall: it takes over as soon as it can.
    is_steady = (steps >= _SOONEST) & (qpos[2] > _TALL) & (uprightness(qpos) > _STRAIGHT)
    then = jnp.stack(
        [
            jnp.where(is_down, LIES, WALKS),
            jnp.where(rested, jnp.where(on_back, CROUCHES, TURNS), LIES),
            jnp.where(steps >= length(motions.turn), LIES, TURNS),
            jnp.where(steps >= length(motions.crouch) + HOLD, RISES, CROUCHES),
            jnp.where(is_steady, WALKS, jnp.where(steps < _BALANCING, RISES, jnp.where(is_down, LIES, WALKS))),
        ]
    )[doing]
    return jnp.stack([then, jnp.where(then == doing, steps + 1, 0)]).astype(jnp.int32)


def motion_torques(motions: Motions, memory: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Return torques[21] of lying, turning and crouching."""
    straight = jnp.zeros(21)
    turn, crouch = (pose_at(motion, memory[1]) for motion in motions)
    target = jnp.stack([straight, straight, turn, crouch, straight])[memory[0]]
    return holding_torques(qpos, qvel, target)


def length(motion: Motion) -> jax.Array:
    """Return the motion's length in control steps, float."""
    return jnp.sum(motion.seconds) / STEP_SECONDS


def pose_at(motion: Motion, steps: jax.Array) -> jax.Array:
    """Return the joints' targets[21] (rad) of ``motion`` after ``steps`` control steps; its last ones after its end."""
    poses = jnp.concatenate([jnp.zeros((1, 21)), jnp.asarray(motion.poses)])
    times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.asarray(motion.seconds))])
    return jax.vmap(lambda joint: jnp.interp(steps * STEP_SECONDS, times, joint), in_axes=1)(poses)


def holding_torques(qpos: jax.Array, qvel: jax.Array, targets: jax.Array) -> jax.Array:
    """Return torques[..., 21], as shares of the largest ones, that pull the joints to ``targets[..., 21]`` and damp."""
    angles, rates = qpos[..., 7:][..., HUMANOID_ACTUATED], qvel[..., 6:][..., HUMANOID_ACTUATED]
    return jnp.clip(_STIFFNESS * (targets - angles) - _DAMPING * rates, -1.0, 1.0)


def write_motions(path: Path, motions: Motions, header: dict[str, Any]) -> None:
    """Write the motions as plain arrays with a JSON header; errors as ``files.write_arrays``."""
    arrays = {
        f"{name}/{part}": np.asarray(value, np.float32)
        for name, motion in motions._asdict().items()
        for part, value in motion._asdict().items()
    }
    write_arrays(path, arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})


def read_motions(path: Path) -> tuple[Motions, dict[str, Any]]:
    """Read the motions in ``path``, and the header.

    Raises:
        UserError: the file is missing or holds no motions.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = [Motion(file[f"{name}/poses"], file[f"{name}/seconds"]) for name in Motions._fields]
            return Motions(*found), json.loads(file["header"].tobytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(
            f"cannot read the motions in {path} ({error}); "
            "find them with `python -m qdos_brax.collection.experts.train_motions`"
        ) from error


def humanoid_motions(path: Path | None = None) -> Motions:
    """Load the motions, shipped or from ``path``; errors as ``read_motions``."""
    return read_motions(path or shipped("humanoid_motions"))[0]


def humanoid_rising(path: Path | None = None) -> Rising:
    """Load the whole recovery, with the riser shipped or from ``path``; errors as the two readers."""
    return Rising(humanoid_motions(), read_actor(path or shipped("humanoid_riser")))
