"""Reading of finished runs and comparisons into the study that a report is about."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qdos_brax.config import from_yaml, nearest, values_by_key
from qdos_brax.config.schema import get
from qdos_brax.errors import UserError
from qdos_brax.files import parse_json
from qdos_brax.report.settings import DATA, SETTING_KEYS, notes_on, reference_of, settings_of
from qdos_brax.report.study import Member, Run, Study
from qdos_brax.runs import comparison
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_command, resume_flag
from qdos_brax.runs.metrics import Row, read_rows


def read_study(paths: Sequence[Path], reference: str | None = None, pooled: Sequence[str] = ()) -> Study:
    """Read runs and comparisons.

    Args:
        paths: folders of either kind.
        reference: the method or label to compare with; None for supe if it was run, or the first.
        pooled: keys that do not make a setting here, ``DATA`` among them: members that differ in them alone count as
            further seeds.

    Raises:
        UserError: a folder is not a run, has not finished or is empty; two members are the same; there is no such
            reference, or no such key.
    """
    for key in pooled:
        if key not in (DATA, *SETTING_KEYS):
            raise UserError(f"--pool {key}: no key by which settings are told apart{nearest(key, SETTING_KEYS)}")
    folders = [folder for path in paths for folder in _folders(path)]
    counts = Counter(folder.path.resolve() for folder in folders)
    for path, count in counts.items():
        if count > 1:
            raise UserError(f"{path} was given twice; give each run once")
    runs = [_read_run(folder) for folder in folders]
    settings = settings_of([member for run in runs for member in run.members], pooled)
    return Study(
        runs=runs,
        tasks=sorted({member.task for run in runs for member in run.members}),
        settings=settings,
        reference=reference_of(settings, reference),
        notes=list(notes_on(settings, pooled)),
    )


def _folders(path: Path) -> list[RunFolder]:
    if comparison.is_comparison(path):
        return list(comparison.runs(path).values())
    return [RunFolder.open(path)]


def _read_run(folder: RunFolder) -> Run:
    config = from_yaml(folder.config)
    summary = folder.read_summary()
    if summary is None:
        raise UserError(f"the run in {folder.path} has not finished; continue it with: {resume_command(folder.path)}")
    rows = read_rows(folder.metrics)
    if not rows:
        raise UserError(f"{folder.metrics} has no rows, so there is nothing to report; leave this run out")
    provenance = _provenance(folder)
    values = {key: get(config, key) for key in SETTING_KEYS}
    values[DATA] = provenance.get("dataset", {}).get("sha256", "")[:8]
    by_member: dict[str, list[Row]] = {}
    for row in rows:
        by_member.setdefault(row["member"], []).append(row)
    try:
        entries = enumerate(summary["members"])
        members = [_member(folder.path, summary, values, entry, by_member[str(i)]) for i, entry in entries]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder.summary} does not match {folder.metrics.name} or is damaged ({error!r}); delete it, and "
            f"{resume_flag(folder.path)} writes it again"
        ) from error
    return Run(folder.path, config, provenance, summary, members)


def _member(
    path: Path, summary: dict[str, Any], values: dict[str, Any], entry: dict[str, Any], rows: list[Row]
) -> Member:
    return Member(
        run=path,
        task=str(summary["env"]),
        method=str(summary["method"]),
        seed=int(entry["seed"]),
        values=values | values_by_key(entry),
        success=_number(entry["eval_success"]),
        score=_number(entry.get("eval_score")),
        first_goal=_number(entry["first_goal_step"]),
        frozen=entry["status"] != "ok",
        rows=rows,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _provenance(folder: RunFolder) -> dict[str, Any]:
    if not folder.provenance.is_file():
        return {}
    try:
        return dict(parse_json(folder.provenance.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"cannot read {folder.provenance}: {error}") from error
