"""Settings: members grouped by method and by what was varied, their labels, and what makes them unlike."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from qdos_brax.config import Config, nearest
from qdos_brax.config.schema import format_value, leaves
from qdos_brax.errors import UserError
from qdos_brax.report.study import Member, Setting

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
SETTING_KEYS = [key for key, _ in leaves(Config) if key not in _NOT_A_SETTING]  # those that do, besides DATA
# What methods that are compared on one task should have in common.
_BUDGET = ("preset", "physics", "high_level.env_steps", "eval.episodes", DATA)
_MOST_NAMED = 3


def settings_of(members: Sequence[Member], pooled: Sequence[str]) -> list[Setting]:
    """Join members with the same method and equal values, but for those pooled, whatever their run folders.

    Args:
        members: the members.
        pooled: keys that do not make a setting, ``DATA`` among them.

    Raises:
        UserError: two members are the same.
    """
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


def reference_of(settings: Sequence[Setting], name: str | None) -> Setting:
    """Return the setting of that label or method; by default supe's, or else the first.

    Raises:
        UserError: there is none.
    """
    if name is None:
        return next((setting for setting in settings if setting.method == "supe"), settings[0])
    for setting in settings:
        if name in (setting.label, setting.method):
            return setting
    labels = [setting.label for setting in settings]
    raise UserError(
        f"--reference {name}: no such method was run{nearest(name, labels)}; choose from: {'; '.join(labels)}"
    )


def notes_on(settings: Sequence[Setting], pooled: Sequence[str]) -> Iterable[str]:
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
