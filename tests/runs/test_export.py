"""A trained run as one file: bit for bit what was learned, and one line for everything that cannot be trusted."""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

import envs
from qdos_brax import config as configs
from qdos_brax.analysis.finished import load_run
from qdos_brax.commands.main import main
from qdos_brax.commands.train import configs_from_args, train_main, train_parser
from qdos_brax.methods.given_skills import GivenSkillsPhase, read_skills
from qdos_brax.methods.low_level_kinds import make_low_level
from qdos_brax.runs import bundle
from qdos_brax.runs.checkpoint import final_artifacts
from qdos_brax.runs.folder import RunFolder
from tests.point import bound, run_phase

TINY = (
    "--env antmaze-medium --preset smoke --pretrain-steps 2 --steps 160 --set data.transitions=1000 "
    "--set data.num_envs=4 --set labels.start_env_steps=80 --set high_level.warmup_env_steps=80 "
    "--set eval.every_env_steps=160 --set eval.episodes=1"
)


@pytest.fixture
def exported(finished: Path) -> Path:
    """The file of a run of two members."""
    file = finished.parent / "run.safetensors"
    assert main(["export", str(finished), "--out", str(file)]) == 0
    return file


def artifacts_of(run: Path) -> dict[str, Any]:
    folder = RunFolder(run)
    return final_artifacts(folder.checkpoints, configs.config_hash(configs.from_yaml(folder.config)))


