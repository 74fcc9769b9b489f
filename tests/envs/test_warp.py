"""MuJoCo Warp: a clear line where it cannot run, and its steps, on a CPU, where the package is there."""

from __future__ import annotations

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.mazes.walls import NearWalls
from envs.physics import why_not
from qdos_brax.commands import doctor


def test_it_is_refused_with_what_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"'mjx-warp' cannot run here.*warp-lang.*pip install .* '\.\[warp\]'"):
        envs.make("antmaze-medium", physics="mjx-warp")

    def no_devices(platform: str) -> Any:
        raise RuntimeError(f"no {platform}")

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(jax, "devices", no_devices)
    with pytest.raises(ValueError, match=r"'mjx-warp' cannot run here.*CUDA device.*choose mjx or mujoco"):
        envs.make("antmaze-medium", physics="mjx-warp")
    monkeypatch.setattr(jax, "devices", lambda platform: [object()])
    assert why_not("mjx-warp") == why_not("mjx") == why_not("mujoco") == ""


def test_doctor_says_which_engines_run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    passed, line = doctor._engines()  # a missing engine that nobody asked for is no fault
    assert passed and line.startswith(
        "engines: mjx, mujoco (auto); not mjx-warp: the package warp-lang is not installed"
    )
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(jax, "devices", lambda platform: [object()])
    assert doctor._engines() == (True, "engines: mjx, mjx-warp, mujoco (auto)")


@pytest.mark.slow
@pytest.mark.timeout(1800)  # Warp compiles some 50 kernels, one after the other
def test_its_steps_on_a_cpu_are_near_cs() -> None:
    """One kick of the ant in the air, then on the floor; and a population's axis, which joins the batch."""
    pytest.importorskip("warp", reason="the optional package warp-lang")
    from envs.physics.mjx.warp_engine import MjxWarpEngine

    env = envs.make("antmaze-medium", physics="mujoco")
    body = env.body
    near_walls = NearWalls(env.layout, body.places)
    engine = MjxWarpEngine(body.near(True), near_walls, body.most_contacts, sensors=body.sensors)
    step = jax.jit(jax.vmap(jax.vmap(engine.step)))
    exact_step = jax.jit(jax.vmap(jax.vmap(env.engine.step)))
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 8)).pipeline_state
    action = jax.random.uniform(jax.random.key(1), (2, 4, 8), minval=-1.0)
    for lift, within in ((1.0, 2e-5), (-0.3, 2e-2)):  # 0.3 lower all touch the floor
        qpos, qvel = (x.reshape(2, 4, -1) for x in (start.qpos.at[:, 2].add(lift), start.qvel))
        ends = []
        for one, stepper in ((engine, step), (env.engine, exact_step)):
            ends.append(stepper(jax.vmap(jax.vmap(one.init))(qpos, qvel), action))
        error = np.abs(np.asarray(ends[0].qpos - ends[1].qpos))
        assert error.max() < within
        assert np.abs(np.asarray(ends[1].qpos) - qpos).max() > 0.05

    # what does not fit shows: room for the limits' 8 rows alone, and several legs on the floor, of 4 rows each
    cramped = MjxWarpEngine(body.near(True), near_walls, {3: 0})
    lowered = start.qpos.at[:, 2].add(-0.5)
    after = jax.jit(jax.vmap(cramped.step))(jax.vmap(cramped.init)(lowered, start.qvel), jnp.zeros((8, 8)))
    assert bool(jnp.isnan(after.qpos).all())
