"""metrics.csv: late columns, absent numbers, and the summary read off it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from qdos_brax.errors import UserError
from qdos_brax.runs.metrics import MetricsTable, read_rows

pytestmark = pytest.mark.quick

MEMBERS = [{"seed": 0, "alpha": 0.1}, {"seed": 1, "alpha": 0.1}]


@pytest.fixture
def table(tmp_path: Path) -> MetricsTable:
    table = MetricsTable(tmp_path / "metrics.csv", MEMBERS)
    table.start()
    return table


def test_first_columns_are_the_documented_ones(tmp_path: Path, table: MetricsTable) -> None:
    header = (tmp_path / "metrics.csv").read_text()
    assert header == "member,seed,alpha,phase,env_steps,update,eval/success,eval/return,sps\n"


def test_late_column_is_empty_before_never_zero(tmp_path: Path, table: MetricsTable) -> None:
    table.append("pretrain", {"update": 10, "loss": np.asarray([1.5, np.nan])}, sps=2.0)
    table.append("online", {"update": 20, "env_steps": 40, "eval/success": np.asarray([0.5, 1.0])}, sps=3.0)
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines[0].endswith("eval/return,loss,sps")
    assert lines[1] == "0,0,0.1,pretrain,,10,,,1.5,2.0"
    assert lines[2] == "1,1,0.1,pretrain,,10,,,nan,2.0"
    assert lines[4] == "1,1,0.1,online,40,20,1,,,3.0"


def test_half_a_line_left_by_a_kill_is_dropped(tmp_path: Path, table: MetricsTable) -> None:
    table.append("pretrain", {"update": 1}, sps=1.0)
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("0,0,0.1,pretr")
    assert len(read_rows(tmp_path / "metrics.csv")) == 2


def test_summary(table: MetricsTable) -> None:
    nan = math.nan
    table.append("pretrain", {"update": 10, "loss": 1.0}, sps=1.0)
    for steps, success, first in [(100, [0.5, 0.0], [80, nan]), (200, [0.25, 0.0], [80, nan])]:
        metrics = {"env_steps": steps, "eval/success": success, "eval/return": [-5.0, -9.0], "eval/episodes": 20}
        table.append("online", {**metrics, "first_goal_step": first, "status_ok": [1, steps == 100]}, sps=1.0)
    assert table.summary() == [
        {
            "seed": 0,
            "alpha": 0.1,
            "env_steps": 200,
            "eval_success": 0.25,
            "eval_return": -5.0,
            "eval_episodes": 20,
            "best_success": 0.5,
            "first_goal_step": 80,
            "status": "ok",
        },
        {
            "seed": 1,
            "alpha": 0.1,
            "env_steps": 200,
            "eval_success": 0.0,
            "eval_return": -9.0,
            "eval_episodes": 20,
            "best_success": 0.0,
            "first_goal_step": None,
            "status": "nan",
        },
    ]


def test_what_was_never_measured_is_none(table: MetricsTable) -> None:
    table.append("pretrain", {"update": 10}, sps=1.0)
    entry = table.summary()[0]
    assert entry["eval_success"] is None and entry["best_success"] is None and entry["eval_episodes"] is None


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match="not a metrics file"):
        read_rows(tmp_path / "x.csv")
