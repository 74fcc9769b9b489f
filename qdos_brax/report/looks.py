"""What was seen inside the runs, read from their inside.npz; what its arrays are says ``qdos_brax.analysis.inside``."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.report.study import Member, Run, Study
from qdos_brax.runs.folder import RunFolder

QUALITIES = ("good", "noisy", "wandering", "failing")  # by code, as data.quality.QUALITY has them
QUALITY_COLOURS = ("#009E73", "#56B4E9", "#E69F00", "#D55E00")  # of these
WALL = "#b4bac2"


class Look(NamedTuple):
    """What was found of one member.

    Attributes:
        member: whose it is.
        label: its setting and seed.
        data: the arrays that all members of the run share.
        own: its own arrays.
    """

    member: Member
    label: str
    data: dict[str, np.ndarray]
    own: dict[str, np.ndarray]


def read_looks(study: Study) -> tuple[list[Look], list[str]]:
    """Every look there is, and a line on each file that cannot be read: a page without it is better than none."""
    looks: list[Look] = []
    notes = []
    for run in study.runs:
        try:
            looks += _of_run(study, run)
        except UserError as error:
            notes.append(str(error))
    return looks, notes


def by_quality(look: Look) -> Iterator[tuple[np.ndarray, str, str]]:
    """(which segments, colour, name) of every kind of behaviour in the data; one for all where nobody knows."""
    quality = look.data.get("quality")
    if quality is None:
        yield np.ones(len(look.data["return"]), bool), QUALITY_COLOURS[1], "segments"
        return
    for code, name in enumerate(QUALITIES):
        if (quality == code).any():
            yield quality == code, QUALITY_COLOURS[code], name


def extent(look: Look) -> tuple[np.ndarray, np.ndarray, float]:
    """(lower corner[2], upper corner[2], half a cell) of the maze."""
    walls = look.data["walls"]
    half = 0.5 * float(np.diff(np.unique(walls[:, 0])).min())
    return walls.min(axis=0) - half, walls.max(axis=0) + half, half


def _of_run(study: Study, run: Run) -> list[Look]:
    file = RunFolder(run.path).inside
    if not file.is_file():
        return []
    try:
        with np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        members = {int(index): run.members[int(index)] for index in arrays["members"]}
    except (OSError, EOFError, LookupError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(f"cannot read {file} ({error}); remove it, and --resume {run.path} makes it again") from error
    shared = {name: array for name, array in arrays.items() if "/" not in name}
    several = len(study.tasks) > 1
    found = []
    for index, member in members.items():
        own = {name.partition("/")[2]: array for name, array in arrays.items() if name.startswith(f"{index}/")}
        label = next(s.label for s in study.settings if any(m is member for m in s.members.get(member.task, [])))
        found.append(
            Look(member, f"{label}, seed {member.seed}" + (f", {member.task}" if several else ""), shared, own)
        )
    return found
