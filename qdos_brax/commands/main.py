"""The commands of ``python -m qdos_brax``: train, data, evaluate, export, report, picture, tasks, doctor."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from qdos_brax import __version__
from qdos_brax.commands.arguments import Parser, natural, parse, positive
from qdos_brax.commands.config import add_parser as add_config
from qdos_brax.commands.streams import lasting_streams
from qdos_brax.commands.train import add_options, train_main
from qdos_brax.errors import UserError, guarded

_PROGRAM = "python -m qdos_brax"


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``python -m qdos_brax``; return the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv[:1] == ["train"]:
        return train_main(argv[1:], prog=f"{_PROGRAM} train")
    with lasting_streams():
        args = parse(main_parser(argv), argv)
        return guarded(lambda: args.run(args))


def main_parser(argv: Sequence[str], prog: str = _PROGRAM) -> Parser:
    """Return the parser of ``python -m qdos_brax``; the actions of ``data`` only if ``argv`` asks for them."""
    parser = Parser(prog=prog, description="Training, data, evaluation, reports, pictures, a check of this machine.")
    parser.add_argument("--version", action="version", version=f"qdos-brax {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    add_options(commands.add_parser("train", help="train, as train.py does"))
    if argv[:1] in (["data"], ["completion"]):
        from qdos_brax.commands.data import add_parser  # imports jax and h5py, which the others need not wait for

        add_parser(commands)
    else:
        commands.add_parser("data", help="make, fetch, describe, check and export data files")

    evaluate = commands.add_parser("evaluate", help="evaluate the policy of a run")
    evaluate.add_argument(
        "runs", metavar="RUN", nargs="+", help="a run folder, a file that `export` wrote, or hub:USER/NAME"
    )
    evaluate.add_argument("--episodes", metavar="N", type=positive, default=20, help="episodes per member (default 20)")
    evaluate.add_argument(
        "--video", metavar="FILE", help="also film the first member's first episode, as .mp4; takes one RUN"
    )
    evaluate.set_defaults(run=_evaluate)

    export = commands.add_parser("export", help="write skills and policy of a run to one file, to hand on")
    export.add_argument("run_folder", metavar="RUN", help="the folder of a finished run")
    export.add_argument("--out", metavar="FILE", required=True, help="the file to write, as .safetensors")
    export.add_argument("--member", metavar="N", type=natural, help="one member, from 0 (default: all)")
    export.set_defaults(run=_export)

    report = commands.add_parser("report", help="tables, learning curves and a page of runs")
    report.add_argument("runs", metavar="RUN", nargs="+", help="the folder of a finished run or comparison")
    report.add_argument(
        "--out", metavar="DIR", help="the folder for the files (default: that of a single RUN, else report/)"
    )
    report.add_argument(
        "--reference",
        metavar="METHOD",
        help="the method to compare the others with (default supe, else the first)",
    )
    report.add_argument(
        "--published", action="store_true", help="also show what others published for the tasks, in their own settings"
    )
    report.add_argument(
        "--pool",
        metavar="KEY",
        action="append",
        default=[],
        help="count members that differ in KEY (data.seed; data: the file) as seeds of one setting; may be repeated",
    )
    report.set_defaults(run=_report)

    picture = commands.add_parser("picture", help="draw a task at its start, or an episode and the latents of a run")
    picture.add_argument(
        "subject",
        metavar="TASK|RUN",
        help="a task (python -m qdos_brax tasks), or the folder of a finished run; ./NAME if it is called like a task",
    )
    picture.add_argument("--out", metavar="FILE", required=True, help="the picture to write, as .png")
    picture.set_defaults(run=_picture)

    tasks = commands.add_parser("tasks", help="list the tasks and their aliases")
    tasks.set_defaults(run=_tasks)

    add_config(commands)

    doctor = commands.add_parser("doctor", help="check versions, devices, engines, caches and drawing on this machine")
    doctor.set_defaults(run=_doctor)

    completion = commands.add_parser("completion", help="print a script by which a shell completes the command qdos")
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    completion.set_defaults(run=_completion)
    return parser


def _evaluate(args: argparse.Namespace) -> int:
    if args.video and len(args.runs) > 1:
        raise UserError(f"--video films one run, and {len(args.runs)} were given; name one RUN")

    from qdos_brax.analysis.conclusion import listed
    from qdos_brax.analysis.finished import evaluate_run
    from qdos_brax.runs.hub import local_path
    from qdos_brax.runs.jax_setup import prepare_jax

    prepare_jax()
    if args.video:
        from qdos_brax.analysis.film import film_run

        episode = film_run(local_path(args.runs[0]), Path(args.video))
        print(f"{args.video}: " + ", ".join(f"{name} {value:g}" for name, value in episode.items()), flush=True)
    for run in args.runs:
        for member in evaluate_run(local_path(run), args.episodes):
            print(f"{run}: " + ", ".join(f"{name} {listed(value)}" for name, value in member.items()))
    return 0


def _export(args: argparse.Namespace) -> int:
    from qdos_brax.runs.export import export_run

    for member in export_run(Path(args.run_folder), Path(args.out), args.member):
        print(", ".join(f"{name} {value}" for name, value in member.items()))
    print(args.out)
    return 0


def _report(args: argparse.Namespace) -> int:
    from qdos_brax.report.write import write_report

    runs = [Path(run) for run in args.runs]
    out = Path(args.out) if args.out else runs[0] if len(runs) == 1 else Path("report")
    report = write_report(runs, out, args.reference, args.published, args.pool)
    print(f"{report.text}\n")
    for file in report.files:
        print(file)
    return 0


def _picture(args: argparse.Namespace) -> int:
    folder, task = Path(args.subject).is_dir(), _is_task(args.subject)
    if folder and not task:
        from qdos_brax.analysis.strip import draw_run

        draw_run(Path(args.subject), Path(args.out))
    else:
        from qdos_brax.report.picture import draw_task

        draw_task(args.subject, Path(args.out))
    print(args.out)
    if folder and task:
        print(f"note: drew the task; for the folder of that name write ./{args.subject}", file=sys.stderr)
    return 0


def _is_task(name: str) -> bool:
    import envs

    try:
        envs.get_spec(name)
    except ValueError:
        return False
    return True


def _tasks(args: argparse.Namespace) -> int:
    import envs

    aliases = {(spec.name, spec.task_id): alias for alias in envs.ALIASES for spec in [envs.get_spec(alias)]}
    counts = Counter(spec.name for spec in envs.list_tasks())
    rows = [["task", "observation", "action", "cap", "engines", "variants", "default", "alias"]]
    for name, count in counts.items():
        default = envs.get_spec(name)
        family = envs.FAMILIES[default.family]
        variant = family.variants[default.variant]
        sizes = map(str, (variant.observation_size, variant.action_size, variant.episode_length))
        alias = [
            short if task == default.task_id else f"{short} (task{task})"
            for (full, task), short in aliases.items()
            if full == name
        ]
        numbers = "task1" if count == 1 else f"task1 to task{count}"
        variants = [numbers, f"task{default.task_id}", *(alias or [""])]
        rows.append([name, *sizes, ", ".join(family.engines), *variants])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            text.rjust(width) if column in (1, 2, 3) else text.ljust(width)  # numbers to the right
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        print("  ".join(cells).rstrip())
    print("\nmjx-warp runs on CUDA only. Run `python -m qdos_brax doctor` to see which engines work here.")
    return 0


def _completion(args: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError as error:
        raise UserError('completion needs shtab; run: pip install -c constraints.txt -e ".[completion]"') from error
    print(shtab.complete(main_parser(["completion"], prog="qdos"), args.shell))
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from qdos_brax.commands.doctor import examine

    return 0 if examine() else 1
