"""Observers of metrics.csv: TensorBoard, Weights & Biases."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from qdos_brax.runs import wandb_log
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import Observer
from qdos_brax.runs.tensorboard import TensorBoard

_OBSERVERS: dict[str, Callable[[RunFolder, Sequence[Mapping[str, Any]]], Observer]] = {
    "tensorboard": lambda folder, members: TensorBoard(folder.tensorboard, members),
    "wandb": wandb_log.WandbLog,
}


def check(wanted: Any) -> None:
    """Raise UserError if something that ``wanted`` (the configuration's ``run``) asks for is not installed."""
    if wanted.wandb:
        wandb_log.load()


def make(wanted: Any, folder: RunFolder, members: Sequence[Mapping[str, Any]]) -> list[Observer]:
    """Return the observers that ``wanted`` asks for by name.

    Args:
        wanted: the configuration's ``run``.
        folder: the run's folder.
        members: the population, with the keys that metrics.csv has.
    """
    return [make_one(folder, members) for name, make_one in _OBSERVERS.items() if getattr(wanted, name)]
