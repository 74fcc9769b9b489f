"""What else sees the rows of metrics.csv: event files, Weights & Biases, the terminal. A kill tangles no curve."""

from __future__ import annotations

import io
import math
import struct
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tensorboardX.proto.event_pb2 import Event

from qdos_brax.commands import train as train_command
from qdos_brax.errors import UserError
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.live import MemberBoard
from qdos_brax.runs.metrics import MetricsTable, measured, read_rows, step_of
from qdos_brax.runs.progress import Progress
from qdos_brax.runs.tensorboard import TensorBoard
from qdos_brax.runs.wandb_log import WandbLog
from tests.runs import toy


class Killed(BaseException):
    """Ends a run within a chunk, as a kill would: what is open stays open."""


class KilledPhase(toy.ToyPhase):
    def chunk(self, state: toy.ToyState, constants: None) -> Any:
        if self.name == "online" and self.chunks_run == 4:
            raise Killed
        return super().chunk(state, constants)


def killed_run(path: Path, observer: Any) -> None:
    """A run that saved after its phases only, and was killed four chunks into the last one."""
    phases = [KilledPhase(phase.name, phase.num_chunks) for phase in toy.phases()]
    with pytest.raises(Killed):
        toy.run(path, phases, 1e9, [observer])


def events(file: Path) -> Iterator[Event]:
    """The records of an event file: length, its checksum, the message, its checksum."""
    content = io.BytesIO(file.read_bytes())
    while header := content.read(12):
        yield Event.FromString(content.read(struct.unpack("<Q", header[:8])[0]))
        content.read(4)


def curves(folder: Path) -> dict[tuple[str, str], list[tuple[int, float]]]:
    """(step, value) by member's folder and tag, of everything that TensorBoard finds in ``folder``."""
    found: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for file in sorted(folder.glob("*/events.out.tfevents.*")):
        for event in events(file):
            for value in event.summary.value:
                found.setdefault((file.parent.name, value.tag), []).append((event.step, value.simple_value))
    return found


def test_event_files_hold_the_rows_and_a_kill_doubles_none(tmp_path: Path) -> None:
    path = tmp_path / "run"
    board = path / "tensorboard"
    killed_run(path, TensorBoard(board, toy.MEMBERS))
    ahead = curves(board)["seed=0-alpha=0.1", "online/loss"]
    toy.run(path, observers=[TensorBoard(board, toy.MEMBERS)])
    found = curves(board)
    assert {member for member, _ in found} == {"seed=0-alpha=0.1", "seed=0-alpha=0.3", "seed=7-alpha=0.1",
                                               "seed=7-alpha=0.3"}  # fmt: skip
    rows = [row for row in read_rows(path / "metrics.csv") if row["member"] == "1"]
    for phase, column, axis in [("pretrain", "loss", "update"), ("online", "eval/success", "env_steps")]:
        wanted = [(int(r[axis]), float(r[column])) for r in rows if r["phase"] == phase and r[column]]
        assert found["seed=0-alpha=0.3", f"{phase}/{column}"] == [(s, pytest.approx(v)) for s, v in wanted]
    steps = [step for step, _ in found["seed=0-alpha=0.1", "online/loss"]]
    assert steps == sorted(set(steps)) and len(steps) == 6 and len(ahead) == 4
    assert ("seed=0-alpha=0.1", "online/eval/success") in found
    assert all(not math.isnan(value) for curve in found.values() for _, value in curve)


class FakeRun:
    """A run at the fake server, which outlives the process: rows by step."""

    def __init__(self, settings: dict[str, Any], rows: dict[int, dict[str, float]]) -> None:
        self.settings, self.rows, self.finished = settings, rows, False
        self.step = max(rows, default=-1) + 1

    def define_metric(self, name: str, step_metric: str) -> None:
        self.axis = (name, step_metric)

    def log(self, values: dict[str, float], step: int, commit: bool) -> None:
        assert step not in self.rows and commit, "a row was sent twice"
        self.rows[step] = values

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> dict[str, FakeRun]:
    """Runs by id, of a wandb that keeps them."""
    runs: dict[str, FakeRun] = {}
    wandb: Any = types.ModuleType("wandb")
    wandb.Error = type("Error", (Exception,), {})

    def init(**settings: Any) -> FakeRun:
        assert settings["resume"] == "allow" and settings["reinit"] == "create_new"
        earlier = runs[settings["id"]].rows if settings["id"] in runs else {}
        runs[settings["id"]] = FakeRun(settings, earlier)
        return runs[settings["id"]]

    wandb.init = init
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    return runs


