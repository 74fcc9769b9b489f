"""Make 100,000 steps of every task: ``python benchmarks/long_rollouts.py [--out results/long_rollouts.json]``.

A hundred environments make a thousand control steps each, with resets in between. Half of the bodies walk straight on,
into the walls (a humanoid as far as it gets, for it begins with a fall); the others act at random. Measured over all
states:

- how many were not finite,
- height (m) and speed (m/s) of the walking body, and of the ball,
- mechanical energy (J), kinetic and potential as computed by MuJoCo C, zero at the floor; and its largest rise in one
  control step, next to the most that the motors could have added in that step: torque times the joints' speed (the
  faster of before and after), summed over joints. A body at rest against a wall loses energy ever more slowly, down to
  less than the last bit of its float32 coordinates: a rise counts only if it also exceeds that,
- how often the middle of a body was inside a wall.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs.mazes.families import MAZE_FAMILIES
from envs.mazes.walls import cells_in_reach
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.views import direction_of
from qdos_brax.collection.profiles import profile_of
from qdos_brax.files import write_text

STEPS = 100_000
NUM_ENVS = 100


def rollouts(env: Any, seed: int = 0) -> dict[str, np.ndarray]:
    """Make ``STEPS`` steps of the task in N environments.

    Args:
        env: the task wrapped by ``AutoReset``; the state after a step that is done is the next episode's first.
        seed: seed of starts, directions and actions.

    Returns:
        qpos[T + 1, N, nq] and qvel[T + 1, N, nv], starting before the first step, and bool[T, N] done and nan.
    """
    reset_key, angle_key, action_key = jax.random.split(jax.random.key(seed), 3)
    profile, half = profile_of(env), NUM_ENVS // 2
    walker = policies.walker_of(profile.expert())
    angle = jax.random.uniform(angle_key, (NUM_ENVS,), minval=-np.pi, maxval=np.pi)
    direction = direction_of(angle)

    def body(state: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        action = jax.random.uniform(key, (NUM_ENVS, env.action_size), minval=-1)
        before = state.pipeline_state
        walk = walker.act(before.qpos[:half], before.qvel[:half], direction[:half])
        state = jax.vmap(env.step)(state, jnp.concatenate([walk, action[half:]]))
        after = state.pipeline_state
        return state, {"qpos": after.qpos, "qvel": after.qvel, "done": state.done > 0, "nan": state.metrics["nan"] > 0}

    reset_keys = jax.random.split(reset_key, NUM_ENVS)
    state = jax.jit(jax.vmap(env.reset))(reset_keys)
    keys = jax.random.split(action_key, STEPS // NUM_ENVS)
    _, seen = jax.jit(lambda s, k: jax.lax.scan(body, s, k))(state, keys)
    start = {"qpos": state.pipeline_state.qpos[None], "qvel": state.pipeline_state.qvel[None]}
    return {
        name: np.concatenate([start[name], part]) if name in start else np.asarray(part) for name, part in seen.items()
    }


def energy(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return float64[...], kinetic plus potential energy (J), of states (qpos[..., nq], qvel[..., nv])."""
    data = mujoco.MjData(model)
    found = []
    for position, velocity in zip(qpos.reshape(-1, model.nq), qvel.reshape(-1, model.nv), strict=True):
        data.qpos[:], data.qvel[:] = position, velocity
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        found.append(data.energy.sum())
    return np.asarray(found).reshape(qpos.shape[:-1])


def motor_work(model: mujoco.MjModel, qvel: np.ndarray, seconds: float) -> np.ndarray:
    """Return float64[T, ...], the most work (J) of the motors between each of ``qvel[T + 1, ..., nv]`` and the next."""
    joints = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    torque = np.abs(model.actuator_gear[:, 0] * model.actuator_ctrlrange[:, 1])
    rate = np.abs(qvel[..., joints])
    return seconds * np.maximum(rate[:-1], rate[1:]) @ torque


