"""Draw where a data set has been, as a PNG."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from envs.task import Task
from qdos_brax.errors import UserError
from qdos_brax.files import replacing

_BINS_PER_CELL = 8


def draw_coverage(qpos: np.ndarray, env: Task, out: Path, title: str) -> None:
    """Draw how often each place was visited: one panel for everything that moves, such as body and ball.

    Args:
        qpos: float[N, nq].
        env: the task, for its floor map and its positions.
        out: the picture, ending in .png; its folder must exist. It is replaced at once or not at all.
        title: a line above.

    Raises:
        UserError: the task has no positions in a plane, or the picture cannot be written.
    """
    if out.suffix != ".png":
        raise UserError(f"a map is written as .png, not as {out.name}; choose another name for it")
    floor, places = env.floor_map(), env.position(qpos)
    if floor is None or places is None:
        raise UserError(f"nothing in {env.spec.name} has a position on a map, so there is none to draw")
    grid, (left, low) = floor.grid, floor.corner
    extent = (left, left + grid.shape[1] * floor.cell, low, low + grid.shape[0] * floor.cell)
    bins = [size * _BINS_PER_CELL for size in (grid.shape[1], grid.shape[0])]
    figure, axes = plt.subplots(1, len(places), figsize=(7 * len(places), 6), layout="constrained", squeeze=False)
    for axis, (name, xy) in zip(axes[0], places.items(), strict=True):
        counts, _, _ = np.histogram2d(xy[:, 0], xy[:, 1], bins=bins, range=[extent[:2], extent[2:]])
        axis.imshow(np.where(grid == 1, 0.75, np.nan), extent=extent, origin="lower", cmap="gray", vmin=0, vmax=1)
        image = axis.imshow(
            np.where(counts > 0, counts, np.nan).T, extent=extent, origin="lower", norm=LogNorm(1, max(2, counts.max()))
        )
        axis.plot(*floor.goal, marker="*", color="red", markersize=14, linestyle="none", label="goal")
        visited = counts.reshape(grid.shape[1], _BINS_PER_CELL, grid.shape[0], _BINS_PER_CELL).sum(axis=(1, 3)).T
        share = (visited[grid == 0] > 0).mean()
        axis.set_title(f"{name}: {share:.0%} of the free cells")
        axis.legend(loc="upper right", fontsize="small")
        figure.colorbar(image, ax=axis, label="rows", shrink=0.8)
    figure.suptitle(title)
    try:
        with replacing(out) as partial:
            figure.savefig(partial, dpi=110)
    finally:
        plt.close(figure)
