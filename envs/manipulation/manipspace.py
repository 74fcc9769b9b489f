"""Define what OGBench's manipulation tasks share: objects that have to be in place, starts, labels."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_base import State
from envs.families import TaskSpec
from envs.manipulation.manipspace_rig import (
    CENTRE,
    CUBE_COLUMNS,
    FRAME_SKIP,
    HAND_COLUMN,
    PLACE_SCALE,
    ROBOT_COLUMNS,
    ROBOT_JOINTS,
    WORKSPACE,
    ManipSpaceRig,
)
from envs.manipulation.ogbench_model import manip_space
from envs.manipulation.table_frame import TableFrame
from envs.physics import MujocoEngine, PipelineState
from envs.physics.host_function import HostFunction
from envs.scene import Scene, fixed_view
from envs.task import SimulatorStates, StateRows, Task, count_rows

CUBE = 7
"""Numbers of qpos per cube: its place and its quaternion."""
NEAR = 0.04
"""How far from its goal a thing counts as in place, in m."""
SHIFT = 0.01
"""By how much starts vary, in m."""
_DIFFERENCE = 2e-3  # between an observation and qpos, in the observation's units; data is float32
_OVERSHOOT = 0.1  # m, of the hand beyond the workspace that its targets are kept in
_TABLE = np.array([[0.0, -0.6, -0.2], [0.9, 0.6, 0.6]])  # m, where cubes are while the physics is sound


class TableState(NamedTuple):
    """Hold what is on the table.

    Attributes:
        cubes: float64[c, 3], their centres, in m.
        fixtures: float64[k], what follows the cubes in qpos.
        extra: int32[e], the discrete state.
    """

    cubes: np.ndarray
    fixtures: np.ndarray
    extra: np.ndarray


class ManipSpaceTask(Task):
    """Simulate one of OGBench 1.2.2's manipulation tasks, as ``*-singletask-taskN-v0``: action 5, 20 Hz.

    An action moves the hand by up to 5 cm along x, y and z, turns it by up to 0.3 rad, and shuts (1) or opens (-1) the
    gripper, relative to where all of it is. Actions beyond [-1, 1] are clipped, which the reference does not do.

    The reward is minus the number of things that are not in place, success is that all are, on the state before the
    action. ``metrics["score"]`` is the share in place.

    Args:
        spec: which task.
        rig_class: what connects the task to MuJoCo.

    Attributes:
        body_frame: the cubes as seen from the gripper.
    """

    distance_margin = 0.5
    metric_names = ("success", "score")

    def __init__(self, spec: TaskSpec, rig_class: type[ManipSpaceRig]) -> None:
        self.space = manip_space(spec.name)
        self.rig = rig_class(self.space)
        self.description = self.space.tasks[spec.task_id - 1]
        super().__init__(spec, MujocoEngine(self.space.stepped, self.rig, FRAME_SKIP), self.goal_of(self.description))
        self.cubes = len(self.start_of(self.description).cubes)
        self.body_frame = TableFrame(self.cubes)
        self._arm_start = HostFunction(self._arm_starts, b"arm" + self.rig.identity() + self.space.arm_bounds.tobytes())

    @abstractmethod
    def goal_state(self, description: dict[str, Any]) -> TableState:
        """Return where everything is at the goal of a task."""

    @property
    def descriptions(self) -> list[dict[str, Any]]:
        """Return OGBench's description of each task of the variant."""
        return self.space.tasks

    @abstractmethod
    def goal_of(self, description: dict[str, Any]) -> np.ndarray:
        """Return float64[g], the goal of a task as ``reset_to`` takes it, from OGBench's description."""

    @abstractmethod
    def in_place(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[..., k], which things are in place, at ``qpos[..., nq]``; NumPy or jax."""

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """Return the names of the things that ``in_place`` is about, in its order."""

    @abstractmethod
    def start_of(self, description: dict[str, Any]) -> TableState:
        """Return about where everything is at a start of a task."""

    def reset(self, rng: jax.Array) -> State:
        """Return a start of the task: the hand anywhere above the table, the cubes where the task has them.

        Each cube is moved by up to 1 cm in x and y and turned at random.
        """
        keys = jax.random.split(rng, 5)
        start = self.start_of(self.description)
        cubes = jnp.asarray(start.cubes, jnp.float32)
        shift = jax.random.uniform(keys[2], (len(cubes), 2), minval=-SHIFT, maxval=SHIFT)
        half = jax.random.uniform(keys[3], (len(cubes), 1), maxval=jnp.pi)
        zero = jnp.zeros_like(half)
        cubes = jnp.concatenate([cubes.at[:, :2].add(shift), jnp.cos(half), zero, zero, jnp.sin(half)], axis=1)
        robot = jnp.concatenate([self._draw_arm(keys[0], keys[1]), jnp.zeros(ROBOT_JOINTS - 6)])
        fixtures = self._draw_fixtures(keys[4], jnp.asarray(start.fixtures, jnp.float32))
        qpos = jnp.concatenate([robot, cubes.ravel(), fixtures])
        return self.reset_to(qpos, jnp.zeros(self.engine.nv), key=rng, extra=jnp.asarray(start.extra))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step under ``action[5]``."""
        before = state.pipeline_state
        share = self.in_place(before.qpos, state.info["goal"], before.extra).mean(dtype=jnp.float32)
        after = super().step(state, action)
        return after.replace(metrics=after.metrics | {"score": share})

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        """Return float32[obs], all of it computed by the rig."""
        return pipeline_state.sensed

    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[...], whether everything is in place."""
        return self.in_place(qpos, goal, extra).all(axis=-1)

    def labels(self, states: SimulatorStates, goal: Any = None) -> tuple[Any, Any]:
        """Return (reward[...], mask[...]): minus the number of things not in place, and 0 where there is none."""
        placed = self.in_place(states.qpos, self._goal if goal is None else goal, states.extra)
        return (placed.sum(axis=-1) - placed.shape[-1]).astype(np.float32), (~placed.all(axis=-1)).astype(np.float32)

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Return float64[...], how many things are not in place."""
        return (~self.in_place(qpos, self._goal, extra)).sum(axis=-1).astype(np.float64)

    def parts(self, states: SimulatorStates) -> dict[str, Any]:
        """Return bool[...] by the name of each thing, whether it is in place."""
        placed = self.in_place(states.qpos, self._goal, states.extra)
        return {name: placed[..., index] for index, name in enumerate(self.names)}

    def scene(self) -> Scene:
        """Return the table with the goals of the cubes as ghosts, seen from the front or closer."""
        model = copy.deepcopy(self.space.whole)
        for index in range(self.cubes):
            _paint_goal(model, index, self._goal[3 * index : 3 * index + 3])
        views = {
            "front": fixed_view((0.3, 0.0, 0.15), azimuth=160.0, elevation=-25.0, distance=1.5),
            "near": fixed_view((0.4, 0.0, 0.08), azimuth=160.0, elevation=-30.0, distance=1.1),
        }
        return Scene(model, views)

    def check_rows(self, rows: StateRows) -> list[str]:
        """Return a line where cubes are at another place in the observations than in the states."""
        if rows.qpos is None:
            return []
        found = []
        for index, name in zip(range(self.cubes), ("first", "second"), strict=False):
            column, place = ROBOT_COLUMNS + CUBE_COLUMNS * index, ROBOT_JOINTS + CUBE * index
            seen = rows.observations[:, column : column + 3]
            differ = np.abs(seen - (rows.qpos[:, place : place + 3] - CENTRE) * PLACE_SCALE).max(axis=1, initial=0.0)
            if (wrong := differ > _DIFFERENCE).any():
                found.append(f"qpos and observations disagree on the {name} cube in {count_rows(wrong)}")
        return found

    def check_steps(self, rows: StateRows) -> list[str]:
        """Return a line per kind of state that no sound simulation reaches."""
        if rows.qpos is None:
            return []
        found = []
        hand = rows.observations[:, HAND_COLUMN : HAND_COLUMN + 3] / PLACE_SCALE + CENTRE
        if (away := ((hand < WORKSPACE[0] - _OVERSHOOT) | (hand > WORKSPACE[1] + _OVERSHOOT)).any(axis=1)).any():
            found.append(f"the hand is out of its workspace in {count_rows(away)}")
        for index in range(self.cubes):
            first = ROBOT_JOINTS + CUBE * index
            place, turn = rows.qpos[:, first : first + 3], rows.qpos[:, first + 3 : first + CUBE]
            if (out := ((place < _TABLE[0]) | (place > _TABLE[1])).any(axis=1)).any():
                found.append(f"cube {index} is off the table in {count_rows(out)}")
            if (bent := np.abs((turn**2).sum(axis=1) - 1) > 1e-3).any():
                found.append(f"the quaternion of cube {index} is not of length 1 in {count_rows(bent)}")
        return found

    def _draw_fixtures(self, key: jax.Array, fixtures: jax.Array) -> jax.Array:
        """Return what follows the cubes in qpos at a start, about at ``fixtures``."""
        return fixtures

    def _draw_arm(self, key: jax.Array, key_yaw: jax.Array) -> jax.Array:
        """Return float32[6], joints with the hand somewhere within the bounds of starts."""
        low, high = jnp.asarray(self.space.arm_bounds, jnp.float32)
        place = jax.random.uniform(key, (3,), minval=low, maxval=high)
        yaw = jax.random.uniform(key_yaw, (1,), minval=-jnp.pi, maxval=jnp.pi)
        return self._arm_start((jax.ShapeDtypeStruct((6,), jnp.float32),), place, yaw)[0]

    def _arm_starts(self, place: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray]:
        """Return the joints [.., 6] for ``place[.., 3]`` and ``yaw[.., 1]``; a function that programs call."""
        joints = self.rig.arm_start(np.asarray(place).reshape(-1, 3), np.asarray(yaw).reshape(-1))
        return (joints.astype(np.float32).reshape(*np.shape(place)[:-1], 6),)


def near(place: Any, goal: Any) -> Any:
    """Return bool[...], whether ``place[..., 3]`` is within 4 cm of ``goal[..., 3]``; NumPy or jax."""
    return ((place - goal) ** 2).sum(axis=-1) ** 0.5 <= NEAR


def _paint_goal(model: Any, index: int, place: np.ndarray) -> None:
    """Show where a cube has to be, as a ghost in the cube's colour."""
    target, cube = model.body(f"object_target_{index}"), model.body(f"object_{index}")
    target.pos[:] = place
    colour = model.geom_rgba[cube.geomadr[0]]
    for geom in range(target.geomadr[0], target.geomadr[0] + target.geomnum[0]):
        model.geom_rgba[geom] = (*colour[:3], 0.3)
