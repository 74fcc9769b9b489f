"""A run that was stopped, killed or robbed of its newest checkpoint ends as if nothing had happened."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from qdos_brax.errors import UserError
from qdos_brax.runs.checkpoint import CheckpointStore
from tests.runs import toy

CONFIG = "0123456789abcdef"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an undisturbed run."""
    path = tmp_path_factory.mktemp("whole") / "run"
    toy.run(path)
    return path


class Stopped(Exception):
    """Raised inside a chunk: what a crash looks like from within."""


class StoppingPhase(toy.ToyPhase):
    """Crashes before its chunk number ``at``."""

    def __init__(self, name: str, num_chunks: int, at: int) -> None:
        super().__init__(name, num_chunks)
        self._at = at

    def chunk(self, state: toy.ToyState, constants: None) -> tuple[toy.ToyState, dict[str, Any]]:
        if self.chunks_run == self._at:
            raise Stopped
        return super().chunk(state, constants)


def stopped_run(path: Path, phase: str, at: int, checkpoint_seconds: float = 0.0) -> None:
    """A run that crashed in ``phase`` before its chunk ``at``."""
    phases = [StoppingPhase(p.name, p.num_chunks, at) if p.name == phase else p for p in toy.phases()]
    with pytest.raises(Stopped):
        toy.run(path, phases, checkpoint_seconds)


def rows(path: Path) -> list[dict[str, str]]:
    """metrics.csv without the one column that measures time."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]


def final_artifacts(path: Path) -> dict[str, Any]:
    return CheckpointStore(path / "checkpoints", CONFIG).artifacts(3)


def assert_same_end(path: Path, whole: Path) -> None:
    assert rows(path) == rows(whole)
    header = (path / "metrics.csv").read_text().splitlines()[0]
    assert header == (whole / "metrics.csv").read_text().splitlines()[0]
    a, b = final_artifacts(path), final_artifacts(whole)
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)
    members = [json.loads((p / "summary.json").read_text())["members"] for p in (path, whole)]
    assert members[0] == members[1]


@pytest.mark.parametrize(("phase", "at"), [("pretrain", 0), ("pretrain", 3), ("online", 0), ("online", 5)])
def test_crashed_run_resumes_exactly(tmp_path: Path, whole: Path, phase: str, at: int) -> None:
    path = tmp_path / "run"
    stopped_run(path, phase, at)
    phases = toy.phases()
    toy.run(path, phases)
    done_before = {"pretrain": at, "online": 5 + at}[phase]
    assert sum(p.chunks_run for p in phases) == 11 - done_before
    assert_same_end(path, whole)


def test_rows_after_the_checkpoint_are_cut_back(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "run"
    stopped_run(path, "online", 5, checkpoint_seconds=1e9)  # saves at the phases' ends only
    assert len(rows(path)) == 4 * 10
    phases = toy.phases()
    toy.run(path, phases)
    assert [p.chunks_run for p in phases] == [0, 0, 6]
    assert_same_end(path, whole)


@pytest.mark.parametrize(("phase", "chunks"), [("pretrain", 2), ("online", 8)])
def test_kill_9_resumes_exactly(tmp_path: Path, whole: Path, phase: str, chunks: int) -> None:
    path = tmp_path / "run"
    process = start(path, 0.3)
    wait_for_rows(process, path, 4 * chunks)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert rows(path)[-1]["phase"] == phase
    assert not (path / "summary.json").exists()
    toy.run(path)
    assert_same_end(path, whole)


@pytest.mark.parametrize("numbers", [[signal.SIGTERM], [signal.SIGHUP, signal.SIGHUP]], ids=["term", "hangups"])
def test_a_signal_saves_and_says_how_to_go_on(tmp_path: Path, whole: Path, numbers: list[signal.Signals]) -> None:
    """A session that ends hangs up more than once."""
    path = tmp_path / "my run"
    process = start(path, 1.0)  # long enough for a busy machine to send the signal before the run has ended
    wait_for_rows(process, path, 4 * 2)
    for number in numbers:
        process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + numbers[0]
    assert f"--resume '{path}'" in err
    toy.run(path)
    assert_same_end(path, whole)


def start(path: Path, sleep: float) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.runs.toy", str(path), str(sleep)]
    root = Path(__file__).parents[2]
    env = {**os.environ, "PYTHONPATH": str(root)}  # on the device of the unbroken run, too
    return subprocess.Popen(command, cwd=root, env=env, stderr=subprocess.PIPE, text=True, preexec_fn=_heed_hangups)


def _heed_hangups() -> None:
    """Undo ``nohup``, under which the tests themselves may have been started: a child ignores what its parent does."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def wait_for_rows(process: subprocess.Popen[str], path: Path, count: int) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if (path / "metrics.csv").exists() and len(rows(path)) >= count:
            return
        time.sleep(0.02)
    raise AssertionError(f"no {count} rows: {process.communicate()[1] if process.poll() is not None else 'too slow'}")


