"""The study that a report is about: members of finished runs, grouped by method and by what was varied."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from qdos_brax.config import Config, from_yaml, nearest, values_by_key
from qdos_brax.config.schema import format_value, get, leaves
from qdos_brax.errors import UserError
from qdos_brax.files import parse_json
from qdos_brax.report.published import Published
from qdos_brax.runs import comparison
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_command, resume_flag
from qdos_brax.runs.metrics import Row, read_rows

DATA = "data"  # the key under which a setting holds the data file's hash
# Keys that do not make a setting: seeds, paths, and the names of task and method, by which members are grouped anyway.
_NOT_A_SETTING = {
    "env",
    "method",
    "seed",
    "out",
    "dataset",
    *(key for key, _ in leaves(Config) if key.startswith("run.")),
    # How a scan's members were chosen and run; the values that it chose are among the other keys.
    "scan.combine",
    "scan.samples",
    "scan.draw_seed",
    "members_per_program",
}
_SETTING_KEYS = [key for key, _ in leaves(Config) if key not in _NOT_A_SETTING]  # those that do, besides DATA
# What methods that are compared on one task should have in common.
_BUDGET = ("preset", "physics", "high_level.env_steps", "eval.episodes", DATA)
_MOST_NAMED = 3


@dataclasses.dataclass(frozen=True)
class Member:
    """Hold one seed with one setting, trained to its end.

    Attributes:
        run: its run folder.
        task: the task's full name.
        method: the method's name.
        seed: its seed.
        values: by dotted key, everything in the configuration in which two settings may differ.
        success: at the last evaluation, 0 to 1; nan if it was never evaluated.
        score: the share of the task that episodes of the last evaluation did, 0 to 1; nan for a task without parts.
        first_goal: environment steps when the goal was first reached; nan if never.
        frozen: whether it was frozen because its numbers were no longer finite.
        rows: its rows of metrics.csv.
    """

    run: Path
    task: str
    method: str
    seed: int
    values: dict[str, Any]
    success: float
    score: float
    first_goal: float
    frozen: bool
    rows: list[Row]


@dataclasses.dataclass(frozen=True)
class Run:
    """Hold what a run folder says of a finished run.

    Attributes:
        path: the folder.
        config: its configuration.
        provenance: the content of run.json; empty if there is none.
        summary: the content of summary.json.
        members: its members, in the population's order.
    """

    path: Path
    config: Config
    provenance: dict[str, Any]
    summary: dict[str, Any]
    members: list[Member]


@dataclasses.dataclass(frozen=True)
class Setting:
    """Hold a method with one choice of its varied hyperparameters: one row of the tables, one colour of the figures.

    Attributes:
        label: its name, such as "qdos" or "qdos, alpha 0.3".
        method: the method's name.
        values: the values of what was varied, by dotted key.
        members: its members by task, one per seed.
    """

    label: str
    method: str
    values: dict[str, Any]
    members: dict[str, list[Member]]


@dataclasses.dataclass(frozen=True)
class Study:
    """Hold everything that one report is about.

    Attributes:
        runs: the runs.
        tasks: the full names of the tasks, sorted.
        settings: the settings, in the order in which they were given.
        reference: the setting that the others are compared with.
        notes: warnings to a reader who compares the settings, one line each.
        published: what others published for the tasks, if the reader asked for it.
    """

    runs: list[Run]
    tasks: list[str]
    settings: list[Setting]
    reference: Setting
    notes: list[str]
    published: list[Published] = dataclasses.field(default_factory=list)


def read_study(paths: Sequence[Path], reference: str | None = None, pooled: Sequence[str] = ()) -> Study:
    """Read runs and comparisons.

    Args:
        paths: folders of either kind.
        reference: the method or label to compare with; None for supe if it was run, or the first.
        pooled: keys that do not make a setting here, ``DATA`` among them: members that differ in them alone count as
            further seeds.

    Raises:
        UserError: a folder is not a run, has not finished or is empty; two members are the same; there is no such
            reference, or no such key.
    """
    for key in pooled:
        if key not in (DATA, *_SETTING_KEYS):
            raise UserError(f"--pool {key}: no key by which settings are told apart{nearest(key, _SETTING_KEYS)}")
    folders = [folder for path in paths for folder in _folders(path)]
    counts = Counter(folder.path.resolve() for folder in folders)
    for path, count in counts.items():
        if count > 1:
            raise UserError(f"{path} was given twice; give each run once")
    runs = [_read_run(folder) for folder in folders]
    settings = _settings([member for run in runs for member in run.members], pooled)
    return Study(
        runs=runs,
        tasks=sorted({member.task for run in runs for member in run.members}),
        settings=settings,
        reference=_reference(settings, reference),
        notes=list(_notes(settings, pooled)),
    )


def headline(study: Study, task: str) -> str:
    """Return the measure by which a task's settings are told apart: "success", or "score" where nobody succeeded."""
    members = [member for setting in study.settings for member in setting.members.get(task, [])]
    return "score" if any(m.score > 0 for m in members) and not any(m.success > 0 for m in members) else "success"


