"""Measure how well advantages rank segments: ``python benchmarks/advantage.py --env antmaze-medium --out FILE``.

Trains the values (and, for the latent advantage, the skills) as a run does, and ranks all segments of the data by each
advantage. They are compared with the true progress, which training never sees: the decrease of the shortest path to the
task's goal, or of the number of things that are not yet where they shall be. Prints one row per value estimator,
advantage and lambda, with uniform weights and with the true distance in place of V for comparison, and writes CSV.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from qdos_brax import config as configs
from qdos_brax.collection import default_set
from qdos_brax.data import formats, quality
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, to_device
from qdos_brax.errors import guarded
from qdos_brax.methods.learners_view import learners_env, run_dataset
from qdos_brax.methods.low_level_kinds import make_skill_model, value_phase
from qdos_brax.population.members import Population
from qdos_brax.runs.jax_setup import prepare_jax
from qdos_brax.skills.graph_phase import GraphPhase
from qdos_brax.skills.segment_weights import LatentWeights, SegmentBatch
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import segments_at
from qdos_brax.skills.value_phase import ValuePhase, over_rows
from qdos_brax.skills.values import IQL
from qdos_brax.skills.weights import advantage_weights, scaled_advantage

CONFIGURED = {"graph": ("segment", "latent"), "iql": ("segment", "latent", "transition")}
"""Advantages by value estimator."""


class Scores(NamedTuple):
    """Hold the score[S] of each segment, V's correlation with minus the true distance, and V's training seconds."""

    score: np.ndarray
    correlation: float
    seconds: float


def run_phase(phase: Any, seed: int, artifacts: dict[str, Any]) -> Any:
    """Run all chunks of a phase and return its last state."""
    state, constants = phase.init(jax.random.split(jax.random.key(seed), 1), artifacts)
    for _ in range(phase.num_chunks):
        state, _ = phase.chunk(state, constants)
    return jax.block_until_ready(state)


def scores(
    config: configs.Config, env: Any, dataset: Dataset, data: DeviceData, seed: int, advantages: list[str]
) -> dict[str, Scores]:
    """Return the scores of those ``advantages`` that ``config.values.estimator`` has, scaled as configured."""
    found: dict[str, Scores] = {}
    population = Population(configs.population_hyper(config))
    for name in advantages:
        if name not in CONFIGURED[config.values.estimator]:
            continue
        chosen = configs.replace(config, **{"skills.advantage": name})
        if name == "transition" or not found:  # segment and latent share their values
            started = time.perf_counter()
            phase = value_phase(chosen, env, dataset.ends)
            phase.bind(population, data)
            state = run_phase(phase, seed, {})
            artifacts = phase.finish(state, {})
            seconds = time.perf_counter() - started
            fit = correlation(env, dataset, state_values(chosen, env, data, phase, state))
        score = np.asarray(artifacts["advantage"][0])
        if name == "latent":
            score = latent_scores(chosen, env, data, population, artifacts, seed)
        found[name] = Scores(score, fit, seconds)
    return found


def state_values(
    config: configs.Config, env: Any, data: DeviceData, phase: GraphPhase | ValuePhase, state: Any
) -> np.ndarray:
    """Return V of every logged state, float[N]."""
    if isinstance(phase, GraphPhase):
        return np.asarray(state[0])
    iql = IQL(env.observation_size, env.action_size, config.values.hidden)
    params = jax.tree.map(lambda x: x[0], state.values.value)
    return np.asarray(jax.jit(lambda p: over_rows(lambda s: iql.value(p, s), data.observations))(params))


def correlation(env: Any, dataset: Dataset, values: np.ndarray) -> float:
    """Return Pearson's correlation of V with minus the true distance, over the states whose distance is known."""
    distance = np.asarray(env.distance_left(dataset.qpos, dataset.extra), np.float64)
    known = np.isfinite(distance)
    return float(np.corrcoef(values[known], -distance[known])[0, 1]) if values.std() > 0 else float("nan")


