"""The notebook of docs/ runs from its first cell to its last on a finished run."""

from __future__ import annotations

from pathlib import Path

import pytest

from qdos_brax.commands.main import main

NOTEBOOK = Path(__file__).parents[1] / "docs" / "notebook.ipynb"


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