def final_results(members: Iterable[Member], measure: str) -> list[float]:
    """Return the success or score at the last evaluation of the members that were evaluated, 0 to 1."""
    return [result for member in members if not math.isnan(result := getattr(member, measure))]


def _folders(path: Path) -> list[RunFolder]:
    if comparison.is_comparison(path):
        return list(comparison.runs(path).values())
    return [RunFolder.open(path)]


def _read_run(folder: RunFolder) -> Run:
    config = from_yaml(folder.config)
    summary = folder.read_summary()
    if summary is None:
        raise UserError(f"the run in {folder.path} has not finished; continue it with: {resume_command(folder.path)}")
    rows = read_rows(folder.metrics)
    if not rows:
        raise UserError(f"{folder.metrics} has no rows, so there is nothing to report; leave this run out")
    provenance = _provenance(folder)
    values = {key: get(config, key) for key in _SETTING_KEYS}
    values[DATA] = provenance.get("dataset", {}).get("sha256", "")[:8]
    by_member: dict[str, list[Row]] = {}
    for row in rows:
        by_member.setdefault(row["member"], []).append(row)
    try:
        entries = enumerate(summary["members"])
        members = [_member(folder.path, summary, values, entry, by_member[str(i)]) for i, entry in entries]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder.summary} does not match {folder.metrics.name} or is damaged ({error!r}); delete it, and "
            f"{resume_flag(folder.path)} writes it again"
        ) from error
    return Run(folder.path, config, provenance, summary, members)


