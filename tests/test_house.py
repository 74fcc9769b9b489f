"""The house holds itself: imports run one way, files and functions stay small, names and docstrings keep their form."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[1]
# From the ground up; what stands on one floor does not import one another.
FLOORS = (
    ("envs",),
    ("nn", "population", "files", "errors"),
    ("config",),
    ("runs",),
    ("data", "report"),
    ("skills",),
    ("labels",),
    ("high_level",),
    ("offline", "collection"),
    ("methods",),
    ("analysis",),
    ("experiment",),
    ("commands",),
)
FLOOR_OF = {name: level for level, names in enumerate(FLOORS) for name in names}
LEARNERS = {"nn", "skills", "labels", "high_level", "offline", "collection", "methods"}
# The errors of all floors, and how files are written; neither knows of anything else.
EVERYWHERE = {"errors", "files"}
TOP_FILES, FILE_LINES = 6, 330
# What public docstrings begin with; a verb that is missing here may be added.
VERBS = frozenset(re.findall(r"\w+", """
    Act Add Analyse Apply Ask Average Call Change Check Clone Close Collect Combine Compare Compile Compute Configure
    Connect Continue Count Create Decide Decode Define Describe Do Draw Drop Encode End Evaluate Exchange Film Find
    Finish Format Give Hold Identify Infer Join Keep Label Learn List Load Lock Log Look Make Map Measure Move
    Name Normalise Open Parse Place Play Predict Print Put Raise Read Receive Refuse Register Regress Remove
    Replace Report Return Reward Rotate Run Save Schedule Send Set Show Simulate Stack Start Step Store Take Train Turn
    Update Verify Wait Walk Weight Write Yield
"""))  # fmt: skip
FUNCTION_LINES_MEDIAN, FUNCTION_LINES_P95 = 6, 24


def sources(*roots: str) -> list[Path]:
    return [path for root in roots for path in sorted((ROOT / root).rglob("*.py"))]


def imported_modules(path: Path) -> Iterator[str]:
    """Yield every module that a file imports, also inside functions and as ``from package import module``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(module: str) -> str | None:
    """Return the package or file at the top of ``qdos_brax`` that a module belongs to; "envs" for the tasks."""
    parts = module.split(".")
    if parts[0] == "envs":
        return "envs"
    return parts[1] if parts[0] == "qdos_brax" and len(parts) > 1 and parts[1] in FLOOR_OF else None


def test_every_room_has_a_floor() -> None:
    rooms = {path.stem for path in (ROOT / "qdos_brax").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert rooms - {"__init__", "__main__", "__pycache__"} == set(FLOOR_OF) - {"envs"}


@pytest.mark.parametrize("path", sources("qdos_brax", "envs"), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_downwards(path: Path) -> None:
    own = room(".".join(path.relative_to(ROOT).with_suffix("").parts))
    for module in imported_modules(path):
        other = room(module)
        if other is None or other == own or own is None:
            continue
        assert own != "envs", f"envs imports {module}"
        assert other in EVERYWHERE or FLOOR_OF[other] < FLOOR_OF[own], f"{own} imports {module}"
        assert own not in ("runs", "report") or other not in LEARNERS, f"{own} imports the learner {module}"


def test_envs_imports_nothing_of_ours() -> None:
    for path in sources("envs"):
        assert not [name for name in imported_modules(path) if name.startswith("qdos_brax")], path


def test_brax_comes_in_by_one_door() -> None:
    """Elsewhere MJX's lines about the absent package warp would be the first that a run prints."""
    found = [p for p in sources("qdos_brax", "envs") if any(name.startswith("brax.") for name in imported_modules(p))]
    assert found == [ROOT / "envs" / "brax_base.py"]


def test_few_files_lie_at_the_top_and_none_is_long() -> None:
    assert len(list((ROOT / "qdos_brax").glob("*.py"))) <= TOP_FILES
    long = {
        str(path.relative_to(ROOT)): count
        for path in sources("qdos_brax", "envs")
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > FILE_LINES
    }
    assert not long


def test_no_two_public_classes_share_a_name() -> None:
    names = Counter(
        node.name
        for path in sources("qdos_brax", "envs")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert not {name: count for name, count in names.items() if count > 1}


def test_functions_stay_short() -> None:
    lengths = [
        (node.end_lineno or 0) - node.lineno + 1
        for path in sources("qdos_brax", "envs")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    ]
    assert np.median(lengths) <= FUNCTION_LINES_MEDIAN
    assert np.percentile(lengths, 95) <= FUNCTION_LINES_P95


def public_docstrings(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield (name, docstring) of every public function, method and class below ``node`` that has one."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef) and not child.name.startswith("_"):
            if text := ast.get_docstring(child):
                yield child.name, text
            if isinstance(child, ast.ClassDef):
                yield from public_docstrings(child)


def test_public_docstrings_begin_with_a_verb() -> None:
    others = [
        f"{path.relative_to(ROOT)}: {name}: {text.splitlines()[0]}"
        for path in sources("qdos_brax", "envs")
        for name, text in public_docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if re.split(r"[\s.,:;]", text, maxsplit=1)[0] not in VERBS
    ]
    assert not others
