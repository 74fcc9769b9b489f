"""Several methods in one command: one after another, each in its run folder, resumed after a kill."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest

from qdos_brax import experiment
from qdos_brax.analysis import inside
from qdos_brax.commands import train as train_command
from qdos_brax.config.task import make_task
from qdos_brax.errors import UserError
from qdos_brax.population import memory
from qdos_brax.runs import comparison
from tests.runs import toy

ROOT = Path(__file__).parents[1]
SEEDS = "0,1,2,7"  # as many members as the toy has


class DyingPhase(toy.ToyPhase):
    """Ends the program in its third chunk of the online phase, as a kill would: nothing is saved."""

    def chunk(self, state: toy.ToyState, constants: None) -> tuple[toy.ToyState, dict[str, Any]]:
        if self.name == "online" and self.chunks_run == 2:
            raise MemoryError("killed")
        return super().chunk(state, constants)


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Toys in place of the phases; the methods whose phases were built, in order. "supe" dies the first time."""
    data = tmp_path / "data.hdf5"
    data.write_bytes(b"the same for all")
    built: list[str] = []

    def phases(context: Any) -> list[toy.ToyPhase]:
        config = context.config
        built.append(config.method)
        kind = DyingPhase if config.out.endswith("killed/supe") and built.count("supe") == 1 else toy.ToyPhase
        return [kind(phase.name, phase.num_chunks) for phase in toy.phases()]

    monkeypatch.setattr(experiment, "_data_file", lambda config, env: (data, None))
    monkeypatch.setattr(experiment.formats, "read", lambda path, env: SimpleNamespace(notes=(), mismatch=""))
    context = lambda config, env, dataset: SimpleNamespace(config=config, data=None)  # noqa: E731
    monkeypatch.setattr(experiment, "build_context", context)
    monkeypatch.setattr(experiment, "build_phases", phases)
    monkeypatch.setattr(experiment, "bind_phases", lambda *args: None)
    monkeypatch.setattr(
        experiment, "plan_members", lambda *args: memory.MemoryPlan((jax.local_devices()[0],), 1, False, "toys")
    )
    monkeypatch.setattr(inside, "look_inside", lambda *args: None)  # toys have nothing inside
    monkeypatch.setattr(experiment.jax, "clear_caches", lambda: None)  # the other tests' programs are theirs
    return built


def test_killed_comparison_goes_on_exactly(
    tmp_path: Path, built: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert train(f"{command()} --out {whole}") == 0
    assert built == ["qdos", "supe"]
    out = capsys.readouterr().out
    assert "Table 1." in out and "Table 2." in out and "P(better than supe)" in out
    assert out.strip().splitlines()[-2:] == [f"report    {whole}/report.html", f"curves    {whole}/curves.png"]

    built.clear()
    with pytest.raises(MemoryError):
        train(f"{command()} --out {killed}")
    first = (killed / "qdos" / "metrics.csv").read_bytes()
    assert not (killed / "supe" / "summary.json").exists() and not (killed / "report.html").exists()
    assert train(f"--resume {killed}") == 0
    assert built == ["qdos", "supe", "supe"]  # what had ended was not run again
    assert (killed / "qdos" / "metrics.csv").read_bytes() == first
    for method in ("qdos", "supe"):
        assert rows(killed / method) == rows(whole / method)
        a, b = (json.loads((path / method / "summary.json").read_text()) for path in (killed, whole))
        assert a["members"] == b["members"] and a["method"] == method
    for name in ("table1.csv", "table2.csv"):
        assert (killed / name).read_text() == (whole / name).read_text()
    capsys.readouterr()
    assert train(f"--resume {whole}") == 0 and built == ["qdos", "supe", "supe"]
    assert capsys.readouterr().out.count("has finished already") == 2


def test_alpha_is_not_scanned_where_it_weighs_nothing(tmp_path: Path, built: list[str]) -> None:
    flags = shlex.split(f"{command()} --alpha 0.1,0.3")
    configs = train_command.configs_from_args(train_command.train_parser().parse_args(flags))
    env = make_task(configs["qdos"].env, "mujoco")
    alphas = [experiment._resolved(config, env, tmp_path).skills.alpha for config in configs.values()]
    assert alphas == [(0.1, 0.3), 0.0]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--method qdos,qdso", "there is no method 'qdso', did you mean 'qdos'?"),
        ("--method qdos,qdos", "--method holds 'qdos' twice"),
        ("--method qdos,", "there is no method ''"),
        ("--method qdos,supe --set method=supe", "--set method comes too late"),
        ("--method qdos,supe --out {tmp}/full", "is not empty"),
        ("--method qdos,supe --out {tmp}/file", "cannot write"),
    ],
)
def test_nothing_starts_on_a_wrong_flag(
    flags: str, message: str, tmp_path: Path, built: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    assert train(f"--env antmaze-medium --preset smoke {flags.format(tmp=tmp_path)}") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert sorted(tmp_path.rglob("*")) == before and not built


def test_second_process_is_refused(tmp_path: Path, built: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    comparison.create(tmp_path / "c", {"qdos": "env: antmaze-medium-task1\n", "supe": "env: antmaze-medium-task1\n"})
    with experiment.RunFolder(tmp_path / "c").held():
        assert train(f"--resume {tmp_path}/c") == 2
    assert "another process works in" in capsys.readouterr().err and not built


def test_comparison_is_not_made_twice_nor_read_when_damaged(tmp_path: Path) -> None:
    path = tmp_path / "c"
    comparison.create(path, {"qdos": "env: antmaze-medium-task1\n"})
    assert list(comparison.runs(path)) == ["qdos"]
    with pytest.raises(UserError, match="holds a comparison already; continue with --resume"):
        comparison.create(path, {"qdos": ""})
    (path / "comparison.json").write_text('{"methods"')
    with pytest.raises(UserError, match="cannot read"):
        comparison.runs(path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_kill_9_of_a_real_comparison(tmp_path: Path) -> None:
    flags = shlex.split("--env antmaze-medium --preset smoke --method qdos,supe --seed 0,1")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert launch(*flags, "--out", str(whole)).wait(1700) == 0
    process = launch(*flags, "--out", str(killed), "--set", "run.checkpoint_seconds=0")
    while not (killed / "supe" / "metrics.csv").exists() or len(rows(killed / "supe")) < 4:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "supe" / "summary.json").exists()
    assert launch("--resume", str(killed)).wait(1700) == 0
    for method in ("qdos", "supe"):
        assert rows(killed / method) == rows(whole / method)
    assert (killed / "table1.csv").read_text() == (whole / "table1.csv").read_text()
    assert (killed / "report.html").exists()


def command() -> str:
    return f"--env antmaze-medium --preset smoke --method qdos,supe --seed {SEEDS}"


def train(command: str) -> int:
    try:
        return train_command.train_main(shlex.split(command))
    except SystemExit as stop:
        return int(stop.code or 0)


def launch(*arguments: str) -> subprocess.Popen[bytes]:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], env=env)


def rows(path: Path) -> list[dict[str, str]]:
    """metrics.csv without the one column that measures time."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]
