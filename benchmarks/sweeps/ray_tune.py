"""A sweep larger than one job, on Ray Tune: every trial is one ``train.py`` with one setting and all its seeds.

    pip install "ray[tune]"
    python benchmarks/sweeps/ray_tune.py --out runs/sweep --set skills.alpha=0.1,0.3 \
        --set "skills.kl_weight=loguniform(0.02,0.5)" --samples 8 --gpus 1 --stop-early 20000 \
        --env antmaze-large --seed 0,1,2,3

runs 16 trials: 8 for every alpha, each with a KL weight of its own. Flags that this script does not know (here --env
and --seed) are passed on to train.py. Ray starts as many trials at once as the machine, or the cluster that RAY_ADDRESS
names, has room for; on a cluster this checkout and --out must be on a disk that all nodes share. The seeds of a trial
train together as one program.

While a trial runs, it reports the success of the last evaluation, the mean over the seeds, to Ray. With --stop-early
Ray stops trials that are behind (ASHA). A trial that is stopped gets SIGTERM, saves and ends; so do all on Ctrl-C or
SIGTERM. The same command again continues unfinished trials exactly where they were. (If you started a cluster by hand,
set RAY_kill_child_processes_on_worker_exit=0 for ``ray start``: otherwise Ray kills a trial that takes more than 10
seconds to save, which loses the work since the last checkpoint.) When all have finished:

    python -m qdos_brax report $(dirname runs/sweep/trials/*/summary.json) --out runs/sweep/report

(stopped trials have no summary.json, and no place in a report).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from qdos_brax.commands.arguments import Parser, positive
from qdos_brax.commands.train import configs_from_args, train_parser
from qdos_brax.config.scan import distribution
from qdos_brax.errors import UserError, guarded
from qdos_brax.files import user_errors, write_text
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import read_rows, step_of

TRAIN = Path(__file__).resolve().parents[2] / "train.py"
_POLL = 0.5
_HEARTBEAT = 5.0  # seconds between two reports to Ray, which cannot stop a trial while it waits for one
_ENDLESS = 10**12  # environment steps; train.py sets the length of a trial
_RETRIES = 2  # for a trial whose machine was lost


class Run:
    """Start, watch and stop one ``train.py`` in a folder of its own, for Ray's worker.

    Args:
        folder: the run folder; if it holds a run already, that run is continued.
        flags: flags of train.py for a new run.
        cwd: folder that relative paths among the flags refer to.
    """

    def __init__(self, folder: Path, flags: Sequence[str], cwd: str) -> None:
        self.folder = RunFolder(folder)
        self.log = folder.with_name(f"{folder.name}.log")  # beside it, since a new run needs an empty folder
        folder.parent.mkdir(parents=True, exist_ok=True)
        while folder.exists() and self.folder.is_held():  # by the run of a worker that was lost, which continues alone
            time.sleep(_POLL)
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command(self.folder, flags), cwd=cwd, stdout=log, stderr=log, start_new_session=True
            )

    def step(self) -> dict[str, Any]:
        """Wait for an evaluation, the end, or the heartbeat; return what is new.

        Returns:
            "steps" and "success" of the last evaluation (0 and nan before the first), "done".

        Raises:
            RuntimeError: train.py failed; its last line is the message.
        """
        known, deadline = score(self.folder), time.monotonic() + _HEARTBEAT
        while (code := self.process.poll()) is None and time.monotonic() < deadline and score(self.folder) == known:
            time.sleep(_POLL)
        if code:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
            raise RuntimeError(f"train.py ended with code {code}: {lines[-1] if lines else 'it printed nothing'}")
        steps, success = score(self.folder)
        return {"steps": steps, "success": success, "done": code == 0}

    def stop(self) -> None:
        """Stop train.py, which saves first."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait()


