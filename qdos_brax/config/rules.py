"""Rules of the configuration's fields: what each accepts, and one clear line for everything else."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from qdos_brax.errors import UserError

MAX_COUNT = 2**31 - 1
AUTO = "auto"  # where a field accepts it: the number is found while training
_PLAIN_KINDS = {"bool": "true or false", "text": "text", "path": "path"}
_NUMBER_KINDS = {
    "int": "whole number",
    "float": "number",
    "widths": "one or more whole numbers",
    "seeds": "one or more whole numbers",
}


@dataclasses.dataclass(frozen=True)
class Rule:
    """Hold what a field accepts.

    Attributes:
        kind: "int", "float", "bool", "text", "path", "widths" (a list of layer widths) or "seeds".
        low: smallest value accepted.
        high: largest value accepted.
        above: whether ``low`` itself is refused.
        choices: the only texts accepted; empty for any.
        auto: whether ``AUTO`` is accepted in a number's place.
    """

    kind: str
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[str, ...] = ()
    auto: bool = False


def field(
    default: Any, meaning: str, rule: Rule, *, scan: bool = False, label: str = "", pretrain: bool = False
) -> Any:
    """Return a dataclass field with its rule and its marks.

    Args:
        default: the paper's value.
        meaning: what the value means, for ``python -m qdos_brax config``.
        rule: the values accepted.
        scan: whether the members of one program may have different values.
        label: short name of the key: its flag on the command line, its column in metrics.csv and its entry in
            summary.json, which are there for every run; empty for none.
        pretrain: whether ``--pretrain-steps`` sets it.
    """
    marks = {"meaning": meaning, "rule": rule, "scan": scan, "label": label, "pretrain": pretrain}
    return dataclasses.field(default=default, metadata=marks)


def count(default: int, meaning: str, low: int = 1, pretrain: bool = False) -> Any:
    """Return a field for a whole number, at least ``low``."""
    return field(default, meaning, Rule("int", low=low, high=MAX_COUNT), pretrain=pretrain)


def number(
    default: float,
    meaning: str,
    low: float = 0.0,
    high: float = math.inf,
    above: bool = False,
    scan: bool = True,
    label: str = "",
    auto: bool = False,
) -> Any:
    """Return a field for a real number in [low, high], or in (low, high] if ``above``; or ``AUTO``, if ``auto``."""
    return field(default, meaning, Rule("float", low, high, above, auto=auto), scan=scan, label=label)


def rate(default: float, meaning: str = "Adam learning rate") -> Any:
    """Return a field for a learning rate in (0, 1]."""
    return number(default, meaning, high=1.0, above=True)


def schedule(end: str) -> Any:
    """Return a field for how a learning rate goes on until ``end``."""
    return choice(
        "constant", f"how the learning rate goes on: constant, or cosine (down to 0 at {end})", "constant", "cosine"
    )


def choice(default: str, meaning: str, *choices: str) -> Any:
    """Return a field for one of a few words."""
    return field(default, meaning, Rule("text", choices=choices))


def flag(default: bool, meaning: str) -> Any:
    """Return a field for true or false."""
    return field(default, meaning, Rule("bool"))


def widths(default: tuple[int, ...], meaning: str) -> Any:
    """Return a field for the widths of layers."""
    return field(default, meaning, Rule("widths", low=1, high=2**20))


def describe(rule: Rule) -> str:
    """Return the accepted values in words, as "number, above 0 and at most 1"."""
    if rule.choices:
        return f"one of {', '.join(rule.choices)}"
    if rule.kind in _PLAIN_KINDS:
        return _PLAIN_KINDS[rule.kind]
    return f"{_NUMBER_KINDS[rule.kind]}, {_range(rule)}" + (f", or {AUTO}" if rule.auto else "")


def convert(key: str, value: Any, leaf: dataclasses.Field[Any]) -> Any:
    """Return ``value`` in the field's type.

    Raises:
        UserError: the value is of another type or out of range.
    """
    rule: Rule = leaf.metadata["rule"]
    if rule.kind == "path":
        return _path(key, value)
    if rule.kind == "bool":
        if not isinstance(value, bool):
            raise UserError(f"{key} must be true or false, not {value!r}")
        return value
    if rule.kind == "text":
        return _text(key, value, rule)
    items = _items(value)
    if rule.kind in ("widths", "seeds"):
        return tuple(int(_number_in(key, item, rule, whole=True)) for item in _some(key, items))
    if isinstance(value, list | tuple) or len(items) > 1:
        if not leaf.metadata["scan"]:
            raise UserError(f"{key} takes one value, not a list: it shapes the program and cannot be scanned")
        listed = listed_in(key, value, rule)
        return listed if len(listed) > 1 else listed[0]
    return int(_number_in(key, value, rule, whole=True)) if rule.kind == "int" else _number_or_auto(key, value, rule)


def listed_in(key: str, value: Any, rule: Rule) -> tuple[float | str, ...]:
    """Return what ``value`` lists, or its one entry, each within the rule."""
    return tuple(_number_or_auto(key, item, rule) for item in _some(key, _items(value)))


def values_in(key: str, value: Any) -> tuple[float, ...]:
    """Return the numbers that ``value`` lists, or its one number, whatever the key's range."""
    return tuple(_number_in(key, item, Rule("float")) for item in _some(key, _items(value)))


