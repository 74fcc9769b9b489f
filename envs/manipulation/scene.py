"""Define OGBench's scene: a cube, two buttons, and a drawer and a window that the buttons lock."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.families import TaskSpec
from envs.manipulation.manipspace import CUBE, NEAR, ManipSpaceTask, near
from envs.manipulation.manipspace_rig import ROBOT_JOINTS
from envs.manipulation.scene_rig import SceneRig

_SLIDES = ROBOT_JOINTS + CUBE + 2  # place of the drawer in qpos; the window is next
_VARIATION = 0.01  # m, by which drawer and window vary at a start
_RANGES = np.array([[-0.16, 0.0], [0.0, 0.2]])  # m, of drawer and window


class SceneTask(ManipSpaceTask):
    """Simulate ``scene``: qpos 25, qvel 24, observation 40.

    The discrete state is int32[2], the buttons: where one is 0 its drawer or window is locked. A goal is float[7]: the
    place of the cube, both buttons, the drawer, the window.

    Args:
        spec: which task.
        physics: "mujoco".
    """

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        super().__init__(spec, SceneRig)

    def goal_of(self, description: dict[str, Any]) -> np.ndarray:
        """Return float64[7]: the place of the cube, both buttons, the drawer, the window."""
        goal = description["goal"]
        return np.concatenate([
            goal["block_xyzs"][0], goal["button_states"], [goal["drawer_pos"], goal["window_pos"]]
        ])  # fmt: skip

    def in_place(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[..., 5]: the cube, both buttons (``extra[..., 2]``), the drawer, the window."""
        xp = jnp if isinstance(qpos, jax.Array) else np
        cube = near(qpos[..., ROBOT_JOINTS : ROBOT_JOINTS + 3], goal[..., :3])[..., None]
        slides = abs(qpos[..., _SLIDES : _SLIDES + 2] - goal[..., 5:]) <= NEAR
        return xp.concatenate([cube, xp.broadcast_to(extra == goal[..., 3:5], slides.shape), slides], axis=-1)

    def _start_cubes(self) -> np.ndarray:
        return np.asarray(self.description["init"]["block_xyzs"], np.float64)

    def _start_extra(self) -> jax.Array:
        return jnp.asarray(self.description["init"]["button_states"], jnp.int32)

    def _start_fixtures(self, key: jax.Array) -> jax.Array:
        start = jnp.array([self.description["init"]["drawer_pos"], self.description["init"]["window_pos"]])
        slides = start + jax.random.uniform(key, (2,), minval=-_VARIATION, maxval=_VARIATION)
        return jnp.concatenate([jnp.zeros(2), jnp.clip(slides, *jnp.asarray(_RANGES.T, jnp.float32))])