def latent_scores(
    config: configs.Config, env: Any, data: DeviceData, population: Population, artifacts: Any, seed: int
) -> np.ndarray:
    """Return Q(s_0, z) - V(s_0) of every segment, with Q trained along in a skill phase without rollouts."""
    skills = config.skills
    model = make_skill_model(config, env)
    weights = LatentWeights(env.observation_size, skills.latent_dim, config.values.hidden, skills.advantage_scale)
    phase = SkillPhase(config, model, weights, None)
    phase.bind(population, data)
    learned = run_phase(phase, seed, artifacts)
    learned = jax.tree.map(lambda x: x[0], learned)

    @jax.jit
    def latent(index: jax.Array) -> jax.Array:
        segments = segments_at(data, data.starts[index], skills.horizon, model.reach)
        batch = SegmentBatch(
            index, data.observations[data.starts[index]], lambda: model.encode(learned.params, segments).mean
        )
        return weights.smaller_head(learned.weights, batch)

    total = data.starts.shape[0]
    blocks = [jnp.arange(first, min(first + 4096, total)) for first in range(0, total, 4096)]
    return np.concatenate([np.asarray(latent(block)) for block in blocks])


def rows_of(
    config: configs.Config,
    env: Any,
    dataset: Dataset,
    starts: np.ndarray,
    found: dict[tuple[str, str], Scores],
    temperatures: list[float],
) -> list[dict[str, Any]]:
    """Return one row per estimator, advantage and lambda, and rows for uniform weights and the true distance."""
    gains = quality.progress(env, dataset, starts, config.skills.horizon)
    degraded = None if dataset.quality is None else dataset.quality[starts] != quality.QUALITY["navigate"]
    ceiling = {("uniform", "none"): Scores(np.zeros(len(starts)), float("nan"), 0.0)}
    ceiling |= {("true distance", "segment"): Scores(gains, 1.0, 0.0)}
    rows = []
    for (values, advantage), (score, value_correlation, seconds) in (found | ceiling).items():
        scaled = scaled_advantage(jnp.asarray(score), config.skills.advantage_scale)
        for temperature in [1.0] if values == "uniform" else temperatures:
            weights = np.asarray(advantage_weights(scaled, temperature, float(np.mean(config.skills.weight_clip))))
            rows.append(
                {"values": values, "advantage": advantage, "lambda": temperature}
                | quality.report(score, weights, gains, env.distance_margin, degraded)
                | {"value_correlation": value_correlation, "values_seconds": round(seconds, 1)}
            )
    return rows


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="antmaze-medium")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--dataset", type=Path, help="data file (default: the task's own data set)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--values", default="graph,iql", help="value estimators, comma-separated")
    parser.add_argument("--advantages", default="segment,latent,transition", help="comma-separated")
    parser.add_argument("--lambdas", default="0.3,0.5,0.7,1.0", help="temperatures of the weights, comma-separated")
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE for the configuration; may be repeated")
    parser.add_argument("--out", type=Path, help="CSV file to append to")
    args = parser.parse_args()
    prepare_jax()
    started = time.perf_counter()
    config = configs.load_config(args.env, args.preset, {}, args.set)
    env = envs.make(args.env, physics="mujoco")
    d = config.data
    path = args.dataset or default_set.default_dataset(
        env, transitions=d.transitions, degraded_share=d.degraded_share, noise=d.noise, seed=d.seed, num_envs=d.num_envs
    )
    logged, env = formats.read(path, env), learners_env(config, env)
    dataset = run_dataset(config, env, logged)
    data, _ = to_device(dataset, config.skills.horizon)
    found: dict[tuple[str, str], Scores] = {}
    for values in args.values.split(","):
        chosen = configs.replace(config, **{"values.estimator": values})
        by_name = scores(chosen, env, dataset, data, args.seed, args.advantages.split(","))
        found |= {(values, name): score for name, score in by_name.items()}
    temperatures = [float(text) for text in args.lambdas.split(",")]
    rows = rows_of(config, env, dataset, np.asarray(data.starts), found, temperatures)
    head = {
        "env": env.spec.full_name,
        "seed": args.seed,
        "transitions": dataset.size,
        "degraded_share": share(dataset),
        "scale": config.skills.advantage_scale,
    }
    for row in rows:
        print(
            "  ".join(
                f"{key} {value:.3f}" if isinstance(value, float) else f"{value:13s}" for key, value in row.items()
            )
        )
    print(f"{time.perf_counter() - started:.0f} s")
    if args.out:
        new = not args.out.exists()
        with open(args.out, "a", newline="") as file:
            writer = csv.DictWriter(file, [*head, *rows[0]])
            if new:
                writer.writeheader()
            writer.writerows({**head, **row} for row in rows)


def share(dataset: Dataset) -> float:
    """Return the share of rows from degraded behaviour, to two digits; NaN if it is unknown."""
    if dataset.quality is None:
        return float("nan")
    return round(float(np.mean(dataset.quality != quality.QUALITY["navigate"])), 2)


if __name__ == "__main__":
    raise SystemExit(guarded(main))
