"""What experts are trained on: a body on an open floor, a commanded direction, a reward."""

from __future__ import annotations

from collections.abc import Callable

from qdos_brax.collection.experts.tasks.ant import AntDribbling, AntWalking
from qdos_brax.collection.experts.tasks.base import ExpertTask
from qdos_brax.collection.experts.tasks.humanoid import HumanoidRising, HumanoidWalking

TASKS: dict[str, Callable[[], ExpertTask]] = {
    task.name: task for task in (AntWalking, AntDribbling, HumanoidWalking, HumanoidRising)
}
"""The tasks by the names of their experts."""
