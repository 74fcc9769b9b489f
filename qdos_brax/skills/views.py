"""How skills see the body: as the observation has it, or in the body's own frame.

A skill that is learned in the world's frame has to be learned anew for every place and heading. In a frame that starts
where the body stands and faces where it faces, a skill that leads off a wall is the same skill at every wall.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from envs.body_frame import Frame
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.data.segments import window
from qdos_brax.errors import UserError

_SEGMENTS = 4_000  # that the statistics of a view are taken from, about
_CONSTANT = 1e-3  # deviation of a column that never changes in the frame, such as the place in one's own


class View(Protocol):
    """Define what posterior, prior and decoder are shown of an observation (normalised; leading axes are free).

    A pose is taken where a skill begins and kept until it ends. ``params`` is what ``fit`` returned.

    Attributes:
        pose_size: numbers of a pose.
    """

    pose_size: int

    def size(self, observation_size: int) -> int:
        """Return the numbers that are seen of an observation."""
        ...

    def fit(self, windows: jax.Array, normaliser: Normaliser) -> dict[str, Any]:
        """Return what the view must know of the data: of ``windows[B, H, obs]``, normalised, each a segment."""
        ...

    def pose(self, params: Any, observation: jax.Array) -> jax.Array:
        """Return pose[..., pose_size] of a skill that begins at ``observation[..., obs]``."""
        ...

    def see(self, params: Any, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return what is seen of ``observation[..., obs]`` in a skill that began at ``pose[..., pose_size]``."""
        ...


class WorldView:
    """Show the observation as it is (the paper)."""

    pose_size = 0

    def size(self, observation_size: int) -> int:
        """Return ``observation_size``."""
        return observation_size

    def fit(self, windows: jax.Array, normaliser: Normaliser) -> dict[str, Any]:
        """Return nothing: nothing has to be known."""
        return {}

    def pose(self, params: Any, observation: jax.Array) -> jax.Array:
        """Return an empty pose."""
        return observation[..., :0]

    def see(self, params: Any, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return the observation."""
        return observation


class StartView:
    """Show everything from the pose that the body had when the skill began.

    Args:
        frame: the task's.
    """

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self.pose_size = frame.pose_size

    def size(self, observation_size: int) -> int:
        """Return the numbers of the frame."""
        return self._frame.size(observation_size)

    def fit(self, windows: jax.Array, normaliser: Normaliser) -> dict[str, Any]:
        """Return mean and scale of observations ("world") and of what is seen of them ("seen")."""
        world = {"mean": normaliser.mean, "scale": normaliser.scale}
        plain = {"world": world, "seen": {"mean": 0.0, "scale": 1.0}}
        seen = self.see(plain, windows, self.pose(plain, windows[:, 0])[:, None])
        deviation = jnp.std(seen, axis=(0, 1))
        scale = jnp.where(deviation < _CONSTANT, 1.0, deviation)
        return {"world": world, "seen": {"mean": jnp.mean(seen, axis=(0, 1)), "scale": scale}}

    def pose(self, params: Any, observation: jax.Array) -> jax.Array:
        """Return the frame's pose."""
        return self._frame.pose(in_own_units(params, observation))

    def see(self, params: Any, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return the observation in the frame of the pose, normalised."""
        normalise = Normaliser(**jax.lax.stop_gradient(params["seen"]))
        return normalise(self._frame.see(in_own_units(params, observation), pose))


class BodyView(StartView):
    """Show every observation from the body's present pose: where the skill began is forgotten."""

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        self.pose_size = 0

    def pose(self, params: Any, observation: jax.Array) -> jax.Array:
        """Return an empty pose."""
        return observation[..., :0]

    def see(self, params: Any, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return the observation in its own frame, normalised."""
        return super().see(params, observation, super().pose(params, observation))


def in_own_units(params: Any, observation: jax.Array) -> jax.Array:
    """Return a normalised observation in the task's own units, by what a view knows of the data."""
    world = jax.lax.stop_gradient(params["world"])
    return observation * world["scale"] + world["mean"]


def fit_view(view: View, data: DeviceData, normaliser: Normaliser, horizon: int) -> dict[str, Any]:
    """Return what ``view`` must know of the data, from evenly spaced segments of ``horizon`` rows."""
    starts = data.starts[:: max(1, len(data.starts) // _SEGMENTS)]
    return view.fit(jax.jit(window, static_argnums=2)(data.observations, starts, horizon), normaliser)


def make_view(name: str, frame: Frame | None) -> View:
    """Return the view called "world", "start" or "body".

    Args:
        name: of the view.
        frame: the task's, or None if it offers none.

    Raises:
        UserError: the view needs a frame and there is none.
    """
    if name == "world":
        return WorldView()
    if frame is None:
        raise UserError(f"this task offers no frame of a body for skills.view={name}; use --set skills.view=world")
    return {"start": StartView, "body": BodyView}[name](frame)
