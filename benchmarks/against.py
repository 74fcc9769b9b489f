"""Measure this tree beside another one: ``python benchmarks/against.py OTHER [--jobs smoke ..] [--out FILE]``.

OTHER is a checkout of an older commit (``git worktree add --detach OTHER 08c5c3e``); both run in this Python, each with
compiled programs and data of its own. The jobs:

    smoke   train.py --env antsoccer-arena --alpha 0.3 --preset smoke, everything warm
    cold    the same, with no compiled programs
    scan    nine members of antmaze-medium (three alphas, three seeds), preset smoke, warm
    cpu     train.py --env antmaze-medium --preset cpu, a seed per round from 10 on (settings are chosen on others),
            data there; and the seconds until an evaluation finds a success of 0.5
    steps   environment steps per second inside jit, of 4 and 64 environments of three tasks

Of each job the two trees take turns; what is printed is the median of each, and their ratio. Processor time is that of
the process and its children.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qdos_brax.files import write_text
from qdos_brax.runs.metrics import read_rows

THIS = Path(__file__).resolve().parents[1]
SMOKE = ("--env", "antsoccer-arena", "--alpha", "0.3", "--preset", "smoke")
SCAN = ("--env", "antmaze-medium", "--preset", "smoke", "--alpha", "0.1,0.2,0.3", "--seed", "0,1,2")
CPU = ("--env", "antmaze-medium", "--preset", "cpu")
BATCHES, TASKS = (4, 64), ("antmaze-large", "antsoccer-arena", "humanoidmaze-medium")
# Runs in either tree: what both have in common.
STEPS = """
import sys, time, jax, envs
jax.config.update("jax_cpu_enable_async_dispatch", False)
env, batch = envs.AutoReset(envs.make(sys.argv[1], physics="mujoco")), int(sys.argv[2])
def body(state, key):
    return jax.vmap(env.step)(state, jax.random.uniform(key, (batch, env.action_size), minval=-1.0)), None
