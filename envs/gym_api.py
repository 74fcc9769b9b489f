"""The tasks for learners that speak Gymnasium: NumPy in, NumPy out.

Importing this module registers every task that ``envs`` knows by then (see ``register_tasks``):
``qdos/antmaze-large-v0`` with its default task and ``qdos/antmaze-large-task3-v0`` with that one. ``gymnasium.make``
gives one environment, ``gymnasium.make_vec`` a batch of them that one compiled program steps, on MuJoCo C (in threads)
or MJX.

Observation, reward, success and cap are the task's: success, read on the state before the action, terminates an
episode, the cap truncates it. Environment 0 of a batch starts as the single one with the same seed.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs.brax_base import State
from envs.gym_programs import checked, programs, started, to_numpy
from envs.registry import get_spec, list_tasks
from envs.render import Renderer, steps_per_second
from envs.task import Task

_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10.0}


class _Backed:
    """Hold what one environment and a batch have in common: the programs, the renderer and the state."""

    metadata: dict[str, Any]

    def _open(
        self, task: str, physics: str, render_mode: str | None, frames: Mapping[str, Any], cap: int | None = None
    ) -> None:
        _require_known(type(self), frames)
        self._programs = programs(get_spec(task).full_name, physics, cap)
        self.task = self._programs.task
        self.metadata = self.metadata | {"render_fps": steps_per_second(self.task)}
        self.render_mode = render_mode
        self._renderer = _renderer(self.task, render_mode, frames)
        self._state: State | None = None

    def _frames(self) -> tuple[np.ndarray, ...] | None:
        """Return every environment's state as uint8[height, width, 3]; None without a render mode."""
        if self._renderer is None:
            return None
        state = started(self._state)
        physics = state.pipeline_state
        states = zip(*map(np.asarray, (physics.qpos, state.info["goal"], physics.extra)), strict=True)
        return tuple(self._renderer.frame(*seen) for seen in states)

    def _release(self) -> None:
        """Give the OpenGL context back."""
        if self._renderer is not None:
            self._renderer.close()


class TaskGymEnv(_Backed, gymnasium.Env):
    """Run one environment.

    ``info["success"]`` (bool) is that of the step just made. Physics that is no longer finite truncates the episode,
    with the last finite observation.

    Args:
        task: a name that ``envs.make`` knows.
        physics: "mjx", "mjx-warp", "mujoco", or "auto" (MuJoCo C).
        render_mode: None or "rgb_array".
        **frames: height, width and camera of frames, as ``envs.render.Renderer`` takes them.

    Attributes:
        task: the Brax environment behind it.

    Raises:
        ValueError: unknown task, engine, keyword, render mode or camera; the message names the choices.
        NoOpenGL: frames are wanted and this machine cannot draw.
    """

    metadata = _METADATA

    def __init__(self, task: str, physics: str = "auto", render_mode: str | None = None, **frames: Any) -> None:
        self._open(task, physics, render_mode, frames)
        self.observation_space, self.action_space = self._programs.spaces

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the start of an episode: observation float32[obs] and info.

        Args:
            seed: makes everything from here on repeatable; None goes on with the random numbers of the last seed.
            options: keyword arguments for the task's own ``reset``.

        Raises:
            ValueError: it knows no such option.
        """
        super().reset(seed=seed)
        self._state = self._programs.start(self.np_random, 1, options)
        return np.array(self._state.obs)[0], {"success": False}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return what one control step under ``action[act]`` brings; the motors clip to [-1, 1].

        Raises:
            ValueError: the action's shape is wrong or it is not finite.
        """
        state = started(self._state)
        self._state, out = self._programs.step(state, checked(action, self.action_space)[None])
        out = to_numpy(out)
        finite = bool(np.isfinite(out.obs).all())
        return (
            out.obs[0] if finite else np.array(state.obs)[0],
            float(out.reward[0]),
            bool(out.terminated[0]) and finite,
            bool(out.truncated[0]) or not finite,
            {"success": bool(out.success[0])},
        )

    def render(self) -> np.ndarray | None:
        """Return the state as uint8[height, width, 3]; None without a render mode."""
        frames = self._frames()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._release()


