"""A map of the places that a data set visits, as a PNG file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from qdos_brax.errors import UserError
from qdos_brax.files import replacing

_BINS_PER_CELL = 8


def draw_coverage(qpos: np.ndarray, env: Any, out: Path, title: str) -> None:
    """Draw how often each place was visited: one panel for the body, one for the ball where there is one.

    Args:
        qpos: float[N, nq].
        env: the task, for its maze and its goal.
        out: the file, ending in .png; its folder must exist. It is replaced as a whole or not at all.
        title: the line above the map.

    Raises:
        UserError: the file has another ending or cannot be written.
    """
    if out.suffix != ".png":
        raise UserError(f"a map is written as .png, not as {out.name}; choose another name for it")
    grid = env.layout.grid
    (left, low), (right, high) = env.layout.ij_to_xy(np.array([[0, 0], np.array(grid.shape) - 1]))
    half = 0.5 * (right - left) / (grid.shape[1] - 1)  # of a cell
    extent = (left - half, right + half, low - half, high + half)
    bins = [size * _BINS_PER_CELL for size in (grid.shape[1], grid.shape[0])]
    places = env.body.places
    figure, axes = plt.subplots(1, len(places), figsize=(7 * len(places), 6), layout="constrained", squeeze=False)
    for axis, index, name in zip(axes[0], places, ("body", "ball"), strict=False):
        x, y = qpos[:, index], qpos[:, index + 1]
        counts, _, _ = np.histogram2d(x, y, bins=bins, range=[extent[:2], extent[2:]])
        axis.imshow(np.where(grid == 1, 0.75, np.nan), extent=extent, origin="lower", cmap="gray", vmin=0, vmax=1)
        image = axis.imshow(
            np.where(counts > 0, counts, np.nan).T, extent=extent, origin="lower", norm=LogNorm(1, max(2, counts.max()))
        )
        axis.plot(*env.goal_xy, marker="*", color="red", markersize=14, linestyle="none", label="goal")
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
