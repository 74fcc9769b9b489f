"""A task that is no maze, in everything a task may be: an arm of two links and a switch, on the C engine.

The arm has to press the switch by turning its shoulder, and to bring its tip to the goal. The action moves the joint
targets, which the rig remembers; while the switch is on, the shoulder turns in oil.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import State
from mujoco.batch import Batch

import envs
from envs.physics import MujocoEngine, PipelineState
from envs.physics.mujoco.rig import Rig
from envs.scene import Scene
from envs.task import SimulatorStates

XML = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <geom name="goal" type="sphere" size=".05" contype="0" conaffinity="0"/>
    <body>
      <joint name="shoulder" axis="0 0 1" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" contype="0" conaffinity="0"/>
      <body pos=".5 0 0">
        <joint name="elbow" axis="0 0 1" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" contype="0" conaffinity="0"/>
        <site name="tip" pos=".5 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="5"/>
    <position joint="elbow" kp="5"/>
  </actuator>
</mujoco>
"""
TOLERANCE = 0.2
SWITCH = 0.3  # rad, where the shoulder flips it on its way up
MOVE = 0.2  # rad per control step and unit of action
OIL = 2.0  # damping
FRAME_SKIP = 5
GOALS = ((0.6, 0.5), (-0.3, 0.6))


class ArmRig(Rig):
    """Remember joint targets, flip the switch, sense the tip."""

    memory_size = 2
    extra_size = 1
    sensed_size = 2
    fields = ("site_xpos",)
    stage = mujoco.mjtStage.mjSTAGE_POS

    def start(self, batch: Batch, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return batch.bind("qpos").copy(), self._tip(batch)

    def before(self, batch: Batch, extra: np.ndarray) -> None:
        batch.expand("dof_damping")[:, 0] = np.where(extra[:, 0] == 1, OIL, 0.1)

    def ctrl(
        self, qpos: np.ndarray, qvel: np.ndarray, memory: np.ndarray, extra: np.ndarray, action: np.ndarray
    ) -> np.ndarray:
        return memory + MOVE * np.clip(action, -1, 1).astype(np.float64)

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pressed = (qpos[:, :1] <= SWITCH) & (batch.bind("qpos")[:, :1] > SWITCH)
        return batch.bind("ctrl").copy(), np.where(pressed, 1 - extra, extra).astype(np.int32), self._tip(batch)

    def _tip(self, batch: Batch) -> np.ndarray:
        return batch.bind("site_xpos")[:, 0, :2].astype(np.float32)


def tip(qpos: Any) -> Any:
    """Return where the tip is, [..., 2], at ``qpos[..., 2]``."""
    xp = jnp if isinstance(qpos, jax.Array) else np
    angles = xp.stack([qpos[..., 0], qpos[..., 0] + qpos[..., 1]], axis=-1)
    return 0.5 * xp.stack([xp.cos(angles).sum(axis=-1), xp.sin(angles).sum(axis=-1)], axis=-1)


class Reacher(envs.Task):
    """Observe joint angles, velocities, tip and switch; earn -1 for each of tip and switch that is not there."""

    distance_margin = 0.5

    def __init__(self, spec: envs.TaskSpec, physics: str) -> None:
        assert physics == "mujoco"
        engine = MujocoEngine(mujoco.MjModel.from_xml_string(XML), ArmRig(), FRAME_SKIP)
        super().__init__(spec, engine, GOALS[spec.task_id - 1])

    def scene(self) -> Scene:
        return replace(super().scene(), goal_marker="goal")

    def reset(self, rng: jax.Array) -> State:
        pose_key, next_key = jax.random.split(rng)
        return self.reset_to(jax.random.uniform(pose_key, (2,), minval=-0.2, maxval=0.2), jnp.zeros(2), key=next_key)

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        parts = (pipeline_state.qpos, pipeline_state.qvel, pipeline_state.sensed, pipeline_state.extra)
        return jnp.concatenate([part.astype(jnp.float32) for part in parts])

    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        return self._left(qpos, goal, extra) == 0

    def labels(self, states: SimulatorStates, goal: Any = None) -> tuple[Any, Any]:
        left = self._left(states.qpos, self._goal if goal is None else goal, states.extra).astype(np.float32)
        return -left, (left > 0).astype(np.float32)

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        return np.asarray(self._left(qpos, self._goal, extra), np.float64)

    def _left(self, qpos: Any, goal: Any, extra: Any) -> Any:
        """Return int[...], how many of tip and switch are not where they shall be."""
        away = ((tip(qpos) - goal) ** 2).sum(axis=-1) > TOLERANCE**2
        return away.astype(np.int32) + (extra[..., 0] == 0)


FAMILY = envs.Family(Reacher, ("mujoco",), {"": envs.Variant(7, 2, episode_length=40, num_tasks=2)}, default_variant="")


@contextmanager
def registered() -> Iterator[None]:
    """Have the family "reacher" among those of ``envs``."""
    envs.register_family("reacher", FAMILY)
    try:
        yield
    finally:
        del envs.FAMILIES["reacher"]


def random_rows(env: Reacher, episodes: int, length: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return rows of episodes under random actions that last, in D4RL's flat layout with ``infos/extra``."""

    def step(state: State, action: jax.Array) -> tuple[State, Any]:
        after = env.step(state, action)
        physics, (reward, mask) = state.pipeline_state, env.labels(state.pipeline_state)
        return after, (state.obs, after.obs, reward, 1 - mask, physics.qpos, physics.qvel, physics.extra)

    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1, 1, (episodes, length // 5, 2)), 5, axis=1).astype(np.float32)
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), episodes))
    _, rows = jax.jit(lambda s, a: jax.lax.scan(jax.vmap(step), s, a))(starts, np.swapaxes(actions, 0, 1))
    names = ("observations", "next_observations", "rewards", "terminals", "infos/qpos", "infos/qvel", "infos/extra")
    flat = {name: np.swapaxes(np.asarray(x), 0, 1) for name, x in zip(names, rows, strict=True)}
    flat = {name: array.reshape(episodes * length, *array.shape[2:]) for name, array in flat.items()}
    timeouts = np.arange(episodes * length) % length == length - 1
    return flat | {"actions": actions.reshape(-1, 2), "timeouts": timeouts}
