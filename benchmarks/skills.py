"""Measure the ceiling of a skill space, without RL: ``python benchmarks/skills.py RUN [RUN ..] --out FILE``.

Asks the simulator's truth, which training never sees, of the first member of each setting of a finished run:

- from logged states, with draws from the skill prior each: the true progress of a macro step (decrease of the shortest
  path to the goal) in mean and of the best draw, and how far the end points lie from their mean;
- R2 of the latent, as a linear map of the start's observation alone, and of that and where the body got, as seen from
  its start: the second beyond the first is what z says about what happens;
- the share of states at a wall, less than WALL away, from which a draw gets more than AWAY away;
- the oracle: success and steps of episodes in which the draw of most true progress is played.

Prints a table and writes CSV.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes.maze import UNIT
from qdos_brax import config as configs
from qdos_brax.analysis.conclusion import read_finished
from qdos_brax.analysis.film import of_member, on_mujoco_c
from qdos_brax.analysis.finished import TrainedRun
from qdos_brax.data.dataset import Dataset
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.jax_setup import prepare_jax

WALL = 1.3  # m between the body and the nearest wall's face, at most, of a state at a wall
AWAY = 1.5  # m


class Skills:
    """Play draws from one member's skill prior.

    Args:
        trained: the run, on MuJoCo C.
        member: its number.
        draws: skills tried from each state.
    """

    def __init__(self, trained: TrainedRun, member: int, draws: int) -> None:
        artifacts, hyper = of_member(trained, member)
        self.env, self._horizon, self._draws = trained.env, trained.config.skills.horizon, draws
        self._agent: Any = trained.agent(artifacts, hyper)
        self.play = jax.jit(self._play)

    def _play(self, qpos: jax.Array, qvel: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        """Return what each draw leads to from states[S]: [draws, S] of success, qpos, qvel, steps and z."""
        keys = jax.random.split(key, (self._draws, len(qpos)))
        return jax.vmap(jax.vmap(self._macro_step), in_axes=(None, None, 0))(qpos, qvel, keys)

    def _macro_step(self, qpos: jax.Array, qvel: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        agent, env = self._agent, self.env
        start = env.reset_to(qpos, qvel)
        normal = agent.normaliser(start.obs)
        action = agent.low_level.first(agent.skills, key, normal, agent.box)
        skill = agent.skill(action, normal)

        def step(carry: Any, index: jax.Array) -> tuple[Any, None]:
            state, success, steps = carry
            new = env.step(state, agent.play(state.obs, skill, index))
            state = jax.tree.map(lambda a, b: jnp.where(success, a, b), state, new)
            steps = steps + ~success
            return (state, success | env.success(state.pipeline_state.qpos, state.info["goal"]), steps), None

        first = (start, env.success(qpos, start.info["goal"]), jnp.zeros((), jnp.int32))
        (state, success, steps), _ = jax.lax.scan(step, first, jnp.arange(self._horizon))
        physics = state.pipeline_state
        latent = skill[: agent.low_level.width]
        return {"success": success, "qpos": physics.qpos, "qvel": physics.qvel, "steps": steps, "latent": latent}


def progress(env: Any, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the decrease of the shortest path from qpos ``before[S, nq]`` to ``after[N, S, nq]``."""
    left = np.nan_to_num(env.distance_left(after.reshape(-1, after.shape[-1])), posinf=1e3).reshape(after.shape[:2])
    return np.nan_to_num(env.distance_left(before), posinf=1e3) - left


def at_walls(env: Any, qpos: np.ndarray) -> np.ndarray:
    """Return bool[S], whether the body is at most ``WALL`` from a wall's face."""
    gap = np.abs(qpos[:, None, :2] - env.floor_map().walls) - UNIT / 2
    return (np.linalg.norm(np.maximum(gap, 0), axis=-1).min(axis=1) < WALL).astype(bool)


def r2(target: np.ndarray, *given: np.ndarray) -> float:
    """Return the share of ``target[n, z]``'s variance that a linear map of ``given`` explains, on the held-out half."""
    inputs = np.concatenate([*given, np.ones((len(target), 1))], axis=1)
    half = np.random.default_rng(0).permutation(len(target)) < len(target) // 2
    weights = np.linalg.lstsq(inputs[half], target[half], rcond=None)[0]
    error = target[~half] - inputs[~half] @ weights
    return float(1 - (error**2).mean() / target[~half].var(axis=0).mean())


