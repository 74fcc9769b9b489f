"""What the trainings of experts note down, and read again when they go on: their command line and their curve."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

CurveRow = dict[str, float]  # of a curve: numbers by column


def read_curve(path: Path) -> list[CurveRow]:
    """Return the rows of a curve's CSV file; what was written without a point is an int, and is written so again."""
    with open(path, encoding="utf-8") as file:
        return [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(file)]


def _number(text: str) -> float:
    return int(text) if text.lstrip("-").isdigit() else float(text)


def command_line(module: str, subject: str, args: argparse.Namespace, names: Sequence[str]) -> str:
    """Return the command line as it is recorded with what came of it, without folders.

    Args:
        module: of this package, that was run.
        subject: what it trained, its first argument.
        args: its flags.
        names: the flags to record, in order; those that were not given and have no default are left out.
    """
    given = {name: getattr(args, name) for name in names}
    flags = [
        f"--{name.replace('_', '-')} {value.name if isinstance(value, Path) else value}"
        for name, value in given.items()
        if value is not None
    ]
    return " ".join([f"python -m qdos_brax.collection.experts.{module}", subject, *flags])
