"""Rollouts of OGBench's environments and of ours, side by side; shared by the tests of envs/."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import gymnasium
import jax
import numpy as np
import ogbench  # noqa: F401  (registers the environments)

from envs import Task


def ogbench_env(name: str) -> gymnasium.Env:
    """OGBench's single-task environment for one of our full names, e.g. "antmaze-medium-task1"."""
    base, task = name.rsplit("-", 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(f"{base}-singletask-{task}-v0")


def ogbench_rollout(
    env: gymnasium.Env, qpos: np.ndarray, qvel: np.ndarray, actions: np.ndarray, steps_done: int = 0
) -> dict[str, np.ndarray]:
    """OGBench's environment from (qpos, qvel) under ``actions[T, nu]``; everything stacked over time, in float64.

    ``state`` is the simulator's [nq + nv] after the step, with what a teleporter did.

    Args:
        env: from ``ogbench_env``.
        qpos: [nq].
        qvel: [nv].
        actions: [T, nu].
        steps_done: how much of the episode's cap is used up.
    """
    env.reset()
    env.unwrapped.set_state(qpos.astype(np.float64), qvel.astype(np.float64))
    limit = env
    while not isinstance(limit, gymnasium.wrappers.TimeLimit):
        limit = limit.env
    limit._elapsed_steps = steps_done
    rows: dict[str, list[Any]] = {
        "obs": [],
        "state": [],
        "reward": [],
        "success": [],
        "terminated": [],
        "truncated": [],
    }
    data = env.unwrapped.data
    for action in actions:
        obs, reward, terminated, truncated, info = env.step(action)
        state = np.concatenate([data.qpos, data.qvel])
        values = (obs, state, reward, info["success"], terminated, truncated)
        for key, value in zip(rows, values, strict=True):
            rows[key].append(value)
    return {key: np.asarray(value) for key, value in rows.items()}


def our_rollout(env: Task, state: Any, actions: np.ndarray) -> Any:
    """States stacked over time, from ``state`` under ``actions[T, nu]`` (one environment, jitted once per ``env``)."""
    return _rollout_program(env)(state, actions)


@cache
def _rollout_program(env: Task) -> Any:
    def body(carry: Any, action: jax.Array) -> tuple[Any, Any]:
        after = env.step(carry, action)
        return after, after

    return jax.jit(lambda state, actions: jax.lax.scan(body, state, actions)[1])


def start_state(env: Task, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """float32 (qpos[nq], qvel[nv]) of a reset."""
    state = env.reset(jax.random.key(seed))
    return np.array(state.pipeline_state.qpos), np.array(state.pipeline_state.qvel)
