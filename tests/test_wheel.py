"""What an installed wheel needs to train: every file that is no module is named in pyproject.toml."""

from __future__ import annotations

import fnmatch
import importlib
import tomllib
from pathlib import Path

import pytest

from qdos_brax.commands.main import main

ROOT = Path(__file__).parents[1]
SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
LEFT_OUT = {".py", ".pyc", ".md"}


def data_files() -> list[Path]:
    return [
        path.relative_to(ROOT)
        for folder in ("configs", "envs", "qdos_brax")
        for path in sorted((ROOT / folder).rglob("*"))
        if path.is_file() and path.suffix not in LEFT_OUT
    ]


@pytest.mark.quick
@pytest.mark.parametrize("path", data_files(), ids=str)
def test_the_wheel_holds(path: Path) -> None:
    patterns = SETUPTOOLS["package-data"].get(".".join(path.parent.parts), [])
    assert any(fnmatch.fnmatch(path.name, pattern) for pattern in patterns)


@pytest.mark.quick
def test_the_console_command_is_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, function = project["scripts"]["qdos"].partition(":")
    assert getattr(importlib.import_module(module), function) is main
