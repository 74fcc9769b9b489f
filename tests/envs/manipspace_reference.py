"""OGBench's manipulation environments as a reference, from given starts, with its oracles as a source of actions."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np

from envs.task import Task


def reference(task: Task) -> Any:
    """OGBench's environment of the task."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("ogbench.manipspace")
        spec = task.spec
        made = gymnasium.make(f"{spec.name}-singletask-task{spec.task_id}-v0", disable_env_checker=True).unwrapped
        made.reset(seed=spec.task_id)
    return made


def place(env: Any, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray | None) -> np.ndarray:
    """Put the reference where ``reset_to`` puts ours; return its observation."""
    goals = env._data.mocap_pos.copy()
    mujoco.mj_resetData(env._model, env._data)
    env._data.mocap_pos[:] = goals
    env._data.qpos[:], env._data.qvel[:] = qpos, qvel
    if extra is not None:
        env._cur_button_states = np.array(extra)
        env._apply_button_states()
    mujoco.mj_forward(env._model, env._data)
    env.pre_step()
    env.post_step()
    env._data.qacc_warmstart[:] = 0
    return np.asarray(env.compute_observation())


def rollout(env: Any, actions: np.ndarray) -> dict[str, np.ndarray]:
    """What follows under ``actions[T, 5]``: observation, state, buttons, reward, terminated, success."""
    names = ("observation", "reward", "terminated", "success", "state", "extra")
    rows: dict[str, list[Any]] = {name: [] for name in names}
    for action in actions:
        observation, reward, terminated, _, info = env.step(action)
        state = np.concatenate([env._data.qpos, env._data.qvel])
        buttons = np.array(getattr(env, "_cur_button_states", np.zeros(0)))
        found = (observation, reward, terminated, info["success"], state, buttons)
        for name, value in zip(names, found, strict=True):
            rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}


def oracle_actions(
    env: Any, steps: int, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray | None, seed: int
) -> np.ndarray:
    """Actions float32[steps, 5] of OGBench's plan oracles from there, plan after plan; the reference is reset after."""
    kinds = ("cube", "button", "drawer", "window") if extra is not None else ("cube",)
    oracles = {}
    for kind in kinds:
        module = importlib.import_module(f"ogbench.manipspace.oracles.plan.{kind}_plan")
        oracles[kind] = getattr(module, f"{kind.capitalize()}PlanOracle")(env=env, noise=0.1)
    np.random.seed(seed)
    env.np_random = np.random.default_rng(seed)
    env._mode = "data_collection"
    observation, taken, oracle = place(env, qpos, qvel, extra), [], None
    info: dict[str, Any] = {}
    for _ in range(steps):
        if oracle is None or oracle.done:
            observation, info = env.set_new_target()
            oracle = oracles[info["privileged/target_task"]]
            oracle.reset(observation, info)
        action = np.clip(oracle.select_action(observation, info), -1, 1).astype(np.float32)
        observation, _, _, _, info = env.step(action)
        taken.append(action)
    env._mode = "task"
    env.reset(seed=seed)
    return np.array(taken)


def start_of(state: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(qpos, qvel, extra) of one of our states; no extra for tasks without."""
    held = jax.device_get(state.pipeline_state)
    return held.qpos, held.qvel, held.extra if held.extra.size else None