def _member(
    path: Path, summary: dict[str, Any], values: dict[str, Any], entry: dict[str, Any], rows: list[Row]
) -> Member:
    return Member(
        run=path,
        task=str(summary["env"]),
        method=str(summary["method"]),
        seed=int(entry["seed"]),
        values=values | values_by_key(entry),
        success=_number(entry["eval_success"]),
        score=_number(entry.get("eval_score")),
        first_goal=_number(entry["first_goal_step"]),
        frozen=entry["status"] != "ok",
        rows=rows,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _provenance(folder: RunFolder) -> dict[str, Any]:
    if not folder.provenance.is_file():
        return {}
    try:
        return dict(parse_json(folder.provenance.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"cannot read {folder.provenance}: {error}") from error


# --- Settings --------------------------------------------------------------------------------------------------


def _settings(members: Sequence[Member], pooled: Sequence[str]) -> list[Setting]:
    """Group members with the same method and equal values, but for those pooled, whatever their run folders."""
    methods = dict.fromkeys(member.method for member in members)
    varied = {method: [key for key in varied_keys(members, method) if key not in pooled] for method in methods}
    settings: dict[tuple[str, ...], Setting] = {}
    for member in members:
        values = {key: member.values[key] for key in varied[member.method]}
        named = _named(member, values, members)
        words = [f"{short_key(key, named)} {format_value(value)}" for key, value in named.items()]
        label = ", ".join([member.method, *words])
        setting = settings.setdefault((label, *map(str, values.values())), Setting(label, member.method, values, {}))
        others = setting.members.setdefault(member.task, [])
        for other in others:
            if other.seed == member.seed and all(other.values[key] == member.values[key] for key in pooled):
                where = f"{label}, seed {member.seed} on {member.task}"
                raise UserError(f"{other.run} and {member.run} both hold {where}; leave one out")
        others.append(member)
    return list(settings.values())


def _named(member: Member, values: dict[str, Any], members: Sequence[Member]) -> dict[str, Any]:
    """Return what a label names: the values, or if they are many, the run and those that vary within it."""
    if len(values) <= _MOST_NAMED:
        return values
    others = [other for other in members if other.method == member.method]
    own = [other for other in others if other.run == member.run]
    scanned = {key: value for key, value in values.items() if any(other.values[key] != value for other in own)}
    return scanned if len(own) == len(others) else {"run": member.run, **scanned}


def varied_keys(members: Sequence[Member], method: str) -> list[str]:
    """Return the keys in which members of the method differ on the same task."""
    keys: dict[str, None] = {}
    for task in dict.fromkeys(member.task for member in members):
        group = [member.values for member in members if (member.method, member.task) == (method, task)]
        for key in group[0] if group else ():
            if any(values[key] != group[0][key] for values in group):
                keys[key] = None
    if any(key.startswith("data.") for key in keys):
        keys.pop(DATA, None)  # the file differs because these keys do
    return list(keys)


def short_key(key: str, others: Iterable[str] = ()) -> str:
    """Return the last part of a dotted key in words, such as "advantage temperature".

    Args:
        key: the key.
        others: keys named beside it. Where one of them ends alike, and where a member's own seed does, all of it is
            returned, such as "data seed".
    """
    last = key.rpartition(".")[2]
    alike = [other for other in ("seed", *others) if other != key and other.rpartition(".")[2] == last]
    return (key if alike else last).replace(".", " ").replace("_", " ")


def _reference(settings: Sequence[Setting], name: str | None) -> Setting:
    if name is None:
        return next((setting for setting in settings if setting.method == "supe"), settings[0])
    for setting in settings:
        if name in (setting.label, setting.method):
            return setting
    labels = [setting.label for setting in settings]
    raise UserError(
        f"--reference {name}: no such method was run{nearest(name, labels)}; choose from: {'; '.join(labels)}"
    )


def _notes(settings: Sequence[Setting], pooled: Sequence[str]) -> Iterable[str]:
    """Yield a warning for unequal budgets, data and numbers of seeds, and for frozen and never evaluated members."""
    everyone = [member for setting in settings for members in setting.members.values() for member in members]
    pools_data = any(key.partition(".")[0] == DATA for key in pooled)
    for task in sorted({member.task for member in everyone}):
        for key in (key for key in _BUDGET if not (key == DATA and pools_data)):
            found = _methods_by_value([member for member in everyone if member.task == task], key)
            if len(found) > 1:
                parts = "; ".join(f"{value}: {', '.join(methods)}" for value, methods in found.items())
                yield f"{task}: the members differ in {short_key(key)} ({parts})"
        counts = {setting.label: len(setting.members[task]) for setting in settings if task in setting.members}
        if len(set(counts.values())) > 1:
            yield f"{task}: unequal numbers of seeds ({', '.join(f'{k}: {v}' for k, v in counts.items())})"
    for member in everyone:
        name = f"{member.run} ({member.method}, seed {member.seed})"
        if member.frozen:
            yield f"{name} was frozen: its numbers were no longer finite; it counts with its last evaluation"
        if math.isnan(member.success):
            yield f"{name} was never evaluated, so table 1 leaves it out"


def _methods_by_value(members: Sequence[Member], key: str) -> dict[str, dict[str, None]]:
    """Return the methods, as an ordered set, of the members that have each value of a key."""
    found: dict[str, dict[str, None]] = {}
    for member in members:
        found.setdefault(format_value(member.values[key]) or "unknown", {})[member.method] = None
    return found
