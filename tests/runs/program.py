"""The real program in processes of its own, and what two of its runs must have in common."""

from __future__ import annotations

import csv
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port: int = free.getsockname()[1]
    return port


def launch(data: Path, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
    """Start the program with its own folders for data and output."""
    data.mkdir(exist_ok=True)
    env = {**os.environ, "QDOS_DATA": str(data), "PYTHONPATH": str(ROOT), **environment}
    with (data / "log").open("wb") as log:
        return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], env=env, stdout=log, stderr=log)


def wait_for_start(process: subprocess.Popen[bytes], data: Path) -> float:
    """Return the time when the program had printed its first line, after its imports."""
    deadline = time.monotonic() + 300
    while not (data / "log").stat().st_size:
        assert process.poll() is None and time.monotonic() < deadline, "it has not started"
        time.sleep(0.02)
    return time.monotonic()


def place(path: Path, data: Path) -> str:
    """Return where a kill hit: the last rows, and the last line that was printed."""
    last = [
        f"{file.parent.name} {rows(file.parent)[-1]['phase']}"
        for file in path.rglob("metrics.csv")
        if rows(file.parent)
    ]
    lines = (data / "log").read_text(errors="replace").replace("\r", "\n").split("\n")
    printed = next((line for line in reversed(lines) if line.strip()), "")
    ended = " ended" if list(path.rglob("summary.json")) else ""
    return f"rows of {', '.join(last) or 'nothing'}{ended}; last line: {printed[:60]}"


def assert_same_end(path: Path, whole: Path) -> None:
    """Every run folder in ``path`` holds what its like in ``whole`` holds, and there is a page."""
    assert (path / "report.html").exists()
    summaries = sorted(file.relative_to(whole) for file in whole.rglob("summary.json"))
    assert summaries and summaries == sorted(file.relative_to(path) for file in path.rglob("summary.json"))
    for summary in summaries:
        assert_same_run((path / summary).parent, (whole / summary).parent)
    for table in ("table1.csv", "table2.csv"):
        assert (path / table).read_text() == (whole / table).read_text()


def assert_same_run(path: Path, other: Path) -> None:
    """Two run folders hold the same metrics and the same summary, times aside."""
    a, b = (json.loads((folder / "summary.json").read_text()) for folder in (path, other))
    assert a.pop("wall_seconds").keys() == b.pop("wall_seconds").keys()
    assert a == b
    assert rows(path) == rows(other)


def rows(path: Path) -> list[dict[str, str]]:
    """metrics.csv without the one column that measures time."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]
