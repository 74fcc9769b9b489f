"""Default sets: collected once per machine, kept in a folder, shared by all tasks of a maze."""

from __future__ import annotations

from pathlib import Path

import jax
import mujoco
import numpy as np

import qdos_brax
from envs.task import TaskEnv
from qdos_brax.collection import bodies, collect, recipes
from qdos_brax.collection.experts import policies
from qdos_brax.data import formats
from qdos_brax.data.cache import folder, locked
from qdos_brax.data.quality import QUALITY
from qdos_brax.runs.progress import Progress


def default_dataset(
    env: TaskEnv, transitions: int, degraded_share: float, noise: float, seed: int, num_envs: int = 64
) -> Path:
    """The path of the set with these parameters; collects it if it is not there.

    Two processes that ask at once collect it once: the second waits. What lies under the name is always whole.

    Args:
        env: the task; the set is that of its maze, for the rows are labelled when they are read.
        transitions: rows.
        degraded_share: share of degraded episodes.
        noise: standard deviation of the action noise of the others.
        seed: of the collection.
        num_envs: environments stepped at once.

    Raises:
        UserError: a parameter is out of range, no expert is shipped for the body, or the folder cannot be written.
    """
    body = bodies.conduct_of(env)
    policy = body.expert()
    recipe = recipes.degraded(degraded_share, body, noise)
    parameters = f"n{transitions}-bad{degraded_share:g}-noise{noise:g}-seed{seed}-envs{num_envs}"
    version = f"{env.backend}-v{collect.RECIPE}-{policies.digest(policy)}"
    path = folder() / f"{env.spec.name}-{parameters}-{version}.hdf5"
    if path.exists():
        return path
    with locked(path):
        if not path.exists():  # another process may have made it while this one waited
            print(f"no data for {env.spec.name} yet: collecting {transitions:,} steps into {path}", flush=True)
            make_file(path, env, transitions, recipe, seed, num_envs, policy)
    return path


def make_file(
    path: Path,
    env: TaskEnv,
    transitions: int,
    recipe: recipes.Recipe,
    seed: int,
    num_envs: int,
    policy: policies.Policy | None = None,
) -> None:
    """Collects a set (see ``collect.collect``) with a progress bar; writes it to ``path`` with where it came from."""
    policy = policy or bodies.conduct_of(env).expert()
    collect.check_size(transitions, seed, num_envs)  # before there is a bar
    with Progress("collect", transitions) as bar:

        def report(done: int, total: int) -> None:
            bar.advance_to(done, "steps")

        rows = collect.collect(env, transitions, recipe, seed, num_envs, report, policy)
    counts = np.bincount(rows["infos/quality"], minlength=len(QUALITY))
    attributes = {
        "env": env.spec.full_name,
        "seed": seed,
        "recipe": recipe.name,
        "mix": recipes.mix_text(recipe.mix),
        "noise": recipe.noise,
        "heavy_noise": recipe.heavy_noise,
        "num_envs": num_envs,
        "physics": env.backend,
        "expert": policies.digest(policy),
        "composition": " ".join(f"{name}={counts[code] / transitions:.3f}" for name, code in QUALITY.items()),
        "version": collect.RECIPE,
        "packages": f"qdos-brax {qdos_brax.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__}",
    }
    if "infos/fell" in rows:
        attributes["falls"] = _falls(rows)
    formats.write_hdf5(path, rows, attributes)


def _falls(rows: dict[str, np.ndarray]) -> str:
    """As "navigate=7/40 noisy=31/35": episodes of each behaviour that a fall ended, of how many."""
    kinds, fell = rows["infos/quality"][rows["timeouts"]], rows["infos/fell"][rows["timeouts"]]
    counts = {name: kinds == code for name, code in QUALITY.items()}
    return " ".join(f"{name}={(fell & chosen).sum()}/{chosen.sum()}" for name, chosen in counts.items() if chosen.any())
