"""The real program, killed at twenty random moments: what it ends with is what it would have ended with."""

from __future__ import annotations

import csv
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# A save after every chunk, so that a kill lands between two checkpoints or in the middle of one.
SETTINGS = ["--env", "antmaze-medium", "--preset", "smoke", "--set", "run.checkpoint_seconds=0"]
KILLS = 14
KILLS_OF_A_COMPARISON = 6


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize(
    ("flags", "kills"),
    [([], KILLS), (["--method", "qdos,explore"], KILLS_OF_A_COMPARISON)],
    ids=["run", "comparison"],
)
def test_kill_9_at_random_moments(tmp_path: Path, flags: list[str], kills: int) -> None:
    """Runs are killed and gone on with until they end, and new ones begun, until there were enough kills.

    A moment is drawn from the whole time between the first line of the program and its end: collection of the data
    (each run collects its own), every phase, and the report. Most of a resumed run is behind it, so many runs end.
    """
    seed = int(os.environ.get("QDOS_KILL_SEED") or time.time_ns() % 2**32)
    print(f"QDOS_KILL_SEED={seed}")
    draw = random.Random(seed)
    whole = tmp_path / "whole"
    launch(tmp_path / "compiling", *SETTINGS, *flags, "--out", str(tmp_path / "first")).wait(1200)  # fills the cache
    process = launch(tmp_path / "data", *SETTINGS, *flags, "--out", str(whole))
    started = wait_for_start(process, tmp_path / "data")
    assert process.wait(1200) == 0
    duration = time.monotonic() - started
    done, number = 0, 0
    while done < kills:
        number += 1
        path, data = tmp_path / f"killed-{number}", tmp_path / f"data-{number}"
        while True:
            begun = (path / "config.yaml").exists() or (path / "comparison.json").exists()
            arguments = ["--resume", str(path)] if begun else [*SETTINGS, *flags, "--out", str(path)]
            process = launch(data, *arguments)
            wait_for_start(process, data)
            try:
                code = process.wait(draw.uniform(0, duration) if done < kills else 1200)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                done += 1
                print(f"kill {done}: run {number}, {place(path, data)}")
                continue
            assert code == 0, (data / "log").read_text()
            break
        assert_same_end(path, whole)
    print(f"{done} kills of {number} runs of {duration:.0f} s")


def launch(data: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """The program, with its own folder for data and for what it says."""
    data.mkdir(exist_ok=True)
    env = {**os.environ, "QDOS_DATA": str(data), "PYTHONPATH": str(ROOT)}
    with (data / "log").open("wb") as log:
        return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], env=env, stdout=log, stderr=log)


def wait_for_start(process: subprocess.Popen[bytes], data: Path) -> float:
    """The time when the program had said its first line, after its imports."""
    deadline = time.monotonic() + 300
    while not (data / "log").stat().st_size:
        assert process.poll() is None and time.monotonic() < deadline, "it has not begun"
        time.sleep(0.02)
    return time.monotonic()


def place(path: Path, data: Path) -> str:
    """Where a kill came: the last row and the last line said."""
    last = [
        f"{file.parent.name} {rows(file.parent)[-1]['phase']}"
        for file in path.rglob("metrics.csv")
        if rows(file.parent)
    ]
    lines = (data / "log").read_text(errors="replace").replace("\r", "\n").split("\n")
    said = next((line for line in reversed(lines) if line.strip()), "")
    ended = " ended" if list(path.rglob("summary.json")) else ""
    return f"rows of {', '.join(last) or 'nothing'}{ended}; last line: {said[:60]}"


def assert_same_end(path: Path, whole: Path) -> None:
    """Every run folder in ``path`` holds what its like in ``whole`` holds, and there is a page."""
    assert (path / "report.html").exists()
    summaries = sorted(file.relative_to(whole) for file in whole.rglob("summary.json"))
    assert summaries and summaries == sorted(file.relative_to(path) for file in path.rglob("summary.json"))
    for summary in summaries:
        a, b = (json.loads((folder / summary).read_text()) for folder in (path, whole))
        assert a.pop("wall_seconds").keys() == b.pop("wall_seconds").keys()
        assert a == b
        assert rows((path / summary).parent) == rows((whole / summary).parent)
    for table in ("table1.csv", "table2.csv"):
        assert (path / table).read_text() == (whole / table).read_text()


def rows(path: Path) -> list[dict[str, str]]:
    """metrics.csv without the one column that measures time."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]
