"""Measure whether skills have learned their data by heart: ``python benchmarks/held_out.py RUN --dataset FILE``.

FILE holds data of the same task that the run has not seen, such as ``data make TASK --seed 77`` writes. Segments are
encoded, and decoded along their own observations, by the first member of a finished run. Prints the mean squared error
of the actions, on the run's data and on FILE, over all segments and over those that begin in good behaviour where the
data tell. An error on FILE that is much the larger asks for more data, not for more updates. The noise in the logged
actions, squared, is its floor.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.analysis.conclusion import read_finished
from qdos_brax.analysis.film import of_member
from qdos_brax.data import formats
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import Normaliser, to_device
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import guarded
from qdos_brax.methods.learners_view import learners_dataset
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.jax_setup import prepare_jax
from qdos_brax.skills.low_level import LowLevelPolicy
from qdos_brax.skills.vae import Segments, segments_at


def squared_error(low_level: LowLevelPolicy, params: Any, segments: Segments, after: jax.Array) -> jax.Array:
    """Return [B], the mean squared error of each segment's actions under the mean of its posterior.

    Args:
        low_level: the skills.
        params: theirs.
        segments: windows, observations normalised.
        after: [B, obs], what the posterior is told of what came after, normalised.
    """
    observations, actions = segments.observations, segments.actions
    latent = low_level.posterior(params, segments, after).mean
    skill = low_level.begin(params, latent, observations[:, 0])
    steps = range(observations.shape[1])
    played = jnp.stack([low_level.act(params, observations[:, step], skill, step) for step in steps], axis=1)
    return jnp.mean((played - actions) ** 2, axis=(1, 2))


def errors(
    dataset: Dataset, normaliser: Normaliser, low_level: LowLevelPolicy, params: Any, horizon: int, count: int
) -> dict[str, float]:
    """Return the error over ``count`` segments of all, and of "good" ones where the data tell."""
    data, _ = to_device(dataset, horizon, normaliser)
    starts = np.asarray(data.starts)
    pools = {"all": starts}
    if dataset.quality is not None:
        pools["good"] = starts[dataset.quality[starts] == QUALITY["navigate"]]
    measure = jax.jit(lambda segments: squared_error(low_level, params, segments, segments.later).mean())
    rng, found = np.random.default_rng(0), {}
    for name, pool in pools.items():
        chosen = jnp.asarray(rng.choice(pool, min(count, len(pool)), replace=False))
        segments = segments_at(data, chosen, horizon, low_level.reach or horizon)
        found[name] = float(measure(segments))
    return found


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", metavar="RUN", type=Path, help="the folder of a finished run")
    parser.add_argument("--dataset", metavar="FILE", type=Path, required=True, help="data that the run has not seen")
    parser.add_argument("--segments", type=int, default=3_000, help="segments of each kind (default: 3000)")
    args = parser.parse_args()
    prepare_jax()
    trained, seen = read_finished(RunFolder.open(str(args.run)))
    artifacts, hyper = of_member(trained, 0)
    agent: Any = trained.agent(artifacts, hyper)
    horizon = trained.config.skills.horizon
    for name, rows in (("its own data", seen), ("held out", formats.read(args.dataset, trained.env.unwrapped))):
        dataset = learners_dataset(trained.env, rows)
        found = errors(dataset, agent.normaliser, agent.low_level, agent.skills, horizon, args.segments)
        print(f"{args.run}, {name}: " + ", ".join(f"{kind} {error:.4f}" for kind, error in found.items()), flush=True)


if __name__ == "__main__":
    raise SystemExit(guarded(main))
