"""The command line of ``train.py``: its flags, and the configurations that they ask for."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from qdos_brax import __version__
from qdos_brax.commands.arguments import Parser, natural, parse, positive
from qdos_brax.commands.streams import lasting_streams
from qdos_brax.config import Config, load_programs, presets
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import get_field, labelled, pretrain_keys
from qdos_brax.errors import UserError, guarded


def train_main(argv: Sequence[str] | None = None, prog: str = "python train.py") -> int:
    """Run ``python train.py``, or the same under another name; return the exit code."""
    started = time.perf_counter()
    with lasting_streams():
        args = parse(train_parser(prog), sys.argv[1:] if argv is None else argv)
        return guarded(lambda: _train(args, started))


_EXAMPLES = """examples:
  {prog} --env antsoccer --alpha 0.3
  {prog} --env antmaze-large --alpha 0.1,0.3 --seed 0,1,2     # a scan
  {prog} --env antmaze-medium --method qdos,supe --seed 0,1   # a comparison
  {prog} --env antsoccer --preset smoke                       # does it run here?
  {prog} --resume runs/mine"""
_EPILOG = """--set takes any key of config.yaml; python -m qdos_brax config lists and explains them.
Methods: docs/methods.md."""


def train_parser(prog: str = "python train.py") -> Parser:
    """Return the parser of ``train.py``."""
    parser = Parser(
        prog=prog,
        usage=f"{prog} --env TASK [options]",
        description=_EXAMPLES.format(prog=prog),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser)
    parser.add_argument("--version", action="version", version=f"qdos-brax {__version__}")
    return parser


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the flags of ``train.py``, in groups."""
    _add_run(parser.add_argument_group("what is trained"))
    _add_sizes(parser.add_argument_group("how much, and with what settings"))
    _add_scan(parser.add_argument_group("scans: several values of --seed, --method or --set"))
    _add_folder(parser.add_argument_group("the run's folder"))
    _add_processes(parser.add_argument_group("several processes"))


def _add_run(group: Any) -> None:
    group.add_argument("--env", metavar="TASK", help="a task: python -m qdos_brax tasks")
    group.add_argument("--method", metavar="NAME[,..]", help=f"{', '.join(METHODS)} (default qdos)")
    group.add_argument("--seed", metavar="S[,..]", help="default 0")
    for label, key in labelled().items():
        meaning = get_field(key).metadata["meaning"]
        group.add_argument(f"--{label}", metavar="X[,..]", help=meaning)
    group.add_argument(
        "--dataset",
        metavar="FILE",
        help="OGBench .npz, D4RL .hdf5, Minari folder, or a public set's name (default: the task's own set, collected)",
    )
    group.add_argument("--skills", metavar="FILE", help="begin on the skills that `export` wrote (or hub:USER/NAME)")
    group.add_argument("--physics", metavar="ENGINE", help="auto, mjx, mjx-warp or mujoco (default auto)")


def _add_sizes(group: Any) -> None:
    names = ", ".join(presets())
    group.add_argument("--preset", metavar="NAME", help=f"{names} (default: cpu without an accelerator, else paper)")
    group.add_argument("--steps", metavar="N", help="environment steps of the online phase")
    group.add_argument("--pretrain-steps", metavar="N", help="gradient steps of each part learned from data")
    group.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="any key of the configuration; may be repeated"
    )


def _add_scan(group: Any) -> None:
    group.add_argument("--zip", action="store_true", help="pair the lists instead of taking their product")
    group.add_argument(
        "--sample",
        metavar="N",
        help="draw N settings from the lists and from values such as skills.alpha=loguniform(0.1,3), with every seed",
    )
    group.add_argument(
        "--members-per-program",
        metavar="N",
        help="members that a device trains at once, the others take turns (default: chosen and printed)",
    )


