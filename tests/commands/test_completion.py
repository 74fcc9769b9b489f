"""The shell completes the command and its flags by the script that it prints for itself."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qdos_brax.commands.main import main

ASK = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
$(complete -p qdos | sed 's/.*-F \\([^ ]*\\) .*/\\1/') qdos "${@: -1}" "${@: -2:1}"
echo "${COMPREPLY[@]}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_commands_and_flags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.sh"
    script.write_text(capsys.readouterr().out)
    for typed, proposed in (
        (["tr"], "train"),
        (["train", "--pre"], "--preset --pretrain-steps"),
        (["data", ""], "make fetch info check export"),
        (["completion", ""], "bash zsh tcsh"),
    ):
        asked = subprocess.run(
            ["bash", "-c", ASK, "bash", str(script), "qdos", *typed], capture_output=True, text=True, check=True
        )
        assert asked.stdout.strip() == proposed


def test_without_shtab_it_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert capsys.readouterr().err.startswith("error: completion needs shtab; run: pip install")
