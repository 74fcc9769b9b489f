"""The report on finished runs: tables, figures and a page, written into one folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from qdos_brax.errors import UserError
from qdos_brax.files import user_errors, write_text
from qdos_brax.report.curves import draw_curves, draw_scans
from qdos_brax.report.member_analysis import read_analyses
from qdos_brax.report.page import write_page
from qdos_brax.report.published import published_on
from qdos_brax.report.reading import read_study
from qdos_brax.report.static_figures import draw_static_figures
from qdos_brax.report.tables import Table, first_goal_csv, success_csv, tables


@dataclasses.dataclass(frozen=True)
class Report:
    """Hold what was written.

    Attributes:
        text: the tables and notes, for a terminal.
        page: the path of report.html.
        curves: the path of curves.png.
        files: every file that was written.
    """

    text: str
    page: Path
    curves: Path
    files: list[Path]


def write_report(
    runs: Sequence[Path],
    out: Path,
    reference: str | None = None,
    published: bool = False,
    pooled: Sequence[str] = (),
) -> Report:
    """Write page, tables (CSV and Markdown) and figures of runs and comparisons.

    Args:
        runs: folders of either kind; all must have finished. An inside.npz that cannot be read is left out and noted.
        out: the folder for the files, created if it does not exist; files of an earlier report are replaced.
        reference: the method or label that the others are compared with; None for supe if it was run, or the first.
        published: whether to show what others published for the tasks, marked as of settings of their own.
        pooled: keys in which seeds of one setting may differ, such as data.seed.

    Raises:
        UserError: a folder is no finished run, or something cannot be written.
    """
    study = read_study(runs, reference, pooled)
    analyses, missing = read_analyses(study)
    others = published_on(study.tasks) if published else []
    study = dataclasses.replace(study, notes=[*study.notes, *missing], published=others)
    with user_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    if not out.is_dir():
        raise UserError(f"--out {out} is a file; give a folder for the files of the report")
    page, curves, scan = out / "report.html", out / "curves.png", out / "scan.png"
    found = tables(study)
    draw_curves(study, curves)
    files = [page, curves]
    if draw_scans(study, scan):
        files.append(scan)
    files += draw_static_figures(study, analyses, out)
    for name, text in (
        ("table1.csv", success_csv(study)),
        ("table2.csv", first_goal_csv(study)),
        ("report.md", _markdown(found, study.notes)),
    ):
        write_text(out / name, text)
        files.append(out / name)
    write_page(study, analyses, page)
    return Report(_text(found, study.notes), page, curves, files)


def _text(found: list[Table], notes: Sequence[str]) -> str:
    parts = [table.text() for table in found]
    return "\n\n".join([*parts, "\n".join(f"note: {note}" for note in notes)]).rstrip()


def _markdown(found: list[Table], notes: Sequence[str]) -> str:
    parts = [table.markdown() for table in found]
    return "\n\n".join([*parts, "\n".join(f"- {note}" for note in notes)]).rstrip() + "\n"