def displacement(env: Any, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return float[N, S, 2], where the body got, as seen from the start."""
    pose = np.asarray(env.body_frame.pose(jnp.asarray(before)))  # an ant's observation begins with its qpos
    turn = pose[:, 2] - 1j * pose[:, 3]
    moved = ((after[..., 0] - before[:, 0]) + 1j * (after[..., 1] - before[:, 1])) * turn
    return np.stack([moved.real, moved.imag], axis=-1)


def from_logged_states(skills: Skills, dataset: Dataset, states: int) -> dict[str, float]:
    """Return the measures that need no episodes."""
    rows = np.random.default_rng(0).choice(len(dataset.qpos), states, replace=False)
    qpos, qvel = dataset.qpos[rows], dataset.qvel[rows]
    found = {name: np.asarray(value) for name, value in skills.play(qpos, qvel, jax.random.key(1)).items()}
    gain = progress(skills.env, qpos, found["qpos"])
    moved = displacement(skills.env, qpos, found["qpos"])
    far = np.linalg.norm(moved, axis=-1).max(axis=0) > AWAY
    z = found["latent"].reshape(-1, found["latent"].shape[-1])
    seen = np.tile(dataset.observations[rows], (len(moved), 1))
    where = moved.reshape(len(z), -1)
    # What a displacement says of z depends on the state.
    turned = (where[:, :, None] * seen[:, None, :]).reshape(len(z), -1)
    return {
        "progress_mean": float(gain.mean()),
        "progress_best": float(gain.max(axis=0).mean()),
        "spread": float(np.sqrt(moved.var(axis=0).sum(axis=-1)).mean()),
        "r2_state": r2(z, seen),
        "r2_state_and_outcome": r2(z, seen, where, turned),
        "freed_from_walls": float(far[at_walls(skills.env, qpos)].mean()),
    }


def oracle(skills: Skills, episodes: int) -> dict[str, float]:
    """Return success and mean steps of episodes by the draw of most true progress."""
    env = skills.env
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(7), episodes)).pipeline_state
    qpos, qvel = np.asarray(states.qpos), np.asarray(states.qvel)
    steps, done = np.zeros(episodes), np.zeros(episodes, bool)
    for decision in range(env.episode_length):
        found = {name: np.asarray(value) for name, value in skills.play(qpos, qvel, jax.random.key(decision)).items()}
        gain = np.where(found["success"], np.inf, progress(env, qpos, found["qpos"]))
        best = gain.argmax(axis=0), np.arange(episodes)
        steps += np.where(done, 0, found["steps"][best])
        done = done | (found["success"][best] & (steps < env.episode_length))
        qpos, qvel = found["qpos"][best], found["qvel"][best]
        if done.all() or steps[~done].min() >= env.episode_length:
            break
    return {"oracle_success": float(done.mean()), "oracle_steps": float(steps[done].mean()) if done.any() else np.nan}


def measure(run: Path, draws: int, states: int, episodes: int) -> list[dict[str, Any]]:
    """Return one row per member of a finished run."""
    trained, dataset = read_finished(RunFolder.open(run))
    trained = on_mujoco_c(trained)
    rows = []
    for member, settings in enumerate(configs.members(trained.config)):
        started = time.perf_counter()
        skills = Skills(trained, member, draws)
        found = from_logged_states(skills, dataset, states) | oracle(skills, episodes)
        row = {"task": trained.config.env, "method": trained.config.method, "view": trained.config.skills.view}
        rows.append(row | settings | found | {"seconds": time.perf_counter() - started})
        print(
            "  ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()), flush=True
        )
    return rows


def main() -> None:
    """Measure the runs named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a finished run of a maze, with skills")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="the CSV to write")
    parser.add_argument("--draws", type=int, default=16, help="skills drawn in each state (default 16)")
    parser.add_argument("--states", type=int, default=500, help="logged states (default 500)")
    parser.add_argument("--episodes", type=int, default=16, help="episodes of the oracle (default 16)")
    args = parser.parse_args()
    prepare_jax()
    rows = [row for run in args.runs for row in measure(run, args.draws, args.states, args.episodes)]
    names = list(dict.fromkeys(name for row in rows for name in row))
    with args.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
