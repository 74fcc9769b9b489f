"""The real program, killed at random moments: what it ends with is what it would have ended with."""

from __future__ import annotations

import os
import random
import shlex
import signal
import subprocess
import time
from pathlib import Path

import pytest

from qdos_brax.commands.train import train_main
from tests.runs.program import assert_same_end, launch, place, rows, wait_for_start

# A save after every chunk, so that a kill lands between two checkpoints or in the middle of one.
SETTINGS = ["--env", "antmaze-medium", "--preset", "smoke", "--set", "run.checkpoint_seconds=0"]
KILLS = 14
KILLS_OF_A_COMPARISON = 6
# One phase, four log points, and no program with physics in it but the evaluation's: those are not in jax's cache.
SMALL = (
    "--env antmaze-medium --preset smoke --method bc --set policy.updates=40 --set policy.every_updates=10 "
    "--set data.transitions=1000 --set data.num_envs=4 --set eval.episodes=1 --set run.checkpoint_seconds=0"
)
SMALL_ROWS = 4


def test_a_small_run_killed_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill within a second of a log point that is drawn, or of the start; a second one after the run went on."""
    draw = random.Random(drawn_seed())
    path, data = tmp_path / "killed", tmp_path / "data"
    for wanted in sorted(draw.sample(range(SMALL_ROWS), 2)):
        process = launch(data, *arguments(path, shlex.split(SMALL)))
        wait_for_start(process, data)
        while wanted and (not (path / "metrics.csv").exists() or len(rows(path)) < wanted):
            assert process.poll() is None, (data / "log").read_text()
            time.sleep(0.02)
        time.sleep(draw.uniform(0, 1))
        process.kill()
        assert process.wait() == -signal.SIGKILL
        print(place(path, data))
    assert launch(data, *arguments(path, shlex.split(SMALL))).wait(300) == 0, (data / "log").read_text()
    monkeypatch.setenv("QDOS_DATA", str(data))
    assert train_main([*shlex.split(SMALL), "--out", str(tmp_path / "whole")]) == 0
    assert len(rows(path)) == SMALL_ROWS
    assert_same_end(path, tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize(
    ("flags", "kills"),
    [([], KILLS), (["--method", "qdos,explore"], KILLS_OF_A_COMPARISON)],
    ids=["run", "comparison"],
)
def test_kill_9_at_random_moments(tmp_path: Path, flags: list[str], kills: int) -> None:
    """Runs are killed and resumed until they finish, and new ones started, until there were enough kills.

    A moment is drawn from the whole time between the first line of the program and its end: collection of the data
    (each run collects its own), every phase, and the report. Most of a resumed run is behind it, so many runs end.
    """
    draw = random.Random(drawn_seed())
    whole = tmp_path / "whole"
    launch(tmp_path / "compiling", *SETTINGS, *flags, "--out", str(tmp_path / "first")).wait(1200)  # fills the cache
    process = launch(tmp_path / "data", *SETTINGS, *flags, "--out", str(whole))
    started = wait_for_start(process, tmp_path / "data")
    assert process.wait(1200) == 0
    duration = time.monotonic() - started
    done, number = 0, 0
    while done < kills:
        number += 1
        path, data = tmp_path / f"killed-{number}", tmp_path / f"data-{number}"
        while True:
            process = launch(data, *arguments(path, [*SETTINGS, *flags]))
            wait_for_start(process, data)
            try:
                code = process.wait(draw.uniform(0, duration) if done < kills else 1200)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                done += 1
                print(f"kill {done}: run {number}, {place(path, data)}")
                continue
            assert code == 0, (data / "log").read_text()
            break
        assert_same_end(path, whole)
    print(f"{done} kills of {number} runs of {duration:.0f} s")


def drawn_seed() -> int:
    """Return a random seed and print it, so that a failure can be reproduced."""
    seed = int(os.environ.get("QDOS_KILL_SEED") or time.time_ns() % 2**32)
    print(f"QDOS_KILL_SEED={seed}")
    return seed


def arguments(path: Path, flags: list[str]) -> list[str]:
    """Return the flags that resume the run in ``path``, or start it there."""
    begun = (path / "config.yaml").exists() or (path / "comparison.json").exists()
    return ["--resume", str(path)] if begun else [*flags, "--out", str(path)]
