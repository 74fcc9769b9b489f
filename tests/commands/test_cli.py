"""The command lines: help for every flag, and one clear line with exit code 2 for what is wrong."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import envs
from qdos_brax.commands.main import main
from qdos_brax.commands.train import configs_from_args, train_main, train_parser
from tests.runs import toy

pytestmark = pytest.mark.quick


def run(command: str, train: bool = True) -> int:
    try:
        return (train_main if train else main)(shlex.split(command))
    except SystemExit as stop:
        return int(stop.code or 0)


def test_every_flag_of_the_contract_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    for flag in ("--env", "--alpha", "--seed", "--method", "--preset", "--out", "--resume", "--dataset", "--physics"):
        assert f"{flag} " in text
    for flag in ("--steps", "--pretrain-steps", "--set"):
        assert f"{flag} " in text
    for action in train_parser()._actions:
        assert action.help
    assert text.index("examples:") < text.index("  --env TASK ") and len(text.splitlines()) < 60


@pytest.mark.parametrize("call", ["train.train_parser()", "main.main_parser([])"])
def test_help_waits_for_no_jax(call: str) -> None:
    """It must answer at once; importing jax takes seconds."""
    module = f"qdos_brax.commands.{call.split('.')[0]}"
    code = f"import sys, {module}; qdos_brax.commands.{call}.format_help(); sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "give a task with --env"),
        ("--alhpa 0.3", "did you mean '--alpha'"),
        ("--alph 0.3", "did you mean '--alpha'"),
        ("--env", "expected one argument"),
        ("--resume x --env antmaze", "leave out --env"),
        ("--resume /nowhere", "not a run folder"),
        ("--env antmaze --preset cpu --alpha x", "skills.alpha must be a number"),
        ("--env antmaze --preset cpu --seed 1.5", "seed must be a whole number"),
        ("--env antmaze --preset cpu --steps 0", "high_level.env_steps must be at least 1"),
        ("--env antmaze --preset cpu --physics mujco", "did you mean 'mujoco'"),
        ("--env antmaze --preset cpu --method qdso", "did you mean 'qdos'"),
        ("--env cube-tripple", "no task 'cube-tripple'; did you mean"),
        ("--env antmaze-huge --preset cpu", "no task 'antmaze-huge'; did you mean"),
        ("--env antmaze --preset cpu --dataset /nowhere.npz --out {tmp}/run", "/nowhere.npz: no such file"),
    ],
)
def test_wrong_flags_are_one_line(
    command: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command.format(tmp=tmp_path)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]


def test_flags_reach_the_configuration() -> None:
    flags = "--env antsoccer --alpha 0.1,0.3 --seed 0,1 --method supe --preset smoke --physics mujoco --out o"
    more = "--dataset d.npz --steps 4000 --pretrain-steps 70 --set skills.kl_weight=0.2 --set eval.episodes=3"
    (config,) = configs_from_args(train_parser().parse_args(shlex.split(f"{flags} {more}"))).values()
    assert (config.env, config.method, config.preset, config.physics) == ("antsoccer", "supe", "smoke", "mujoco")
    assert (config.out, config.dataset, config.seed) == ("o", "d.npz", (0, 1))
    assert config.skills.alpha == (0.1, 0.3) and config.skills.kl_weight == 0.2
    assert (config.high_level.env_steps, config.eval.episodes) == (4000, 3)
    assert config.values.updates == config.skills.updates == 70
    assert config.policy.updates == config.guide.updates == config.hilbert.updates == config.diveoff.updates == 70


def test_tasks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("tasks", train=False) == 0
    header, *lines, blank, note = capsys.readouterr().out.splitlines()
    assert blank == "" and "doctor" in note
    assert header.split() == ["task", "observation", "action", "cap", "engines", "variants", "default", "alias"]
    rows = dict(" ".join(line.split()).split(" ", 1) for line in lines)
    assert set(rows) == {spec.name for spec in envs.list_tasks()} and len(lines) == len(rows)
    assert rows["antsoccer-arena"] == "42 8 1000 mujoco, mjx, mjx-warp task1 to task5 task4 antsoccer (task1)"
    assert rows["humanoidmaze-giant"].startswith("69 21 4000 mujoco, mjx, mjx-warp ") and rows[
        "humanoidmaze-giant"
    ].endswith("task1")


def test_report_draws_a_picture(tmp_path: Path) -> None:
    toy.run(tmp_path / "run")
    assert run(f"report {tmp_path}/run", train=False) == 0
    assert (tmp_path / "run" / "curves.png").exists()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "COMMAND"),
        ("evalute x", "invalid choice"),
        ("evaluate x --episods 3", "did you mean '--episodes'"),
        ("evaluate x --episodes 0", "whole number from 1"),
        ("evaluate /nowhere", "not a run folder"),
        ("report /nowhere", "not a run folder"),
    ],
)
def test_wrong_commands_are_one_line(command: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command, train=False) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]
