"""The notebook of docs/ runs from its first cell to its last on a finished run."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
from pathlib import Path
from typing import Any

import pytest

from qdos_brax.commands.main import main

NOTEBOOK = Path(__file__).parents[1] / "docs" / "notebook.ipynb"


@pytest.mark.quick
def test_the_notebook_calls_our_functions_as_they_are() -> None:
    """Names and numbers of arguments, so that a changed signature is seen before the slow test."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    tree = ast.parse("\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))
    ours = {
        alias.name: getattr(importlib.import_module(node.module), alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("qdos_brax")
        for alias in node.names
    }
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ours]
    assert {getattr(call.func, "id", "") for call in calls} == set(ours)
    for call in calls:
        signature = inspect.signature(ours[getattr(call.func, "id", "")])
        signature.bind(*call.args, **{str(word.arg): None for word in call.keywords})


def test_the_notebook_plays_an_episode(finished: Path) -> None:
    """Its cells from "An episode" on, in this process; without OpenGL there is no film to show."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    first = next(index for index, cell in enumerate(cells) if "".join(cell["source"]).startswith("## An episode"))
    shown: list[str] = []
    names: dict[str, Any] = {"run": finished, "HTML": str, "display": shown.append}
    for cell in cells[first + 1 :]:
        exec("".join(cell["source"]), names)
    assert 1 < len(names["qpos"]) == len(names["moments"]) <= 26
    assert len(shown) == bool(names["pictures"])


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opengl: None) -> None:
    """On a run of a minute; curves, latents, skills and a film are shown."""
    nbclient = pytest.importorskip("nbclient", reason='no nbclient: pip install -c constraints.txt -e ".[docs]"')
    nbformat = pytest.importorskip("nbformat")
    run = tmp_path / "run"
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    assert main(["train", "--env", "antmaze-medium", "--preset", "smoke", "--out", str(run)]) == 0
    monkeypatch.setenv("QDOS_RUN", str(run))
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parents[1]))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "committed without outputs"
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.get("text", "") for output in shown if output.output_type == "stream")
    assert "Table 1." in printed and "steps, success" in printed
    pictures = [output.data for output in shown if output.output_type == "display_data"]
    assert sum("image/png" in data for data in pictures) == 3
    assert sum("data:image/webp" in data.get("text/html", "") for data in pictures) == 1
