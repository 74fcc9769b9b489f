"""Fixtures that several folders share."""

from __future__ import annotations

import faulthandler
import json
import os
from collections.abc import Generator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import envs
from envs import render
from qdos_brax import config as configs
from qdos_brax.high_level.sac import SAC
from qdos_brax.methods.low_level_kinds import make_skill_model
from qdos_brax.runs.checkpoint import CheckpointStore, Position
from qdos_brax.runs.folder import RunFolder

# As every run has it (``qdos_brax.runs.jax_setup``): programs that call MuJoCo C can wait for ever on arrays that wait
# for them if they are dispatched asynchronously.
jax.config.update("jax_cpu_enable_async_dispatch", False)

_stderr = pytest.StashKey[int]()


def pytest_configure(config: pytest.Config) -> None:
    """Keep the error output that pytest captures while tests run."""
    config.stash[_stderr] = os.dup(2)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """End the process of a test that does not end, a tenth after its time, and say where its threads are.

    ``timeout`` is a signal, which Python answers between two instructions: a test that waits within a C++ library never
    comes to them, and a run of all tests would wait with it.
    """
    mark = item.get_closest_marker("timeout")
    seconds = float(mark.args[0] if mark else item.config.getini("timeout"))
    faulthandler.dump_traceback_later(1.1 * seconds, file=item.config.stash[_stderr], exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of whole runs first: they are the longest, and none must be left alone at the end."""
    items.sort(key=lambda item: item.path.parent.name not in ("tests", "runs"))


@pytest.fixture
def opengl() -> None:
    """Skips where there is no OpenGL, with the line that a user would see."""
    try:
        render.Renderer(envs.make("antmaze-medium", physics="mujoco"), 16, 16).close()
    except render.NoOpenGL as error:
        pytest.skip(str(error))


@pytest.fixture
def finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder of two members, with everything that an evaluation reads; episodes are cut short."""
    monkeypatch.setattr(envs.Task, "episode_length", 25)
    given = {"seed": (0, 1), "physics": "mujoco", "skills.horizon": 10}
    config = configs.load_config("antmaze-medium", "smoke", given, [])
    env = envs.make(config.env, physics="mujoco")
    model = make_skill_model(config, env)
    sac = SAC(env.observation_size, config.skills.latent_dim, config.high_level)

    def member(key: jax.Array) -> dict:
        normaliser = {"mean": jnp.zeros(29), "scale": jnp.ones(29)}
        return {"skills": model.init(key), "actor": sac.init(key, 1.0).actor, "normaliser": normaliser}

    folder = RunFolder.create(tmp_path / "run")
    folder.config.write_text(configs.to_yaml(config), encoding="utf-8")
    folder.summary.write_text(json.dumps({"members": []}), encoding="utf-8")
    store = CheckpointStore(folder.checkpoints, configs.config_hash(config))
    store.save_artifacts(1, jax.jit(jax.vmap(member))(jax.random.split(jax.random.key(0), 2)))
    store.save(Position(phase=1, chunk=0, rows=0, columns=(), wall_seconds={}), None)
    return folder.path
