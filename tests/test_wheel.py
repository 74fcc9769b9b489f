"""What an installed wheel needs to train: every file that is no module is named in pyproject.toml."""

from __future__ import annotations

import fnmatch
import importlib
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from qdos_brax.commands.main import main

ROOT = Path(__file__).parents[1]
SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
LEFT_OUT = {".py", ".pyc", ".md"}
NEWEST_PYTHON = shutil.which("python3.13")
NEWEST = {
    "completion",
    "docs",
    "hub",
    "minari",
    "sweeps",
    "video",
    "wandb",
    "warp",
}  # the extras that constraints-newest.txt pins


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


@pytest.mark.quick
def test_the_container_copies_what_its_builder_is_given() -> None:
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    copied = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    assert {"pyproject.toml", "constraints.txt", "configs", "envs", "qdos_brax"} <= set(copied)
    assert [name for name in copied if not (ROOT / name).exists()] == []
    given = {line.removeprefix("!") for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] == "!"}
    assert given == set(copied)
    assert lines.index("USER qdos") < next(i for i, line in enumerate(lines) if line.startswith("CMD"))


@pytest.mark.quick
def test_every_dependency_is_pinned_within_its_range() -> None:
    pins, project = read_pins("constraints.txt"), read_project()
    for text in [
        *project["dependencies"],
        *(text for extra in project["optional-dependencies"].values() for text in extra),
    ]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pins[canonicalize_name(wanted.name)]), text


@pytest.mark.quick
def test_the_newest_versions_are_within_the_ranges() -> None:
    pins, project = read_pins("constraints-newest.txt"), read_project()
    extras = [text for name, texts in project["optional-dependencies"].items() if name in NEWEST for text in texts]
    for text in [*project["dependencies"], *extras]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pins[canonicalize_name(wanted.name)]), text
    assert Version(pins["jax"]) > Version(read_pins("constraints.txt")["jax"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(NEWEST_PYTHON is None, reason="no python3.13 is on the PATH, for which constraints-newest.txt is")
def test_the_newest_versions_run_the_smoke_preset() -> None:
    """In an environment made from nothing; it needs a package index."""
    subprocess.run([ROOT / ".ci" / "release_check", NEWEST_PYTHON, "constraints-newest.txt"], check=True)


def read_pins(name: str) -> dict[str, str]:
    """Return the versions of a file of constraints, whose names are sorted and different."""
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    pins = {canonicalize_name(package): version for package, version in (line.split("==") for line in lines[1:])}
    assert lines[1:] == sorted(lines[1:], key=str.lower) and len(pins) == len(lines) - 1
    return pins


def read_project() -> dict[str, Any]:
    """Return the table "project" of pyproject.toml."""
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project
