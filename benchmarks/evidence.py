"""Measure QDOS's two mechanisms without RL: ``python benchmarks/evidence.py --env TASK --seed 0,1,2 --out DIR``.

Trains values and skills alone, for every seed with weights on and off and the mutual-information term off, as in the
paper (``segment``), and on outcomes (``outcome``, random skills drawn where the agent plays), in every ``--view`` of
the trajectory VAE, and for skills that are outcomes themselves (the view ``outcome``, without the paper's term). Then
measures each as ``benchmarks/skills.py`` does. All arms of a view and an encoder are the members of one program, so
that a seed's data, values and first parameters are shared by its arms.

The same command goes on where it was stopped. DIR/evidence.csv has a row per arm and seed, DIR/evidence.txt the means
over seeds with bootstrapped intervals (95 %).
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import skills
from table import aligned, write_rows

import envs
from qdos_brax import config as configs
from qdos_brax.analysis.finished import trained_run
from qdos_brax.collection.default_set import default_dataset
from qdos_brax.config import Config
from qdos_brax.data import formats
from qdos_brax.data.dataset import Dataset
from qdos_brax.errors import UserError, guarded
from qdos_brax.files import write_text
from qdos_brax.methods.build import bind_phases, build_context, build_phases, plan_members
from qdos_brax.population.members import Population
from qdos_brax.report.statistics import mean_curve
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.jax_setup import prepare_jax
from qdos_brax.runs.loop import run_phases

OUTCOMES = "outcome"
NO_WEIGHTS = 1e6  # lambda: exp(A / lambda) is 1 for every advantage
ARM = ("view", "weights", "information")
BEFORE_ONLINE = ("values", "skills")


class Program(NamedTuple):
    """Hold a program of the table: its name, and the settings in which it differs from the task's."""

    name: str
    settings: dict[str, Any]


def programs(views: Sequence[str], temperature: float, alpha: float, outcome_alpha: float) -> list[Program]:
    """Return the programs of all arms; the arms without the term are the segment programs' members of alpha 0, and of
    the view "outcome", skills that are outcomes, its own.
    """
    temperatures = {"skills.advantage_temperature": [temperature, NO_WEIGHTS]}
    outcome = {"skills.mi_encoder": "outcome", "skills.mi_latent": "played"}
    found = []
    for view in views:
        if view == OUTCOMES:
            skills = {"skills.model": "outcome", "skills.view": "body", "skills.alpha": [0.0, outcome_alpha]}
            found.append(Program(view, temperatures | outcome | skills))
            continue
        latents = {"skills.model": "vae", "skills.latent_dim": Config().skills.latent_dim}
        shared = temperatures | latents | {"skills.view": view}
        paper = {"skills.mi_encoder": "segment", "skills.mi_latent": "box", "skills.alpha": [0.0, alpha]}
        found += [
            Program(f"{view}-segment", shared | paper),
            Program(f"{view}-outcome", shared | outcome | {"skills.alpha": outcome_alpha}),
        ]
    return found


