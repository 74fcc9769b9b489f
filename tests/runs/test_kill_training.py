"""The real program, killed in every phase: what it ends with is what it would have ended with."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# A save after every chunk, so that a kill lands between two checkpoints or in the middle of one.
SETTINGS = ["--env", "antmaze-medium", "--preset", "smoke", "--set", "run.checkpoint_seconds=0"]
PHASES = ("values", "skills", "label", "online")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_kill_9_in_every_phase(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert launch(tmp_path, *SETTINGS, "--out", str(whole)).wait(900) == 0
    process = launch(tmp_path, *SETTINGS, "--out", str(killed))
    for seen in (None, *PHASES):  # the kill comes a little after the phase's last row so far: in the next one
        wait_for_phase(process, killed, seen)
        time.sleep(1.0)
        process.kill()
        process.wait()
        assert not (killed / "summary.json").exists(), f"it had ended before the kill after {seen}"
        process = launch(tmp_path, "--resume", str(killed))
    assert process.wait(900) == 0
    assert rows(killed) == rows(whole)
    a, b = (json.loads((path / "summary.json").read_text()) for path in (killed, whole))
    assert a["members"] == b["members"]
    assert set(a["wall_seconds"]) == {"data", "pretrain", "label", "online", "eval", "total"}


def launch(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    env = {**os.environ, "QDOS_DATA": str(folder / "data"), "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], env=env)


def wait_for_phase(process: subprocess.Popen[bytes], path: Path, phase: str | None) -> None:
    """Returns once metrics.csv exists and, with a phase, holds a row of it."""
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        assert process.poll() is None, f"it ended with {process.returncode} before a row of {phase}"
        if (path / "metrics.csv").exists() and (phase is None or any(row["phase"] == phase for row in rows(path))):
            return
        time.sleep(0.02)
    raise AssertionError(f"no row of {phase} in ten minutes")


def rows(path: Path) -> list[dict[str, str]]:
    """metrics.csv without the one column that measures time."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]
