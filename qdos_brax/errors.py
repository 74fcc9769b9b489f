"""The one exception whose cause the user can fix, and how a program ends on it."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path


class UserError(Exception):
    """Report bad input: a file, a flag, a shape, a value.

    The message is one line that names the cause and the fix. The command line prints it and exits with code 2;
    a library caller may catch it.
    """


def guarded(work: Callable[[], int | None]) -> int:
    """Return the exit code of ``work``; for a UserError print one line and return 2."""
    try:
        code = work() or 0
        sys.stdout.flush()
        return code
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except Exception as error:
        if not _is_from_opengl(error):
            raise
        asked = os.environ.get("MUJOCO_GL")
        print(f"error: MUJOCO_GL is {asked!r}, which MuJoCo cannot load here ({error}); unset it", file=sys.stderr)
        return 2


def _is_from_opengl(error: Exception) -> bool:
    """Return whether ``import mujoco`` failed at the OpenGL library that MUJOCO_GL names; only pictures need one."""
    frames = traceback.extract_tb(error.__traceback__)
    return "MUJOCO_GL" in os.environ and any(Path(frame.filename).name == "gl_context.py" for frame in frames)
