"""Import Brax's environment classes without printed lines."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints two lines where the optional package warp is absent
    from brax.envs.base import Env, State

__all__ = ["Env", "State"]
