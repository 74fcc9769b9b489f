"""Define OGBench's scene: a cube, two buttons, and a drawer and a window that the buttons lock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.families import TaskSpec
from envs.manipulation.manipspace import CUBE, NEAR, SHIFT, ManipSpaceTask, TableState, near
from envs.manipulation.manipspace_rig import CUBE_COLUMNS, ROBOT_COLUMNS, ROBOT_JOINTS
from envs.manipulation.scene_rig import SceneRig
from envs.scene import Scene
from envs.task import StateRows, count_rows

_SLIDES = ROBOT_JOINTS + CUBE + 2  # place of the drawer in qpos; the window is next
_HANDLES = ("drawer_handle", "window_handle")  # materials
_GIVE = 0.05  # m, by which a drawer or a window that is pulled hard passes its stops
_BUTTON_COLUMNS = (ROBOT_COLUMNS + CUBE_COLUMNS + 1, ROBOT_COLUMNS + CUBE_COLUMNS + 5)  # of an observation: 1 unlocks
_LOCKED, _FREE = (0.9, 0.2, 0.2, 1.0), (0.95, 0.95, 0.95, 1.0)
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

    @property
    def names(self) -> list[str]:
        """Return the names of the cube, the buttons, the drawer and the window."""
        return ["cube", "button 0", "button 1", "drawer", "window"]

    def scene(self) -> Scene:
        """Return the table; what is locked, and its button, is red, as OGBench paints it."""
        return replace(super().scene(), paint=_paint_locks)

    def start_of(self, description: dict[str, Any]) -> TableState:
        """Return about where everything starts."""
        return _table_state(description["init"])

    def goal_state(self, description: dict[str, Any]) -> TableState:
        """Return everything in its place."""
        return _table_state(description["goal"])

    def check_steps(self, rows: StateRows) -> list[str]:
        """Return a line per kind of state that no sound simulation reaches, and where buttons are told apart."""
        found = super().check_steps(rows)
        if rows.qpos is None:
            return found
        slides = rows.qpos[:, _SLIDES : _SLIDES + 2]
        beyond = (slides < _RANGES[:, 0] - _GIVE) | (slides > _RANGES[:, 1] + _GIVE)
        for name, wrong in zip(("drawer", "window"), beyond.T, strict=True):
            if wrong.any():
                found.append(f"the {name} is beyond its range in {count_rows(wrong)}")
        for index, column in enumerate(_BUTTON_COLUMNS if rows.extra is not None else ()):
            if (wrong := (rows.observations[:, column] > 0.5) != (rows.extra[:, index] == 1)).any():
                found.append(f"extra and observations disagree on button {index} in {count_rows(wrong)}")
        return found

    def _draw_fixtures(self, key: jax.Array, fixtures: jax.Array) -> jax.Array:
        shift = jax.random.uniform(key, (2,), minval=-SHIFT, maxval=SHIFT)
        return fixtures.at[2:].set(jnp.clip(fixtures[2:] + shift, *jnp.asarray(_RANGES.T, jnp.float32)))


def _paint_locks(model: mujoco.MjModel, extra: np.ndarray) -> None:
    """Paint each button and the handle of what it locks."""
    for button, (free, handle) in enumerate(zip(extra, _HANDLES, strict=True)):
        colour, body = _FREE if free else _LOCKED, model.body(f"button_{button}")
        model.geom_rgba[body.geomadr[0] : body.geomadr[0] + body.geomnum[0]] = colour
        model.mat(handle).rgba[:] = colour


def _table_state(description: dict[str, Any]) -> TableState:
    """Return what a half of OGBench's description of a task says."""
    fixtures = np.array([0.0, 0.0, description["drawer_pos"], description["window_pos"]])
    buttons = np.array(description["button_states"], np.int32)
    return TableState(np.array(description["block_xyzs"], np.float64), fixtures, buttons)
