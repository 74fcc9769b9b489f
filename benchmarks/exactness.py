"""Measure the accuracy of the physics: ``python benchmarks/exactness.py [--out results/exactness.json]``.

The states are visited by rollouts, half of them of a walker and half of random actions (the humanoid has random actions
only); three quarters of the rollouts start at a wall. Measured are:

- *MuJoCo C engine against OGBench's environment*: the largest difference of any coordinate of qpos and qvel, in
  float64, over whole rollouts. Teleporters are switched off (OGBench draws exits from a generator of its own);
  ``tests/envs/test_parity.py`` compares them.
- *MJX engine against the MuJoCo C engine*: the error of one control step, the largest of any coordinate of qpos,
  separately for states that touch a wall (or the ball) in that step; and the distance between the bodies after 100
  steps under the same policy, next to the distance that they covered.
- *Contacts* of a state, by dimension, and the share of states with more contacts than MJX keeps.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs.mazes.families import MAZE_FAMILIES
from qdos_brax.collection.experts import policies
from qdos_brax.files import write_text

STATES = 1000
ROLLOUTS = 125  # also the batch of every compiled step
EVERY = 5  # control steps between two states taken from a rollout
REPLAYED = 10  # rollouts that are replayed in OGBench
DRIFT_STEPS = 100
HOLD = 4  # control steps for which a random action is held


class States(NamedTuple):
    """Hold visited states: qpos[N, nq], qvel[N, nv], and an action[N, nu] for each."""

    qpos: np.ndarray
    qvel: np.ndarray
    action: np.ndarray


class Policy:
    """Walk along a direction in the first half of the environments, act at random in the others.

    Args:
        env: the task; bodies without a shipped walker act at random in all environments.
        seed: the seed of directions and actions.
    """

    def __init__(self, env: Any, seed: int) -> None:
        rng = np.random.default_rng(seed)
        angle = rng.uniform(-np.pi, np.pi, ROLLOUTS)
        direction = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=1), jnp.float32)
        self._random = rng.uniform(-1, 1, (DRIFT_STEPS // HOLD, ROLLOUTS, env.action_size)).astype(np.float32)
        self._walks = (np.arange(ROLLOUTS) < ROLLOUTS // 2)[:, None]
        if env.spec.family.startswith("ant"):
            act = policies.ant_walker().act
            self._walk = jax.jit(lambda qpos, qvel: act(qpos[:, :15], qvel[:, :14], direction))
        else:
            self._walk = None

    def act(self, step: int, state: Any) -> np.ndarray:
        """Return the actions float32[ROLLOUTS, nu] of a step below ``DRIFT_STEPS``."""
        action = self._random[step // HOLD]
        if self._walk is None:
            return action
        return np.where(self._walks, np.asarray(self._walk(state.qpos, state.qvel)), action)


def starts(env: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 (qpos[ROLLOUTS, nq], qvel[ROLLOUTS, nv]), most at a wall and moving towards it."""
    rng = np.random.default_rng(seed)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(seed), ROLLOUTS)).pipeline_state
    qpos, qvel = np.array(state.qpos), np.array(state.qvel)
    cells = env.layout.free_cells[rng.integers(len(env.layout.free_cells), size=ROLLOUTS)]
    at_wall = (np.arange(ROLLOUTS) % 4 > 0)[:, None]
    shape = (ROLLOUTS, 2)
    off_centre = np.where(at_wall, rng.choice([-1.0, 1.0], shape), rng.uniform(-1, 1, shape))
    qpos[:, :2] = env.layout.ij_to_xy(cells) + off_centre
    qvel[:, :2] += np.where(at_wall, 2 * off_centre, 0)
    for place in env.body.places[1:]:  # the ball, near the ant and in the same cell
        angle = rng.uniform(0, 2 * np.pi, ROLLOUTS)
        near = qpos[:, :2] + 0.9 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        centre = env.layout.ij_to_xy(cells)
        qpos[:, place : place + 2] = np.clip(near, centre - 1.7, centre + 1.7)
        qvel[:, place - 1 : place + 2] = rng.normal(size=(ROLLOUTS, 3))
    return qpos, qvel


