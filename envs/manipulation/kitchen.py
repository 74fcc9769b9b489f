"""Define the Franka kitchen: an arm that has to complete four subtasks, in any order."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_base import State
from envs.families import TaskSpec
from envs.manipulation.hand_frame import HandFrame
from envs.manipulation.kitchen_model import arm_config, stepped_model, whole_model
from envs.manipulation.kitchen_rig import FRAME_SKIP, START_QPOS, SUBTASKS, KitchenRig
from envs.physics import MujocoEngine, PipelineState
from envs.scene import Scene, fixed_view
from envs.task import SimulatorStates, StateRows, Task, count_rows
from envs.things import Thing

_OF_VARIANT = {
    "mixed": ("microwave", "kettle", "bottom burner", "light switch"),
    "partial": ("microwave", "kettle", "light switch", "slide cabinet"),
    "complete": ("microwave", "kettle", "light switch", "slide cabinet"),
}
_OBSERVED_QPOS = np.array([*range(9), *range(18, 39)])  # numbers of an observation that are qpos
_OBSERVED_QVEL = np.array([*range(9, 18), *range(39, 59)])  # the same of qvel
_THINGS = {
    "bottom right burner": range(9, 11),
    "bottom burner": range(11, 13),
    "top right burner": range(13, 15),
    "top burner": range(15, 17),
    "light switch": range(17, 19),
    "slide cabinet": range(19, 20),
    "hinge cabinet": range(20, 22),
    "microwave": range(22, 23),
    "kettle": range(23, 30),
}  # numbers of qpos
_KETTLE_HEIGHT = 25  # number of qpos
_STOVE = 1.6  # m
_GIVE = 0.5  # rad or m, by which what is pushed hard passes its stop
_LARGEST_ERROR = 2e-3  # of observed qpos; the arm's sensors err by up to 1e-3, and data is float32


class Kitchen(Task):
    """Simulate the kitchen of gymnasium-robotics 1.4.2's ``FrankaKitchen-v1``: qpos 30, qvel 29, action 9.

    The observation is its 59 numbers, errors of the sensors included, which are drawn from the state's key. The
    discrete state (``extra``, int32[7]) says which of ``kitchen_rig.SUBTASKS`` were completed so far; the task asks for
    four of them.

    The reward is that number, of the four, minus four, where the reference pays one for each new completion: the count
    is what SUPE's agents see, and minus four it never speaks against an end by success. As in the reference an episode
    ends in the very step that completes the last subtask. ``metrics["score"]`` is the share of the four.

    Args:
        spec: which task.
        physics: "mujoco".

    Attributes:
        subtasks: the four, by name.
        arm: the arm's limits and its sensors' errors.
        body_frame: the kitchen as seen from the finger tips.
        things: knobs with their burners, light, cabinets, microwave and kettle.
    """

    distance_margin = 0.5
    metric_names = ("success", "score")
    unfit = MappingProxyType(
        {60: "D4RL's kitchen: 30 positions and the goal, neither velocities nor simulator states; use data make"}
    )

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        model = stepped_model()
        self.arm = arm_config(model.nv)
        super().__init__(spec, MujocoEngine(model, KitchenRig(self.arm), FRAME_SKIP))
        self.body_frame = HandFrame(model, _OBSERVED_QPOS)
        self.things = tuple(_thing(name, qpos) for name, qpos in _THINGS.items())
        self.subtasks = _OF_VARIANT[spec.variant]
        self._places = np.array([SUBTASKS.index(name) for name in self.subtasks])

    def reset(self, rng: jax.Array) -> State:
        """Return the start, which is always the same but for the sensors' errors."""
        return self.reset_to(jnp.asarray(START_QPOS), jnp.zeros(self.engine.nv), key=rng)

    def start_physics(
        self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None, key: jax.Array | None
    ) -> PipelineState:
        """Return the physics at (qpos[30], qvel[29], extra[7]), sensed with errors drawn from ``key``."""
        return self.engine.init(qpos, qvel, extra, key)

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step under ``action[9]``, over if all four are complete in it."""
        after = super().step(state, action)
        score = self.score(after.pipeline_state.extra)
        success = (score == 1).astype(jnp.float32)
        return after.replace(
            done=jnp.maximum(after.done, success),
            metrics=after.metrics | {"success": success, "score": score},
            info=after.info | {"truncation": after.info["truncation"] * (1 - success)},
        )

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        """Return float32[59]: qpos and qvel of the arm, of everything else, as the sensors see them."""
        return pipeline_state.sensed

    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[...], whether all four were completed, by ``extra[..., 7]``."""
        return self.score(extra) == 1

    def score(self, extra: Any) -> Any:
        """Return float32[...], the share of the four that were completed, by ``extra[..., 7]``; NumPy or jax."""
        return extra[..., self._places].astype(np.float32).mean(axis=-1)

    def labels(self, states: SimulatorStates, goal: Any = None) -> tuple[Any, Any]:
        """Return (reward[...], mask[...]): the subtasks completed so far minus four, and 0 where none is left."""
        score = self.score(states.extra)
        return 4.0 * (score - 1.0), (score < 1).astype(np.float32)

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Return float64[...], how many of the four are left."""
        return np.asarray(4.0 * (1.0 - self.score(extra)), np.float64)

    def parts(self, states: SimulatorStates) -> dict[str, Any]:
        """Return bool[...] for each of the four, whether it was completed."""
        return {name: states.extra[..., place] == 1 for name, place in zip(self.subtasks, self._places, strict=True)}

    def scene(self) -> Scene:
        """Return the whole kitchen, from behind the arm or from closer to the things that it moves."""
        kitchen = fixed_view((-0.2, 0.5, 1.9), azimuth=70.0, elevation=-30.0, distance=2.8)
        return Scene(whole_model(), {"kitchen": kitchen, "near": fixed_view((-0.2, 0.5, 2.0), 70.0, -35.0, 2.2)})

    def check_steps(self, rows: StateRows) -> list[str]:
        """Return a line where states and observations disagree by more than the sensors err, or no stop holds."""
        if rows.qpos is None:
            return []
        found = []
        differ = np.abs(rows.observations[:, _OBSERVED_QPOS] - rows.qpos).max(axis=1) > _LARGEST_ERROR
        if differ.any():
            found.append(f"qpos and observations disagree on the state in {count_rows(differ)}")
        model = self.engine.model
        for joint in np.flatnonzero(model.jnt_limited):
            (low, high), place = model.jnt_range[joint], model.jnt_qposadr[joint]
            if (wrong := (rows.qpos[:, place] < low - _GIVE) | (rows.qpos[:, place] > high + _GIVE)).any():
                found.append(f"{model.joint(joint).name} is beyond its range in {count_rows(wrong)}")
        if (fallen := rows.qpos[:, _KETTLE_HEIGHT] < _STOVE - _GIVE).any():
            found.append(f"the kettle has fallen off the stove in {count_rows(fallen)}")
        return found


def _thing(name: str, qpos: range) -> Thing:
    """Return a thing; numbers of qvel are those of qpos, but that the kettle, free and the last, has one less."""
    qvel = range(qpos.start, min(qpos.stop, len(_OBSERVED_QVEL)))
    observed = (*_OBSERVED_QPOS[qpos].tolist(), *_OBSERVED_QVEL[qvel].tolist())
    extra = (SUBTASKS.index(name),) if name in SUBTASKS else ()
    return Thing(name, tuple(qpos), tuple(qvel), observed, extra)
