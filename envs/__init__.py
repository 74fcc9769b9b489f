"""The tasks, as Brax environments on exact physics. Knows nothing of learning."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # it prints two lines where the optional package warp is absent
    import mujoco.mjx  # noqa: F401

from envs.registry import ALIASES, get_spec, list_tasks, make
from envs.task import TaskEnv, TaskSpec
from envs.wrappers import AutoReset

__all__ = ["ALIASES", "AutoReset", "TaskEnv", "TaskSpec", "get_spec", "list_tasks", "make"]
