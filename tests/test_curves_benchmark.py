"""Which rows of its file ``benchmarks/curves.py`` replaces."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

from benchmarks import curves

pytestmark = pytest.mark.quick
COMMAND = "python train.py --method qdos,supe"


def row(part: str, success: str) -> dict[str, str]:
    return dict.fromkeys(curves.COLUMNS, "") | {"command": COMMAND, "part": part, "eval_success": success}


def test_runs_of_a_comparison_do_not_replace_one_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They have one command; the same run read again does."""
    out = tmp_path / "curves.csv"
    successes = iter(["0.1", "0.2", "0.3"])
    monkeypatch.setattr(curves, "read_study", lambda runs: runs)
    monkeypatch.setattr(curves, "rows_of", lambda runs: [row(runs[0].name, next(successes))])
    for part in ("qdos", "supe", "qdos"):
        monkeypatch.setattr(sys, "argv", ["curves.py", part, "--out", str(out)])
        curves.main()
    with out.open(newline="") as file:
        kept = [(found["part"], found["eval_success"]) for found in csv.DictReader(file)]
    assert kept == [("supe", "0.2"), ("qdos", "0.3")]
