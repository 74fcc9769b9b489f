"""The command lines of ``train.py`` and ``python -m qdos_brax``: parsing, and one clear line for what is wrong."""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from qdos_brax import __version__
from qdos_brax.commands.config import add_parser as add_config
from qdos_brax.config import Config, load_programs, nearest, presets
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import get_field, labelled, pretrain_keys
from qdos_brax.errors import UserError


class Parser(argparse.ArgumentParser):
    """argparse with errors of one line, and no flag understood by its first letters."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Prints the line and exits with code 2."""
        self.exit(2, f"error: {message} (see {self.prog} --help)\n")


def train_main(argv: Sequence[str] | None = None) -> int:
    """``python train.py``: the exit code."""
    started = time.perf_counter()
    args = _parse(train_parser(), sys.argv[1:] if argv is None else argv)
    return _guarded(lambda: _train(args, started))


def main(argv: Sequence[str] | None = None) -> int:
    """``python -m qdos_brax``: the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    args = _parse(main_parser(argv), argv)
    return _guarded(lambda: args.run(args))


def train_parser() -> Parser:
    """Return the parser of ``train.py``'s flags."""
    parser = Parser(
        prog="python train.py",
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
        help="continue the run or comparison in DIR exactly where it stopped; takes no other flag",
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
    parser.add_argument("--process-id", metavar="I", type=_index, help="number of this process, from 0")
    parser.add_argument("--version", action="version", version=f"qdos-brax {__version__}")
    return parser


def _parse(parser: Parser, argv: Sequence[str]) -> argparse.Namespace:
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        word = unknown[0].partition("=")[0]
        parser.error(f"unknown argument {unknown[0]}{nearest(word, _flags(parser))}")
    return args


def _flags(parser: argparse.ArgumentParser) -> list[str]:
    """The long flags of a parser and of its commands."""
    flags = [name for action in parser._actions for name in action.option_strings if name.startswith("--")]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            flags += [name for command in action.choices.values() for name in _flags(command)]
    return flags


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
    meeting = ("distributed", "coordinator", "processes", "process_id")
    given = [name for name, value in vars(args).items() if name not in ("resume", *meeting) and value]
    if args.resume is not None and given:
        raise UserError(f"--resume goes on with the run's own config.yaml; leave out --{given[0].replace('_', '-')}")
    if args.resume is None and args.env is None:
        raise UserError("give a task with --env (python -m qdos_brax tasks lists them), or a run to --resume")

    if not args.distributed:
        for name in meeting:
            if getattr(args, name) is not None and name != "distributed":
                raise UserError(f"--{name.replace('_', '-')} is for a run of several processes; give --distributed too")
    elif args.resume is None and args.out is None:
        raise UserError("--distributed needs a folder that all processes know; give --out or --resume")

    from qdos_brax import experiment  # here, so that --help and a wrong flag answer at once
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
        experiment.resume(args.resume, started=started, hosts=hosts)
    return 0


def main_parser(argv: Sequence[str]) -> Parser:
    """Return the parser of ``python -m qdos_brax``; the commands of ``data`` are there if ``argv`` asks for them."""
    parser = Parser(prog="python -m qdos_brax", description="Data, evaluation, reports, and a look at this machine.")
    parser.add_argument("--version", action="version", version=f"qdos-brax {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    if argv[:1] == ["data"]:
        from qdos_brax.commands.data import add_parser  # imports jax and h5py, which the others need not wait for

        add_parser(commands)
    else:
        commands.add_parser("data", help="make, look at and check data files")

    evaluate = commands.add_parser("evaluate", help="evaluate the policy of a run")
    evaluate.add_argument("runs", metavar="RUN", nargs="+", help="a run folder")
    evaluate.add_argument("--episodes", metavar="N", type=positive, default=20, help="episodes per member (default 20)")
    evaluate.add_argument(
        "--video", metavar="FILE", help="also film the first member's first episode, as .mp4; takes one RUN"
    )
    evaluate.set_defaults(run=_evaluate)

    report = commands.add_parser("report", help="tables, learning curves and a page of runs")
    report.add_argument("runs", metavar="RUN", nargs="+", help="a run's or comparison's folder; all must have ended")
    report.add_argument(
        "--out", metavar="DIR", help="where the files go (default: the folder of a single RUN, else report/)"
    )
    report.add_argument(
        "--reference", metavar="METHOD", help="what the others are compared with (default supe, else the first)"
    )
    report.set_defaults(run=_report)

    picture = commands.add_parser("picture", help="draw a task at its start")
    picture.add_argument("task", metavar="TASK", help="a task, as listed by: python -m qdos_brax tasks")
    picture.add_argument("--out", metavar="FILE", required=True, help="the picture, as .png")
    picture.set_defaults(run=_picture)

    tasks = commands.add_parser("tasks", help="list the tasks and their aliases")
    tasks.set_defaults(run=_tasks)

    add_config(commands)

    doctor = commands.add_parser("doctor", help="check versions, devices, caches and callbacks of this machine")
    doctor.set_defaults(run=_doctor)
    return parser


def _evaluate(args: argparse.Namespace) -> int:
    if args.video and len(args.runs) > 1:
        raise UserError(f"--video films one run, and {len(args.runs)} were given; name one RUN")

    from qdos_brax.analysis.finished import evaluate_run
    from qdos_brax.runs.jax_setup import prepare_jax

    prepare_jax()
    if args.video:
        from qdos_brax.analysis.film import film_run

        episode = film_run(Path(args.runs[0]), Path(args.video))
        print(f"{args.video}: " + ", ".join(f"{name} {value:g}" for name, value in episode.items()), flush=True)
    for run in args.runs:
        for member in evaluate_run(Path(run), args.episodes):
            print(f"{run}: " + ", ".join(f"{name} {value:g}" for name, value in member.items()))
    return 0


def _report(args: argparse.Namespace) -> int:
    from qdos_brax.report.write import write_report

    runs = [Path(run) for run in args.runs]
    out = Path(args.out) if args.out else runs[0] if len(runs) == 1 else Path("report")
    report = write_report(runs, out, args.reference)
    print(f"{report.text}\n")
    for file in report.files:
        print(file)
    return 0


def _picture(args: argparse.Namespace) -> int:
    from qdos_brax.report.picture import draw_task

    draw_task(args.task, Path(args.out))
    print(args.out)
    return 0


def _tasks(args: argparse.Namespace) -> int:
    import envs

    aliases = {target: alias for alias, target in envs.ALIASES.items()}
    counts = Counter(spec.name for spec in envs.list_tasks())
    rows = [["task", "observation", "action", "cap", "engines", "variants", "default", "alias"]]
    for name, count in counts.items():
        default = envs.get_spec(name)
        family = envs.FAMILIES[default.family]
        sizes = map(str, (family.observation_size, family.action_size, default.episode_length))
        variants = [f"task1 to task{count}", f"task{default.task_id}", aliases.get(name, "")]
        rows.append([name, *sizes, ", ".join(family.engines), *variants])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            text.rjust(width) if column in (1, 2, 3) else text.ljust(width)  # numbers to the right
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        print("  ".join(cells).rstrip())
    print("\nmjx-warp runs on CUDA only; which engines run on this machine says: python -m qdos_brax doctor")
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from qdos_brax.commands.doctor import examine

    return 0 if examine() else 1


def positive(text: str) -> int:
    number = int(text) if text.isdigit() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, not {text!r}")
    return number


def _index(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0, not {text!r}")
    return int(text)


def _guarded(work: Callable[[], int | None]) -> int:
    """The exit code of ``work``; a user's error is one line and code 2."""
    try:
        return work() or 0
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except Exception as error:
        if not _is_opengls(error):
            raise
        asked = os.environ.get("MUJOCO_GL")
        print(f"error: MUJOCO_GL is {asked!r}, which MuJoCo cannot load here ({error}); unset it", file=sys.stderr)
        return 2


def _is_opengls(error: Exception) -> bool:
    """Whether ``import mujoco`` failed at the OpenGL library that MUJOCO_GL names; nothing but pictures needs one."""
    frames = traceback.extract_tb(error.__traceback__)
    return "MUJOCO_GL" in os.environ and any(Path(frame.filename).name == "gl_context.py" for frame in frames)
