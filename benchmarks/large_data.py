"""Measure a run's start on data of several sizes: ``python benchmarks/large_data.py [--sizes 200000 ..] [--out FILE]``.

For every size the transitions of antmaze-large are collected first, which is timed apart. Then one member of preset cpu
trains on the file until its first steps online, with few updates of the skills, for these take the same time on any
data. Reported are the seconds until the data is in memory and of each phase, the most memory that the process held by
the end of each, and how much that is beside the data's own bytes in memory. The runs compile nothing that lasts: a run
on a small file has made the programs, but for those whose shapes depend on the data.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import h5py

from qdos_brax.files import write_text

ROOT = Path(__file__).resolve().parents[1]
TASK = "antmaze-large"
TRAIN = ("--env", TASK, "--preset", "cpu", "--set", "skills.updates=200", "--set", "eval.episodes=4", "--steps", "2000")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_ENDS = re.compile(r"^(members|values 100%|skills 100%|label 100%|online 100%)")


def collect(size: int, out: Path) -> float:
    """Collect ``size`` transitions; the seconds it took."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "qdos_brax", "data", "make", TASK, "--transitions", str(size), "--out", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - began


def data_bytes(path: Path) -> int:
    """Return what the file's arrays take in memory."""
    with h5py.File(path) as file:
        found: list[int] = []
        file.visititems(lambda _, item: found.append(item.nbytes) if isinstance(item, h5py.Dataset) else None)
    return sum(found)


class _Watch(threading.Thread):
    """Hold the most memory that a process has held, asked twenty times a second."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self._path, self.peak = Path(f"/proc/{pid}/statm"), 0

    def run(self) -> None:
        while True:
            try:
                self.peak = max(self.peak, int(self._path.read_text().split()[1]) * _PAGE)
            except (OSError, IndexError, ValueError):
                return
            time.sleep(0.05)


def train(dataset: Path, out: Path) -> dict[str, Any]:
    """Train on a file; seconds and peak bytes at the end of the data and of every phase."""
    command = [sys.executable, "train.py", *TRAIN, "--dataset", str(dataset), "--out", str(out)]
    began = mark = time.perf_counter()
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    watch = _Watch(process.pid)
    watch.start()
    found: dict[str, Any] = {}
    for line in process.stdout or ():
        if end := _ENDS.match(line):
            now, name = time.perf_counter(), end[1].split()[0].replace("members", "data")
            found[name] = {"seconds": round(now - mark, 1), "peak_mb": watch.peak // 2**20}
            mark = now
    if process.wait():
        raise SystemExit(f"the run on {dataset} failed")
    return found | {"seconds": round(time.perf_counter() - began, 1), "peak_mb": watch.peak // 2**20}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[50_000, 200_000, 1_000_000], help="transitions")
    parser.add_argument("--out", type=Path, help="JSON file for the result")
    args = parser.parse_args()
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for size in (20_000, *args.sizes):  # the first makes the programs
            path = folder / f"{size}.hdf5"
            seconds = collect(size, path)
            found = {"collected_seconds": round(seconds, 1), "data_mb": data_bytes(path) // 2**20}
            found |= train(path, folder / f"run-{size}")
            path.unlink()
            if size in args.sizes:
                results[str(size)] = found
                print(size, json.dumps(found), flush=True)
                if args.out:
                    write_text(args.out, json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