def rounding(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return float64[...], the error of ``energy`` (J) that float32 states can cause.

    Every number may be half a unit in its last place away from the simulator's. To first order the error is weight
    times the shift in height of the centre of mass, plus momentum times the shift in velocity. The change of the mass
    matrix with qpos is left out: it scales with the square of the speed, which is negligible for a body at rest.
    """
    data = mujoco.MjData(model)
    jacobian, momentum = np.zeros((3, model.nv)), np.zeros(model.nv)
    weight = -model.opt.gravity[2] * model.body_mass.sum()
    shifts = _shifts(model, qpos).reshape(-1, model.nv)
    found = []
    for position, velocity, shift in zip(qpos.reshape(-1, model.nq), qvel.reshape(-1, model.nv), shifts, strict=True):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_jacSubtreeCom(model, data, jacobian, 0)
        mujoco.mj_mulM(model, data, momentum, velocity)
        found.append(weight * np.abs(jacobian[2]) @ shift + np.abs(momentum) @ _half_units(velocity))
    return np.asarray(found).reshape(qpos.shape[:-1])


def _shifts(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return float64[..., nv], the most that rounding ``qpos[..., nq]`` to float32 moves each degree of freedom."""
    units = _half_units(qpos)
    moved = np.empty((*qpos.shape[:-1], model.nv))
    for kind, place, first in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        moved[..., first] = units[..., place]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            moved[..., first : first + 3] = units[..., place : place + 3]
            # the body turns by twice the distance that its unit quaternion moves
            turn = 2 * np.linalg.norm(units[..., place + 3 : place + 7], axis=-1, keepdims=True)
            moved[..., first + 3 : first + 6] = turn
    return moved


def _half_units(values: np.ndarray) -> np.ndarray:
    """Return float64[...], half a unit in the last place of each of ``values`` in float32."""
    return np.spacing(np.abs(values).astype(np.float32)).astype(np.float64) / 2


def watch(name: str, physics: str) -> dict[str, Any]:
    """Measure one task on one engine; return the numbers that the JSON file holds."""
    began = time.perf_counter()
    env = envs.AutoReset(envs.make(name, physics=physics))
    model = env.whole_model()
    seen = rollouts(env)
    qpos, qvel = seen["qpos"], seen["qvel"]
    things = dict(zip(("body", "ball"), env.body.places, strict=False))
    joules = energy(model, qpos, qvel)
    jumped = seen["done"] | (np.abs(np.diff(qpos[..., :2], axis=0)).max(axis=-1) > 2)  # a reset or a teleport
    rise = np.where(jumped, -np.inf, np.diff(joules, axis=0))
    work = motor_work(model, qvel, env.engine.frame_skip * model.opt.timestep)
    unseen = rounding(model, qpos, qvel)
    found: dict[str, Any] = {"steps": int(seen["done"].size), "episodes_ended": int(seen["done"].sum())}
    found["not_finite"] = int(seen["nan"].sum())
    for thing, place in things.items():
        velocity = place - (thing == "ball")  # a free joint has one number more in qpos than in qvel
        inside = cells_in_reach(env.layout, qpos[..., place : place + 2])[1][..., 0]
        found[thing] = {
            "height": span(qpos[..., place + 2]),
            "speed": span(np.linalg.norm(qvel[..., velocity : velocity + 3], axis=-1)),
            "inside_a_wall": int(inside.sum()),
        }
    most = np.unravel_index(rise.argmax(), rise.shape)
    found["energy"] = span(joules) | {
        "most_rise": float(f"{rise[most]:.4g}"),
        "motors_could_then": float(f"{work[most]:.4g}"),
        "rose_beyond_motors": int((rise > work + unseen[:-1] + unseen[1:]).sum()),
    }
    return found | {"seconds": round(time.perf_counter() - began)}


def span(values: np.ndarray) -> dict[str, float]:
    """Return the least, the median and the largest value, to four digits."""
    least, median, most = (float(f"{value:.4g}") for value in np.quantile(values, [0, 0.5, 1]))
    return {"least": least, "median": median, "most": most}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = list(dict.fromkeys(s.name for s in envs.list_tasks() if s.family in MAZE_FAMILIES))
    parser.add_argument("--tasks", nargs="+", default=names, help="tasks (default all)")
    parser.add_argument("--physics", nargs="+", default=["mujoco", "mjx"], help="engines (default mujoco mjx)")
    parser.add_argument("--out", type=Path, help="JSON file to update; entries of other tasks and engines are kept")
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    found = json.loads(args.out.read_text()) if args.out and args.out.exists() else {}
    for physics in args.physics:
        for task in args.tasks:
            found[f"{task} {physics}"] = watch(task, physics)
            print(task, physics, json.dumps(found[f"{task} {physics}"]), flush=True)
            if args.out:
                args.out.parent.mkdir(parents=True, exist_ok=True)
                write_text(args.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
