"""The task that a configuration or a command names."""

from __future__ import annotations

import envs
from qdos_brax.errors import UserError


def make_task(name: str, physics: str) -> envs.Task:
    """Return a task, on an engine.

    Raises:
        UserError: there is no such task or engine, or this machine does not have it. ``envs`` does not know this error;
            its messages are written for the user too.
    """
    try:
        return envs.make(name, physics=physics)
    except ValueError as error:
        raise UserError(str(error)) from error