class TaskVectorEnv(_Backed, gymnasium.vector.VectorEnv):
    """Run a batch of environments, stepped by one compiled program.

    An environment whose episode ends starts the next one in the same step (``AutoresetMode.SAME_STEP``): the true last
    observation is in ``infos["final_obs"]``, the last step's info in ``infos["final_info"]``. Physics that is
    no longer finite truncates, as in ``TaskGymEnv``, whose arguments are the same.

    Args:
        task: a name that ``envs.make`` knows.
        num_envs: how many.
        max_episode_steps: truncates episodes that early; None or -1: where the task does, which is the most.
        physics: the engine.
        render_mode: None or "rgb_array".
        **frames: as in ``TaskGymEnv``.

    Attributes:
        task: the Brax environment behind it, unbatched.

    Raises:
        ValueError: there is no environment at all, or as in ``TaskGymEnv``.
        NoOpenGL: frames are wanted and this machine cannot draw.
    """

    metadata = _METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        physics: str = "auto",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **frames: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.num_envs = num_envs
        self._open(task, physics, render_mode, frames, _earlier_cap(task, max_episode_steps))
        self.single_observation_space, self.single_action_space = self._programs.spaces
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return fresh episodes everywhere: observations float32[N, obs] and infos.

        Args:
            seed: one number, for all; see ``TaskGymEnv.reset``.
            options: keyword arguments for the task's own ``reset``, the same for all; episodes that start by
                themselves later on start without them.

        Raises:
            ValueError: it knows no such option.
        """
        super().reset(seed=seed)
        self._state = self._programs.start(self.np_random, self.num_envs, options)
        return np.array(self._state.obs), {"success": np.zeros(self.num_envs, bool), "_success": self._everywhere()}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations, infos of one control step under ``actions[N, act]``.

        Raises:
            ValueError: the actions' shape is wrong or they are not finite.
        """
        state = started(self._state)
        self._state, out = self._programs.auto_step(state, checked(actions, self.action_space))
        out = to_numpy(out)
        done = out.terminated | out.truncated
        # As gymnasium's own vector environments: where an episode has ended, infos are those of the new one's reset.
        infos: dict[str, Any] = {"success": out.success & ~done, "_success": self._everywhere()}
        if done.any():
            final_obs = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(done):
                final_obs[index] = out.final_obs[index].copy()
            infos |= {
                "final_obs": final_obs,
                "_final_obs": done.copy(),
                "final_info": {"success": out.success & done, "_success": done.copy()},
                "_final_info": done.copy(),
            }
        return out.obs, out.reward, out.terminated, out.truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return every environment's state as uint8[height, width, 3]; None without a render mode."""
        return self._frames()

    def close_extras(self) -> None:
        """Give the OpenGL context back."""
        self._release()

    def _everywhere(self) -> np.ndarray:
        return np.ones(self.num_envs, bool)


def _require_known(env: type, frames: Mapping[str, Any]) -> None:
    """Raise ValueError for a keyword that neither the environment nor its renderer takes."""
    names = inspect.signature(Renderer.__init__).parameters
    drawn = [name for name in names if name not in ("self", "env")]
    known = [name for name in inspect.signature(env).parameters if name != "frames"] + drawn
    for name in frames:
        if name not in drawn:
            near = max(known, key=lambda other: difflib.SequenceMatcher(None, other, name).ratio())
            raise ValueError(f"there is no keyword {name!r}; did you mean {near!r}? (keywords: {', '.join(known)})")


def _earlier_cap(task: str, steps: int | None) -> int | None:
    """Return ``steps`` where that is less than the task's own cap, else None."""
    if steps is None or steps == -1:
        return None
    if steps < 1:
        raise ValueError(f"max_episode_steps must be at least 1, not {steps}")
    return steps if steps < get_spec(task).episode_length else None


def _renderer(task: Task, render_mode: str | None, frames: Mapping[str, Any]) -> Renderer | None:
    if render_mode is None:
        return None
    if render_mode not in _METADATA["render_modes"]:
        raise ValueError(f"there is no render mode {render_mode!r}; choose rgb_array or None")
    return Renderer(task, **frames)


def register_tasks() -> None:
    """Register with Gymnasium every task that is not yet; for families that were added after the import."""
    caps = {name: spec.episode_length for spec in list_tasks() for name in (spec.full_name, spec.name)}
    for name in sorted(caps):
        if f"qdos/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"qdos/{name}-v0",
                entry_point=f"{__name__}:TaskGymEnv",
                vector_entry_point=f"{__name__}:TaskVectorEnv",
                kwargs={"task": name},
                max_episode_steps=caps[name],
            )


register_tasks()
