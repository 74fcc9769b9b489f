"""The example of docs/own-environment.md: the page quotes it, and it goes from data to a trained agent."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax.commands.main import main, main_parser
from qdos_brax.commands.train import train_parser

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "own_environment.py"
PAGE = (ROOT / "docs" / "own-environment.md").read_text(encoding="utf-8")
START = "python docs/examples/own_environment.py "
COMMANDS = [line.removeprefix(START) for line in PAGE.splitlines() if line.startswith(START)]


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The example as a module, its family registered."""
    spec = importlib.util.spec_from_file_location("own_environment", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    envs.register_family("reacher", module.REACHER)
    try:
        yield module
    finally:
        del envs.FAMILIES["reacher"]


@pytest.fixture(scope="module")
def file(example: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "reacher.hdf5"
    example.collect(path, episodes=40)
    return path


@pytest.mark.quick
def test_the_page_quotes_the_example() -> None:
    lines = {line.strip() for line in EXAMPLE.read_text(encoding="utf-8").splitlines()}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    assert len(blocks) >= 5
    for block in blocks:
        assert [line for line in block.splitlines() if line.strip() not in lines] == []


def test_the_task_is_what_the_page_says(example: ModuleType) -> None:
    env = envs.make("reacher")
    assert (env.observation_size, env.action_size, env.episode_length) == (6, 2, 100)
    x, y = example.GOALS[0]
    elbow = np.arccos((x * x + y * y - 0.5) / 0.5)
    there = np.array([np.arctan2(y, x) - elbow / 2, elbow], np.float32)
    np.testing.assert_allclose(example.tip(there), (x, y), atol=1e-6)
    ends = [env.step(env.reset_to(jnp.asarray(qpos), jnp.zeros(2)), jnp.zeros(2)) for qpos in (there, 0 * there)]
    assert [(float(state.reward), float(state.done)) for state in ends] == [(0.0, 1.0), (-1.0, 0.0)]
    assert env.distance_left(np.zeros((1, 2)))[0] == pytest.approx(np.hypot(1 - x, y))
    assert jax.jit(env.reset)(jax.random.key(0)).obs.shape == (6,)


def test_its_data_fits_it(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "check", str(file), "--env", "reacher", "--horizon", "10"]) == 0
    assert "fits reacher-task1: 4,000 transitions, 40 episodes" in capsys.readouterr().out


@pytest.mark.parametrize("line", COMMANDS)
def test_its_commands_can_be_typed(line: str) -> None:
    words = shlex.split(line)
    if words[0] == "train":
        train_parser().parse_args(words[1:])
    elif words[0] != "collect":
        assert callable(main_parser(words).parse_args(words).run)


@pytest.mark.slow
def test_it_is_trained_and_evaluated(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    sets = ["skills.horizon=10", "values.n_step=10", "high_level.env_steps=1000", "high_level.warmup_env_steps=200"]
    sets += ["labels.start_env_steps=200", "eval.episodes=2", "eval.every_env_steps=500"]
    flags = ["--env", "reacher", "--preset", "smoke", "--dataset", str(file), "--out", str(out)]
    assert main(["train", *flags, *(word for text in sets for word in ("--set", text))]) == 0
    assert json.loads((out / "summary.json").read_text())["members"][0]["status"] == "ok"
    assert main(["evaluate", str(out), "--episodes", "2"]) == 0
