"""What a scripted demonstrator is: a program that plays a task by itself, in NumPy, for its offline data."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from envs.task import Task


class SimStates(NamedTuple):
    """Hold n simulations before a control step, in NumPy; a demonstrator reads these arrays and changes none.

    Attributes:
        qpos: float64[n, nq], exact; at the start of an episode what ``begin`` returned, rounded to float32.
        qvel: float64[n, nv], likewise.
        extra: int32[n, e], the discrete state; e may be 0.
        sensed: float32[n, k], what the task's rig senses, errors included; k may be 0.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray


class Demonstrator(Protocol):
    """Play episodes in n simulations at once, in NumPy.

    A class is registered by the name of its family of tasks (``qdos_brax.collection.scripted``). What it remembers
    between two steps (a plan, a goal, a counter) it keeps itself; ``begin`` forgets all of it, since one demonstrator
    may play many episodes, one after another. All its random numbers come from the generators it is given.

    Args:
        env: the task; the set serves all tasks of its variant, so that goals are the demonstrator's own choice.
        n: simulations played at once, the n of all arrays.
        noise: standard deviation of the Gaussian noise on actions, in units of the action, but for noisy episodes.

    Attributes:
        version: raised whenever the same arguments give other actions or starts; part of the default sets' names.
        heavy_noise: standard deviation of the action noise in noisy episodes.
    """

    version: ClassVar[int]
    heavy_noise: ClassVar[float]

    def __init__(self, env: Task, n: int, noise: float) -> None: ...

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        """Start an episode in every simulation and return where it starts.

        Args:
            kinds: int8[n], the behaviour of each episode, codes of ``qdos_brax.data.quality.QUALITY``.
            rng: what the starts, and the demonstrator's own choices, are drawn from.

        Returns:
            The states. qpos and qvel are rounded to float32, as every start of the engine is. The caller senses:
            ``sensed`` may be anything here, such as an array of size 0, and is whole in what ``act`` gets.
        """
        ...

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return the next action of every simulation.

        It is called once per control step of the episodes that ``begin`` started, which last as long as the caller
        likes, success or not.

        Args:
            states: before the step.
            rng: what action noise and choices are drawn from.

        Returns:
            actions: float32[n, act] within [-1, 1], noise included.
            quality: int8[n], codes of ``QUALITY``: the behaviour in this very step, which may be better or worse than
                that of the episode.
        """
        ...