def command(folder: RunFolder, flags: Sequence[str]) -> list[str]:
    """Return the command of a trial: a new run in the folder, or the run that it holds."""
    begun = folder.metrics.exists()
    return [sys.executable, str(TRAIN), *(["--resume"] if begun else [*flags, "--out"]), str(folder.path)]


def score(folder: RunFolder) -> tuple[int, float]:
    """Return (steps, success) of the last evaluation: environment steps, and the mean over the members, 0..1.

    Steps are updates if the method learns from the data alone. Before the first evaluation they are (0, nan).
    """
    if not folder.metrics.exists():
        return 0, math.nan
    evaluated = [row for row in read_rows(folder.metrics) if row.get("eval/success")]
    if not evaluated:
        return 0, math.nan
    last = step_of(evaluated[-1])
    values = [float(row["eval/success"]) for row in evaluated if step_of(row) == last]
    return last, sum(values) / len(values)


def settings(chosen: Mapping[str, Any]) -> list[str]:
    """Return the flags for the values that Ray chose; numbers have six digits, as in a table."""
    texts = {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in chosen.items()}
    return [part for key, text in texts.items() for part in ("--set", f"{key}={text}")]


def searched(assignments: Sequence[str]) -> dict[str, tuple[str, float, float] | list[str]]:
    """Return what Ray chooses from, by dotted key: (name, low, high) of a distribution, or a list.

    Raises:
        UserError: one is no assignment, or a key appears twice.
    """
    found: dict[str, tuple[str, float, float] | list[str]] = {}
    for assignment in assignments:
        key, _, text = (part.strip() for part in assignment.partition("="))
        if not text:
            raise UserError(f"--set {assignment}: give KEY=VALUE[,VALUE..] or KEY=loguniform(a,b)")
        if key in found:
            raise UserError(f"--set holds {key} twice; give its values as one list")
        found[key] = distribution(key, text) or [value.strip() for value in text.split(",")]
    return found


def check(flags: Sequence[str], space: Mapping[str, tuple[str, float, float] | list[str]]) -> None:
    """Read the flags and every value as train.py will, before any trial starts.

    Raises:
        UserError: train.py would refuse them, or the flags name a folder or ask for more than one program.
    """
    parser = train_parser()
    args = parser.parse_args(list(flags))
    if args.env is None:
        raise UserError("give a task with --env")
    for name in ("out", "resume", "distributed"):
        if getattr(args, name):
            raise UserError(f"--{name} is not for a trial: each has a folder and a process of its own")
    args.preset = args.preset or "cpu"  # the default depends on this machine's devices, and trials may run on others
    given = args.set
    for key, values in space.items():
        for value in values[1:] if isinstance(values, tuple) else values:
            args.set = [*given, *settings({key: value})[1:]]
            if len(configs_from_args(args)) > 1:
                raise UserError("a trial is one program; give one method, and lists of sizes with this script's --set")


