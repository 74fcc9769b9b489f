"""The run folder: its files, and the lock by which one process at a time may write to it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from qdos_brax.errors import UserError
from qdos_brax.files import is_partial, parse_json, user_errors
from qdos_brax.runs.hints import resume_flag


class RunFolder:
    """Name the files of a run's folder, and hold its lock.

    Attributes:
        path: the folder.
        config: config.yaml, complete and resolved.
        metrics: metrics.csv, one row per member and log point.
        provenance: run.json: the command, the data file's hash, the versions of the packages.
        summary: summary.json, present once the run has finished.
        tensorboard: folder of TensorBoard's event files.
        wandb: wandb.json, the run's name at Weights & Biases if it is logged there.
        inside: inside.npz, the analysis of the finished run.
        checkpoints: folder of the checkpoints.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.provenance = self.path / "run.json"
        self.metrics = self.path / "metrics.csv"
        self.summary = self.path / "summary.json"
        self.tensorboard = self.path / "tensorboard"
        self.wandb = self.path / "wandb.json"
        self.inside = self.path / "inside.npz"
        self.checkpoints = self.path / "checkpoints"

    @classmethod
    def create(cls, path: str | Path) -> RunFolder:
        """Create a run folder; ``path`` must be absent, empty, or left by a run that had not begun to train.

        Raises:
            UserError: there is something else at ``path``, or it cannot be written.
        """
        folder = cls(path)
        with user_errors(folder.path):
            if folder.metrics.exists():
                how = f"continue with {resume_flag(folder.path)} or choose another --out"
                raise UserError(f"{folder.path} holds a run already; {how}")
            before_training = {folder.config, folder.provenance, folder.checkpoints, folder.path / ".lock"}
            found = set(folder.path.iterdir()) if folder.path.exists() else set()
            if any(path not in before_training and not is_partial(path) for path in found):
                raise UserError(f"{folder.path} is not empty; choose another --out")
            folder.checkpoints.mkdir(parents=True, exist_ok=True)
        return folder

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Return the folder of a run that was started before.

        Raises:
            UserError: there is no run at ``path``.
        """
        folder = cls(path)
        if not folder.config.is_file():
            raise UserError(f"{folder.path} is not a run folder: it has no config.yaml")
        return folder

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder for this process; the lock ends with the process, however that ends.

        Raises:
            UserError: another process holds it, or it cannot be written.
        """
        with user_errors(self.path):
            descriptor = os.open(self.path / ".lock", os.O_CREAT | os.O_RDWR, 0o644)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"another process works in {self.path}; wait for it or stop it") from None
            yield
        finally:
            os.close(descriptor)

    def is_held(self) -> bool:
        """Return whether a process holds the lock."""
        try:
            with self.held():
                return False
        except UserError:
            return True

    def read_origin(self) -> dict[str, Any]:
        """Return the content of run.json.

        Raises:
            UserError: the file is damaged.
        """
        try:
            content = dict(parse_json(self.provenance.read_text(encoding="utf-8")))
            if not isinstance(content["dataset"]["sha256"], str):
                raise ValueError("dataset.sha256 is no text")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{self.provenance} is damaged ({error!r}); restore it, or start a new run") from error
        return content

    def read_summary(self) -> dict[str, Any] | None:
        """Return the content of summary.json; None if the run has not finished.

        Raises:
            UserError: the file is damaged.
        """
        if not self.summary.is_file():
            return None
        try:
            return dict(parse_json(self.summary.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as error:
            raise UserError(f"cannot read {self.summary}: {error}; remove it and --resume writes it again") from error


def new_path(root: str | Path, name: str) -> Path:
    """Return a folder under ``root`` that does not exist yet: the name and the time, numbered if taken."""
    base = Path(root) / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    path, count = base, 1
    while path.exists():
        count += 1
        path = base.with_name(f"{base.name}-{count}")
    return path
