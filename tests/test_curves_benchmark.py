"""Which rows of its file ``benchmarks/curves.py`` replaces."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from types import SimpleNamespace

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


def test_members_of_a_scan_are_told_apart(tmp_path: Path) -> None:
    """By what it varies besides alpha and seed, which have columns."""

    def member(seed: int, alpha: float, temperature: float) -> SimpleNamespace:
        values = {"skills.alpha": alpha, "skills.advantage_temperature": temperature, "high_level.discount": 0.99}
        rows = [{"eval/success": "0.5", "env_steps": "100", "update": ""}]
        own = {"task": "a", "method": "qdos", "seed": seed, "first_goal": float("nan"), "rows": rows}
        return SimpleNamespace(**own, values=values)

    (tmp_path / "run.json").write_text('{"command": ["train.py", "--env", "a"]}')
    view = SimpleNamespace(view="start", horizon=10)
    config = SimpleNamespace(method="qdos", skills=view, observation=view)
    summary = {"preset": "cpu", "wall_seconds": {"total": 60.0}}
    members = [member(10, 0.3, 1.0), member(10, 0.3, 1e6), member(11, 0.0, 1.0)]
    run = SimpleNamespace(path=tmp_path, summary=summary, config=config, members=members)
    found = curves.rows_of(SimpleNamespace(runs=[run]))  # type: ignore[arg-type]
    assert [(row["seed"], row["alpha"], row["scanned"]) for row in found] == [
        ("10", "0.3", "skills.advantage_temperature=1.0"),
        ("10", "0.3", "skills.advantage_temperature=1000000.0"),
        ("11", "0.0", "skills.advantage_temperature=1.0"),
    ]
