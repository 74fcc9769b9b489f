"""A sweep on Optuna: every trial is one ``train.py`` with one setting and all its seeds; those behind are pruned.

    pip install -c constraints.txt -e ".[sweeps]"
    python benchmarks/sweeps/optuna_tpe.py --out runs/sweep --set "skills.alpha=uniform(0,0.5)" \
        --set "skills.kl_weight=loguniform(0.02,0.5)" --trials 20 --env antmaze-large --seed 0,1,2,3

Flags that this script does not know (here --env and --seed) are passed on to train.py. After every evaluation of a
trial Optuna hears its success, the mean over the seeds, and stops the trial if it is behind the median of the others at
as many steps; it then saves and ends. Settings are proposed by Optuna's default, TPE. The study lies in OUT/study.db
(SQLite; ``optuna-dashboard sqlite:///OUT/study.db`` shows it). One process runs the trials one after another: on Ctrl-C
or SIGTERM the trial under way saves and ends, and the same command goes on with it where it was. When all are over:

    python -m qdos_brax report $(dirname runs/sweep/trials/*/summary.json) --out runs/sweep/report

(pruned trials have no summary.json, and no place in a report).
"""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.sweeps.ray_tune import (
    Run,
    check,
    print_report_command,
    same_as_before,
    searched,
    settings,
    sweep_parser,
)
from qdos_brax.commands.arguments import positive
from qdos_brax.errors import UserError, guarded

Space = Mapping[str, tuple[str, float, float] | list[str]]
_FOLDER, _STOPPED = "folder", "stopped"  # Optuna's attributes of a trial: of its run, and whether it was interrupted


def main() -> int:
    """Run the command line; return 0 if all trials ended."""
    parser = sweep_parser("optuna_tpe.py", __doc__, "Optuna chooses: a list, uniform(a,b) or loguniform(a,b)")
    parser.add_argument("--trials", metavar="N", type=positive, default=20, help="how many (default 20)")
    parser.add_argument("--startup", metavar="N", type=positive, default=5, help="trials that none is pruned before")
    parser.add_argument(
        "--sampler-seed", metavar="S", type=positive, default=1, help="seed of the proposals (default 1)"
    )
    args, flags = parser.parse_known_args()
    try:
        space = searched(args.set)
        check(flags, space)
        same_as_before(args.out.resolve() / "sweep.json", {"set": args.set, "flags": list(flags)})
        return sweep(args.out.resolve(), space, flags, args.trials, args.startup, args.sampler_seed)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        return 130


def sweep(out: Path, space: Space, flags: Sequence[str], trials: int, startup: int, sampler_seed: int) -> int:
    """Run trials until ``trials`` have ended or were pruned; return the exit code."""
    try:
        import optuna
    except ImportError as error:
        raise UserError('Optuna is not installed; install it with: pip install -e ".[sweeps]"') from error
    signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))  # which Optuna passes on
    study = optuna.create_study(
        study_name=out.name,
        storage=f"sqlite:///{out}/study.db",
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=sampler_seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=startup),
        load_if_exists=True,
    )
    put_back(study)
    over = sum(trial.state.is_finished() for trial in last_of_each(study))
    study.optimize(lambda trial: play(trial, out, space, flags), n_trials=max(0, trials - over), catch=RuntimeError)
    for trial in last_of_each(study):
        value = math.nan if trial.value is None else trial.value
        name, chosen = trial.user_attrs[_FOLDER], " ".join(settings(trial.params)[1::2])
        print(f"{name}: {chosen}, {trial.state.name.lower()}, success {value:.2f}")
    print_report_command(out)
    return 0


def put_back(study: Any) -> None:
    """Queue trials again that were stopped, or whose process was killed, with the folders of their runs."""
    from optuna.trial import TrialState

    for trial in last_of_each(study):
        if was_stopped(trial) or trial.state == TrialState.RUNNING:
            study.enqueue_trial(trial.params, user_attrs={_FOLDER: trial.user_attrs[_FOLDER]})
        if trial.state == TrialState.RUNNING:
            study.tell(trial.number, state=TrialState.FAIL)


def last_of_each(study: Any) -> list[Any]:
    """Return Optuna's last trial of each run: one that was put back is another trial of the same run."""
    begun = [trial for trial in study.trials if _FOLDER in trial.user_attrs]
    return list({trial.user_attrs[_FOLDER]: trial for trial in begun}.values())


def was_stopped(trial: Any) -> bool:
    """Return whether a trial was interrupted, which Optuna counts as a failure; its run was saved."""
    return bool(trial.user_attrs.get(_STOPPED))


def play(trial: Any, out: Path, space: Space, flags: Sequence[str]) -> float:
    """Run a trial to its end, or until it is pruned; return its last success.

    Raises:
        optuna.TrialPruned: it was behind the others at as many steps; its run was stopped and saved.
    """
    import optuna

    chosen = {key: suggested(trial, key, values) for key, values in space.items()}
    name = trial.user_attrs.get(_FOLDER, f"trial-{trial.number:03d}")
    trial.set_user_attr(_FOLDER, name)
    run = Run(out / "trials" / name, [*flags, *settings(chosen)], os.getcwd())
    try:
        reported = -1
        while True:
            result = run.step()
            if result["steps"] > reported and not math.isnan(result["success"]):
                reported = result["steps"]
                trial.report(result["success"], reported)
                if not result["done"] and trial.should_prune():
                    raise optuna.TrialPruned
            if result["done"]:
                return float(result["success"])
    except KeyboardInterrupt:
        trial.set_user_attr(_STOPPED, True)
        raise
    finally:
        run.stop()


def suggested(trial: Any, key: str, values: tuple[str, float, float] | list[str]) -> Any:
    """Return what Optuna proposes for a key: a number of a distribution, or a text of a list."""
    if isinstance(values, list):
        return trial.suggest_categorical(key, values)
    name, low, high = values
    return trial.suggest_float(key, low, high, log=name == "loguniform")


if __name__ == "__main__":
    sys.exit(guarded(main))
