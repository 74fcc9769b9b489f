"""One process per run folder, and one line for what the file system refuses."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest

from qdos_brax.errors import UserError
from qdos_brax.files import is_partial, replacing_folder, write_text
from qdos_brax.runs import hints, signals
from qdos_brax.runs.folder import RunFolder, new_path

pytestmark = pytest.mark.quick


def made(path: Path) -> RunFolder:
    folder = RunFolder.create(path)
    write_text(folder.config, "env: antmaze-medium\n")
    return folder


def test_second_process_is_refused(tmp_path: Path) -> None:
    folder = made(tmp_path / "run")
    with folder.held(), pytest.raises(UserError, match="another process"), RunFolder.open(folder.path).held():
        pass
    with RunFolder.open(folder.path).held():
        pass


def test_a_run_is_not_overwritten(tmp_path: Path) -> None:
    folder = made(tmp_path / "run")
    RunFolder.create(folder.path)  # nothing was trained in it yet
    write_text(folder.metrics, "member,seed\n")
    with pytest.raises(UserError, match="holds a run already; continue with --resume"):
        RunFolder.create(tmp_path / "run")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(UserError, match="not empty"):
        RunFolder.create(tmp_path / "other")


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write .*choose another folder"):
        RunFolder.create(tmp_path / "file" / "run")
    with pytest.raises(UserError, match="not a run folder"):
        RunFolder.open(tmp_path)


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "x.txt"
    write_text(target, "old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="No space left on device; free some space"):
        write_text(target, "new")
    assert target.read_text() == "old"


def test_a_folder_is_replaced_when_it_is_complete_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "made"
    for word in ("first", "second"):
        with replacing_folder(path) as partial:
            assert is_partial(partial) and partial.parent == tmp_path
            (partial / word).touch()
        assert [file.name for file in path.iterdir()] == [word]
    with pytest.raises(UserError, match="No space left on device; free some space"), replacing_folder(path) as partial:
        (partial / "third").touch()
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == [path] and [file.name for file in path.iterdir()] == ["second"]


def test_new_path_never_repeats(tmp_path: Path) -> None:
    first = new_path(tmp_path, "a")
    first.mkdir()
    assert new_path(tmp_path, "a") != first


def test_what_a_kill_left_half_written_is_not_in_the_way(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    (folder.path / ".config.partial.yaml").write_text("env: antm")
    RunFolder.create(folder.path)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129)])
def test_a_signal_outside_the_phases_says_how_to_go_on(
    number: int, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outside = signal.signal(number, signal.SIG_DFL)  # under nohup it would be ignored, and waited for without end
    try:
        with pytest.raises(SystemExit) as stopped, signals.stops_at_once(tmp_path):
            try:
                os.kill(os.getpid(), number)
                signal.pause()
            except SystemExit as error:  # as a compiled program does with what its callback raises
                raise RuntimeError("INTERNAL: callback") from error
        assert stopped.value.code == code and signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, outside)
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"stopped; continue with: python train.py --resume {tmp_path}"


def test_what_nohup_ignores_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.stops_at_once(tmp_path):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_hints_are_quoted_for_the_shell() -> None:
    assert hints.resume_command("my run") == "python train.py --resume 'my run'"
    assert hints.module_command("evaluate", Path("it's")) == """python -m qdos_brax evaluate 'it'"'"'s'"""
    assert hints.resume_flag("plain") == "--resume plain"