def assert_same(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_the_round_trip_is_exact(finished: Path, exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ours, theirs = load_run(finished), load_run(exported)
    assert_same(theirs.artifacts, ours.artifacts)
    assert_same(theirs.hyper, ours.hyper)
    capsys.readouterr()
    assert main(["evaluate", str(finished), str(exported), "--episodes", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    played = [line.partition(": ")[2] for line in lines]
    assert len(played) == 4 and played[:2] == played[2:] and "length 25" in played[0]


def test_the_same_bundle_gives_the_same_bytes(exported: Path, tmp_path: Path) -> None:
    found = bundle.read(exported)
    for name in ("a", "b", "c", "d"):
        bundle.write(tmp_path / name, found)
        assert (tmp_path / name).read_bytes() == exported.read_bytes()
    size = int.from_bytes(exported.read_bytes()[:8], "little")
    header = json.loads(exported.read_bytes()[8 : 8 + size])
    assert size % 8 == 0 and list(header["__metadata__"]) == ["card", "format", "kind", "sha256"]


def test_one_member_is_written_with_its_own_seed(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "one.safetensors"
    assert main(["export", str(finished), "--out", str(file), "--member", "1"]) == 0
    trained = load_run(file)
    assert configs.members(trained.config) == configs.members(load_run(finished).config)[1:]
    assert_same(trained.artifacts, jax.tree.map(lambda leaf: leaf[1:], load_run(finished).artifacts))
    assert main(["export", str(finished), "--out", str(file), "--member", "2"]) == 2


def test_the_card_can_be_read_without_us(exported: Path) -> None:
    with safe_open(exported, framework="numpy") as file:
        header = file.metadata()
    assert (header["kind"], header["format"]) == ("qdos-brax", "1")
    card = json.loads(header["card"])
    assert (card["task"], card["method"], card["seeds"]) == ("antmaze-medium", "qdos", [0, 1])
    assert {"data_sha256", "members", "command", "packages", "config", "qdos_brax"} <= set(card)
    assert not {"out", "dataset", "run", "skills_file"} & set(card["config"])


def rewritten(path: Path, header: dict[str, str] | None, **card: Any) -> Path:
    """The file with another header, or entries of its card changed and the checksum right."""
    found = bundle.read(path)
    out = path.with_name("other.safetensors")
    if header is None:
        bundle.write(out, bundle.Bundle(found.card | card, found.arrays))
    else:
        save_file({"a": np.zeros(3)}, out, header)
    return out


def test_damage_is_refused_wherever_it_is(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every piece that is cut off, and every one of many flipped bits."""
    whole = exported.read_bytes()
    bad = exported.with_name("bad.safetensors")
    rng = np.random.default_rng(0)
    header = int.from_bytes(whole[:8], "little") + 8
    flips = [*rng.integers(0, header, 20), *rng.integers(header, len(whole), 10)]
    pieces = [whole[:n] for n in (0, 7, 100, len(whole) // 2, len(whole) - 1)] + [whole + b"x"]
    pieces += [whole[:i] + bytes([whole[i] ^ 4]) + whole[i + 1 :] for i in flips]
    for number, content in enumerate(pieces):
        bad.write_bytes(content)
        capsys.readouterr()
        assert main(["evaluate", str(bad), "--episodes", "1"]) == 2, number
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and lines[0].startswith(f"error: {bad}"), lines


FOREIGN: list[tuple[dict[str, str] | None, dict[str, Any], str]] = [
    ({}, {}, "was not written by"),
    ({"kind": "qdos-brax", "format": "2"}, {}, "newer than 1"),
    (None, {"config": 3}, "holds no configuration"),
    (None, {"config": {"env": "antmaze-medium", "skills": {"wings": 2}}}, "unknown key 'skills.wings'"),
    (None, {"config": {"env": "moonmaze"}}, "not those of 1 members"),
    (None, {"config": {"env": "moonmaze", "seed": [0, 1]}}, "no task 'moonmaze'"),
    (None, {"config": {"env": "antmaze-medium", "seed": [0, 1], "method": "bc"}}, "do not fit"),
    (None, {"config": {"env": "antsoccer", "preset": "smoke", "seed": [0, 1]}}, "do not fit"),
]


def test_foreign_and_newer_files_are_refused(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for header, card, message in FOREIGN:
        capsys.readouterr()
        assert main(["evaluate", str(rewritten(exported, header, **card)), "--episodes", "1"]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and message in lines[0], lines


def test_a_run_folder_in_place_of_its_file_names_the_command(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skills = ["train", "--env", "antmaze-medium", "--preset", "smoke", "--skills", str(finished)]
    assert main([*skills, "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        line
        == f"error: {finished} is a folder: `python -m qdos_brax export {finished} --out FILE` makes the file of a run"
    )


def test_a_card_without_bottom_is_refused(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its checksum is right, and no JSON reader follows it."""
    arrays, card = {"x": np.zeros(1, np.float32)}, "[" * 200_000
    header = {"kind": "qdos-brax", "format": "1", "card": card, "sha256": bundle._digest(card, arrays)}
    bad = exported.with_name("deep.safetensors")
    save_file(arrays, bad, header)
    capsys.readouterr()
    assert main(["evaluate", str(bad), "--episodes", "1"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "its card or its names cannot be read (nested too deeply)" in lines[0], lines


@pytest.mark.slow
def test_a_high_level_begins_on_the_skills_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    first, again, file = tmp_path / "first", tmp_path / "again", tmp_path / "skills.safetensors"
    assert train_main(shlex.split(f"{TINY} --method supe --out {first}")) == 0
    assert main(["export", str(first), "--out", str(file)]) == 0
    more = TINY.replace("--pretrain-steps 2", "")
    assert train_main(shlex.split(f"{more} --method supe --skills {file} --seed 3,4 --out {again}")) == 0
    with (again / "metrics.csv").open(newline="") as table:
        assert {row["phase"] for row in csv.DictReader(table)} == {"label", "online"}
    ours, theirs = artifacts_of(first), artifacts_of(again)
    for name in ("skills", "normaliser"):
        assert_same(theirs[name], jax.tree.map(lambda leaf: np.repeat(leaf, 2, axis=0), ours[name]))
    assert not np.array_equal(*jax.tree.leaves(theirs["actor"])[-1])  # two seeds of the high level
    assert json.loads((again / "run.json").read_text())["skills"]["path"] == str(file)


def test_given_skills_reach_every_member(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "one.safetensors"
    assert main(["export", str(finished), "--out", str(file), "--member", "1"]) == 0
    flags = ["--env", "antmaze-medium-task1", "--preset", "smoke", "--skills", str(file), "--seed", "3,4,5"]
    (config,) = configs_from_args(train_parser().parse_args(flags)).values()
    assert config.skills.horizon == 10 and config.skills_file == str(file)
    env = envs.make("antmaze-medium", physics="mujoco")
    given = read_skills(config, env, make_low_level(config, env))
    phase = bound(GivenSkillsPhase(given), config, None)
    (_, metrics, artifacts), theirs = run_phase(phase, jax.random.split(jax.random.key(0), 3), {}), load_run(finished)
    assert not metrics and artifacts["healthy"].tolist() == [True] * 3
    for name in ("skills", "normaliser"):
        assert_same(artifacts[name], jax.tree.map(lambda leaf: np.repeat(leaf[1:], 3, axis=0), theirs.artifacts[name]))


REFUSED = {
    "--env antmaze-large": "skills of antmaze-medium-task1",
    "--env antmaze-medium-task2": "skills of antmaze-medium-task1",
    "--env antmaze-medium --method hilp": "which hilp cannot play",
    "--env antmaze-medium --method rlpd": "rlpd has no skills",
    "--env antmaze-medium --set skills.horizon=4": "skills.horizon is 4, and 10 in",
    "--env antmaze-medium --alpha 0.7": "skills.alpha is 0.7, and 0.3 in",
    "--env antmaze-medium --skills {two}": "several members; export one",
    "--env antmaze-medium --skills {two}x": "cannot be read",
}


def test_skills_of_another_kind_are_refused(
    finished: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, new = tmp_path / "one", tmp_path / "new"
    assert main(["export", str(finished), "--out", str(one), "--member", "0"]) == 0
    for flags, message in REFUSED.items():
        capsys.readouterr()
        command = f"--preset smoke --skills {one} --out {new} {flags.format(two=exported)}"
        assert train_main(shlex.split(command)) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and message in lines[0], lines
        assert not new.exists()
