"""What all command lines share: a parser, types of numbers, and one clear line for an error."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from qdos_brax.config import nearest


class Parser(argparse.ArgumentParser):
    """Parse arguments with errors of one line, and without abbreviated flags."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Print the line and exit with code 2."""
        self.exit(2, f"error: {message} (see {self.prog} --help)\n")


def parse(parser: Parser, argv: Sequence[str]) -> argparse.Namespace:
    """Return the parsed arguments; for an unknown one, exit with the nearest flag in the message."""
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        word = unknown[0].partition("=")[0]
        parser.error(f"unknown argument {unknown[0]}{nearest(word, _flags(parser))}")
    return args


def _flags(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long flags of a parser and of its commands."""
    flags = [name for action in parser._actions for name in action.option_strings if name.startswith("--")]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            flags += [name for command in action.choices.values() for name in _flags(command)]
    return flags


def positive(text: str) -> int:
    """Return a whole number from 1; the type of an argument."""
    number = int(text) if text.isdigit() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, not {text!r}")
    return number


def natural(text: str) -> int:
    """Return a whole number from 0; the type of an argument."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0, not {text!r}")
    return int(text)
