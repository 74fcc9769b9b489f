"""``python -m qdos_brax config``: every key, its meaning, its range, and the layer that set its value."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from qdos_brax.commands.main import main
from qdos_brax.config import Config, default_preset
from qdos_brax.config.schema import groups, leaves

pytestmark = pytest.mark.quick


def shown(command: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert main(["config", *shlex.split(command)]) == 0
    return capsys.readouterr().out.splitlines()


def test_every_key_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown("--preset paper", capsys)
    heads = [line for line in lines if " = " in line and not line.startswith(" ")]
    assert [line.split(" = ")[0] for line in heads] == [key for key, _ in leaves(Config)]
    assert all(line.endswith(")") and "  (set by " in line for line in heads)
    assert [line.split(":")[0] for line in lines if line.startswith("# ")] == [f"# {name}" for name in groups()]
    assert sum(line.startswith("    accepts ") for line in lines) == len(heads)
    assert max(map(len, lines)) <= 120


def test_a_key_shows_every_layer_that_set_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(
        "high_level.discount --env antsoccer --method rlpd --preset cpu --set high_level.discount=0.9", capsys
    ) == [
        "high_level.discount = 0.9  (set by --set)",
        "    discount per macro step",
        "    accepts number, at least 0 and at most 1; a list makes a scan",
        "    0.99 in default",
        "    0.995 in configs/antsoccer.yaml",
        "    0.99 in preset cpu, section families.antsoccer",
        "    0.995 in preset cpu, section families.antsoccer.low_level.action",
        "    0.9 in --set",
    ]


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("skills.alpha --preset paper --env antsoccer", "skills.alpha = 0.3  (set by configs/antsoccer.yaml)"),
        ("skills.alpha --preset paper", "    accepts number, at least 0, or auto; a list makes a scan; flag --alpha"),
        ("skills.alpha --preset paper --set skills.alpha=0.1,0.2", "skills.alpha = 0.1, 0.2  (set by --set)"),
        ("skills.updates --preset paper", "    accepts whole number, at least 1; flag --pretrain-steps"),
        ("skills.updates --preset smoke", "skills.updates = 50  (set by preset smoke)"),
        ("skills.horizon --env humanoidmaze --preset cpu --method bc", "skills.horizon = 1  (set by method bc)"),
        ("skills.horizon --preset cpu --set skills.horizon=4,20", "skills.horizon = 4, 20  (set by --set)"),
        ("values.estimator --preset cpu", "    accepts one of graph, iql"),
        ("values.hidden --preset cpu", "values.hidden = 256, 256  (set by preset cpu)"),
        ("run.wandb --preset cpu", "    accepts true or false"),
        ("dataset --preset cpu", "dataset = none  (set by default)"),
        ("method --preset cpu --method iql", "method = iql  (set by flag)"),
        ("env --preset cpu", "env = antmaze  (set by default)"),
        ("preset", f"preset = {default_preset()}  (set by this machine's default)"),
    ],
)
def test_one_key(command: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in shown(command, capsys)


def test_a_group_shows_its_own_keys_alone(capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown("eval --preset cpu", capsys)
    assert lines[0] == "# eval: Configure the evaluation, which has environments of its own."
    assert [line.split(" = ")[0] for line in lines if " = " in line] == ["eval.episodes", "eval.every_env_steps"]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("skils --preset cpu", "there is no key 'skils', did you mean 'skills'?"),
        ("alpha --preset cpu", "did you mean 'skills.alpha'?"),
        ("skills.alhpa --preset cpu", "did you mean 'skills.alpha'?"),
        ("--env cube-tripple --preset cpu", "there is no task 'cube-tripple'"),
        ("--method nosuch --preset cpu", "there is no method 'nosuch'"),
        ("--preset cpuu", "did you mean 'cpu'?"),
        ("skills.alpha --preset cpu --set skills.alpha=-1", "skills.alpha must be at least 0"),
    ],
)
def test_wrong_requests_are_one_line(command: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", *shlex.split(command)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]


def test_a_named_preset_needs_no_jax() -> None:
    """The answer is there at once: no device is started, nor jax loaded."""
    code = (
        "import sys; from qdos_brax.commands.main import main; code = main(['config', '--preset', 'cpu']); "
        "sys.exit(code or 'jax' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2], stdout=subprocess.DEVNULL)
