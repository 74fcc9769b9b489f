"""A report: everything that can be said of finished runs, written into one folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from qdos_brax.errors import UserError
from qdos_brax.files import user_errors, write_text
from qdos_brax.report.curves import draw_curves, draw_scans
from qdos_brax.report.looks import read_looks
from qdos_brax.report.page import write_page
from qdos_brax.report.stills import draw_stills
from qdos_brax.report.study import read_study
from qdos_brax.report.tables import Table, first_goal_csv, success_csv, tables


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
        runs: folders of either kind; all must have ended. An inside.npz that cannot be read is left out and noted.
        out: the folder for the files, made if it is not there; files of an earlier report in it are replaced.
        reference: the method or label that the others are compared with; None for supe, or else the first.

    Raises:
        UserError: a folder is no finished run, or something cannot be written.
    """
    study = read_study(runs, reference)
    looks, missing = read_looks(study)
    study = dataclasses.replace(study, notes=[*study.notes, *missing])
    with user_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    if not out.is_dir():
        raise UserError(f"--out {out} must be a folder for the report's files")
    page, curves, scan = out / "report.html", out / "curves.png", out / "scan.png"
    found = tables(study)
    draw_curves(study, curves)
    files = [page, curves]
    if draw_scans(study, scan):
        files.append(scan)
    files += draw_stills(study, looks, out)
    for name, text in (
        ("table1.csv", success_csv(study)),
        ("table2.csv", first_goal_csv(study)),
        ("report.md", _markdown(found, study.notes)),
    ):
        write_text(out / name, text)
        files.append(out / name)
    write_page(study, looks, page)
    return Report(_text(found, study.notes), page, curves, files)


def _text(found: list[Table], remarks: Sequence[str]) -> str:
    parts = [table.text() for table in found]
    notes = "\n".join(f"note: {remark}" for remark in remarks)
    return "\n\n".join([*parts, *([notes] if notes else [])])


def _markdown(found: list[Table], remarks: Sequence[str]) -> str:
    parts = [table.markdown() for table in found]
    notes = "\n".join(f"- {remark}" for remark in remarks)
    return "\n\n".join([*parts, *([notes] if notes else [])]) + "\n"