def _add_folder(group: Any) -> None:
    group.add_argument("--out", metavar="DIR", help="of the run or comparison (default: a new one under runs/)")
    group.add_argument(
        "--resume",
        metavar="DIR",
        help="continue exactly where it stopped; no other flag but --dataset, if the data has moved",
    )
    group.add_argument("--wandb", action="store_true", default=None, help="also log to Weights & Biases (extra: wandb)")


def _add_processes(group: Any) -> None:
    group.add_argument(
        "--distributed",
        action="store_true",
        help="share the members with processes that run the same command; found by Slurm, Open MPI, Kubernetes, or by:",
    )
    group.add_argument("--coordinator", metavar="HOST:PORT", help="address of the first process")
    group.add_argument("--processes", metavar="N", type=positive, help="how many there are")
    group.add_argument("--process-id", metavar="I", type=natural, help="number of this one, from 0")


def configs_from_args(args: argparse.Namespace) -> dict[str, Config]:
    """Return the configurations that the flags of ``train.py`` ask for, by name: one per method and choice of sizes.

    Raises:
        UserError: a value is wrong.
    """
    by_key = {
        **{key: getattr(args, label) for label, key in labelled().items()},
        "seed": args.seed,
        "out": args.out,
        "dataset": args.dataset,
        "physics": args.physics,
        "scan.combine": "zip" if args.zip else None,
        "scan.samples": args.sample,
        "members_per_program": args.members_per_program,
        "high_level.env_steps": args.steps,
        **dict.fromkeys(pretrain_keys(), args.pretrain_steps),
        "run.wandb": args.wandb,
    }
    flags = {key: value for key, value in by_key.items() if value is not None}
    if args.skills is not None:
        flags = _of_skills(args.skills) | flags
    methods = [Config.method] if args.method is None else [name.strip() for name in args.method.split(",")]
    for name in methods:
        if methods.count(name) > 1:
            raise UserError(f"--method holds {name!r} twice: {args.method}")
    found: dict[str, Config] = {}
    for method in methods:
        for sizes, config in load_programs(args.env, args.preset, {**flags, "method": method}, args.set).items():
            found["_".join(part for part in (method if len(methods) > 1 else "", sizes) if part) or method] = config
    return found


def _of_skills(file: str) -> dict[str, Any]:
    """Return what a file of skills says of them, by dotted key: what is trained on them must not differ."""
    from qdos_brax.runs.export import skill_settings  # here, so that --help and a wrong flag wait for no jax
    from qdos_brax.runs.hub import local_path

    path = local_path(file).absolute()
    return {"skills_file": str(path), **skill_settings(path)}


def _train(args: argparse.Namespace, started: float) -> int:
    connection = ("distributed", "coordinator", "processes", "process_id")
    given = [name for name, value in vars(args).items() if name not in ("resume", "dataset", *connection) and value]
    if args.resume is not None and given:
        raise UserError(f"--resume uses the run's own config.yaml; leave out --{given[0].replace('_', '-')}")
    if args.resume is not None and args.dataset is not None and args.distributed:
        raise UserError("--resume with --dataset notes where the data is now; do that once without --distributed")
    if args.resume is None and args.env is None:
        raise UserError("give a task with --env (python -m qdos_brax tasks lists them), or a run to --resume")

    if not args.distributed:
        for name in connection:
            if getattr(args, name) is not None and name != "distributed":
                raise UserError(f"--{name.replace('_', '-')} is for a run of several processes; give --distributed too")
    elif args.resume is None and args.out is None:
        raise UserError("--distributed needs a folder that all processes share; give --out or --resume")

    from qdos_brax import experiment  # here, so that --help and a wrong flag answer without importing jax
    from qdos_brax.runs.hosts import ALONE, join

    hosts = ALONE
    if args.distributed:
        if args.resume is None:
            experiment.check_new(args.out)
        hosts = join(args.coordinator, args.processes, args.process_id)
    if args.resume is None:
        asked = partial(configs_from_args, args)
        experiment.start(asked, preset_given=args.preset is not None, started=started, hosts=hosts)
    else:
        experiment.resume(args.resume, started=started, hosts=hosts, dataset=args.dataset)
    return 0
