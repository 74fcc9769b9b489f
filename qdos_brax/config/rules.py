"""What a field of the configuration accepts, and the one clear line for everything else."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from qdos_brax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Rule:
    """What a field accepts.

    Attributes:
        kind: "int", "float", "bool", "text", "path", "widths" (a list of layer widths) or "seeds".
        low: smallest value accepted.
        high: largest value accepted.
        above: if True, ``low`` itself is refused.
        choices: the only texts accepted; empty for any.
    """

    kind: str
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[str, ...] = ()


def field(default: Any, rule: Rule, scan: bool = False) -> Any:
    """A dataclass field with its rule; ``scan`` if a scan may vary it."""
    return dataclasses.field(default=default, metadata={"rule": rule, "scan": scan})


def count(default: int, low: int = 1) -> Any:
    """A whole number from ``low`` on."""
    return field(default, Rule("int", low=low, high=2**31 - 1))


def number(default: float, low: float = 0.0, high: float = math.inf, above: bool = False, scan: bool = True) -> Any:
    """A real number from ``low`` to ``high``; ``above``: not ``low`` itself."""
    return field(default, Rule("float", low, high, above), scan)


def rate(default: float) -> Any:
    """A learning rate: above 0, at most 1."""
    return number(default, high=1.0, above=True)


def choice(default: str, *choices: str) -> Any:
    """One of a few words."""
    return field(default, Rule("text", choices=choices))


def flag(default: bool) -> Any:
    """True or false."""
    return field(default, Rule("bool"))


def widths(*default: int) -> Any:
    """Widths of layers."""
    return field(default, Rule("widths", low=1, high=2**20))


def convert(key: str, value: Any, leaf: dataclasses.Field[Any]) -> Any:
    """``value`` in the field's type, within its range."""
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
    if rule.kind == "widths":
        return tuple(int(_number_in(key, item, rule, whole=True)) for item in _some(key, items))
    if rule.kind == "seeds":
        return tuple(int(_number_in(key, item, rule, whole=True)) for item in _some(key, items))
    if isinstance(value, list | tuple) or len(items) > 1:
        if not leaf.metadata["scan"]:
            raise UserError(f"{key} takes one value, not a list: it shapes the program and cannot be scanned")
        numbers = tuple(_number_in(key, item, rule) for item in _some(key, items))
        return numbers if len(numbers) > 1 else numbers[0]
    single = _number_in(key, value, rule, whole=rule.kind == "int")
    return int(single) if rule.kind == "int" else single


def values_in(key: str, value: Any, whole: bool = False) -> tuple[float, ...]:
    """The numbers that ``value`` lists, or the one that it is, whatever the key's range."""
    return tuple(_number_in(key, item, Rule("float"), whole) for item in _some(key, _items(value)))


def choices_in(key: str, value: Any, rule: Rule) -> list[Any]:
    """What ``value`` lists of a field that takes one value; widths are a list, so several are lists in a list."""
    if rule.kind == "widths":
        nested = isinstance(value, list) and any(isinstance(item, list) for item in value)
        if isinstance(value, str) and ";" in value:
            raise UserError(f"{key}: several lists of widths are written [[64,64],[128,128]], not {value!r}")
        return _some(key, value) if nested else [value]
    return _some(key, [_read(item) for item in _items(value)])


def _read(item: Any) -> Any:
    """A piece of a text as YAML reads it, so that "true" is no word."""
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


def _number_in(key: str, value: Any, rule: Rule, whole: bool = False) -> float:
    """``value`` as a number in the rule's range; texts such as "1e5" (a text in YAML) are read too."""
    kind = "a whole number" if whole else "a number"
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
    return low if rule.high in (math.inf, 2**31 - 1) else f"{low} and at most {rule.high:.10g}"


def nearest(word: str, known: Sequence[str]) -> str:
    """', did you mean ...?' with the most similar known word; empty if none is similar."""
    last_words: dict[str, str] = {}
    for name in known:
        last_words.setdefault(name.rpartition(".")[2], name)
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if not near:
        near = [last_words[last] for last in difflib.get_close_matches(word.rpartition(".")[2], last_words, 1, 0.6)]
    return f", did you mean {near[0]!r}?" if near else ""
