"""See OGBench's table as its oracles do: the hand, and every thing that can be moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from envs.manipulation import poses
from envs.manipulation.manipspace import CUBE, ManipSpaceTask
from envs.manipulation.manipspace_rig import CENTRE, GRIPPER_SCALE, HAND_COLUMN, PLACE_SCALE, ROBOT_JOINTS
from envs.manipulation.scene_rig import SLIDES
from qdos_brax.collection.scripted.demonstrator import SimStates

DRAWER_SPOT = np.array([0.33, -0.24, 0.066])
"""Where OGBench puts a cube into the open drawer, in m."""
_DRAWER_LOW, _DRAWER_HIGH = np.array([0.21, -0.27, 0.0]), np.array([0.45, -0.07, 0.15])
"""m, of the inside of the drawer; y relative to its handle."""


@dataclass(frozen=True)
class TableTarget:
    """Describe one thing to do.

    Attributes:
        kind: "cube", "button", "drawer" or "window".
        index: which cube or button.
        place: float64[3], where the cube shall be, in m.
        yaw: how the cube shall be turned, in rad.
        value: what the button (0 or 1), the drawer or the window (m) shall be.
    """

    kind: str
    index: int = 0
    place: np.ndarray | None = None
    yaw: float = 0.0
    value: float = 0.0


@dataclass(frozen=True)
class Fixtures:
    """Hold where the things are that stay on the table.

    Attributes:
        buttons: float64[b, 3], their tops.
        slides: float64[s, 3], the handles of the drawer and of the window where these are at 0.
        ways: float64[s, 3], where the handles go per unit.
        yaws: float64[s], how the handles are turned.
    """

    buttons: np.ndarray
    slides: np.ndarray
    ways: np.ndarray
    yaws: np.ndarray

    @classmethod
    def of(cls, env: ManipSpaceTask) -> Fixtures:
        """Return those of a task; none for the cubes."""
        if not env.extra_size:
            none = np.zeros((0, 3))
            return cls(none, none, none, np.zeros(0))
        model, data = env.space.whole, mujoco.MjData(env.space.whole)
        handles = [model.site(f"{name.split('_')[0]}_handle_center").id for name in SLIDES]
        mujoco.mj_kinematics(model, data)
        buttons = np.array([data.site(f"btntop_{index}").xpos for index in range(env.extra_size)])
        first, turned = data.site_xpos[handles].copy(), poses.yaw(poses.from_matrices(data.site_xmat[handles]))
        data.qpos[[model.joint(name).qposadr[0] for name in SLIDES]] = 1.0
        mujoco.mj_kinematics(model, data)
        return cls(buttons, first, data.site_xpos[handles] - first, turned)


@dataclass(frozen=True)
class TableView:
    """Hold one simulation as the oracles see it.

    Attributes:
        hand: float64[3], in m.
        yaw: of the hand, in rad.
        grip: how far the gripper is shut, 0 to 1.
        contact: how hard its pad is touched, 0 to 1.
        cubes: float64[c, 3].
        cube_yaws: float64[c].
        buttons: int[b].
        slides: float64[s], the drawer and the window, in m.
        fixtures: what stays.
    """

    hand: np.ndarray
    yaw: float
    grip: float
    contact: float
    cubes: np.ndarray
    cube_yaws: np.ndarray
    buttons: np.ndarray
    slides: np.ndarray
    fixtures: Fixtures

    def handle(self, index: int, value: float) -> np.ndarray:
        """Return float64[3], where the handle of the drawer (0) or the window (1) is when that is at ``value``."""
        return self.fixtures.slides[index] + value * self.fixtures.ways[index]

    def in_drawer(self, cube: int) -> bool:
        """Return whether a cube is in the drawer."""
        if not len(self.slides):
            return False
        handle = np.array([0.0, self.handle(0, self.slides[0])[1], 0.0])
        place = self.cubes[cube] - handle
        return bool((place >= _DRAWER_LOW).all() and (place <= _DRAWER_HIGH).all())

    def top_cubes(self) -> list[int]:
        """Return the cubes that can be picked up: nothing lies on them, and they are not in the drawer."""
        return [i for i in range(len(self.cubes)) if not self._covered(i) and not self.in_drawer(i)]

    def info(self, target: TableTarget, time: float) -> dict[str, Any]:
        """Return what OGBench's oracles read at ``time`` (s) of their plan."""
        seen: dict[str, Any] = {
            "time": [time],
            "proprio/effector_pos": self.hand,
            "proprio/effector_yaw": np.array([self.yaw]),
            "proprio/gripper_opening": np.array([self.grip]),
            "proprio/gripper_contact": np.array([self.contact]),
        }
        if target.kind == "cube":
            return seen | {
                "privileged/target_block": target.index,
                f"privileged/block_{target.index}_pos": self.cubes[target.index],
                f"privileged/block_{target.index}_yaw": self.cube_yaws[target.index, None],
                "privileged/target_block_pos": target.place,
                "privileged/target_block_yaw": np.array([target.yaw]),
            }
        if target.kind == "button":
            return seen | {
                "privileged/target_button": target.index,
                "privileged/target_button_top_pos": self.fixtures.buttons[target.index],
                f"privileged/button_{target.index}_state": self.buttons[target.index],
                "privileged/target_button_state": target.value,
            }
        slide = ("drawer", "window").index(target.kind)
        return seen | {
            f"privileged/{target.kind}_handle_pos": self.handle(slide, self.slides[slide]),
            f"privileged/{target.kind}_handle_yaw": self.fixtures.yaws[slide, None],
            f"privileged/target_{target.kind}_handle_pos": self.handle(slide, target.value),
        }

    def _covered(self, cube: int) -> bool:
        gaps = self.cubes - self.cubes[cube]
        return bool(((gaps[:, 2] > 0) & (np.hypot(gaps[:, 0], gaps[:, 1]) < 0.02)).any())


class TableReader:
    """Read simulations of a task as tables.

    Args:
        env: the task.
    """

    def __init__(self, env: ManipSpaceTask) -> None:
        self._fixtures = Fixtures.of(env)
        self._cubes = (env.engine.nq - ROBOT_JOINTS) // CUBE

    def read(self, states: SimStates) -> list[TableView]:
        """Return the table of each simulation."""
        sensed = states.sensed.astype(np.float64)
        hands = sensed[:, HAND_COLUMN : HAND_COLUMN + 3] / PLACE_SCALE + CENTRE
        yaws, grips = np.arctan2(sensed[:, 16], sensed[:, 15]), sensed[:, 17] / GRIPPER_SCALE
        last = ROBOT_JOINTS + CUBE * self._cubes
        cubes = states.qpos[:, ROBOT_JOINTS:last].reshape(len(hands), self._cubes, CUBE)
        turns = poses.yaw(cubes[..., 3:])
        slides = states.qpos[:, last + states.extra.shape[1] :]
        return [
            TableView(
                hand=hands[sim],
                yaw=yaws[sim],
                grip=grips[sim],
                contact=sensed[sim, 18],
                cubes=cubes[sim, :, :3],
                cube_yaws=turns[sim],
                buttons=states.extra[sim],
                slides=slides[sim],
                fixtures=self._fixtures,
            )
            for sim in range(len(hands))
        ]