def choices_in(key: str, value: Any, rule: Rule) -> list[Any]:
    """Return the alternatives that ``value`` lists for a field that takes one; several widths are lists in a list."""
    if rule.kind == "widths":
        nested = isinstance(value, list) and any(isinstance(item, list) for item in value)
        if isinstance(value, str) and ";" in value:
            raise UserError(f"{key}: several lists of widths are written [[64,64],[128,128]], not {value!r}")
        return _some(key, value) if nested else [value]
    return _some(key, [_read(item) for item in _items(value)])


def _read(item: Any) -> Any:
    """Read a piece of a text as YAML does, so that "true" is no word."""
    return yaml.safe_load(item) if isinstance(item, str) else item


def _path(key: str, value: Any) -> str | None:
    if value is None:
        return None
    if not isinstance(value, str | Path) or not str(value):
        raise UserError(f"{key} must be a path, not {value!r}")
    return str(value)


def _text(key: str, value: Any, rule: Rule) -> str:
    if not isinstance(value, str) or not value:
        raise UserError(f"{key} must be a word, not {value!r}")
    if rule.choices and value not in rule.choices:
        raise UserError(f"{key} must be one of {', '.join(rule.choices)}, not {value!r}{nearest(value, rule.choices)}")
    return value


def _items(value: Any) -> list[Any]:
    if isinstance(value, str):
        return value.strip("()[] ").split(",") if value.strip("()[] ") else []
    return list(value) if isinstance(value, list | tuple) else [value]


def _some(key: str, items: list[Any]) -> list[Any]:
    if not items:
        raise UserError(f"{key} must not be empty")
    return items


def _number_or_auto(key: str, value: Any, rule: Rule) -> float | str:
    return AUTO if rule.auto and isinstance(value, str) and value.strip() == AUTO else _number_in(key, value, rule)


def _number_in(key: str, value: Any, rule: Rule, whole: bool = False) -> float:
    """Return ``value`` as a number in the rule's range; it may be a text such as "1e5", which YAML takes for a text."""
    kind = "a whole number" if whole else "a number or auto" if rule.auto else "a number"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise UserError(f"{key} must be {kind}, not {value!r}")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise UserError(f"{key} must be {kind}, not {value!r}") from None
    if not math.isfinite(number):
        raise UserError(f"{key} must be finite, not {value}")
    if whole and number != int(number):
        raise UserError(f"{key} must be {kind}, not {value}")
    if number < rule.low or number > rule.high or (rule.above and number == rule.low):
        raise UserError(f"{key} must be {_range(rule)}, not {value}")
    return number


def _range(rule: Rule) -> str:
    low = f"{'above' if rule.above else 'at least'} {rule.low:.10g}"
    return low if rule.high in (math.inf, MAX_COUNT) else f"{low} and at most {rule.high:.10g}"


def nearest(word: str, known: Sequence[str]) -> str:
    """Return ", did you mean ..?" with the most similar known word; empty if none is similar."""
    last_words: dict[str, str] = {}
    for name in known:
        last_words.setdefault(name.rpartition(".")[2], name)
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if not near:
        near = [last_words[last] for last in difflib.get_close_matches(word.rpartition(".")[2], last_words, 1, 0.6)]
    return f", did you mean {near[0]!r}?" if near else ""
