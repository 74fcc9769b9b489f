"""Do the weights know which segments gain ground? ``python benchmarks/advantage.py --env antmaze-medium --out FILE``.

Trains the values (and, for the latent estimator, the skills) as a run would, and ranks all segments of the data by each
of the three advantages. The truth, which training never sees, is how much of the shortest path to the task's goal a
segment gains. Prints one row per estimator and writes CSV.
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

import envs
from qdos_brax import config as configs
from qdos_brax.data import cache, formats, quality
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, macro_rows, to_device
from qdos_brax.data.segments import window
from qdos_brax.skills.segment_weights import LatentWeights, SegmentBatch
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import Segments, SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL
from qdos_brax.skills.weights import advantage_weights
from qdos_brax.train_flow import prepare_jax


def run_phase(phase: Any, seed: int, artifacts: dict[str, Any]) -> Any:
    """The phase's state after its last chunk."""
    state = phase.init(jax.random.split(jax.random.key(seed), 1), artifacts)
    for _ in range(phase.num_chunks):
        state, _ = phase.chunk(state)
    return state


def advantages(config: configs.Config, env: Any, data: DeviceData, seed: int) -> dict[str, np.ndarray]:
    """float[S] of every segment, by estimator."""
    hyper = {key: jnp.asarray(value) for key, value in configs.population_hyper(config).items()}
    skills, discount = config.skills, hyper["values.discount"][0]
    iql = IQL(env.observation_size, env.action_size, config.values.hidden)
    phase = ValuePhase(config, data, hyper, iql)
    state = run_phase(phase, seed, {})
    values = jax.tree.map(lambda x: x[0], state.values)
    found = {
        "segment": np.asarray(jax.jit(phase.segment)(values, data, discount)),
        "transition": np.asarray(jax.jit(phase.transition)(values, data, discount)),
    }

    model = SkillModel(env.observation_size, env.action_size, skills.latent_dim, skills.encoder_hidden,
                       skills.encoder_layers, skills.decoder_hidden, skills.prior_hidden)  # fmt: skip
    weights = LatentWeights(env.observation_size, skills.latent_dim, config.values.hidden, iql.value, skills.horizon)
    artifacts = phase.finish(state, {})
    learned = run_phase(SkillPhase(config, data, hyper, model, weights, None), seed, artifacts)
    learned = jax.tree.map(lambda x: x[0], learned)
    value = jax.tree.map(lambda x: x[0], artifacts["value"])

    @jax.jit
    def latent(index: jax.Array) -> jax.Array:
        rows = macro_rows(data, data.starts[index], skills.horizon, discount)
        segments = Segments(*window((data.observations, data.actions), data.starts[index], skills.horizon))
        batch = SegmentBatch(index, rows, lambda: model.encode(learned.params, segments).mean)
        return weights.raw_advantage(learned.weights, batch, {"value": value})

    total = data.starts.shape[0]
    blocks = [jnp.arange(first, min(first + 4096, total)) for first in range(0, total, 4096)]
    return found | {"latent": np.concatenate([np.asarray(latent(block)) for block in blocks])}


def rows_of(
    config: configs.Config, env: Any, dataset: Dataset, found: dict[str, np.ndarray], starts: np.ndarray
) -> list[dict[str, Any]]:
    """One row per estimator, with the uniform weights and the true distance beside them."""
    gains = quality.progress(env, dataset, starts, config.skills.horizon)
    degraded = None if dataset.quality is None else dataset.quality[starts] != quality.QUALITY["navigate"]
    scored = found | {"uniform": np.zeros(len(starts)), "true progress": gains}
    rows = []
    for name, scores in scored.items():
        spread = scores / (scores.std() + 1e-6)
        temperature, clip = np.mean(config.skills.advantage_temperature), np.mean(config.skills.weight_clip)
        weights = np.asarray(advantage_weights(jnp.asarray(spread), float(temperature), float(clip)))
        rows.append({"estimator": name, **quality.report(scores, weights, gains, degraded)})
    return rows


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="antmaze-medium")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--dataset", type=Path, help="default: the task's own set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--out", type=Path, help="CSV file, appended to")
    args = parser.parse_args()
    prepare_jax()
    started = time.perf_counter()
    config = configs.load_config(args.env, args.preset, {}, args.set)
    env = envs.make(args.env, physics="mujoco")
    d = config.data
    path = args.dataset or cache.default_dataset(
        env, transitions=d.transitions, degraded_share=d.degraded_share, noise=d.noise, seed=d.seed, num_envs=d.num_envs
    )
    dataset = formats.read(path, env)
    data, _ = to_device(dataset, config.skills.horizon)
    found = advantages(config, env, data, args.seed)
    rows = rows_of(config, env, dataset, found, np.asarray(data.starts))
    head = {
        "env": env.spec.full_name,
        "seed": args.seed,
        "transitions": dataset.size,
        "values_updates": config.values.updates,
    }
    for row in rows:
        print(
            "  ".join(
                f"{key} {value:.3f}" if isinstance(value, float) else f"{value:14s}" for key, value in row.items()
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


if __name__ == "__main__":
    main()
