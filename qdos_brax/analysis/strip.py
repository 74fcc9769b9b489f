"""Draw a finished run in one picture: frames of an episode, and the map of its latents."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np

from envs.render import NoOpenGL, Renderer, steps_per_second
from qdos_brax.analysis.film import EpisodeRunner, on_mujoco_c
from qdos_brax.analysis.finished import TrainedRun, load_run
from qdos_brax.analysis.pictures import evenly_spaced, near_camera
from qdos_brax.errors import UserError
from qdos_brax.report.curves import save_figure
from qdos_brax.report.member_analysis import read_analyses
from qdos_brax.report.picture import check_name
from qdos_brax.report.reading import read_study

_FRAMES = 4
_HEIGHT = 300  # pixels of a frame


def draw_run(run: Path, out: Path) -> None:
    """Draw frames of the first member's first episode, and the t-SNE of its latents, coloured by progress.

    Args:
        run: the folder of a finished run.
        out: the picture, ending in .png; its folder must exist.

    Raises:
        UserError: the run has not finished, this machine cannot draw, or the picture cannot be written.
    """
    check_name(out)
    frames, latents = _frames(load_run(run)), _latents(run)
    columns = len(frames) + (latents is not None)
    figure, axes = plt.subplots(1, columns, figsize=(2.4 * columns, 2.4), layout="constrained")
    for axis, (seconds, frame) in zip(axes, frames, strict=False):
        axis.imshow(frame)
        axis.set_title(f"{seconds:.0f} s", fontsize="small")
        axis.set_axis_off()
    if latents is not None:
        places, progress = latents
        axes[-1].scatter(*places.T, s=4, c=progress)
        axes[-1].set_title("latents by progress", fontsize="small")
        axes[-1].set(xticks=[], yticks=[])
        axes[-1].set_box_aspect(1)
    save_figure(figure, out)


def _frames(trained: TrainedRun) -> list[tuple[float, np.ndarray]]:
    """Return (seconds, image) of some of the episode's states, evenly spaced from its start to its end."""
    trained = on_mujoco_c(trained)
    env = trained.env
    states = [(moment.qpos, moment.goal, moment.extra) for moment in EpisodeRunner(trained).episode(0)]
    rate = steps_per_second(env)
    try:
        with Renderer(env, _HEIGHT, _HEIGHT, near_camera(env)) as renderer:
            return [(step / rate, renderer.frame(*states[step])) for step in evenly_spaced(_FRAMES, len(states))]
    except NoOpenGL as error:
        raise UserError(str(error)) from error


def _latents(run: Path) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Return t-SNE[n, 2] and progress[n] of the first member's segments, where the run's analysis has them."""
    analyses, _ = read_analyses(read_study([run]))
    if not analyses or "tsne" not in analyses[0].own:
        return None
    return analyses[0].own["tsne"], analyses[0].data.get("gain")
