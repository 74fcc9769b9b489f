"""Weights & Biases: the numbers of metrics.csv, one of its runs per member, in a group."""

from __future__ import annotations

import importlib
import json
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from qdos_brax.errors import UserError
from qdos_brax.files import parse_json, write_text
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import Row, measured, step_of

PROJECT = "qdos-brax"


def load() -> Any:
    """Return the package wandb.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module("wandb")
    except ImportError as error:
        raise UserError(
            'wandb is not installed: pip install -c constraints.txt -e ".[wandb]" installs it; or leave out --wandb '
            "(for a resumed run: set run.wandb to false in its config.yaml)"
        ) from error


class WandbLog:
    """Log a member's n-th row at step n, its numbers as "phase/column".

    A resumed run makes the same rows again after its checkpoint. Rows that the server has already are not sent again:
    it reports the next step that it expects.

    Args:
        folder: the run's folder; wandb.json in it keeps the run's name at the server.
        members: the population.
    """

    def __init__(self, folder: RunFolder, members: Sequence[Mapping[str, Any]]) -> None:
        self._folder, self._members = folder, members
        self._runs: list[Any] = []
        self._seen = [0] * len(members)  # rows so far, by member

    def begin(self, rows: Sequence[Row]) -> None:
        """Open the members' runs, and send the rows so far that the server lacks.

        Raises:
            UserError: the server refuses.
        """
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
                f"Weights & Biases refuses the run ({reason}); set WANDB_MODE=offline to keep it on this machine"
            ) from error
        self.append(rows)

    def append(self, rows: Sequence[Row]) -> None:
        """Send new rows."""
        for row in rows:
            index = int(row["member"])
            run, number = self._runs[index], self._seen[index]
            self._seen[index] += 1
            if number >= run.step:
                values = {f"{row['phase']}/{name}": value for name, value in measured(row, self._members).items()}
                run.log({"step": step_of(row), **values}, step=number, commit=True)

    def end(self) -> None:
        """Close the members' runs."""
        for run in self._runs:
            run.finish()

    def _group(self) -> str:
        """Return the common part of the members' names: random, since names must be unique at the server, and kept."""
        if not self._folder.wandb.exists():
            write_text(self._folder.wandb, json.dumps({"group": uuid.uuid4().hex[:8]}) + "\n")
        try:
            return str(parse_json(self._folder.wandb.read_text(encoding="utf-8"))["group"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{self._folder.wandb} is damaged ({error!r}); remove it to start new runs there"
            ) from error
