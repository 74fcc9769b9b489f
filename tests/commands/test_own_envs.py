"""A folder of the user's own called envs, in the working directory or beside a script."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parents[2]
KINDS = pytest.mark.parametrize("regular", [True, False], ids=["package", "folder"])


def user_folder(tmp_path: Path, regular: bool) -> Path:
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "mine.py").write_text("HERE = 1\n", encoding="utf-8")
    if regular:
        (tmp_path / "envs" / "__init__.py").touch()
    return tmp_path


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )


@KINDS
@pytest.mark.parametrize("command", [["tasks"], ["train", "--help"], ["config"]], ids=" ".join)
def test_the_commands_find_their_own_package(tmp_path, regular, command):
    ended = python(user_folder(tmp_path, regular), "-m", "qdos_brax", *command)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "antmaze" in ended.stdout or "skills" in ended.stdout


def test_a_script_that_imports_qdos_brax_gets_its_package_and_a_warning(tmp_path):
    script = user_folder(tmp_path, regular=True) / "script.py"
    script.write_text("import qdos_brax, envs\nprint(envs.get_spec('antmaze').full_name)\n", encoding="utf-8")
    ended = python(tmp_path, "script.py")
    assert ended.returncode == 0 and ended.stdout.startswith("antmaze-")
    assert str(tmp_path / "envs") in ended.stderr and "rename that folder" in ended.stderr


def test_the_users_package_imported_first_is_named_in_one_line(tmp_path):
    script = user_folder(tmp_path, regular=True) / "script.py"
    script.write_text("import envs.mine, qdos_brax\n", encoding="utf-8")
    ended = python(tmp_path, "script.py")
    assert ended.returncode == 1
    line = ended.stderr.splitlines()[-1]
    assert line.startswith("ImportError: another package named envs") and str(tmp_path / "envs") in line


def test_without_a_clash_nothing_is_said(tmp_path):
    ended = python(tmp_path, "-W", "error", "-c", "import qdos_brax, envs; print(envs.__file__)")
    assert ended.stdout.strip() == str(ROOT / "envs" / "__init__.py") and not ended.stderr
