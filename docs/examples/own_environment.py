"""An environment of your own, from the model to a trained agent; docs/own-environment.md goes through it.

python docs/examples/own_environment.py collect reacher.hdf5
python docs/examples/own_environment.py data check reacher.hdf5 --env reacher --horizon 10
python docs/examples/own_environment.py train --env reacher --dataset reacher.hdf5 --preset cpu
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs.physics import MujocoEngine
from qdos_brax.commands.main import main
from qdos_brax.data import formats

MODEL = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 0 1" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" contype="0" conaffinity="0"/>
      <body pos=".5 0 0">
        <joint name="elbow" axis="0 0 1" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear=".5" ctrlrange="-1 1"/>
    <motor joint="elbow" gear=".5" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
GOALS = ((0.6, 0.5), (-0.3, 0.6))
TOLERANCE = 0.1  # m


class Reacher(envs.Task):
    """Bring the tip of an arm of two links to a goal: qpos 2, qvel 2, action 2, observation 6."""

    distance_margin = 0.1

    def __init__(self, spec: envs.TaskSpec, physics: str) -> None:
        engine = MujocoEngine(mujoco.MjModel.from_xml_string(MODEL), frame_skip=5)
        super().__init__(spec, engine, goal=GOALS[spec.task_id - 1])

    def reset(self, rng: jax.Array) -> Any:
        pose_key, next_key = jax.random.split(rng)
        return self.reset_to(jax.random.uniform(pose_key, (2,), minval=-0.1, maxval=0.1), jnp.zeros(2), key=next_key)

    def observe(self, pipeline_state: Any) -> jax.Array:
        qpos, qvel = pipeline_state.qpos, pipeline_state.qvel
        return jnp.concatenate([jnp.cos(qpos), jnp.sin(qpos), qvel])

    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        return ((tip(qpos) - goal) ** 2).sum(axis=-1) < TOLERANCE**2

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        return np.sqrt(((tip(np.asarray(qpos)) - self._goal) ** 2).sum(axis=-1))


def tip(qpos: Any) -> Any:
    """Return where the tip is, [..., 2], at ``qpos[..., 2]``; NumPy or jax."""
    xp = jnp if isinstance(qpos, jax.Array) else np
    angles = xp.stack([qpos[..., 0], qpos[..., 0] + qpos[..., 1]], axis=-1)
    return 0.5 * xp.stack([xp.cos(angles).sum(axis=-1), xp.sin(angles).sum(axis=-1)], axis=-1)


REACHER = envs.Family(
    make=Reacher,
    engines=("mujoco",),
    variants={"": envs.Variant(observation_size=6, action_size=2, episode_length=100, num_tasks=2)},
    default_variant="",
)


def collect(out: Path, episodes: int = 500, hold: int = 10) -> None:
    """Write episodes of random actions, each held for some steps, in D4RL's flat layout."""
    env = envs.make("reacher")
    length = env.episode_length
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (length // hold, episodes, 2)).repeat(hold, axis=0).astype(np.float32)

    def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
        after = env.step(state, action)
        physics, (reward, mask) = state.pipeline_state, env.labels(state.pipeline_state)
        return after, (state.obs, action, reward, 1 - mask, after.obs, physics.qpos, physics.qvel)

    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), episodes))
    _, rows = jax.jit(lambda s, a: jax.lax.scan(jax.vmap(step), s, a))(starts, actions)
    names = ("observations", "actions", "rewards", "terminals", "next_observations", "infos/qpos", "infos/qvel")
    columns = {name: np.swapaxes(np.asarray(x), 0, 1) for name, x in zip(names, rows, strict=True)}
    flat = {name: x.reshape(episodes * length, *x.shape[2:]) for name, x in columns.items()}
    flat["timeouts"] = np.arange(episodes * length) % length == length - 1
    formats.write_hdf5(out, flat, {"env": "reacher-task1"})


if __name__ == "__main__":
    envs.register_family("reacher", REACHER)
    if sys.argv[1:2] == ["collect"]:
        collect(Path(sys.argv[2]))
    else:
        sys.exit(main())
