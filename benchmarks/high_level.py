"""Train the high level anew on a run's skills: ``python benchmarks/high_level.py RUN --set KEY=VALUE --out FILE``.

A setting of the high level is compared with another one on the same skills and labels, without learning those again:
the phases after the skills run with the run's configuration and the ``--set`` of the command line. Prints each
evaluation; the CSV gets one row per member and evaluation. Settings of what stays, such as how skills were learned, are
refused: they would change nothing.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from qdos_brax import config as configs
from qdos_brax.analysis.conclusion import read_finished
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import skill_keys
from qdos_brax.errors import UserError, guarded
from qdos_brax.methods.build import bind_phases, build_context, build_phases
from qdos_brax.methods.given_skills import FREE
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase
from qdos_brax.runs.checkpoint import as_device_arrays
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.jax_setup import prepare_jax

COLUMNS = ("env", "method", "settings", "seed", "env_steps", "eval_success", "eval_score", "first_goal_step", "seconds")
KEPT = ("values", "skills", "guide")  # what these phases learned, as far as the method has them, is the run's own
# Groups of settings that only they, or the data, read; those of skills depend on the method.
BEFORE = ("data", "exchange", "values", "guide")


def after_skills(phases: list[MemberPhase]) -> list[MemberPhase]:
    """Return the phases that make the high level: labels, what it begins as, online."""
    return [phase for phase in phases if phase.name not in KEPT]


def check_settings(method: str, settings: list[str]) -> None:
    """Refuse settings of what stays as the run has it.

    Raises:
        UserError: a setting would change nothing.
    """
    learned = set(skill_keys(METHODS[method].low_level)) - FREE
    for key in (text.partition("=")[0] for text in settings):
        if key in learned or key.partition(".")[0] in BEFORE:
            raise UserError(f"{key} would change nothing: data and skills stay those of the run; give it to train.py")


def check_members(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> None:
    """Refuse settings that make other members of a run, which would be trained on one another's skills.

    Raises:
        UserError: they differ in number or in their seeds.
    """
    if [member["seed"] for member in before] != [member["seed"] for member in after]:
        raise UserError("members stay those of the run, each on its own skills: give one value per key, and no seed")


def train(run: Path, members: list[int], settings: list[str]) -> list[dict[str, Any]]:
    """Return a row per member and evaluation."""
    trained, dataset = read_finished(RunFolder.open(str(run)))
    check_settings(trained.config.method, settings)
    config = configs.replace(trained.config, **dict(text.split("=", 1) for text in settings))
    everyone = configs.members(config)
    check_members(configs.members(trained.config), everyone)
    members = members or list(range(len(everyone)))
    chosen = [everyone[member] for member in members]
    context = build_context(config, trained.env, dataset)
    phases = after_skills(build_phases(context))
    bind_phases(phases, Population(configs.population_hyper(config, chosen), 1, jax.local_devices()), context.data)
    kept = {name: value for name, value in trained.artifacts.items() if name not in ("actor", "normaliser")}
    # From host memory: arrays that say on which device they lie would make a chunk's second call compile it anew.
    artifacts = as_device_arrays(jax.tree.map(lambda x: np.asarray(x)[members], kept))
    seeds = np.asarray([member["seed"] for member in chosen], np.uint32)
    rows, began = [], time.perf_counter()
    for index, phase in enumerate(phases):
        keys = jax.vmap(lambda seed, index=index: jax.random.fold_in(jax.random.key(seed), 100 + index))(seeds)
        state, constants = phase.init(keys, artifacts)
        for _ in range(phase.num_chunks):
            state, info = phase.chunk(state, constants)
            if "eval/success" in info:
                new = _rows(config, chosen, settings, info, time.perf_counter() - began)
                print(f"{new[0]['env_steps']} steps: {', '.join(_shown(row) for row in new)}", flush=True)
                rows += new
        artifacts = phase.finish(state, artifacts)
    return rows


def _rows(config: Any, members: list[Any], settings: list[str], info: Any, seconds: float) -> list[dict[str, Any]]:
    return [
        {
            "env": config.env,
            "method": config.method,
            "settings": " ".join(settings),
            "seed": member["seed"],
            "env_steps": int(info["env_steps"][k]),
            "eval_success": f"{float(info['eval/success'][k]):.3g}",
            "eval_score": f"{float(info['eval/score'][k]):.3g}" if "eval/score" in info else "",
            "first_goal_step": f"{float(info['first_goal_step'][k]):.0f}".replace("nan", ""),
            "seconds": f"{seconds:.0f}",
        }
        for k, member in enumerate(members)
    ]


def _shown(row: dict[str, Any]) -> str:
    """Return the success, and the score of a task that has parts."""
    return row["eval_success"] + (f" (score {row['eval_score']})" if row["eval_score"] else "")


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", metavar="RUN", type=Path, help="the folder of a finished run")
    parser.add_argument(
        "--members", type=int, nargs="+", default=[], help="numbers of the run's members (default: all)"
    )
    parser.add_argument("--set", metavar="KEY=VALUE", nargs="+", default=[], dest="settings", help="changed settings")
    parser.add_argument("--out", type=Path, help="CSV file to add the rows to")
    args = parser.parse_args()
    prepare_jax()
    rows = train(args.run, args.members, args.settings)
    if args.out:
        fresh = not args.out.exists()
        with args.out.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if fresh:
                writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    raise SystemExit(guarded(main))
