"""Draw a task, as a PNG."""

from __future__ import annotations

from pathlib import Path

import jax
import matplotlib.image

from envs.render import NoOpenGL, Renderer
from qdos_brax.config.task import make_task
from qdos_brax.errors import UserError
from qdos_brax.files import user_errors


def draw_task(name: str, out: Path) -> None:
    """Draw a task as its scene is seen (a maze from above), at a start and with the mark of the goal.

    Args:
        name: of the task.
        out: the picture, ending in .png; its folder must exist.

    Raises:
        UserError: there is no such task, this machine cannot draw, or the picture cannot be written.
    """
    check_name(out)
    try:
        env = make_task(name, "mujoco")
        state = env.reset(jax.random.key(0))
        with Renderer(env, height=720) as renderer:
            image = renderer.frame(state.pipeline_state.qpos, state.info["goal"], state.pipeline_state.extra)
    except NoOpenGL as error:
        raise UserError(str(error)) from error
    with user_errors(out):
        matplotlib.image.imsave(out, image)


def check_name(out: Path) -> None:
    """Check that a picture's name ends in .png.

    Raises:
        UserError: it does not.
    """
    if out.suffix != ".png":
        raise UserError(f"a picture is written as .png, not as {out.name}; choose another name for it")