run = jax.jit(lambda state, key: jax.lax.scan(body, state, jax.random.split(key, 2000 // batch))[0])
state = run(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch)), jax.random.key(1))
jax.block_until_ready(state)
began = time.perf_counter()
for turn in range(4):
    state = jax.block_until_ready(run(state, jax.random.key(turn)))
print(4 * (2000 // batch) * batch / (time.perf_counter() - began))
"""
Measured = dict[str, float]


class Tree:
    """Run commands in one checkout.

    Args:
        path: of the checkout.
        folder: for its data, its compiled programs and its runs.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self.path, self.folder = path.resolve(), folder
        self.cache = folder / "cache"
        places = {"PYTHONPATH": self.path, "QDOS_DATA": folder / "data", "JAX_COMPILATION_CACHE_DIR": self.cache}
        self._environment = {**os.environ, **{name: str(place) for name, place in places.items()}}

    def run(self, *command: str) -> tuple[Measured, str]:
        """Return (wall and processor seconds, standard output) of a Python command."""
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [sys.executable, *command], cwd=self.path, env=self._environment, check=True, text=True, capture_output=True
        )
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return {"wall_seconds": wall, "cpu_seconds": processor}, done.stdout

    def train(self, *flags: str) -> Measured:
        """Return the seconds of one training and its success after the last evaluation."""
        out = self.folder / "run"
        shutil.rmtree(out, ignore_errors=True)
        found, _ = self.run("train.py", *flags, "--out", str(out))
        members = json.loads((out / "summary.json").read_text(encoding="utf-8"))["members"]
        return found | {"success": statistics.mean(member["eval_success"] for member in members)}

    def learn(self, *flags: str) -> Measured:
        """Return the seconds of one training, those to half of success, and its success in the end."""
        watch = _Watch(self.folder / "run" / "metrics.csv")
        found = self.train(*flags)
        watch.end()
        return found | {"seconds_to_half": watch.seconds_to_half}

    def cold(self) -> Measured:
        """Return the seconds of a training without compiled programs."""
        shutil.rmtree(self.cache, ignore_errors=True)
        return self.train(*SMOKE)

    def steps(self, task: str, batch: int) -> Measured:
        """Return environment steps per second inside jit."""
        return {"steps_per_second": float(self.run("-c", STEPS, task, str(batch))[1])}


class _Watch(threading.Thread):
    """Look at a run's metrics once a second, until an evaluation has a success of 0.5.

    Attributes:
        seconds_to_half: from the watch's start; infinite until then.
    """

    def __init__(self, metrics: Path) -> None:
        super().__init__(daemon=True)
        metrics.unlink(missing_ok=True)  # of the run before
        self._metrics, self._over, self._began = metrics, threading.Event(), time.perf_counter()
        self.seconds_to_half = math.inf
        self.start()

    def run(self) -> None:
        while math.isinf(self.seconds_to_half) and not self._over.wait(1.0):
            rows = read_rows(self._metrics) if self._metrics.exists() else []
            if any(float(row["eval/success"] or 0) >= 0.5 for row in rows):
                self.seconds_to_half = time.perf_counter() - self._began

    def end(self) -> None:
        """Stop looking."""
        self._over.set()
        self.join()


# What each tree does once, unmeasured, before the rounds: data, and programs where the job is to find them.
WARM_UP: dict[str, Callable[[Tree], Measured]] = {
    "smoke": lambda tree: tree.train(*SMOKE),
    "cold": lambda tree: tree.train(*SMOKE),
    "scan": lambda tree: tree.train(*SCAN),
    "cpu": lambda tree: tree.train(*CPU, "--steps", "80", "--pretrain-steps", "1"),
}
JOBS: dict[str, Callable[[Tree, int], Measured]] = {
    "smoke": lambda tree, turn: tree.train(*SMOKE),
    "cold": lambda tree, turn: tree.cold(),
    "scan": lambda tree, turn: tree.train(*SCAN),
    "cpu": lambda tree, turn: tree.learn(*CPU, "--seed", str(10 + turn)),
}
STEP_JOBS: dict[str, Callable[[Tree, int], Measured]] = {
    f"steps {task} x {batch}": lambda tree, turn, task=task, batch=batch: tree.steps(task, batch)
    for task in TASKS
    for batch in BATCHES
}


def compare(job: Callable[[Tree, int], Measured], trees: list[Tree], rounds: int) -> dict[str, Any]:
    """Return every measurement of [this tree, the other], their medians, and the ratio of the medians."""
    measured: list[list[Measured]] = [[], []]
    for turn in range(rounds):
        for tree, found in zip(trees, measured, strict=True):
            found.append(job(tree, turn))
    medians = [{key: statistics.median(run[key] for run in runs) for key in runs[0]} for runs in measured]
    ratios = {key: value / medians[1][key] for key, value in medians[0].items() if medians[1][key]}
    return {"ratio": ratios, "this": medians[0], "other": medians[1], "runs": measured}


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("--jobs", nargs="+", default=[*JOBS, "steps"], choices=[*JOBS, "steps"], metavar="JOB")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each (default 5)")
    parser.add_argument("--out", type=Path, help="JSON file; results of other jobs in it are kept")
    args = parser.parse_args()
    known = args.out.exists() if args.out else False
    results = json.loads(args.out.read_text(encoding="utf-8")) if known else {}
    with tempfile.TemporaryDirectory() as name:
        trees = [Tree(path, Path(name) / role) for path, role in ((THIS, "this"), (args.other, "other"))]
        for job in args.jobs:
            for tree in trees if job in WARM_UP else ():
                WARM_UP[job](tree)
            for label, measure in (STEP_JOBS if job == "steps" else {job: JOBS[job]}).items():
                results[label] = compare(measure, trees, args.rounds)
                line = "  ".join(f"{key} {value:.2f}" for key, value in results[label]["ratio"].items())
                print(f"{label:30} {line}", flush=True)
                if args.out:
                    write_text(args.out, json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
