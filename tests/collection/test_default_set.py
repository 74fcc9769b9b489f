"""Default sets: collected once, with their origin; the commands that make, describe and check a file."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from qdos_brax.collection import default_set, profiles, recipes
from qdos_brax.collection.collector import Collector
from qdos_brax.collection.experts import policies
from qdos_brax.commands.data import add_parser
from qdos_brax.data import formats
from qdos_brax.errors import UserError
from tests.collection.stand_ins import StandIn, make_env


def test_a_body_without_an_expert_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env("humanoidmaze")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path))
    monkeypatch.delitem(profiles.PROFILES, "humanoidmaze")
    refused = pytest.raises(UserError, match=r"no expert .* humanoidmaze.*--dataset FILE.*humanoidmaze-medium-navigate")
    with refused:
        Collector(env, recipes.degraded(0.5, profiles.ANT))
    with refused:
        default_set.default_dataset(env, transitions=400, degraded_share=0.5, noise=0.2, seed=0)
    assert list(tmp_path.iterdir()) == []


def test_the_default_set_is_collected_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    env = make_env("antmaze-medium")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    monkeypatch.setitem(profiles.PROFILES, "antmaze", replace(profiles.ANT, expert=StandIn))
    parameters: dict[str, Any] = {"transitions": 400, "degraded_share": 0.5, "noise": 0.2, "num_envs": 2}
    path = default_set.default_dataset(env, seed=0, **parameters)
    assert path.parent == tmp_path / "data" and str(path) in capsys.readouterr().out
    made = path.stat().st_mtime_ns
    collected: list[Path] = []
    with monkeypatch.context() as patch:
        patch.setattr(default_set, "make_file", lambda path, *_: collected.append(path))
        assert default_set.default_dataset(env, seed=0, **parameters) == path and path.stat().st_mtime_ns == made
        assert collected == []
        other = default_set.default_dataset(env, seed=1, **parameters)
        assert other != path and collected == [other]
    dataset = formats.read(path, env)
    assert dataset.size == 400 and dataset.quality is not None
    attributes = formats.read_attrs(path)
    assert "wander=" in attributes["composition"] and attributes["recipe"] == "mixed"
    assert recipes.parse_mix(attributes["mix"]).keys() == recipes.BEHAVIOURS.keys()
    assert attributes["expert"] == policies.digest(StandIn())

    with monkeypatch.context() as patch, pytest.raises(UserError, match="give the name of a file with --out"):
        patch.setattr(default_set, "collect", None)  # refused before anything is collected
        default_set.make_file(tmp_path / "data", Collector(env, recipes.degraded(0.5, profiles.ANT)), 400, 0, 2)

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "file"))
    with pytest.raises(UserError, match="QDOS_DATA"):
        default_set.default_dataset(env, seed=0, **parameters)


def test_commands_make_info_and_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(required=True))

    def run(*words: str) -> tuple[int, str]:
        args = parser.parse_args(["data", *words])
        return args.run(args), capsys.readouterr().out

    monkeypatch.setitem(profiles.PROFILES, "antmaze", replace(profiles.ANT, expert=StandIn))
    path = str(tmp_path / "set.hdf5")
    assert run("make", "antmaze-medium", "--out", path, "--transitions", "400", "--num-envs", "2") == (0, f"{path}\n")
    code, text = run("info", path)
    assert code == 0 and "400" in text and "navigate 50.0%" in text
    assert run("check", path, "--env", "antmaze-medium")[0] == 0
    code, text = run("check", path, "--env", "antsoccer-arena")
    assert code == 2 and "observations has 29 numbers per row, antsoccer-arena has 42" in text
    code, text = run("check", path, "--env", "antmaze-medium", "--horizon", "500")
    assert code == 2 and "no episode has 500 steps" in text
    with pytest.raises(UserError, match="did you mean"):
        run("check", path, "--env", "antmaze-medum")
    with pytest.raises(UserError, match=r"\.hdf5"):
        run("make", "antmaze-medium", "--out", str(tmp_path / "set.npz"))
    with pytest.raises(UserError, match="takes neither"):
        run("make", "antmaze-medium", "--out", path, "--recipe", "stitch", "--mix", "expert=1")
    with pytest.raises(UserError, match="give one of them"):
        run("make", "antmaze-medium", "--out", path, "--degraded-share", "0.1", "--mix", "expert=1")
