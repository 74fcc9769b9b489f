"""The public data sets and their addresses."""

from __future__ import annotations

import re
from dataclasses import dataclass

_RAIL = "rail.eecs.berkeley.edu/datasets"
# The mirror is named by OGBench's author (issue 49 of seohongpark/ogbench).
_OGBENCH = (f"https://{_RAIL}/ogbench/", "https://huggingface.co/datasets/zhouzypaul/ogbench_datasets/resolve/main/")
_D4RL = f"http://{_RAIL}/offline_rl/"  # as in D4RL's infos.py; no mirror is known

_OGBENCH_KINDS = {
    "antmaze-(medium|large|giant|teleport)": "navigate|stitch",
    "antmaze-(medium|large|teleport)": "explore",
    "antsoccer-(arena|medium)": "navigate|stitch",
    "humanoidmaze-(medium|large|giant)": "navigate|stitch",
    "cube-(single|double|triple|quadruple)": "play|noisy",
    "scene": "play|noisy",
}
_OGBENCH_NAME = re.compile("|".join(f"{task}-({kinds})-v0(-val)?" for task, kinds in _OGBENCH_KINDS.items()))

_D4RL_FILES = {
    f"antmaze-{size}-{kind}-v2": (
        f"ant_maze_v2/Ant_maze_{maze}_noisy_multistart_True_multigoal_{multigoal}_sparse_fixed.hdf5"
    )
    for size, maze in (("medium", "big-maze"), ("large", "hardest-maze"))
    for kind, multigoal in (("play", False), ("diverse", True))
} | {
    "kitchen-complete-v0": "kitchen/mini_kitchen_microwave_kettle_light_slider-v0.hdf5",
    "kitchen-partial-v0": "kitchen/kitchen_microwave_kettle_light_slider-v0.hdf5",
    "kitchen-mixed-v0": "kitchen/kitchen_microwave_kettle_bottomburner_light-v0.hdf5",
}


@dataclass(frozen=True)
class PublicDataset:
    """Describe a public data file.

    Attributes:
        name: its public name.
        file_name: name of the downloaded file.
        urls: its addresses, the original first.
    """

    name: str
    file_name: str
    urls: tuple[str, ...]


def find(name: str) -> PublicDataset | None:
    """Return the public data set called ``name``, of OGBench (also ``-val``) or D4RL; None if there is none."""
    if _OGBENCH_NAME.fullmatch(name):
        return PublicDataset(name, f"{name}.npz", tuple(f"{base}{name}.npz" for base in _OGBENCH))
    if name in _D4RL_FILES:
        return PublicDataset(name, f"{name}.hdf5", (_D4RL + _D4RL_FILES[name],))
    return None


def examples() -> str:
    """Return example names for an error line."""
    return "antmaze-large-navigate-v0 (OGBench), antmaze-large-play-v2 (D4RL)"
