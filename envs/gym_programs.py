"""Compile the programs behind the Gymnasium environments of a task."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge  # no public name tells whether jax has been used

from envs.brax_base import State
from envs.registry import make
from envs.task import Task
from envs.wrappers import AutoReset


class _Process:
    """Hold whether this process was forked from one that had used jax, whose threads a fork does not copy."""

    broken = False

    @classmethod
    def note_fork(cls) -> None:
        """Note a fork, in the child."""
        cls.broken = cls.broken or xla_bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):  # Windows has no forks
    os.register_at_fork(after_in_child=_Process.note_fork)


def require_threads() -> None:
    """Raise ValueError in a process in which compiled programs would wait forever."""
    if _Process.broken:
        raise ValueError(
            "this process was forked after jax was used and cannot run the physics; for a batch use "
            'vectorization_mode="vector_entry_point", or start processes with context="spawn"'
        )


class Outcome(NamedTuple):
    """Hold what one control step brought; leading axis N. ``obs`` is after the reset where there was one."""

    obs: Any
    final_obs: Any
    reward: Any
    terminated: Any
    truncated: Any
    success: Any


Step = Callable[[State, np.ndarray], tuple[State, Outcome]]


class Programs(NamedTuple):
    """Hold the compiled parts of one task on one engine, shared by all environments of it; batched.

    Attributes:
        task: the environment.
        spaces: of observations and of actions.
        start: (random numbers, N, options) -> states.
        step: leaves ended episodes as they are.
        auto_step: starts the next episodes.
    """

    task: Task
    spaces: tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]
    start: Callable[[np.random.Generator, int, Mapping[str, Any] | None], State]
    step: Step
    auto_step: Step


@functools.cache
def programs(full_name: str, physics: str, cap: int | None = None) -> Programs:
    """Return the programs of a task on an engine, made once; ``cap``: control steps that end an episode earlier."""
    require_threads()
    # Must be set before jax is first used: MuJoCo C is called back from compiled programs, and with asynchronous
    # dispatch on a CPU such a callback can wait forever on arrays that wait for it (jax issue 25861).
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    task = make(full_name, physics=physics)
    if cap is not None:
        task.spec = dataclasses.replace(task.spec, episode_length=cap)
    auto = AutoReset(task)
    limits = np.full(task.observation_size, np.inf, np.float32)
    spaces = (
        gymnasium.spaces.Box(-limits, limits),
        gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32),
    )
    known = [name for name in inspect.signature(task.reset).parameters if name not in ("rng", "key")]

    def start_plainly(key: jax.Array, num_envs: int, options: Mapping[str, Any]) -> State:
        keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(num_envs))
        return jax.vmap(lambda key: auto.reset(key, **options))(keys)

    start_compiled = jax.jit(functools.partial(start_plainly, options={}), static_argnames="num_envs")

    def start(random: np.random.Generator, num_envs: int, options: Mapping[str, Any] | None) -> State:
        require_threads()
        key = jax.random.key(int(random.integers(2**32)))
        if not options:
            return start_compiled(key, num_envs)
        for name in options:
            if name not in known:
                raise ValueError(f"{full_name} has no reset option {name!r}; options: {', '.join(known) or 'none'}")
        return start_plainly(key, num_envs, options)

    def step(env: Task | AutoReset, state: State, actions: jax.Array) -> tuple[State, Outcome]:
        after = jax.vmap(env.step)(state, actions)
        truncated = after.info["truncation"] > 0
        terminated = (after.done > 0) & ~truncated
        success = after.metrics["success"] > 0
        return after, Outcome(after.obs, after.info["final_obs"], after.reward, terminated, truncated, success)

    return Programs(task, spaces, start, jax.jit(functools.partial(step, task)), jax.jit(functools.partial(step, auto)))


def checked(actions: Any, space: gymnasium.Space) -> np.ndarray:
    """Return the actions as float32.

    Raises:
        ValueError: they are not of ``space.shape`` or not finite.
    """
    array = np.asarray(actions, np.float32)
    if array.shape != space.shape:
        raise ValueError(f"actions have the shape {array.shape}; this environment takes {space.shape}")
    if not np.isfinite(array).all():
        raise ValueError("actions are not finite; look at the policy that gave them")
    return array


def to_numpy(out: Outcome) -> Outcome:
    """Return copies that a caller may keep and change; rewards in float64, as gymnasium has them."""
    arrays = Outcome(*(np.array(value) for value in jax.device_get(out)))
    return arrays._replace(reward=arrays.reward.astype(np.float64))


def started(state: State | None) -> State:
    """Return the state.

    Raises:
        ValueError: there is none yet, or this process cannot run the physics.
    """
    require_threads()
    if state is None:
        raise ValueError("the environment has no state yet; call reset() first")
    return state
