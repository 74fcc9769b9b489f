"""Weights & Biases: the numbers of metrics.csv once more, one run of theirs per member, in a group."""

from __future__ import annotations

import importlib
import json
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import Row, measured, step_of

PROJECT = "qdos-brax"


def load() -> Any:
    """The package.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module("wandb")
    except ImportError as error:
        raise UserError(
            'wandb is not installed: pip install -c constraints.txt -e ".[wandb]" does it; or leave out --wandb '
            "(a run that goes on: run.wandb in its config.yaml)"
        ) from error


class WandbLog:
    """Logs a member's n-th row at step n, its numbers as "phase/column".

    A run that is gone on with makes the same rows again after its checkpoint. Those that the server has already are
    not sent twice: it says at which step it goes on.

    Args:
        folder: the run's folder; what names the run to the server is kept in it.
        members: what tells the members apart.
    """

    def __init__(self, folder: RunFolder, members: Sequence[Mapping[str, Any]]) -> None:
        self._folder, self._members = folder, members
        self._runs: list[Any] = []
        self._told = [0] * len(members)  # rows so far, by member

    def begin(self, rows: Sequence[Row]) -> None:
        """Opens the members' runs, and sends what the server lacks of the rows so far."""
        wandb, group = load(), self._group()
        try:
            for index, member in enumerate(self._members):
                run = wandb.init(
                    project=PROJECT,
                    group=f"{self._folder.path.resolve().name}-{group}",
                    id=f"{group}-{index}",
                    name=", ".join(f"{key} {value}" for key, value in member.items()),
                    config=dict(member),
                    dir=str(self._folder.path),
                    resume="allow",
                    reinit="create_new",
                )
                run.define_metric("*", step_metric="step")
                self._runs.append(run)
        except wandb.Error as error:
            reason = " ".join(str(error).split())
            raise UserError(
                f"Weights & Biases does not take the run ({reason}); WANDB_MODE=offline keeps it here"
            ) from error
        self.append(rows)

    def append(self, rows: Sequence[Row]) -> None:
        """Sends new rows."""
        for row in rows:
            index = int(row["member"])
            run, number = self._runs[index], self._told[index]
            self._told[index] += 1
            if number >= run.step:
                values = {f"{row['phase']}/{name}": value for name, value in measured(row, self._members).items()}
                run.log({"step": step_of(row), **values}, step=number, commit=True)

    def end(self) -> None:
        """Closes the members' runs."""
        for run in self._runs:
            run.finish()

    def _group(self) -> str:
        """What the members' runs have in common: drawn once, for names at the server must be nobody else's."""
        if not self._folder.wandb.exists():
            write_text(self._folder.wandb, json.dumps({"group": uuid.uuid4().hex[:8]}) + "\n")
        try:
            return str(json.loads(self._folder.wandb.read_text(encoding="utf-8"))["group"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{self._folder.wandb} is damaged ({error!r}); remove it, and new runs begin there"
            ) from error
