"""What was found inside finished runs, read from their inside.npz (written by ``qdos_brax.analysis.inside``)."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.report.elements import PALETTE
from qdos_brax.report.study import Member, Run, Study
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_flag

# By quality code. Collected data have four codes, 0 for good behaviour; other data may have more.
QUALITY_COLOURS = ("#009E73", "#56B4E9", "#E69F00", "#D55E00", "#CC79A7", "#0072B2")
WALL_COLOUR = "#b4bac2"
_NO_PART, _SEVERAL_PARTS = "#9aa1aa", "#5b6470"


class MemberAnalysis(NamedTuple):
    """Hold what was found of one member. Any array may be missing: not every task and method can give all of them.

    Attributes:
        member: the member.
        label: its setting and seed.
        data: the arrays that all members of the run share.
        own: its own arrays.
    """

    member: Member
    label: str
    data: dict[str, np.ndarray]
    own: dict[str, np.ndarray]


def read_analyses(study: Study) -> tuple[list[MemberAnalysis], list[str]]:
    """Read the analyses of all runs of a study.

    Returns:
        The analyses, and one line for each file that cannot be read: a page without it is better than none.
    """
    analyses: list[MemberAnalysis] = []
    notes = []
    for run in study.runs:
        try:
            analyses += _read_run(study, run)
        except UserError as error:
            notes.append(str(error))
    return analyses, notes


def quality_names(analysis: MemberAnalysis) -> list[str]:
    """Return the names of the quality codes 0, 1, ..; numbered names if the file has none, [] if it has no codes."""
    codes = analysis.data.get("quality")
    if codes is None:
        return []
    names = [str(name) for name in analysis.data.get("quality_names", ())]
    return names + [f"quality {code}" for code in range(len(names), int(codes.max(initial=-1)) + 1)]


def quality_colours(analysis: MemberAnalysis) -> list[str]:
    """Return one colour for each of ``quality_names``."""
    return [QUALITY_COLOURS[code % len(QUALITY_COLOURS)] for code in range(len(quality_names(analysis)))]


def part_names(analysis: MemberAnalysis) -> list[str]:
    """Return what the codes of ``part`` stand for: "none", the parts of the task, "several"; [] without them."""
    return [str(name) for name in analysis.data.get("part_names", ())] if "part" in analysis.data else []


def part_colours(analysis: MemberAnalysis) -> list[str]:
    """Return one colour for each of ``part_names``: greys for none and several."""
    parts = max(0, len(part_names(analysis)) - 2)
    colours = [PALETTE[i % len(PALETTE)] for i in range(parts)]
    return [_NO_PART, *colours, _SEVERAL_PARTS] if parts else []


def quality_groups(analysis: MemberAnalysis, segments: int) -> Iterator[tuple[np.ndarray, str, str]]:
    """Yield (mask bool[segments], colour, name) for each kind of behaviour in the data; one group if it is unknown."""
    quality = analysis.data.get("quality")
    if quality is None:
        yield np.ones(segments, bool), QUALITY_COLOURS[1], "segments"
        return
    for code, (name, colour) in enumerate(zip(quality_names(analysis), quality_colours(analysis), strict=True)):
        if (quality == code).any():
            yield quality == code, colour, name


def maze_extent(analysis: MemberAnalysis) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return (lower corner[2], upper corner[2], half a cell) of the maze; None for a task without walls."""
    walls = analysis.data.get("walls", np.zeros((0, 2)))
    columns = np.unique(walls[:, 0])
    if len(columns) < 2:
        return None
    half = 0.5 * float(np.diff(columns).min())
    return walls.min(axis=0) - half, walls.max(axis=0) + half, half


def _read_run(study: Study, run: Run) -> list[MemberAnalysis]:
    file = RunFolder(run.path).inside
    if not file.is_file():
        return []
    try:
        with np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        members = {int(index): run.members[int(index)] for index in arrays["members"]}
    except (OSError, EOFError, LookupError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(
            f"cannot read {file} ({error}); delete it, and {resume_flag(run.path)} creates it again"
        ) from error
    shared = {name: array for name, array in arrays.items() if "/" not in name}
    return [
        MemberAnalysis(member, _label(study, member), shared, _of_member(arrays, index))
        for index, member in members.items()
    ]


def _of_member(arrays: dict[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
    """Return the arrays "index/name" under their plain names."""
    return {name.partition("/")[2]: array for name, array in arrays.items() if name.startswith(f"{index}/")}


def _label(study: Study, member: Member) -> str:
    setting = next(s.label for s in study.settings if any(m is member for m in s.members.get(member.task, [])))
    return f"{setting}, seed {member.seed}" + (f", {member.task}" if len(study.tasks) > 1 else "")