def test_wandb_gets_every_row_once_although_the_run_was_killed(tmp_path: Path, server: dict[str, FakeRun]) -> None:
    path = tmp_path / "run"
    killed_run(path, WandbLog(RunFolder(path), toy.MEMBERS))
    assert len(server) == 4
    toy.run(path, observers=[WandbLog(RunFolder(path), toy.MEMBERS)])
    assert len(server) == 4, "going on must not open other runs"
    rows = [row for row in read_rows(path / "metrics.csv") if row["member"] == "3"]
    run = next(run for run in server.values() if run.settings["config"] == toy.MEMBERS[3])
    assert run.finished and run.settings["name"] == "seed 7, alpha 0.3"
    assert sorted(run.rows) == list(range(len(rows)))
    for number, row in enumerate(rows):
        numbers = {f"{row['phase']}/{name}": value for name, value in measured(row, toy.MEMBERS).items()}
        numbers.pop(f"{row['phase']}/sps"), run.rows[number].pop(f"{row['phase']}/sps")
        assert run.rows[number] == {"step": step_of(row), **numbers}


def test_wandb_refusing_is_one_line(tmp_path: Path, server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**settings: Any) -> None:
        raise sys.modules["wandb"].Error("no API key\nconfigured")

    monkeypatch.setattr(sys.modules["wandb"], "init", refuse)
    with pytest.raises(UserError, match=r"refuses the run \(no API key configured\); set WANDB_MODE=offline"):
        toy.run(tmp_path / "run", observers=[WandbLog(RunFolder(tmp_path / "run"), toy.MEMBERS)])


def test_wandb_that_is_not_installed_is_one_line_and_nothing_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    flags = ["--env", "antmaze-medium", "--preset", "smoke", "--wandb", "--out", str(tmp_path / "run")]
    assert train_command.train_main(flags) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: wandb is not installed") and not (tmp_path / "run").exists()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def board(tmp_path: Path) -> tuple[MemberBoard, MetricsTable]:
    """(the board, the table that it watches) of three members that differ in alpha alone; the third is frozen."""
    members = [{"seed": 0, "alpha": alpha, "skills.kl_weight": 0.1} for alpha in (0.1, 0.2, 0.3)]
    return MemberBoard(members), MetricsTable(tmp_path / "metrics.csv", members)


def test_terminal_shows_a_table_of_members_and_leaves_a_line(
    board: tuple[MemberBoard, MetricsTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    view, table = board
    table.start()
    terminal = Terminal()
    with table.observed([view]), Progress("online", 2, stream=terminal, below=view) as progress:
        metrics = {"env_steps": 100, "eval/success": [0.25, 0.5, 0], "eval/return": [-90, -50, -100]}
        goal = [math.nan, 1234, math.nan]
        table.append("online", {**metrics, "critic_loss": 1.5, "first_goal_step": goal, "status_ok": [1, 1, 0]}, 10)
        progress.advance(10.0, "env steps", 0.25, -80.0)
    text = terminal.getvalue()
    header = next(line for line in text.splitlines() if "first goal" in line)
    assert [word for word in ("seed", "alpha", "success", "return", "loss") if word not in header] == []
    assert "kl weight" not in header  # it is the same for all
    assert any(line.split()[-6:] == ["0.2", "0.5", "-50", "1,234", "1.5", "(critic)"] for line in text.splitlines()), (
        text
    )
    assert "frozen" in text and "10 env steps/s, success 0.25, return -80" in text
    assert "first goal" not in text.rsplit("online", 1)[1]  # of the phase only the line stays


def test_elsewhere_it_is_quiet(board: tuple[MemberBoard, MetricsTable]) -> None:
    stream = io.StringIO()
    with Progress("online", 3, stream=stream, below=board[0]) as progress:
        for _ in range(3):
            progress.advance(10.0, "env steps")
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("online 100%") and line.endswith("10 env steps/s")


def test_amounts_are_shown_with_mean_rate_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 20.0, 20.0, 25.0, 25.0, 4000.0, 4000.0])
    monkeypatch.setattr("qdos_brax.runs.progress.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    with Progress("collect", 1000, stream=stream) as progress:
        progress.advance_to(200, "steps")
        progress.advance_to(300, "steps")  # within ten seconds of the line before
        progress.advance_to(1000, "steps")
    assert stream.getvalue().splitlines() == [
        "collect  20% 00:20<01:20, 10 steps/s",
        "collect 100% 1:06:40<00:00, 0 steps/s",
    ]
