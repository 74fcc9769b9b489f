"""Default data sets: collected once per machine, kept in a folder, shared by all tasks of a variant, such as a maze."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

import qdos_brax
from envs.task import Task
from qdos_brax.collection import recipes
from qdos_brax.collection.collect import EpisodeCollector, check_size, collect
from qdos_brax.collection.makers import maker_of
from qdos_brax.data import formats
from qdos_brax.data.cache import folder, locked
from qdos_brax.data.quality import QUALITY
from qdos_brax.files import try_to_write
from qdos_brax.runs.progress import Progress


def default_dataset(
    env: Task, transitions: int, degraded_share: float, noise: float, seed: int, num_envs: int = 64
) -> Path:
    """Return the path of the set with these parameters; collect it if it does not exist.

    If two processes ask at once, one collects and the other waits. A file under this name is always complete.

    Args:
        env: the task; the set serves its whole variant, such as a maze, since rows are labelled when they are read.
        transitions: number of rows.
        degraded_share: share of degraded episodes.
        noise: standard deviation of the action noise of the others.
        seed: seed of the collection.
        num_envs: environments stepped at once.

    Raises:
        UserError: a parameter is out of range, nobody collects the task's data, or the folder cannot be written.
    """
    maker = maker_of(env)
    collector = maker.collector(recipes.degraded(degraded_share, maker, noise))
    parameters = f"n{transitions}-bad{degraded_share:g}-noise{noise:g}-seed{seed}-envs{num_envs}"
    version = f"{env.backend}-v{collector.version}-{collector.expert_id}"
    path = folder() / f"{env.spec.name}-{parameters}-{version}.hdf5"
    if path.exists():
        return path
    with locked(path):
        if not path.exists():  # another process may have made it while this one waited
            print(f"no data for {env.spec.name} yet: collecting {transitions:,} steps into {path}", flush=True)
            make_file(path, collector, transitions, seed, num_envs)
    return path


def make_file(path: Path, collector: EpisodeCollector, transitions: int, seed: int, num_envs: int) -> None:
    """Collect a set with a progress bar and write it to ``path``, with its origin as attributes.

    Args:
        path: the ``.hdf5`` file.
        collector, transitions, seed, num_envs: see ``collect.collect``.

    Raises:
        UserError: an argument is out of range, or the file cannot be written.
    """
    check_size(transitions, seed, num_envs)  # before the bar appears
    try_to_write(path)  # before the work
    with Progress("collect", transitions) as bar:

        def report(done: int, total: int) -> None:
            bar.advance_to(done, "steps")

        rows = collect(collector, transitions, seed, num_envs, report)
    formats.write_hdf5(path, rows, _attributes(collector, rows) | {"seed": seed, "num_envs": num_envs})


def _attributes(collector: EpisodeCollector, rows: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the file's attributes: how the rows were collected, and what they contain."""
    env, recipe = collector.env, collector.recipe
    counts = np.bincount(rows["infos/quality"], minlength=len(QUALITY)) / len(rows["infos/quality"])
    return {
        "env": env.spec.full_name,
        "recipe": recipe.name,
        "mix": recipes.mix_text(recipe.mix),
        "noise": recipe.noise,
        "heavy_noise": recipe.heavy_noise,
        "physics": env.backend,
        "expert": collector.expert_id,
        "composition": " ".join(f"{name}={counts[code]:.3f}" for name, code in QUALITY.items()),
        "version": collector.version,
        "packages": f"qdos-brax {qdos_brax.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__}",
    }
