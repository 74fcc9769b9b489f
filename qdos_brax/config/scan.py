"""The axis of seeds and hyperparameters, which a scan varies without a new compilation."""

from __future__ import annotations

import itertools
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from qdos_brax.config.rules import AUTO, Rule, convert, listed_in, values_in
from qdos_brax.config.run_groups import ScanConfig
from qdos_brax.config.schema import Config, get, get_field, labelled, leaves
from qdos_brax.errors import UserError

_DISTRIBUTION = re.compile(r"\s*(\w+)\s*\(([^(),]*),([^(),]*)\)\s*")
_DRAWS_PER_SETTING = 100
_AUTO_NUMBER = -1.0  # what ``AUTO`` is among a member's numbers: the fields that accept it have none below 0


def is_auto(number: Any) -> Any:
    """Return whether a number of ``hyper_tree`` (or each of an array) stands for auto."""
    return number == _AUTO_NUMBER


def asks_auto(value: Any) -> bool:
    """Return whether a field's value is auto, or a list with it."""
    return AUTO in (value if isinstance(value, tuple) else (value,))


def hyper_tree(config: Config, member: Mapping[str, Any] | None = None) -> dict[str, float]:
    """Return the numbers that a scan may vary, by dotted key ("skills.alpha").

    Args:
        config: the run's configuration.
        member: one of ``members(config)``; its values replace the lists of the configuration.

    Raises:
        UserError: a field holds a list and there is no member to choose one of its values.
    """
    chosen = {} if member is None else values_by_key(member)
    tree = {}
    for key, field in leaves(Config):
        if field.metadata["scan"]:
            value = chosen.get(key, get(config, key))
            if isinstance(value, tuple):
                raise UserError(f"{key} holds {len(value)} values where one is wanted")
            tree[key] = _AUTO_NUMBER if value == AUTO else float(value)
    return tree


def members(config: Config) -> list[dict[str, Any]]:
    """Return the population: one dict per member, all different.

    Each holds "seed", the labelled keys by their label ("alpha"), and every other field that varies by its dotted key.
    ``config.scan`` decides how the lists combine: by product, seeds first; as pairs, seeds included; or, if settings
    were drawn, every seed with every setting.
    """
    varied = _varied(config)
    if config.scan.samples:
        seeds = [("seed", seed) for seed in varied.pop("seed")]
        rows = [(seed, *setting) for seed, setting in itertools.product(seeds, _pairs(varied))]
    elif config.scan.combine == "zip":
        rows = list(_pairs(varied))
    else:
        rows = list(itertools.product(*([(key, value) for value in values] for key, values in varied.items())))
    labels = {key: label for label, key in labelled().items()}
    return [{labels.get(key, key): value for key, value in row} for row in dict.fromkeys(rows)]


