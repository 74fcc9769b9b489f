"""A smoke training of each of the arm's tasks: data, weights, rollouts of skills, page, film, picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main

TASKS = {"cube-single": 2, "cube-double": 2, "scene": 1, "kitchen-mixed": 1, "kitchen-partial": 1}


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_smoke_training(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    out = tmp_path / "run"
    assert train_main(["--env", task, "--preset", "smoke", "--out", str(out)]) == 0
    # A rollout of skills from logged states needs the whole state: nothing may be left out for want of it.
    assert "left out" not in capsys.readouterr().err

    summary = json.loads((out / "summary.json").read_text())
    (member,) = summary["members"]
    assert summary["env"] == f"{task}-task{TASKS[task]}" and member["status"] == "ok"
    assert 0 <= member["eval_success"] <= member["eval_score"] <= 1

    page = (out / "report.html").read_text()
    assert "Weight against quality" in page and "Table 1, score" in page
    with np.load(out / "inside.npz") as found:
        assert {"gain", "return", "0/latent", "0/latents"} <= set(found)
        assert not {"walls", "0/grid"} & set(found)

    film, picture = tmp_path / "episode.mp4", tmp_path / "episode.png"
    assert main(["evaluate", str(out), "--episodes", "2", "--video", str(film)]) == 0
    assert main(["picture", str(out), "--out", str(picture)]) == 0
    assert film.stat().st_size > 10_000 and picture.stat().st_size > 10_000