def sweep_parser(prog: str, description: str | None, chosen: str) -> Parser:
    """Return a parser of what every sweep is told; ``chosen`` says who chooses the keys of --set, and from what."""
    parser = Parser(prog=prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweep")
    help_text = f"a key of the configuration that {chosen}"
    parser.add_argument("--set", metavar="KEY=VALUES", action="append", required=True, help=help_text)
    return parser


def main() -> int:
    """Run the command line; return 0 if all trials finished."""
    chosen = "Ray chooses: a list, each value tried, or uniform(a,b), loguniform(a,b)"
    parser = sweep_parser("ray_tune.py", __doc__, chosen)
    parser.add_argument(
        "--samples", metavar="N", type=positive, default=1, help="draws per combination of the lists (default 1)"
    )
    parser.add_argument("--cpus", type=float, default=2, help="CPUs that Ray reserves for a trial (default 2)")
    parser.add_argument("--gpus", type=float, default=0, help="GPUs of a trial (default 0)")
    parser.add_argument(
        "--stop-early", metavar="STEPS", type=positive, help="stop trials that are behind, from STEPS on"
    )
    args, flags = parser.parse_known_args()
    space = searched(args.set)
    check(flags, space)
    return sweep(args, flags, space)


def sweep(
    args: argparse.Namespace, flags: Sequence[str], space: Mapping[str, tuple[str, float, float] | list[str]]
) -> int:
    """Run the trials, or continue the unfinished ones; return the exit code."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # send nothing to Ray's developers
    os.environ.setdefault("TUNE_DISABLE_AUTO_CALLBACK_LOGGERS", "1")  # train.py writes TensorBoard's files and CSVs
    # Ray waits 10 seconds for those it stops at the end; a run whose worker is gone by then still saves.
    os.environ.setdefault("RAY_kill_child_processes_on_worker_exit", "0")
    try:
        import ray
        from ray import tune
        from ray.tune.logger import JsonLoggerCallback
        from ray.tune.schedulers import ASHAScheduler
    except ImportError as error:
        raise UserError('Ray Tune is not installed; install it with: pip install "ray[tune]"') from error
    out = args.out.resolve()
    same_as_before(out / "sweep.json", {"set": args.set, "samples": args.samples, "flags": list(flags)})
    cwd = os.getcwd()
    ray.init()
    signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))  # Tune handles that one

    class Trial(tune.Trainable):
        """Show a run to Ray."""

        def setup(self, config: dict[str, Any]) -> None:
            self._run = Run(out / "trials" / self.trial_id, [*flags, *settings(config)], cwd)

        def step(self) -> dict[str, Any]:
            return self._run.step()

        def cleanup(self) -> None:
            self._run.stop()

    trainable = tune.with_resources(Trial, {"cpu": args.cpus, "gpu": args.gpus})
    state = str(out / "ray")
    if tune.Tuner.can_restore(state):
        tuner = tune.Tuner.restore(state, trainable, restart_errored=True)
    else:
        early = args.stop_early and ASHAScheduler(time_attr="steps", grace_period=args.stop_early, max_t=_ENDLESS)
        tuner = tune.Tuner(
            trainable,
            param_space={
                key: tune.grid_search(values) if isinstance(values, list) else getattr(tune, values[0])(*values[1:])
                for key, values in space.items()
            },
            tune_config=tune.TuneConfig(
                metric="success", mode="max", num_samples=args.samples, scheduler=early or None
            ),
            run_config=tune.RunConfig(
                name="ray",
                storage_path=str(out),
                callbacks=[JsonLoggerCallback()],
                failure_config=tune.FailureConfig(max_failures=_RETRIES),
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),  # train.py saves, in its own folder
            ),
        )
    results = tuner.fit()
    ended = 0
    for result in results:
        metrics = result.metrics or {}
        how = f"success {metrics.get('success', math.nan):.2f}"
        if result.error:
            how = f"failed: {result.error}"
        elif not metrics.get("done"):
            how += ", not finished; run the same command again to continue"
        else:
            ended += 1
        print(f"{metrics.get('trial_id')}: {' '.join(settings(result.config)[1::2])}, {how}")
    print_report_command(out)
    return 0 if ended == len(results) else 1


def print_report_command(out: Path) -> None:
    """Print the command that makes one report of the trials that have finished, if there are any."""
    finished = [str(path.parent) for path in sorted(out.glob("trials/*/summary.json"))]
    if finished:
        line = shlex.join(["python", "-m", "qdos_brax", "report", *finished, "--out", str(out / "report")])
        print(f"report    {line}", flush=True)


def same_as_before(path: Path, asked: dict[str, Any]) -> None:
    """Write the sweep's settings to a file, or compare them with those in it.

    Raises:
        UserError: the file holds the settings of another sweep.
    """
    if path.exists() and json.loads(path.read_text(encoding="utf-8")) != asked:
        raise UserError(f"{path.parent} holds a sweep of other settings; give those, or choose another --out")
    with user_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(asked, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(guarded(main))
