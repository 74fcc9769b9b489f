"""Every command in the blocks of README and docs runs in a smoke form: preset smoke, few episodes, its own folder.

The commands of a page run in their order and in one folder, so that a later one finds what an earlier one made. Runs
and public data that a page only names are made beforehand.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_docs import PAGES, ROOT, code

STARTS = ("python", ".venv/", ". .venv", "make ", "pip ", "qdos ", "docker ", "tensorboard ", "sh ")
NOT_RUN = {
    "python3 -m venv": "an install of its own from a package index: .ci/run and .ci/release_check run it",
    ".venv/bin/pip ": "likewise",
    ". .venv/bin/activate": "likewise",
    "make ": "CI itself, of which the tests are a part",
    "docker ": "a daemon and an image registry are wanted; docs/getting-started.md says how they were tried",
}
PROGRAMS = {
    "python train.py": [str(ROOT / "train.py")],
    "python -m qdos_brax": ["-m", "qdos_brax"],
    "python docs/examples/own_environment.py": [str(ROOT / "docs" / "examples" / "own_environment.py")],
    ".venv/bin/python benchmarks/learner.py": [str(ROOT / "benchmarks" / "learner.py")],
    ".venv/bin/python -m pytest": ["-m", "pytest", "--rootdir", str(ROOT), "--collect-only", "-q"],
}
PUBLIC_DATA = {"antmaze-large-navigate-v0": "antmaze-large", "antmaze-medium-navigate-v0": "antmaze-medium"}
# What a flag is given in the smoke form, and the runs that pages name without making them: runs/b is of another method.
SMALL = {"--preset": "smoke", "--episodes": "2", "--sample": "2"}
METHODS_OF_RUNS = {"mine": "qdos", "a": "qdos", "b": "supe"}
RUN_NAME = re.compile(r"runs/(\w+)")


def typed(page: Path) -> list[str]:
    """The commands in a page's blocks."""
    return [line for line in code(page) if line.startswith(STARTS)]


def smoke_form(line: str) -> list[str] | None:
    """Return the arguments of Python for a command's smoke form; None for one on the list of those that are not run."""
    if line.startswith(tuple(NOT_RUN)):
        return None
    start = next(start for start in PROGRAMS if line.startswith(start))
    words = shlex.split(line.removeprefix(start), comments=True)
    words = [SMALL.get(before, word) for before, word in zip(["", *words], words, strict=False)]
    words = [f"{word}.hdf5" if word in PUBLIC_DATA else word for word in words]
    trains = "train.py" in start or "train" in words[:1]
    if trains and "--resume" not in words and "--preset" not in words:
        words += ["--preset", "smoke"]
    words = [str(ROOT / word) if word.startswith("tests/") else word for word in words]
    return [*PROGRAMS[start], *words]


def run(arguments: list[str], folder: Path, data: Path) -> None:
    env = {**os.environ, "QDOS_DATA": str(data), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{shlex.join(arguments)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


@pytest.mark.quick
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_has_a_smoke_form_or_a_reason(page: Path) -> None:
    for line in typed(page):
        assert smoke_form(line) is None or len(smoke_form(line) or ()) > 1, line


@pytest.mark.quick
def test_what_is_not_run_is_still_there() -> None:
    lines = [line for page in PAGES for line in typed(page)]
    assert [start for start in NOT_RUN if not any(line.startswith(start) for line in lines)] == []


@pytest.mark.quick
def test_smoke_forms_by_hand() -> None:
    (_, *words) = smoke_form("python train.py --env a --dataset antmaze-large-navigate-v0 --sample 8  # b") or []
    assert words == ["--env", "a", "--dataset", "antmaze-large-navigate-v0.hdf5", "--sample", "2", "--preset", "smoke"]
    (_, *words) = smoke_form("python docs/examples/own_environment.py train --env a --preset cpu") or []
    assert words == ["train", "--env", "a", "--preset", "smoke"]
    assert smoke_form("python -m qdos_brax evaluate runs/a --episodes 100") == [
        "-m", "qdos_brax", "evaluate", "runs/a", "--episodes", "2"
    ]  # fmt: skip
    assert smoke_form("make ci") is None


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all default data sets."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the runs that pages name; ``provide`` makes one when it is first asked for."""
    return tmp_path_factory.mktemp("made")


def provide(page: Path, folder: Path, made: Path, data: Path) -> None:
    """Put into a page's folder what its commands need and do not make."""
    text = "\n".join(typed(page))
    outputs = set(re.findall(r"--out runs/(\w+)", text))
    for name in sorted(set(RUN_NAME.findall(text)) - outputs):
        method = METHODS_OF_RUNS[name]
        if not (made / method).exists():
            flags = ["--env", "antmaze-medium", "--preset", "smoke", "--method", method, "--out", method]
            run([*PROGRAMS["python train.py"], *flags], made, data)
        shutil.copytree(made / method, folder / "runs" / name)
    for name, task in PUBLIC_DATA.items():
        if name in text:
            flags = ["data", "make", task, "--transitions", "4000", "--out", f"{name}.hdf5"]
            run([*PROGRAMS["python -m qdos_brax"], *flags], folder, data)


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("page", [page for page in PAGES if any(map(smoke_form, typed(page)))], ids=lambda p: p.name)
def test_every_command_of_a_page_runs(page: Path, tmp_path: Path, made: Path, data: Path) -> None:
    provide(page, tmp_path, made, data)
    for line in typed(page):
        if (arguments := smoke_form(line)) is not None:
            run(arguments, tmp_path, data)
