"""What the phases of a run are made from."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from envs.body_frame import Frame
from qdos_brax.config import Config
from qdos_brax.config.methods import Method
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.methods.given_skills import GivenSkills
from qdos_brax.offline.learner import Learner
from qdos_brax.offline.offline_phase import Evaluation, OfflinePhase


class SpaceSizes(Protocol):
    """Give the sizes of a task's observations and actions, and how they turn; every environment does."""

    observation_size: int
    action_size: int
    body_frame: Frame | None


class BuildContext(NamedTuple):
    """Hold what every phase of a run is made from.

    Attributes:
        config: the run's configuration.
        method: its method.
        env: the task.
        dataset: the data, labelled for that task.
        data: the same on the default device, normalised.
        normaliser: of observations.
        given: skills that the run begins on, or None where it learns its own.
    """

    config: Config
    method: Method
    env: Any
    dataset: Dataset
    data: DeviceData
    normaliser: Normaliser
    given: GivenSkills | None


def offline_phase(
    context: BuildContext,
    name: str,
    learner: Learner,
    updates: int,
    evaluation: Evaluation | None = None,
    reads: tuple[str, ...] = (),
    drops: tuple[str, ...] = (),
) -> OfflinePhase:
    """Return the phase that trains a learner on the data; it leaves the learner's parameters under ``name``."""
    return OfflinePhase(name, learner, context.normaliser, updates, evaluation, reads, drops)
