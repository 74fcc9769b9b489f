"""A sweep on Optuna: which trials are pruned, and that a stopped one goes on; the runs themselves are stand-ins."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from benchmarks.sweeps import optuna_tpe

optuna = pytest.importorskip("optuna")

SPACE: Any = {"skills.alpha": ("uniform", 0.0, 1.0), "skills.horizon": ["10", "20"]}


class StandIn:
    """A run of five evaluations whose success is alpha times the steps; ``interrupt`` ends the first one early."""

    begun: ClassVar[list[tuple[str, list[str]]]] = []
    stopped: ClassVar[list[str]] = []
    interrupt = False

    def __init__(self, folder: Path, flags: list[str], cwd: str) -> None:
        self.folder, self._results = folder, self._evaluations(float(flags[-3].partition("=")[2]))
        StandIn.begun.append((folder.name, flags))

    def _evaluations(self, alpha: float) -> Iterator[dict[str, Any]]:
        yield {"steps": 0, "success": float("nan"), "done": False}
        for step in range(1, 6):
            if StandIn.interrupt and step == 3:
                raise KeyboardInterrupt
            yield {"steps": 1000 * step, "success": alpha * step / 5, "done": step == 5}

    def step(self) -> dict[str, Any]:
        return next(self._results)

    def stop(self) -> None:
        StandIn.stopped.append(self.folder.name)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> type[StandIn]:
    monkeypatch.setattr(optuna_tpe, "Run", StandIn)
    StandIn.begun, StandIn.stopped, StandIn.interrupt = [], [], False
    return StandIn


def trials(out: Path) -> list[Any]:
    return optuna.load_study(study_name=out.name, storage=f"sqlite:///{out}/study.db").trials


def test_trials_behind_the_median_are_pruned_and_stopped(tmp_path: Path, runs: type[StandIn]) -> None:
    assert optuna_tpe.sweep(tmp_path, SPACE, ["--env", "antmaze-medium"], 12, 3, 1) == 0
    found = trials(tmp_path)
    states = [trial.state.name for trial in found]
    assert len(found) == 12 and states[:3] == ["COMPLETE"] * 3 and set(states) == {"COMPLETE", "PRUNED"}
    assert runs.stopped == [name for name, _ in runs.begun] == [f"trial-{n:03d}" for n in range(12)]
    for number, trial in enumerate(found):
        alpha = trial.params["skills.alpha"]
        assert runs.begun[number][1][:3] == ["--env", "antmaze-medium", "--set"]
        assert f"skills.alpha={alpha:.6g}" in runs.begun[number][1]
        before = [other.params["skills.alpha"] for other in found[:number]]
        if trial.state.name == "PRUNED":
            assert alpha < sorted(before)[len(before) // 2] and len(trial.intermediate_values) == 1
        else:
            assert trial.value == pytest.approx(alpha, rel=1e-4) and len(trial.intermediate_values) == 5
    assert optuna_tpe.sweep(tmp_path, SPACE, [], 12, 3, 1) == 0 and len(runs.begun) == 12  # nothing is left to do


def test_a_stopped_trial_goes_on_in_its_folder_with_its_setting(tmp_path: Path, runs: type[StandIn]) -> None:
    runs.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        optuna_tpe.sweep(tmp_path, SPACE, [], 2, 3, 1)
    assert runs.stopped == ["trial-000"]
    runs.interrupt = False
    assert optuna_tpe.sweep(tmp_path, SPACE, [], 2, 3, 1) == 0
    assert [name for name, _ in runs.begun] == ["trial-000", "trial-000", "trial-002"]
    assert runs.begun[0][1] == runs.begun[1][1]
    ended = [trial for trial in trials(tmp_path) if trial.state.name == "COMPLETE"]
    assert len(ended) == 2
