"""Output whose reader goes away, and characters that a terminal cannot show."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from qdos_brax.commands.streams import lasting_streams

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def closed_pipe() -> int:
    """The writing end of a pipe that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


def run(arguments: list[str], cwd: Path = ROOT, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=cwd, text=True, timeout=300, **options)


@pytest.mark.quick
@pytest.mark.parametrize(
    "command",
    [
        ["-m", "qdos_brax", "tasks"],
        ["-m", "qdos_brax", "config"],
        ["-m", "qdos_brax", "--help"],
        ["train.py", "--help"],
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("closed", ["pipe", "from the start"])
def test_a_command_whose_reader_is_gone_ends_quietly(command, closed):
    if closed == "pipe":
        writing = closed_pipe()
        ended = run(command, env=ENVIRONMENT, stdout=writing, stderr=subprocess.PIPE)
        os.close(writing)
    else:
        ended = run(command, env=ENVIRONMENT, preexec_fn=lambda: os.close(1), stderr=subprocess.PIPE)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.quick
def test_an_error_whose_reader_is_gone_keeps_its_exit_code():
    writing = closed_pipe()
    ended = run(["train.py", "--env", "nowhere"], env=ENVIRONMENT, stdout=writing, stderr=writing)
    os.close(writing)
    assert ended.returncode == 2


def test_a_run_goes_on_when_its_reader_goes_away(tmp_path):
    out = tmp_path / "run"
    program = [sys.executable, "train.py", "--env", "antmaze-medium", "--method", "bc", "--preset", "smoke"]
    with subprocess.Popen(
        [*program, "--out", str(out)], cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        process.stdout.readline()
        process.stdout.close()  # as head -1 does
        assert process.wait(timeout=300) == 0
    assert (out / "summary.json").exists() and (out / "report.html").exists()


@pytest.mark.quick
@pytest.mark.parametrize("command", [["train.py", "--env"], ["-m", "qdos_brax", "report"]], ids=" ".join)
def test_what_ascii_cannot_show_is_replaced(tmp_path, command):
    environment = ENVIRONMENT | {"PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0"}
    ended = run([*command, str(tmp_path / "läufe")], env=environment, capture_output=True)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: ") and r"l\xe4ufe" in ended.stderr and len(ended.stderr.splitlines()) == 1


@pytest.mark.quick
def test_what_ascii_cannot_show_is_a_question_mark_in_results():
    code = "from qdos_brax.commands.streams import lasting_streams\nwith lasting_streams(): print('l\\xe4ufe')"
    ended = run(["-c", code], env=ENVIRONMENT | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}, capture_output=True)
    assert (ended.stdout, ended.stderr) == ("l?ufe\n", "")


@pytest.mark.quick
def test_the_streams_are_as_before_afterwards(capsys):
    before = sys.stdout, sys.stderr
    with lasting_streams():
        print("shown")
    assert (sys.stdout, sys.stderr) == before
    assert capsys.readouterr().out == "shown\n"


@pytest.mark.quick
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_behind_stdout_is_no_silent_success():
    with open("/dev/full", "w") as full:
        ended = run(["-m", "qdos_brax", "tasks"], env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: cannot write the output: No space left") and ended.stderr.count("\n") == 1