def test_truncated_newest_checkpoint_falls_back(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    stopped_run(path, "online", 4)
    older, newest = sorted(p.name for p in (path / "checkpoints").glob("02-*"))
    largest = max((path / "checkpoints" / newest).rglob("*"), key=lambda p: p.stat().st_size * p.is_file())
    largest.write_bytes(largest.read_bytes()[:-1])
    phases = toy.phases()
    toy.run(path, phases)
    line = next(line for line in capsys.readouterr().err.splitlines() if "cannot be used" in line)
    assert newest in line and "truncated" in line and f"continuing from {older}" in line
    assert phases[2].chunks_run == 3
    assert_same_end(path, whole)


def test_foreign_checkpoint_falls_back(tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run"
    stopped_run(path, "online", 4)
    _, newest = sorted((path / "checkpoints").glob("02-*"))
    manifest = newest / "manifest.json"
    manifest.write_text(manifest.read_text().replace(CONFIG, "f" * 16))
    toy.run(path)
    assert "another configuration" in capsys.readouterr().err
    assert_same_end(path, whole)


def test_no_usable_checkpoint_is_a_user_error(tmp_path: Path) -> None:
    path = tmp_path / "run"
    stopped_run(path, "online", 4)
    for manifest in (path / "checkpoints").glob("02-*/manifest.json"):
        manifest.write_text("{")
    with pytest.raises(UserError, match=r"no checkpoint can be used .*truncated"):
        toy.run(path)


def test_lost_metrics_rows_are_noticed(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "run"
    stopped_run(path, "online", 4)
    lines = (path / "metrics.csv").read_text().splitlines(keepends=True)
    (path / "metrics.csv").write_text("".join(lines[:-4]))  # the newest checkpoint counts them, the older does not
    toy.run(path)
    assert_same_end(path, whole)


def test_complete_run_trains_nothing_more(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    (path / "summary.json").unlink()  # killed between the last checkpoint and the summary
    phases = toy.phases()
    toy.run(path, phases)
    assert sum(p.chunks_run for p in phases) == 0
    assert_same_end(path, whole)


def test_wall_seconds_add_up(tmp_path: Path) -> None:
    path = tmp_path / "run"
    phases = [StoppingPhase("pretrain", 5, 3), *toy.phases()[1:]]
    phases[0].sleep = 0.2
    with pytest.raises(Stopped):
        toy.run(path, phases)
    wall = toy.run(path)["wall_seconds"]
    assert list(wall) == ["data", "pretrain", "label", "online", "eval", "total"]
    assert wall["data"] == pytest.approx(1.0)  # twice half a second
    assert wall["pretrain"] >= 0.6
    assert wall["eval"] == pytest.approx(0.006)
    parts = sum(seconds for name, seconds in wall.items() if name not in ("total", "data"))
    assert parts <= wall["total"] + 0.01


def test_two_are_kept_with_their_artifacts(whole: Path) -> None:
    names = sorted(p.name for p in (whole / "checkpoints").iterdir())
    assert names == ["02-000005", "03-000000", "artifacts-02", "artifacts-03"]
