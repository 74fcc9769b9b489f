"""Nine members as one command against nine commands, cold: ``python benchmarks/scan.py --out scan.json``.

Each command has a compilation cache of its own, empty at its start; the data set is made before and read by all. The
nine are timed half before and half after the one, so that a load that comes or goes falls on both.
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

ROOT = Path(__file__).parents[1]
ALPHAS, SEEDS = ("0.1", "0.2", "0.3"), ("0", "1", "2")
TARGET = 0.60


def seconds(folder: Path, name: str, flags: list[str], dataset: Path, alpha: str, seed: str) -> float:
    """Wall time of one command with an empty compilation cache."""
    command = [sys.executable, str(ROOT / "train.py"), "--env", "antmaze-medium", *flags]
    command += ["--dataset", str(dataset), "--alpha", alpha, "--seed", seed, "--out", str(folder / name)]
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / f"{name}-cache")}
    started = time.perf_counter()
    subprocess.run(command, env=env, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where the JSON goes")
    parser.add_argument("--flags", default="--preset smoke", help="sizes of all commands")
    args = parser.parse_args()
    flags = args.flags.split()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset = folder / "data.hdf5"
        make = [sys.executable, "-m", "qdos_brax", "data", "make", "antmaze-medium", "--out", str(dataset)]
        subprocess.run([*make, "--transitions", "4000"], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        members = list(itertools.product(ALPHAS, SEEDS))
        alone = [seconds(folder, f"{a}-{s}", flags, dataset, a, s) for a, s in members[:5]]
        together = seconds(folder, "scan", flags, dataset, ",".join(ALPHAS), ",".join(SEEDS))
        alone += [seconds(folder, f"{a}-{s}", flags, dataset, a, s) for a, s in members[5:]]
    result = {
        "flags": args.flags,
        "one command": round(together, 1),
        "nine commands": [round(value, 1) for value in alone],
        "ratio": round(together / sum(alone), 3),
        "target": TARGET,
        "load average at the end": os.getloadavg(),
    }
    args.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
