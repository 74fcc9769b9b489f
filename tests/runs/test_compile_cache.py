"""The cache of compiled programs: a second run compiles nothing, no task finds another's programs, it stays small."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from qdos_brax.runs import compile_cache

ROOT = Path(__file__).parents[2]
TRAIN = ("train.py", "--env", "antmaze-medium", "--preset", "smoke", "--steps", "80", "--pretrain-steps", "2")
TASKS = ("antmaze-medium", "antmaze-large", "antmaze-giant")
# Programs of one shape that begin in one place, beside what is a wall in some: the model that the engine holds differs.
PLAY = """
import sys
import jax
from qdos_brax.runs.jax_setup import prepare_jax
prepare_jax()
import envs
env = envs.make(sys.argv[1])
def episode(key):
    start = env.reset(key).pipeline_state
    start = env.reset_to(start.qpos.at[:2].set(jax.numpy.array([10.0, 9.5])), start.qvel)
    def step(state, key):
        state = env.step(state, jax.random.uniform(key, (env.action_size,), minval=-1.0))
        return state, state.obs
    return jax.lax.scan(step, start, jax.random.split(key, 30))[1]
print(jax.jit(episode)(jax.random.key(3))[-1].tolist())
"""
MISS = "PERSISTENT COMPILATION CACHE MISS"


def python(cache: Path, *arguments: str, **more: str) -> subprocess.Popen[str]:
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), **more}
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def result(process: subprocess.Popen[str]) -> tuple[str, str]:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err[-2000:]
    return out, err


def test_a_second_run_compiles_nothing(tmp_path: Path) -> None:
    logged = {"JAX_DEBUG_LOG_MODULES": "jax._src.compiler"}
    errors = [
        result(python(tmp_path / "cache", *TRAIN, "--out", str(tmp_path / name), **logged))[1]
        for name in ("cold", "warm")
    ]
    assert errors[0].count(MISS) > 20  # the log has the words that are counted
    assert [line for line in errors[1].splitlines() if MISS in line] == []


def test_no_process_finds_the_programs_of_another_task(tmp_path: Path) -> None:
    """Three processes write one empty cache at once; then each finds its own program there, and only that."""
    alone = [result(python(tmp_path / f"cache-{task}", "-c", PLAY, task))[0] for task in TASKS]
    assert len(set(alone)) == len(TASKS)
    for _ in range(2):
        together = [python(tmp_path / "cache", "-c", PLAY, task) for task in TASKS]
        assert [result(process)[0] for process in together] == alone


@pytest.mark.quick
def test_what_was_not_used_for_longest_goes(tmp_path: Path) -> None:
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / f"{name}-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (1_000_000 - age, 1_000_000 - age))
    (tmp_path / "not-a-program").write_bytes(bytes(1000))
    compile_cache.trim(tmp_path, 200)
    assert {path.name for path in tmp_path.iterdir()} == {"new-cache", "middle-cache", "not-a-program"}
    os.utime(tmp_path / "middle-cache", (2_000_000, 999_999))  # read since
    compile_cache.trim(tmp_path, 150)
    assert {path.name for path in tmp_path.iterdir()} == {"middle-cache", "not-a-program"}


@pytest.mark.quick
def test_a_folder_that_the_user_names_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimmed: list[Path] = []
    monkeypatch.setattr(compile_cache, "trim", lambda folder, largest: trimmed.append(folder))
    monkeypatch.setattr(compile_cache.jax.config, "update", lambda name, value: None)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "own"))
    assert compile_cache.enable() == tmp_path / "own" and not trimmed
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compile_cache.enable() == trimmed[0]