def visited(env: Any, step: Any, seed: int = 0) -> States:
    """Return ``STATES`` states along rollouts of MuJoCo C."""
    policy, rng = Policy(env, seed), np.random.default_rng(seed)
    state = jax.vmap(env.engine.init)(*starts(env, seed))
    rows = []
    for k in range(STATES // ROLLOUTS * EVERY):
        state = step(state, policy.act(k, state))
        if (k + 1) % EVERY == 0:
            rows.append((np.asarray(state.qpos), np.asarray(state.qvel)))
    qpos, qvel = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return States(qpos, qvel, rng.uniform(-1, 1, (len(qpos), env.action_size)).astype(np.float32))


def touching(env: Any, states: States) -> tuple[np.ndarray, list[Counter[int]]]:
    """Return bool[N], whether a step touches wall or ball (in C), and its most contacts by dimension."""
    model = env.whole_model()
    data = mujoco.MjData(model)
    hard = [g for g in range(model.ngeom) if model.geom(g).name.startswith("block_") or model.geom(g).name == "ball"]
    floor = model.geom("floor").id
    touched, counts = np.zeros(len(states.qpos), bool), []
    for n, (qpos, qvel, action) in enumerate(zip(*states, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, action
        worst: Counter[int] = Counter()
        for _ in range(env.engine.frame_skip):
            mujoco.mj_step(model, data)
            pairs = data.contact.geom[: data.ncon]
            touched[n] |= (np.isin(pairs, hard).any(axis=1) & (pairs != floor).all(axis=1)).any()
            worst |= Counter(data.contact.dim[: data.ncon].tolist())
        counts.append(worst)
    return touched, counts


def against_ogbench(env: Any, step: Any, seed: int = 1) -> dict[str, Any]:
    """Compare the MuJoCo C engine with OGBench's environment over 100 steps from each of ``REPLAYED`` starts."""
    import gymnasium
    import ogbench  # noqa: F401  (registers the environments)

    policy = Policy(env, seed)
    qpos, qvel = starts(env, seed)
    state = jax.vmap(env.engine.init)(qpos, qvel)
    actions, exact = [], []
    for k in range(DRIFT_STEPS):
        actions.append(policy.act(k, state))
        state = step(state, actions[-1])
        exact.append(np.concatenate(env.engine.exact_state(state), axis=-1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = gymnasium.make(f"{env.spec.name}-singletask-v0").unwrapped
    if env.layout.teleporters is not None:
        reference._teleport_info["teleport_in_xys"] = []
    worst = 0.0
    for n in np.linspace(0, ROLLOUTS - 1, REPLAYED).astype(int):
        reference.reset()
        reference.set_state(qpos[n].astype(np.float64), qvel[n].astype(np.float64))
        for k in range(DRIFT_STEPS):
            reference.step(actions[k][n])
            theirs = np.concatenate([reference.data.qpos, reference.data.qvel])
            worst = max(worst, float(np.abs(theirs - exact[k][n]).max()))
    return {"states": REPLAYED * DRIFT_STEPS, "largest_difference": worst}


def one_step_errors(env: Any, c_step: Any, mjx_engine: Any, mjx_step: Any) -> dict[str, Any]:
    """Return quantiles of the error in qpos, for states with and without touch, and the contacts."""
    states = visited(env, c_step)
    mjx_start = jax.jit(jax.vmap(mjx_engine.init))
    errors = []
    for first in range(0, STATES, ROLLOUTS):
        qpos, qvel, action = (part[first : first + ROLLOUTS] for part in states)
        ours = mjx_step(mjx_start(qpos, qvel), action)
        exact = c_step(jax.vmap(env.engine.init)(qpos, qvel), action)
        errors.append(np.abs(np.asarray(ours.qpos) - np.asarray(exact.qpos)).max(axis=1))
    error = np.concatenate(errors)
    touched, counts = touching(env, states)
    dims = sorted({dim for count in counts for dim in count})
    dropped = np.mean([any(count[dim] > most for dim, most in env.body.most_contacts.items()) for count in counts])
    return {
        "free": quantiles(error[~touched]),
        "touching": quantiles(error[touched]),
        "most_contacts": {str(dim): max(count[dim] for count in counts) for dim in dims},
        "share_beyond_cap": float(dropped),
    }


def drift(env: Any, c_step: Any, mjx_engine: Any, mjx_step: Any, seed: int = 2) -> dict[str, Any]:
    """Return the distance between the bodies of both engines after ``DRIFT_STEPS`` steps, and from their start."""
    policy = Policy(env, seed)
    qpos, qvel = starts(env, seed)
    ends = []
    for engine, step in ((env.engine, c_step), (mjx_engine, mjx_step)):
        state = jax.jit(jax.vmap(engine.init))(qpos, qvel)
        for k in range(DRIFT_STEPS):
            state = step(state, policy.act(k, state))
        ends.append(np.asarray(state.qpos)[:, :2])
    apart = np.linalg.norm(ends[0] - ends[1], axis=1)
    went = [float(np.linalg.norm(end - qpos[:, :2], axis=1).mean()) for end in ends]
    return {"steps": DRIFT_STEPS, "apart": quantiles(apart), "mean_way": {"mujoco": went[0], "mjx": went[1]}}


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Return count, median, p90, p99 and maximum."""
    if len(values) == 0:
        return {"count": 0}
    marks = dict(zip(("median", "p90", "p99", "max"), np.quantile(values, [0.5, 0.9, 0.99, 1.0]), strict=True))
    return {"count": len(values), **{key: float(f"{value:.3g}") for key, value in marks.items()}}


def both_engines(task: str) -> tuple[Any, Any, Any, Any]:
    """Return the task on MuJoCo C, its compiled batched step, the engine on MJX, and its compiled batched step."""
    env, mjx_engine = envs.make(task, physics="mujoco"), envs.make(task, physics="mjx").engine
    return env, jax.jit(jax.vmap(env.engine.step)), mjx_engine, jax.jit(jax.vmap(mjx_engine.step))


def examine(task: str) -> dict[str, Any]:
    """Return all measurements of one task."""
    env, c_step, mjx_engine, mjx_step = both_engines(task)
    return {
        "mujoco_against_ogbench": against_ogbench(env, c_step),
        "mjx_one_step": one_step_errors(env, c_step, mjx_engine, mjx_step),
        "mjx_drift": drift(env, c_step, mjx_engine, mjx_step),
    }


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = list(dict.fromkeys(s.name for s in envs.list_tasks() if s.family in MAZE_FAMILIES))
    parser.add_argument("--tasks", nargs="+", default=names)
    parser.add_argument("--out", type=Path, help="JSON file for the result; its entries of other tasks are kept")
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    found: dict[str, Any] = json.loads(args.out.read_text()) if args.out and args.out.exists() else {}
    for task in args.tasks:
        began = time.perf_counter()
        found[task] = examine(task)
        print(task, f"({time.perf_counter() - began:.0f} s)", json.dumps(found[task]), flush=True)
        if args.out:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            write_text(args.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
