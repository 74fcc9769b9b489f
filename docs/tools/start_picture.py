"""Draw how an episode of collected data begins: ``python docs/tools/start_picture.py FILE --env TASK --out PNG``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt

import envs
from envs.render import Renderer, steps_per_second
from envs.scene import following_view
from qdos_brax.data import formats
from qdos_brax.errors import guarded
from qdos_brax.report.curves import save_figure

HEIGHT = 300  # pixels of a frame
BODY = 1  # the first of the model's that moves
CLOSE = following_view(BODY, azimuth=160.0, elevation=-25.0, distance=4.0)


def main() -> None:
    """Draw the first seconds of the file's first episode, a frame for each of ``--seconds``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", metavar="FILE", type=Path, help="a data file with simulator states")
    parser.add_argument("--env", default="humanoidmaze-medium", help="its task (default humanoidmaze-medium)")
    parser.add_argument("--seconds", type=float, nargs="+", default=[0, 0.5, 2, 3, 4, 5, 6], help="times of the frames")
    parser.add_argument("--out", metavar="PNG", type=Path, required=True, help="the picture")
    args = parser.parse_args()
    env = envs.make(args.env, physics="mujoco")
    states, rate = formats.read(args.data, env).qpos, steps_per_second(env)
    figure, axes = plt.subplots(1, len(args.seconds), figsize=(2 * len(args.seconds), 2.3), layout="constrained")
    near = SimpleNamespace(scene=lambda: replace(env.scene(), cameras={"close": CLOSE}))
    with Renderer(near, HEIGHT, HEIGHT) as renderer:
        for axis, seconds in zip(axes, args.seconds, strict=True):
            axis.imshow(renderer.frame(states[round(seconds * rate)], env.goal_xy))
            axis.set_title(f"{seconds:g} s", fontsize="small")
            axis.set_axis_off()
    save_figure(figure, args.out)


if __name__ == "__main__":
    raise SystemExit(guarded(main))
