"""Exchange things that nobody touched between episodes: what was seen one at a time is seen together.

Counterfactual data augmentation (Pitis, Creager and Garg 2020, "Counterfactual Data Augmentation using Locally Factored
Dynamics", algorithm 1): where a thing rests and nothing meets it, what happens does not depend on how it stands. Here
the factors are a task's ``things``, and one that rests throughout an episode is taken to be met by nothing in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from envs.task import Task
from envs.things import Thing
from qdos_brax.data.dataset import Dataset

RESTS = 0.02  # m or rad: the most that a thing's numbers differ while it rests; contacts make it tremble
SLOW = 0.05  # m/s or rad/s: the most at which a thing moves that an episode has left standing

_NUMBERS = {
    "observations": "observed",
    "next_observations": "observed",
    "qpos": "qpos",
    "qvel": "qvel",
    "extra": "extra",
}
"""By array of the data, which of a ``Thing``'s numbers it holds."""


def exchanged(dataset: Dataset, env: Task, share: float, seed: int) -> Dataset:
    """Return the data with counterfactual episodes in the place of some.

    In a ``share`` of the episodes all things that rest from the first step to the last are as a random episode left
    them, with the parts of the task that it had completed by them; rewards and masks are the task's own of these
    states. Rows, actions and ends stay.

    Args:
        dataset: with qpos and qvel, and the discrete state where a thing has numbers of it.
        env: the task; its ``things`` are exchanged.
        share: of the episodes; 0 returns ``dataset`` itself.
        seed: of the choice of episodes.
    """
    if share == 0:
        return dataset
    old = {name: array for name in _NUMBERS if (array := getattr(dataset, name)) is not None}
    new = {name: array.copy() for name, array in old.items()}
    bounds, rng = dataset.episode_bounds, np.random.default_rng(seed)
    chosen = bounds[rng.random(len(bounds)) < share]
    givers = bounds[rng.integers(len(bounds), size=len(chosen)), 1] - 1
    for (first, stop), giver in zip(chosen, givers, strict=True):
        for thing in _exchangeable(old["qpos"][first:stop], old["qvel"][giver], env.things):
            for name in new:
                numbers = list(getattr(thing, _NUMBERS[name]))
                # The state after a row is one in which the thing stands, too.
                new[name][first:stop, numbers] = old[name.removeprefix("next_")][giver, numbers]
    moved = dataclasses.replace(dataset, **new)
    rewards, masks = env.labels(moved)
    return dataclasses.replace(moved, rewards=rewards, masks=masks)


def _exchangeable(qpos: np.ndarray, giver_qvel: np.ndarray, things: Sequence[Thing]) -> list[Thing]:
    """Return the things that rest in all of qpos[T, nq], and stand where they are given from, at giver_qvel[nv]."""
    return [
        thing
        for thing in things
        if np.ptp(qpos[:, list(thing.qpos)], axis=0).max() < RESTS and np.abs(giver_qvel[list(thing.qvel)]).max() < SLOW
    ]
