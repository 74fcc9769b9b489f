"""The table of evidence without RL: its arms, its arithmetic, and that it is read again instead of measured again."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import evidence
import pytest

from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.errors import UserError


def test_every_arm_is_there_once_for_every_seed() -> None:
    asked = configs.load_config("antmaze-large", "cpu", {"seed": "20,21"})
    found = [
        evidence.arm_of(config, member)
        for program in evidence.programs(["start", "world"], 1.0, 0.3, 3.0)
        for config in [configs.replace(asked, **program.settings)]
        for member in configs.members(config)
    ]
    expected = {
        (view, weights, term, seed)
        for view in ("start", "world")
        for weights in ("on", "off")
        for term in ("off", "segment", "outcome")
        for seed in (20, 21)
    }
    assert len(found) == len(expected) and {tuple(arm.values()) for arm in found} == expected


def test_skills_that_are_outcomes_have_arms_without_the_papers_term() -> None:
    asked = configs.load_config("antmaze-large", "cpu")
    (program,) = evidence.programs(["outcome"], 1.0, 0.3, 3.0)
    config = configs.replace(asked, **program.settings)
    found = {tuple(evidence.arm_of(config, member).values()) for member in configs.members(config)}
    assert found == {("outcome", weights, term, 0) for weights in ("on", "off") for term in ("off", "outcome")}
    (vae, _) = evidence.programs(["start"], 1.0, 0.3, 3.0)
    assert configs.replace(asked, **vae.settings).skills.model == "vae"


def test_an_arms_cell_is_the_mean_over_seeds_with_its_interval() -> None:
    """Of two seeds the bootstrap draws (a, a), (a, b), (b, a), (b, b): the interval of 95 % reaches from a to b."""
    rows = [
        {"view": "start", "weights": weights, "information": "off", "seed": seed, "spread": value, "seconds": 9.0}
        for weights, values in (("on", (0.2, 0.6)), ("off", (0.5, 0.5)))
        for seed, value in enumerate(values)
    ]
    head, on, off = evidence.table(rows).splitlines()
    assert head.split() == ["view", "weights", "information", "seeds", "spread"]
    assert on.split() == ["start", "on", "off", "2", "0.400", "[0.200,", "0.600]"]
    assert off.split() == ["start", "off", "off", "2", "0.500", "[0.500,", "0.500]"]


def program_of(seeds: str, out: Path) -> tuple[evidence.Program, Config, Namespace]:
    """The first program of a table over ``seeds``, its configuration and the command's arguments."""
    asked = configs.load_config("antmaze-large", "cpu", {"seed": seeds})
    args = Namespace(out=out, draws=2, states=3, episodes=0)
    return evidence.programs(["start"], 1.0, 0.3, 3.0)[0], asked, args


def test_a_measured_program_is_read_and_not_trained_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, asked, args = program_of("20,21", tmp_path)
    calls: list[int] = []
    monkeypatch.setattr(evidence, "train", lambda *_: calls.append(0))
    monkeypatch.setattr(evidence, "measure", lambda *_: [{"view": "start", "seed": 20, "spread": 0.25}])
    first = evidence.run_program(program, asked, None, None, args)
    again = evidence.run_program(program, asked, None, None, args)
    assert len(calls) == 1 and float(again[0]["spread"]) == first[0]["spread"] == 0.25
    args.draws = 4
    evidence.run_program(program, asked, None, None, args)
    assert len(calls) == 2  # trained before, which costs nothing; measured anew
    for _ in range(2):
        with pytest.raises(UserError, match="another configuration; give another --out"):
            evidence.run_program(program, configs.replace(asked, seed=(20,)), None, None, args)
    assert float(evidence.run_program(program, asked, None, None, args)[0]["spread"]) == 0.25 and len(calls) == 2


def test_rows_that_were_cut_off_are_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, asked, args = program_of("20", tmp_path)
    calls: list[int] = []
    monkeypatch.setattr(evidence, "train", lambda *_: calls.append(0))

    def killed(*_: object) -> list[dict[str, float]]:
        raise KeyboardInterrupt

    monkeypatch.setattr(evidence, "measure", killed)
    with pytest.raises(KeyboardInterrupt):
        evidence.run_program(program, asked, None, None, args)
    monkeypatch.setattr(evidence, "measure", lambda *_: [{"view": "start", "seed": 20, "spread": 0.5}])
    assert evidence.run_program(program, asked, None, None, args)[0]["spread"] == 0.5 and len(calls) == 2
