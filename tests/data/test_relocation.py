"""A run whose data has moved, or was named from another folder."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from qdos_brax import config as configs
from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main
from qdos_brax.config import Config
from qdos_brax.data import download, relocation
from qdos_brax.errors import UserError
from qdos_brax.runs import comparison, shares
from qdos_brax.runs.fingerprints import sha256
from qdos_brax.runs.folder import RunFolder

FLAGS = "--env antmaze-medium --method bc --preset smoke --pretrain-steps 2 --set eval.episodes=1"


def begun(folder: RunFolder, dataset: Path, **provenance: Any) -> RunFolder:
    """Give a folder what a run has written once it has read its data."""
    folder.path.mkdir(parents=True, exist_ok=True)
    config = configs.replace(Config(), env="antmaze-medium-task1", dataset=str(dataset))
    folder.config.write_text(configs.to_yaml(config), encoding="utf-8")
    origin = {"command": [], "dataset": {"path": str(dataset), "sha256": sha256(dataset)}} | provenance
    folder.provenance.write_text(json.dumps(origin), encoding="utf-8")
    return folder


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "walks.npz"
    path.write_bytes(b"any content: only its hash is asked for")
    return path


@pytest.mark.quick
def test_a_files_name_lasts_in_every_folder_and_a_public_sets_stays(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    assert download.lasting_name("walks.npz") == str(file)
    assert download.lasting_name("antmaze-large-navigate-v0") == "antmaze-large-navigate-v0"


@pytest.mark.quick
def test_the_new_place_is_noted_in_every_folder_of_a_run(file: Path, tmp_path: Path) -> None:
    run = begun(RunFolder(tmp_path / "run"), file)
    shares.create(run, 2, run.config.read_text(encoding="utf-8"))
    moved = file.rename(tmp_path / "elsewhere.npz")
    with pytest.raises(UserError, match=r"walks\.npz, the data of the run, is gone.*--resume .*run --dataset FILE"):
        relocation.check_data(run, configs.from_yaml(run.config))
    relocation.relocate(str(run.path), str(moved))
    for folder in (run, *shares.shares_of(run)):
        assert configs.from_yaml(folder.config).dataset == str(moved)
    assert run.read_origin()["dataset"] == {"path": str(moved), "sha256": sha256(moved)}
    relocation.check_data(run, configs.from_yaml(run.config))


@pytest.mark.quick
def test_a_comparison_moves_as_a_whole_or_not_at_all(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "both"
    comparison.create(path, {"a": configs.to_yaml(Config()), "b": configs.to_yaml(Config())})
    other = tmp_path / "other.npz"
    other.write_bytes(b"other")
    begun(RunFolder(path / "a"), other), begun(RunFolder(path / "b"), file)
    with pytest.raises(UserError, match=r"is not the file that the run in .*/b began with"):
        relocation.relocate(str(path), str(shutil.copy(other, tmp_path / "copy.npz")))
    assert configs.from_yaml(RunFolder(path / "a").config).dataset == str(other)


@pytest.mark.quick
@pytest.mark.parametrize("content", ["", "{", "[]", '{"dataset": {}}', '{"dataset": {"sha256": 1}}'])
def test_a_damaged_record_is_one_line(file: Path, tmp_path: Path, content: str) -> None:
    run = begun(RunFolder(tmp_path / "run"), file)
    run.provenance.write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=r"run\.json is damaged .*; restore it, or start a new run"):
        relocation.relocate(str(run.path), str(file))


@pytest.mark.quick
@pytest.mark.parametrize("flags", ["--dataset /nowhere.npz", "--dataset {file} --distributed", "--dataset {other}"])
def test_a_wrong_place_is_one_line(flags: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = begun(RunFolder(tmp_path / "run"), file)
    other = tmp_path / "other.npz"
    other.write_bytes(b"other")
    before = run.config.read_text(encoding="utf-8"), run.provenance.read_text(encoding="utf-8")
    assert train_main(["--resume", str(run.path), *shlex.split(flags.format(file=file, other=other))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert before == (run.config.read_text(encoding="utf-8"), run.provenance.read_text(encoding="utf-8"))


def test_a_run_with_a_relative_name_goes_on_from_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir(), there.mkdir()
    monkeypatch.chdir(here)
    assert main(shlex.split("data make antmaze-medium --out walks.hdf5 --transitions 1000 --num-envs 4")) == 0
    assert train_main(shlex.split(f"{FLAGS} --dataset walks.hdf5 --out run")) == 0
    (here / "run" / "summary.json").unlink()
    monkeypatch.chdir(there)
    assert train_main(["--resume", "../here/run"]) == 0
    (here / "run" / "summary.json").unlink()
    (here / "walks.hdf5").rename(there / "moved.hdf5")
    assert train_main(["--resume", "../here/run"]) == 2
    assert "--dataset FILE" in capsys.readouterr().err
    assert train_main(shlex.split("--resume ../here/run --dataset moved.hdf5")) == 0
    assert configs.from_yaml(here / "run" / "config.yaml").dataset == str(there / "moved.hdf5")
