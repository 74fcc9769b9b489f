"""The end of a run: its analysis, its report, and the last lines on the terminal."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs.render import find_way
from qdos_brax.analysis.finished import TrainedRun, load_run
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import format_value
from qdos_brax.data import formats
from qdos_brax.data.dataset import Dataset
from qdos_brax.errors import UserError
from qdos_brax.files import parse_json
from qdos_brax.runs.beside import start_beside
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import module_command, train_command

if TYPE_CHECKING:
    from qdos_brax.report.write import Report

_AT_THE_END = ("qdos_brax.report.write", "qdos_brax.analysis.inside")


def load_beside() -> None:
    """Load what the run's end needs on a thread, while the run trains.

    That is Matplotlib, SciPy's statistics and scikit-learn (1.5 s), and how to draw on this machine (0.5 s).
    """

    def load() -> None:
        for name in _AT_THE_END:
            importlib.import_module(name)
        find_way()

    start_beside(load, "load")


def conclude(folder: RunFolder, summary: Mapping[str, Any], finished: Callable[[], tuple[TrainedRun, Dataset]]) -> None:
    """Analyse a run, write the report, and print the last lines: results and files.

    Args:
        folder: the run's folder.
        summary: its summary.
        finished: returns what the run learned, and its data; called only if there is no analysis yet.
    """
    if not folder.inside.exists():
        from qdos_brax.analysis.inside import look_inside

        try:
            look_inside(*finished(), folder.inside)
        except Exception as error:  # whatever it is: the run is done, and the page does without
            print(f"inside    left out: {' '.join(str(error).split()) or repr(error)}", file=sys.stderr, flush=True)
    report = _report_on(folder.path)
    print(f"\ndone in {summary['wall_seconds']['total'] / 60:.1f} minutes")
    for member in summary["members"]:
        print(f"  {with_alpha(summary['method'], member['alpha'])}seed {member['seed']}: {_result(member)}")
    print(f"summary   {folder.summary}")
    _print_files(report)
    print(f"evaluate  {module_command('evaluate', folder.path)}")
    print(f"film      {module_command('evaluate', folder.path, '--video', 'episode.mp4')}")
    print(f"compare   {train_command('--env', summary['env'], '--method', 'qdos,supe', '--seed', '0,1,2')}", flush=True)


def _result(member: Mapping[str, Any]) -> str:
    success, first = member["eval_success"], member["first_goal_step"]
    result = "not evaluated" if success is None else f"success {success:.2f} (best {member['best_success']:.2f})"
    if "eval_score" in member:
        result += f", {100 * member['eval_score']:.0f} % of the task's parts done"
    if first is not None:
        result += f", first goal after {first:,} env steps"
    elif not member["best_success"]:  # an offline method reaches goals without a step online
        result += ", no goal reached"
    return result + ("" if member["status"] == "ok" else ", FROZEN: its numbers were no longer finite")


def read_finished(folder: RunFolder) -> tuple[TrainedRun, Dataset]:
    """Read what a finished run learned, and its data, from its folder.

    Raises:
        UserError: the run has not finished, or the folder or the data are gone or damaged.
    """
    trained = load_run(folder.path)
    try:
        path = Path(parse_json(folder.provenance.read_text(encoding="utf-8"))["dataset"]["path"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read from {folder.provenance} which data the run had ({error})") from error
    return trained, formats.read(path, trained.env.unwrapped)


def conclude_comparison(path: Path, names: Sequence[str]) -> None:
    """Write the report on the comparison in ``path``, and print its tables and files."""
    report = _report_on(path)
    print(f"\n{report.text}\n\ncompared {', '.join(names)}")
    _print_files(report)


def _report_on(path: Path) -> Report:
    """Write the report on the run or the comparison in ``path`` into it; errors as ``write_report``."""
    from qdos_brax.report.write import write_report  # here, so that a run starts before Matplotlib is there

    return write_report([path], path)


def _print_files(report: Report) -> None:
    """Print where the page and the curves are."""
    print(f"report    {report.page}")
    print(f"curves    {report.curves}", flush=True)


def with_alpha(method: str, alpha: Any) -> str:
    """Return "alpha A, " for methods with the mutual-information term, which it weighs; nothing for the others."""
    return f"alpha {listed(alpha)}, " if METHODS[method].information else ""


def listed(values: Any) -> str:
    """Return one number or text, or several separated by commas."""
    each = values if isinstance(values, tuple) else (values,)
    return ", ".join(map(format_value, each))
