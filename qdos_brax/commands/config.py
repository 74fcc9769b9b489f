"""``python -m qdos_brax config``: every key with its value, its meaning, its range, and the layer that set it."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from qdos_brax.config import Config, Layer, nearest, presets, programs_of, run_layers
from qdos_brax.config.rules import describe
from qdos_brax.config.schema import get, get_field, groups, leaves
from qdos_brax.errors import UserError

_WIDTH = 110
_INDENT = "    "


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``python -m qdos_brax``."""
    parser = commands.add_parser(
        "config", help="explain the keys of the configuration and where their values come from"
    )
    parser.add_argument("key", metavar="KEY", nargs="?", help="a key such as skills.alpha, or a group such as skills")
    parser.add_argument("--env", metavar="TASK", help=f"the task (default {Config.env})")
    parser.add_argument("--method", metavar="NAME", help=f"the method (default {Config.method})")
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help=f"{', '.join(presets())} (default cpu without an accelerator, else paper)",
    )
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="as for train.py; may be repeated"
    )
    parser.set_defaults(run=_show)


def explain(key: str | None, layers: Sequence[Layer]) -> str:
    """Return the explanation of a key, of a group of keys, or of all keys (None).

    Args:
        key: a dotted key or the name of a group.
        layers: as ``run_layers`` returns them.

    Raises:
        UserError: there is no such key; the nearest is named. Or the layers make no valid configuration.
    """
    known = [name for name, _ in leaves(Config)]
    chosen = [name for name in known if key in (None, name, name.rpartition(".")[0])]
    if not chosen:
        raise UserError(f"there is no key {key!r}{nearest(str(key), [*groups(), *known])}")
    programs = list(programs_of(layers).values())
    return "\n".join(_lines(chosen, programs, layers, history=key in known)).lstrip()


def _show(args: argparse.Namespace) -> int:
    flags = {} if args.method is None else {"method": args.method}
    print(explain(args.key, run_layers(args.env, args.preset, flags, args.set)))
    return 0


def _lines(keys: Sequence[str], programs: Sequence[Config], layers: Sequence[Layer], history: bool) -> Iterator[str]:
    group = ""
    for key in keys:
        if (own := key.rpartition(".")[0]) != group and not history:
            group = own
            yield f"\n# {group}: {groups()[group]}"
        origins = _origins(key, layers)
        meaning = get_field(key).metadata["meaning"]
        yield f"{key} = {written(_values(programs, key))}  (set by {origins[-1][0]})"
        yield from textwrap.wrap(meaning, _WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT)
        yield f"{_INDENT}accepts {accepted(key)}"
        if history:
            yield from (f"{_INDENT}{written(value)} in {name}" for name, value in origins)


def accepted(key: str) -> str:
    """Return in words what a key accepts, and its flag if a mark of its field names one."""
    marks = get_field(key).metadata
    scan = ["a list makes a scan"] if marks["scan"] else []
    flags = [f"flag --{marks['label']}"] if marks["label"] else ["flag --pretrain-steps"] if marks["pretrain"] else []
    return "; ".join([describe(marks["rule"]), *scan, *flags])


def _values(programs: Sequence[Config], key: str) -> Any:
    """Return the checked value of a key, or a list of them if programs differ in it."""
    found = list(dict.fromkeys(get(program, key) for program in programs))
    return found[0] if len(found) == 1 else found


def _origins(key: str, layers: Sequence[Layer]) -> list[tuple[str, Any]]:
    """Return (layer's name, value) of the default and every layer that sets the key, lowest first."""
    above = [(layer.name, layer.values[key]) for layer in layers if key in layer.values]
    return [("default", get_field(key).default), *above]


def written(value: Any) -> str:
    """Return a value as the user would write it."""
    if isinstance(value, list | tuple):
        return ", ".join(f"[{written(item)}]" if isinstance(item, list | tuple) else written(item) for item in value)
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)
