"""Measure the time that a scan saves: ``python benchmarks/scan.py [--out results/scan.json]``.

Runs nine members of antmaze-medium (three alphas x three seeds, preset smoke) as one command and as nine commands. Each
command is a new process with an empty compilation cache of its own. The data are made before the measurement starts.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from qdos_brax.files import write_text

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = ("--env", "antmaze-medium", "--preset", "smoke")
ALPHAS, SEEDS = ("0.1", "0.2", "0.3"), ("0", "1", "2")


def seconds(folder: Path, name: str, *flags: str) -> float:
    """Return the wall seconds of one command with an empty compilation cache."""
    cache = folder / f"{name}-cache"
    env = {**os.environ, "QDOS_DATA": str(folder / "data"), "JAX_COMPILATION_CACHE_DIR": str(cache)}
    command = [sys.executable, str(ROOT / "train.py"), *SETTINGS, *flags, "--out", str(folder / name)]
    began = time.perf_counter()
    with (folder / f"{name}.log").open("w") as log:
        subprocess.run(command, env=env, stdout=log, stderr=log, check=True)
    return time.perf_counter() - began


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON file for the result")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seconds(folder, "data", "--pretrain-steps", "1", "--steps", "80")  # makes the data
        members = list(itertools.product(ALPHAS, SEEDS))
        # About half of the single commands run before the scan and the others after it, so that a machine that becomes
        # slower or faster favours neither.
        single = [seconds(folder, f"single-{a}-{s}", "--alpha", a, "--seed", s) for a, s in members[:4]]
        scan = seconds(folder, "scan", "--alpha", ",".join(ALPHAS), "--seed", ",".join(SEEDS))
        single += [seconds(folder, f"single-{a}-{s}", "--alpha", a, "--seed", s) for a, s in members[4:]]
    found = {
        "scan_seconds": round(scan, 1),
        "single_seconds": [round(value, 1) for value in single],
        "scan / nine commands": round(scan / sum(single), 3),
    }
    print(json.dumps(found, indent=1))
    if args.out:
        write_text(args.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
