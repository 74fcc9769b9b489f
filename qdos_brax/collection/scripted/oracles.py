"""Play with OGBench's own oracles, one per simulation, without its environment."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from envs.manipulation.manipspace import ManipSpaceTask
from qdos_brax.collection.scripted.table import TableTarget, TableView

CONTROL_STEP = 0.05  # s
MOVE = np.array([0.05, 0.05, 0.05, 0.3, 1.0])
"""What an action of 1 asks for: m, m, m, rad, share of the gripper."""
_numpy_generator = threading.Lock()
_SMOOTHING = 0.5  # control steps, of the noise on a plan, as in OGBench


class Oracle:
    """Do one thing after another in one simulation.

    ``plan`` follows a path that was laid out when the target was set, with smooth noise on it; it never looks again.
    ``markov`` acts on what it sees.

    Args:
        env: the task.
        style: "plan" or "markov".
        noise: standard deviation of the noise on plans, in units of the action.
    """

    def __init__(self, env: ManipSpaceTask, style: str, noise: float) -> None:
        self._env, self._style, self._noise = _stand_in(env), style, noise
        self._oracle: Any = None
        self._steps = 0

    def set_target(self, table: TableView, target: TableTarget, rng: np.random.Generator) -> None:
        """Start with a target; ``rng`` draws the times of the plan, its way, and where the hand goes in the end."""
        self._target, self._steps = target, 0
        self._oracle = _oracle_class(self._style, target.kind)(env=self._env)
        with _numpy_draws_from(rng):
            self._oracle.reset(None, table.info(target, 0.0))
        if self._style == "plan" and self._noise > 0:
            noise = rng.standard_normal(self._oracle._plan.shape) * MOVE * self._noise
            self._oracle._plan += gaussian_filter1d(noise, axis=0, sigma=_SMOOTHING)

    @property
    def done(self) -> bool:
        """Return whether the target is dealt with, or given up, or there was none yet."""
        return self._oracle is None or bool(self._oracle.done)

    def progress(self) -> float:
        """Return how much of a plan is over, 0 to 1."""
        return float(self._steps / len(self._oracle._plan))

    def act(self, table: TableView) -> np.ndarray:
        """Return the action float64[5] within [-1, 1]."""
        action = self._oracle.select_action(None, table.info(self._target, self._steps * CONTROL_STEP))
        self._steps += 1
        return np.asarray(action, np.float64)


@cache
def _oracle_class(style: str, kind: str) -> Any:
    """Return OGBench's oracle; that of plans lays out all points of a plan at once, where OGBench's goes one by one."""
    module = importlib.import_module(f"ogbench.manipspace.oracles.{style}.{kind}_{style}")
    found = getattr(module, f"{kind.capitalize()}{style.capitalize()}Oracle")
    if style == "markov":
        return found

    return type("Planner", (found,), {"compute_plan": _compute_plan})


def _compute_plan(oracle: Any, times: list[float], poses: list[Any], grasps: list[float]) -> np.ndarray:
    """Stand for OGBench's method of that name, without noise."""
    places = np.array([pose.translation() for pose in poses])
    yaws = np.array([pose.rotation().compute_yaw_radians() for pose in poses])
    return lay_out(np.array(times), places, yaws, np.array(grasps))


def lay_out(times: np.ndarray, places: np.ndarray, yaws: np.ndarray, grasps: np.ndarray) -> np.ndarray:
    """Return a plan float64[T, 5] (place, yaw, grip), one row per control step, between key frames.

    Args:
        times: float64[K], s, from 0.
        places: float64[K, 3].
        yaws: float64[K], rad; the shorter way round is taken.
        grasps: float64[K].
    """
    steps = np.arange(0.0, times[-1], CONTROL_STEP)
    turns = np.concatenate([[0.0], np.cumsum(_wrapped(np.diff(yaws)))]) + yaws[0]
    columns = [*places.T, turns, grasps]
    plan = np.stack([np.interp(steps, times, column) for column in columns], axis=1)
    plan[:, 3] = _wrapped(plan[:, 3])
    return plan


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _stand_in(env: ManipSpaceTask) -> Any:
    """Return what OGBench's oracles ask their environment for."""

    def normalize_action(action: np.ndarray) -> np.ndarray:
        return np.clip(action / MOVE, -1.0, 1.0)

    stand_in = SimpleNamespace(
        _control_timestep=CONTROL_STEP, _arm_sampling_bounds=env.space.arm_bounds, normalize_action=normalize_action
    )
    stand_in.unwrapped = stand_in
    return stand_in


@contextmanager
def _numpy_draws_from(rng: np.random.Generator) -> Iterator[None]:
    """Let NumPy's global generator, which OGBench's oracles use, follow ``rng``, and be as before afterwards.

    Threads take turns, since there is one such generator.
    """
    with _numpy_generator:
        before = np.random.get_state()
        np.random.seed(int(rng.integers(2**32)))
        try:
            yield
        finally:
            np.random.set_state(before)
