"""A sweep on Ray Tune: what a trial runs and reports; and, where Ray is installed, a whole sweep."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.sweeps import ray_tune
from qdos_brax.errors import UserError
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import read_rows

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "benchmarks" / "sweeps" / "ray_tune.py"
HEAD = "member,seed,alpha,phase,env_steps,update,eval/success,sps\n"


def test_a_trial_is_a_new_run_and_goes_on_where_it_has_begun(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "a1b2_00000")
    flags = ["--env", "antmaze-large", *ray_tune.settings({"skills.alpha": 0.1234567, "skills.horizon": "20"})]
    new = ray_tune.command(folder, flags)
    assert new[1:] == [str(ROOT / "train.py"), *flags, "--out", str(folder.path)]
    assert flags[2:] == ["--set", "skills.alpha=0.123457", "--set", "skills.horizon=20"]
    folder.path.mkdir()
    folder.config.touch()  # it was killed before it began to train; train.py takes such a folder as new
    assert ray_tune.command(folder, flags) == new
    folder.metrics.touch()
    assert ray_tune.command(folder, flags)[2:] == ["--resume", str(folder.path)]


def test_the_score_is_the_mean_over_members_of_the_last_evaluation(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert ray_tune.score(folder)[0] == 0 and math.isnan(ray_tune.score(folder)[1])
    rows = ["0,0,0.1,skills,,50,,", "1,1,0.1,skills,,50,,"]
    folder.metrics.write_text(HEAD + "\n".join(rows) + "\n")
    assert ray_tune.score(folder)[0] == 0 and math.isnan(ray_tune.score(folder)[1])
    for steps, first, second in ((1000, 1.0, 0.0), (1500, "", ""), (2000, 0.5, 1.0)):
        rows += [f"0,0,0.1,online,{steps},9,{first},", f"1,1,0.1,online,{steps},9,{second},"]
    folder.metrics.write_text(HEAD + "\n".join(rows[:-2]) + "\n")
    assert ray_tune.score(folder) == (1000, 0.5)
    folder.metrics.write_text(HEAD + "\n".join(rows) + "\n")
    assert ray_tune.score(folder) == (2000, 0.75)


@pytest.mark.parametrize(
    ("flags", "space", "line"),
    [
        ("--env antmaze-medium", ["skills.alfa=1"], "did you mean 'skills.alpha'"),
        ("--env antmaze-medium", ["skills.alpha=0.1,x"], "'x'"),
        ("--env antmaze-medium", ["skills.alpha=normal(0,1)"], "no distribution 'normal'"),
        ("--env antmaze-medium", ["skills.alpha="], "give KEY=VALUE"),
        ("--env antmaze-medium", ["skills.alpha=1", "skills.alpha=2"], "twice"),
        ("--env antmaze-medium --method qdos,supe", ["skills.alpha=1"], "one program"),
        ("--env antmaze-medium --out runs/x", ["skills.alpha=1"], "a folder and a process of its own"),
        ("--seed 1", ["skills.alpha=1"], "--env"),
    ],
)
def test_what_train_would_refuse_is_refused_before_a_trial_starts(flags: str, space: list[str], line: str) -> None:
    with pytest.raises(UserError, match=line):
        ray_tune.check(flags.split(), ray_tune.searched(space))


def test_a_failed_run_is_told_with_its_last_line(tmp_path: Path) -> None:
    run = ray_tune.Run(tmp_path / "trials" / "x", ["--env", "antmaze-medium", "--seed", "x"], str(tmp_path))
    with pytest.raises(RuntimeError, match=r"code 2: error: seed .*'x'"):
        while True:
            run.step()


def test_a_sweep_of_other_settings_is_refused(tmp_path: Path) -> None:
    path, asked = tmp_path / "new" / "sweep.json", {"set": ["skills.alpha=1"], "samples": 1, "flags": []}
    ray_tune.same_as_before(path, asked)
    ray_tune.same_as_before(path, asked)
    with pytest.raises(UserError, match="of other settings"):
        ray_tune.same_as_before(path, asked | {"samples": 2})


def test_the_printed_report_is_of_the_trials_that_finished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside their folders lie logs, and stopped trials have no summary: the command would refuse both."""
    ray_tune.print_report_command(tmp_path)
    assert capsys.readouterr().out == ""
    for name in ("a", "b", "stopped"):
        (tmp_path / "trials" / name).mkdir(parents=True)
        (tmp_path / "trials" / f"{name}.log").touch()
    for name in ("a", "b"):
        (tmp_path / "trials" / name / "summary.json").touch()
    ray_tune.print_report_command(tmp_path)
    trials, out = f"{tmp_path}/trials", f"{tmp_path}/report"
    assert capsys.readouterr().out == f"report    python -m qdos_brax report {trials}/a {trials}/b --out {out}\n"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_sweep_is_stopped_and_gone_on_with(tmp_path: Path) -> None:
    """Two trials on local Ray: SIGTERM while they train, the same command again, and every trial has ended."""
    pytest.importorskip("ray.tune")
    out = tmp_path / "sweep"
    flags = f"--out {out} --set skills.alpha=0.1,0.3 --cpus 1 --env antmaze-medium --preset smoke --seed 0,1"
    command = [sys.executable, str(SCRIPT), *flags.split(), "--set", "run.checkpoint_seconds=0"]
    env = {**os.environ, "QDOS_DATA": str(tmp_path / "data"), "PYTHONPATH": str(ROOT)}
    first = subprocess.Popen(command, env=env)
    while not (saved := list(out.glob("trials/*/checkpoints/*"))):
        assert first.poll() is None
        time.sleep(0.5)
    first.terminate()  # as Ctrl-C does, which Tune hears of the same way
    assert first.wait(600) == 1
    begun = {path.parents[1] for path in saved}
    deadline = time.monotonic() + 300  # for the chunk under way, which is being compiled
    while not all("stopped and saved" in path.with_name(f"{path.name}.log").read_text() for path in begun):
        assert time.monotonic() < deadline
        time.sleep(0.5)
    assert not any((path / "summary.json").exists() for path in begun)
    again = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    trials = sorted(path for path in (out / "trials").iterdir() if path.is_dir())
    assert len(trials) == 2 and begun <= set(trials)
    found = {}
    for trial in trials:
        summary = json.loads((trial / "summary.json").read_text())
        found[summary["members"][0]["alpha"]] = [member["eval_success"] for member in summary["members"]]
        assert [member["seed"] for member in summary["members"]] == [0, 1]
        assert {row["phase"] for row in read_rows(trial / "metrics.csv")} >= {"values", "skills", "online"}
    assert sorted(found) == [0.1, 0.3]
    for alpha, successes in found.items():
        assert f"skills.alpha={alpha} run.checkpoint_seconds=0, success {sum(successes) / 2:.2f}" in again.stdout
