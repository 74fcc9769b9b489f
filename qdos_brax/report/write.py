"""A report: everything that can be said of finished runs, written into one folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from qdos_brax.errors import UserError
from qdos_brax.report.curves import draw_curves, draw_scans
from qdos_brax.report.page import write_page
from qdos_brax.report.study import Study, read_study
from qdos_brax.report.tables import first_goal_csv, success_csv, tables
from qdos_brax.runs.folder import user_errors, write_text


@dataclasses.dataclass(frozen=True)
class Report:
    """What was made.

    Attributes:
        text: the tables and notes, for a terminal.
        page: report.html.
        curves: curves.png.
        files: every file written.
    """

    text: str
    page: Path
    curves: Path
    files: list[Path]


def write_report(runs: Sequence[Path], out: Path, reference: str | None = None) -> Report:
    """Writes page, tables (CSV and markdown) and pictures of runs and comparisons.

    Args:
        runs: folders of either kind; all must have ended.
        out: the folder for the files, made if it is not there; files of an earlier report in it are replaced.
        reference: the method or label that the others are compared with; None for supe, or else the first.

    Raises:
        UserError: a folder is no finished run, or something cannot be written.
    """
    study = read_study(runs, reference)
    with user_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    if not out.is_dir():
        raise UserError(f"--out {out} must be a folder for the report's files")
    page, curves, scan = out / "report.html", out / "curves.png", out / "scan.png"
    draw_curves(study, curves)
    files = [page, curves]
    if draw_scans(study, scan):
        files.append(scan)
    for name, text in (
        ("table1.csv", success_csv(study)),
        ("table2.csv", first_goal_csv(study)),
        ("report.md", _markdown(study)),
    ):
        write_text(out / name, text)
        files.append(out / name)
    write_page(study, page)
    return Report(_text(study), page, curves, files)


def _text(study: Study) -> str:
    parts = [table.text() for table in tables(study)]
    notes = "\n".join(f"note: {note}" for note in study.notes)
    return "\n\n".join([*parts, *([notes] if notes else [])])


def _markdown(study: Study) -> str:
    parts = [table.markdown() for table in tables(study)]
    notes = "\n".join(f"- {note}" for note in study.notes)
    return "\n\n".join([*parts, *([notes] if notes else [])]) + "\n"
