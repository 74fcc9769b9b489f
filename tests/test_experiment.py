"""The main command from flags to page, at sizes that prove nothing but that all parts fit together."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from qdos_brax import experiment
from qdos_brax.analysis import conclusion
from qdos_brax.commands.train import train_main
from qdos_brax.data import formats

ROOT = Path(__file__).parents[1]
TINY = (
    "--env antmaze-medium --preset smoke --pretrain-steps 2 --steps 160 --set data.transitions=1000 "
    "--set data.num_envs=4 --set labels.start_env_steps=80 --set high_level.warmup_env_steps=80 "
    "--set eval.every_env_steps=160 --set eval.episodes=1"
)


def test_a_scan_of_two_from_flags_to_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    run = tmp_path / "run"
    counts = ((formats, "read"), (experiment, "sha256_once"))
    calls = {name: counted(monkeypatch, module, name) for module, name in counts}
    monkeypatch.setattr(conclusion, "load_run", refuse)  # what is in memory is not read again
    assert train_main(shlex.split(f"{TINY} --alpha 0.1,0.3 --seed 0,1 --zip --out {run}")) == 0
    printed = capsys.readouterr().out
    assert "members   2 members, " in printed and "done in" in printed
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert [(member["seed"], member["alpha"]) for member in summary["members"]] == [(0, 0.1), (1, 0.3)]
    assert calls == {"read": [1], "sha256_once": [1]} and (run / "inside.npz").exists()
    assert f"  alpha 0.3, seed 1: success {summary['members'][1]['eval_success']:.2f} (best " in printed
    assert all(member["status"] == "ok" and member["env_steps"] == 160 for member in summary["members"])
    with (run / "metrics.csv").open(newline="") as file:
        phases = {row["phase"] for row in csv.DictReader(file)}
    assert phases == {"values", "skills", "label", "online"}
    assert (run / "report.html").stat().st_size > 0 and any((run / "tensorboard").rglob("events*"))
    assert train_main(["--resume", str(run)]) == 0  # it has finished: not run again
    assert "has finished already" in capsys.readouterr().out


def test_a_task_without_things_is_refused_before_data_is_collected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    assert train_main(shlex.split(f"{TINY} --set exchange.share=0.5 --out {tmp_path / 'run'}")) == 2
    assert "exchange.share: antmaze has no things" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_process_that_ends_early_prints_nothing_of_what_it_loads_beside() -> None:
    """A run that data is refused to ends with one line while modules for its report are still loading."""
    code = "from qdos_brax.analysis.conclusion import load_beside; load_beside()"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr, done.stderr


def test_how_to_draw_is_found_beside_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(conclusion, "find_way", lambda: calls.append(1))
    monkeypatch.setattr(conclusion, "start_beside", lambda work, name: work())
    conclusion.load_beside()
    assert calls == [1]


def test_alpha_is_printed_only_where_it_has_an_effect() -> None:
    assert conclusion.with_alpha("qdos", (0.1, 0.3)) == "alpha 0.1, 0.3, "
    assert conclusion.with_alpha("bc", 0.0) == ""


def counted(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    """Count the calls of a function, in the only entry of the list."""
    calls, function = [0], getattr(module, name)

    def call(*args: Any) -> Any:
        calls[0] += 1
        return function(*args)

    monkeypatch.setattr(module, name, call)
    return calls


def refuse(*args: Any) -> None:
    raise AssertionError("read from disk")