def arm_of(config: Config, member: dict[str, Any]) -> dict[str, Any]:
    """Return the arm that a member belongs to, and its seed."""
    off = member.get("skills.advantage_temperature", config.skills.advantage_temperature) == NO_WEIGHTS
    return {
        "view": OUTCOMES if config.skills.model == "outcome" else config.skills.view,
        "weights": "off" if off else "on",
        "information": config.skills.mi_encoder if member["alpha"] else "off",
        "seed": member["seed"],
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the means over seeds of every arm and measure as lines of text, "mean [low, high]" in each cell."""
    measures = [name for name in rows[0] if name not in (*ARM, "seed", "seconds")]
    arms: dict[tuple[Any, ...], list[list[float]]] = {}
    for row in rows:
        arms.setdefault(tuple(row[name] for name in ARM), []).append([float(row[name]) for name in measures])
    lines = [[*ARM, "seeds", *measures]]
    for arm, values in arms.items():
        cells = [f"{mean:.3f} [{low:.3f}, {high:.3f}]" for mean, low, high in zip(*mean_curve(np.array(values)))]  # noqa: B905
        lines.append([*map(str, arm), str(len(values)), *cells])
    return aligned(lines)


def train(config: Config, folder: RunFolder, env: Any, dataset: Dataset) -> Any:
    """Return the artifacts of values and skills of all members; goes on where the folder has got to."""
    context = build_context(config, env, dataset)
    phases = [phase for phase in build_phases(context) if phase.name in BEFORE_ONLINE]
    members = configs.members(config)
    plan = plan_members(context, phases, members)
    population = Population(configs.population_hyper(config), plan.per_program, plan.devices, plan.parked)
    bind_phases(phases, population, context.data)
    _, artifacts = run_phases(phases, folder, members, config=configs.config_hash(config), header={"env": config.env})
    # What plays skills asks for an actor and the normaliser, which the online phase would have left.
    return (
        artifacts
        | {"actor": {"unused": jnp.zeros(len(members))}}
        | {"normaliser": context.normaliser.repeated(len(members))}
    )


def measure(config: Config, env: Any, dataset: Dataset, artifacts: Any, args: Any) -> list[dict[str, Any]]:
    """Return a row per member."""
    about = [arm_of(config, member) for member in configs.members(config)]
    trained = trained_run(config, env, artifacts)
    return skills.measure_members(trained, dataset, about, args.draws, args.states, args.episodes)


def run_program(program: Program, asked: Config, env: Any, dataset: Dataset, args: Any) -> list[dict[str, Any]]:
    """Return the rows of a program, from its folder if it has been measured.

    Raises:
        UserError: its folder holds another configuration.
    """
    folder = RunFolder(args.out / program.name)
    done, of = folder.path / "evidence.csv", folder.path / "evidence.yaml"
    config = configs.replace(asked, **program.settings)
    trained = configs.to_yaml(config)
    text = f"{trained}# {args.draws} draws, {args.states} states, {args.episodes} episodes\n"
    if done.exists() and of.exists() and of.read_text(encoding="utf-8") == text:
        return list(csv.DictReader(done.open(encoding="utf-8")))
    if folder.config.exists() and folder.config.read_text(encoding="utf-8") != trained:
        raise UserError(f"{folder.path} holds runs of another configuration; give another --out, or remove it")
    print(f"--- {program.name}", flush=True)
    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    with folder.held():
        write_text(folder.config, trained)
        rows = measure(config, env, dataset, train(config, folder, env, dataset), args)
        of.unlink(missing_ok=True)  # rows without it are measured again
        write_rows(done, rows)
        write_text(of, text)
    return rows


def main() -> None:
    """Make the table from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="antmaze-large", help="a task (default antmaze-large)")
    parser.add_argument("--seed", default="0,1,2,3,4,5", help="seeds, separated by commas (default 0 to 5)")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="the folder of the table and its runs")
    parser.add_argument("--preset", default="cpu", help="sizes (default cpu)")
    parser.add_argument(
        "--view", default="start", help="values of skills.view, and outcome, separated by commas (default start)"
    )
    parser.add_argument("--temperature", type=float, help="lambda where weights are on (default: the task's)")
    parser.add_argument("--alpha", type=float, default=0.3, help="weight of the paper's term (default 0.3)")
    parser.add_argument("--outcome-alpha", type=float, default=3.0, help="weight of the term on outcomes (default 3)")
    parser.add_argument("--set", metavar="KEY=VALUE", nargs="+", default=[], dest="settings", help="further settings")
    parser.add_argument("--draws", type=int, default=16, help="skills drawn in each state (default 16)")
    parser.add_argument("--states", type=int, default=500, help="logged states (default 500)")
    parser.add_argument("--episodes", type=int, default=16, help="episodes of the oracle; 0 leaves it out (default 16)")
    args = parser.parse_args()
    prepare_jax()
    env = envs.make(args.env, physics="mujoco")
    flags = {"physics": "mujoco", "seed": args.seed}
    config = configs.load_config(args.env, args.preset, flags, args.settings)
    dataset = formats.read(default_dataset(env, **dataclasses.asdict(config.data)), env)
    temperature = args.temperature or config.skills.advantage_temperature
    rows: list[dict[str, Any]] = []
    for program in programs(args.view.split(","), temperature, args.alpha, args.outcome_alpha):
        rows += run_program(program, config, env, dataset, args)
    args.out.mkdir(parents=True, exist_ok=True)
    write_rows(args.out / "evidence.csv", rows)
    text = table(rows)
    write_text(args.out / "evidence.txt", text)
    print(text, end="")


if __name__ == "__main__":
    raise SystemExit(guarded(main))
