"""The command line of ``train.py``: its flags, and the configurations that they ask for."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial

from qdos_brax import __version__
from qdos_brax.commands.arguments import Parser, guarded, natural, parse, positive
from qdos_brax.commands.streams import lasting_streams
from qdos_brax.config import Config, load_programs, presets
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import get_field, labelled, pretrain_keys
from qdos_brax.errors import UserError


def train_main(argv: Sequence[str] | None = None, prog: str = "python train.py") -> int:
    """Run ``python train.py``, or the same under another name; return the exit code."""
    started = time.perf_counter()
    with lasting_streams():
        args = parse(train_parser(prog), sys.argv[1:] if argv is None else argv)
        return guarded(lambda: _train(args, started))


def train_parser(prog: str = "python train.py") -> Parser:
    """Return the parser of ``train.py``."""
    parser = Parser(
        prog=prog,
        description="Collect or read data, pretrain skills, label the data, learn online, evaluate and report.",
        epilog="Any key of config.yaml can be set with --set; python -m qdos_brax config lists and explains the keys.",
    )
    parser.add_argument("--env", metavar="TASK", help="the task, as listed by: python -m qdos_brax tasks")
    for label, key in labelled().items():
        meaning = get_field(key).metadata["meaning"]
        parser.add_argument(f"--{label}", metavar="X[,X..]", help=f"{meaning}; several values make a scan")
    parser.add_argument("--seed", metavar="S[,S..]", help="seed; several make a scan (default 0)")
    methods = "; ".join(f"{name}: {method.summary}" for name, method in METHODS.items())
    parser.add_argument(
        "--method",
        metavar="NAME[,NAME..]",
        help=f"the method (default qdos); several are compared, one run after another. {methods}",
    )
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help=f"sizes of networks and budgets: {', '.join(presets())} (default cpu without an accelerator, else paper)",
    )
    parser.add_argument("--out", metavar="DIR", help="the folder of the run or comparison (default: under runs/)")
    parser.add_argument(
        "--resume",
        metavar="DIR",
        help="continue the run or comparison in DIR exactly where it stopped; takes no other flag but --dataset, which "
        "names the same data in a new place",
    )
    parser.add_argument(
        "--dataset",
        metavar="FILE",
        help="OGBench .npz, D4RL .hdf5, Minari folder, or the name of a public data set such as "
        "antmaze-large-navigate-v0, which is downloaded (default: the task's own set, collected once)",
    )
    parser.add_argument(
        "--physics",
        metavar="ENGINE",
        help="auto, mjx, mjx-warp or mujoco (default auto: MuJoCo C where the task has it)",
    )
    parser.add_argument("--steps", metavar="N", help="environment steps of the online phase")
    parser.add_argument(
        "--pretrain-steps", metavar="N", help="gradient steps of each part that is learned from the data alone"
    )
    parser.add_argument(
        "--wandb", action="store_true", default=None, help="also log to Weights & Biases (extra: wandb)"
    )
    parser.add_argument("--zip", action="store_true", help="pair the lists of a scan instead of taking their product")
    parser.add_argument(
        "--sample",
        metavar="N",
        help="draw N settings at random, from lists and from values such as skills.alpha=loguniform(0.1,3) or "
        "uniform(a,b), each with every seed",
    )
    parser.add_argument(
        "--members-per-program",
        metavar="N",
        help="members of a scan that a device trains at once; the others take turns (default: chosen automatically "
        "and printed)",
    )
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="any key of the configuration, such as skills.kl_weight=0.2, or 0.1,0.2 to scan it; sizes take lists too, "
        "one program each (skills.horizon=4,20); may be repeated",
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="share the members with other processes that run the same command on a common --out or --resume; they are "
        "found by the variables of Slurm, Open MPI or Kubernetes, or by the three flags below",
    )
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="address of the first process")
    parser.add_argument("--processes", metavar="N", type=positive, help="number of processes")
    parser.add_argument("--process-id", metavar="I", type=natural, help="number of this process, from 0")
    parser.add_argument("--version", action="version", version=f"qdos-brax {__version__}")
    return parser


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
    methods = [Config.method] if args.method is None else [name.strip() for name in args.method.split(",")]
    for name in methods:
        if methods.count(name) > 1:
            raise UserError(f"--method holds {name!r} twice: {args.method}")
    found: dict[str, Config] = {}
    for method in methods:
        for sizes, config in load_programs(args.env, args.preset, {**flags, "method": method}, args.set).items():
            found["_".join(part for part in (method if len(methods) > 1 else "", sizes) if part) or method] = config
    return found


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