def values_by_key(member: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a member, or of its entry in summary.json, by dotted key; the seed is none.

    Raises:
        KeyError: a labelled key is missing.
    """
    dotted = {key: value for key, value in member.items() if "." in key}
    return dotted | {key: member[label] for label, key in labelled().items()}


def population_hyper(config: Config, chosen: Sequence[Mapping[str, Any]] | None = None) -> dict[str, np.ndarray]:
    """Stack ``hyper_tree`` over the ``chosen`` members (None for all): float32[members] by dotted key."""
    trees = [hyper_tree(config, member) for member in (members(config) if chosen is None else chosen)]
    return {key: np.asarray([tree[key] for tree in trees], np.float32) for key in trees[0]}


def check(config: Config) -> None:
    """Check that the lists of a configuration make a scan.

    Raises:
        UserError: two members are the same, or lists to be paired have unequal lengths.
    """
    several = {key: values for key, values in _varied(config).items() if len(values) > 1}
    if config.scan.samples:
        several = {key: values for key, values in several.items() if key == "seed"}
    elif config.scan.combine == "zip":
        if len({len(values) for values in several.values()}) > 1:
            counts = ", ".join(f"{key} {len(values)}" for key, values in several.items())
            raise UserError(f"--zip pairs lists of one length, and these have {counts} values")
        rows = list(_pairs(several))
        for row in rows:
            if rows.count(row) > 1:
                raise UserError(f"--zip makes the same member twice: {', '.join(f'{k} {v}' for k, v in row)}")
        return
    for key, values in several.items():
        if len(set(values)) < len(values):
            raise UserError(f"{key} holds the same value twice: {', '.join(map(str, values))}")


def drawn(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace distributions and lists by drawn numbers, if ``scan.samples`` asks for them.

    "uniform(a,b)" and "loguniform(a,b)" are drawn from, values of a list are drawn with equal chances, and no setting
    comes twice.

    Args:
        values: by dotted key, not converted yet.

    Raises:
        UserError: a distribution is wrong or nothing is to be drawn, or there are fewer settings than asked for.
    """
    scannable = [key for key, field in leaves(Config) if field.metadata["scan"] and key in values]
    written = {key: distribution(key, values[key]) for key in scannable}
    wanted = {key: found for key, found in written.items() if found is not None}
    count = convert("scan.samples", values.get("scan.samples", 0), get_field("scan.samples"))
    if not count:
        for key in wanted:
            raise UserError(f"{key}={values[key]} is drawn from with --sample N; give N")
        return dict(values)
    if values.get("scan.combine", ScanConfig.combine) != ScanConfig.combine:
        raise UserError("--sample draws its own settings; leave out --zip")
    seed = convert("scan.draw_seed", values.get("scan.draw_seed", 0), get_field("scan.draw_seed"))
    streams: dict[str, Iterator[float | str]] = {}
    for key in scannable:
        stream = np.random.default_rng([seed, zlib.crc32(key.encode())])
        if key in wanted:
            streams[key] = _draws(*wanted[key], stream)
        elif len(listed := listed_in(key, values[key], Rule("float", auto=True))) > 1:
            streams[key] = _choices(listed, stream)
    if not streams:
        raise UserError("--sample has nothing to draw; give a key as --set 'skills.alpha=loguniform(0.1,3)' or a list")
    settings: dict[tuple[float | str, ...], None] = {}
    for _ in range(_DRAWS_PER_SETTING * count):
        if len(settings) == count:
            break
        settings[tuple(next(stream) for stream in streams.values())] = None
    if len(settings) < count:
        raise UserError(f"--sample {count} asks for more settings than there are ({len(settings)})")
    columns = zip(*settings, strict=True)
    return {**values, **{key: list(column) for key, column in zip(streams, columns, strict=True)}}


def distribution(key: str, value: Any) -> tuple[str, float, float] | None:
    """Read "name(low,high)" as (name, low, high); return None for any other value.

    Raises:
        UserError: there is no such distribution, or its bounds are wrong.
    """
    match = _DISTRIBUTION.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return None
    name, (low, high) = match[1], (values_in(key, text)[0] for text in match.groups()[1:])
    if name not in ("uniform", "loguniform"):
        raise UserError(f"{key}: there is no distribution {name!r}; there are uniform(a,b) and loguniform(a,b)")
    if not low < high or (name == "loguniform" and low <= 0):
        raise UserError(f"{key}={value} wants {'0 < ' if name == 'loguniform' else ''}a < b")
    return name, low, high


def _varied(config: Config) -> dict[str, tuple[Any, ...]]:
    """Return the seeds, the labelled fields, and every other field that holds several values, by dotted key."""
    varied: dict[str, tuple[Any, ...]] = {"seed": config.seed}
    for key in labelled().values():
        value = get(config, key)
        varied[key] = value if isinstance(value, tuple) else (value,)
    for key, field in leaves(Config):
        value = get(config, key)
        if field.metadata["scan"] and isinstance(value, tuple):
            varied[key] = value
    return varied


def _pairs(varied: Mapping[str, tuple[Any, ...]]) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Yield the first values together, then the second ones, and so on; a single value goes with each."""
    count = max((len(values) for values in varied.values()), default=1)
    for index in range(count):
        yield tuple((key, values[index % len(values)]) for key, values in varied.items())


def _draws(name: str, low: float, high: float, stream: np.random.Generator) -> Iterator[float]:
    """Yield numbers of the distribution, to six digits, as they can be read in a table."""
    while True:
        if name == "uniform":
            number = stream.uniform(low, high)
        else:
            number = math.exp(stream.uniform(math.log(low), math.log(high)))
        yield min(max(float(f"{number:.6g}"), low), high)


def _choices(values: tuple[float | str, ...], stream: np.random.Generator) -> Iterator[float | str]:
    while True:
        yield values[stream.integers(len(values))]
