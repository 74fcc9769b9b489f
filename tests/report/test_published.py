"""What others published: on the tasks of the report alone, with its source, and only if it is asked for."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest

import envs
from qdos_brax.commands.main import main
from qdos_brax.report import published
from qdos_brax.report.published import published_on
from tests.report.folders import write_run

pytestmark = pytest.mark.quick


def test_numbers_are_those_of_the_tables() -> None:
    found = {row.method: row for row in published_on(["antmaze-large-task1"])}
    assert set(found) == {"BC", "IQL", "SUPE", "QDOS 0.2", "QDOS 0.3"}
    best = found["QDOS 0.3"]
    assert (best.measure, best.result, best.std, best.seeds) == ("success", 0.96, 0.06, 3)
    assert (best.first_goal, best.first_goal_std) == (11_668, 9_465)
    assert math.isnan(best.before) and best.online_steps is None and "2608.19684" in best.source
    (fql,) = (row for row in published_on(["antsoccer-arena-task4"]) if row.method == "FQL")
    assert (fql.before, fql.result, fql.offline_steps, fql.online_steps) == (0.28, 0.86, 1_000_000, 1_000_000)
    assert published_on(["antmaze-teleport-task1"]) == []
    assert {row.measure for row in published_on(["kitchen-mixed", "kitchen-partial"])} == {"score"}


def test_a_mean_over_tasks_is_shown_for_each_and_says_so() -> None:
    found = [row for row in published_on(["scene-task3"])]
    assert {row.task for row in found} == {"scene-task3"} and all("mean of 5 tasks" in row.source for row in found)


def test_every_row_is_whole() -> None:
    text = (Path(published.__file__).parent / "published.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    assert len({(row["task"], row["method"]) for row in rows}) == len(rows)
    for row in rows:
        assert row["source"] and 0 <= float(row["result"]) <= 100, row
        assert (row["measure"] == "score") == row["task"].startswith("kitchen"), row  # % of 4 subtasks
        assert row["task"].partition("-")[0] in {*envs.FAMILIES, "kitchen", "cube", "scene"}


def test_the_report_shows_them_if_it_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7], env="antmaze-large-task1")
    assert main(["report", str(run), "--out", str(tmp_path / "plain")]) == 0
    assert "published" not in capsys.readouterr().out
    assert main(["report", str(run), "--out", str(tmp_path / "beside"), "--published"]) == 0
    table = capsys.readouterr().out.partition("Published by others, in settings of their own")[2]
    (line,) = (line for line in table.splitlines() if line.startswith("QDOS 0.3, published"))
    assert "96 ± 6" in line
    assert "11,668 ± 9,465" in line and "settings of others" in table
    plain, beside = ((tmp_path / name / "report.html").read_text() for name in ("plain", "beside"))
    assert "QDOS 0.3, published" in beside and "QDOS 0.3, published" not in plain
    pictures = [(tmp_path / name / "curves.png").read_bytes() for name in ("plain", "beside")]
    assert pictures[0] != pictures[1]
