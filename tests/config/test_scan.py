"""Members, scans, hashes, layers by name, and the marks of the schema."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.config import Config, load_config, schema
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick


def test_members_are_the_product() -> None:
    flags = {"skills.alpha": "0.1,0.2", "seed": "0,1,2"}
    config = load_config("antsoccer", "cpu", flags, ["labels.rnd_coefficient=2,8"])
    members = configs.members(config)
    assert len(members) == 12
    assert members[0] == {"seed": 0, "alpha": 0.1, "labels.rnd_coefficient": 2.0}
    assert len({tuple(member.items()) for member in members}) == 12
    hyper = configs.population_hyper(config)
    assert hyper["skills.alpha"].dtype == np.float32 and hyper["skills.alpha"].shape == (12,)
    for index, member in enumerate(members):
        tree = configs.hyper_tree(config, member)
        assert tree["skills.alpha"] == member["alpha"]
        assert hyper["labels.rnd_coefficient"][index] == tree["labels.rnd_coefficient"]
    with pytest.raises(UserError, match="2 values where one is wanted"):
        configs.hyper_tree(config)


def test_zip_pairs_lists_and_seeds() -> None:
    config = load_config("antsoccer", "cpu", {"scan.combine": "zip", "skills.alpha": "0.1,0.1,0.3", "seed": "0,1,0"})
    assert [tuple(member.values()) for member in configs.members(config)] == [(0, 0.1), (1, 0.1), (0, 0.3)]
    paired = load_config(
        "antsoccer", "cpu", {"scan.combine": "zip", "skills.alpha": "0.1,0.3"}, ["skills.kl_weight=1,2"]
    )
    assert [(m["seed"], m["alpha"], m["skills.kl_weight"]) for m in configs.members(paired)] == [
        (0, 0.1, 1),
        (0, 0.3, 2),
    ]


def test_samples_are_drawn_once_and_repeat(tmp_path: Path) -> None:
    flags = {"scan.samples": "5", "seed": "3,4"}
    sets = ["skills.alpha=loguniform(0.01,1)", "values.expectile=uniform(0.7, 0.9)", "skills.kl_weight=0.1,0.2"]
    config = load_config("antsoccer", "cpu", flags, sets)
    assert config == load_config("antsoccer", "cpu", flags, sets)
    found = configs.members(config)
    assert len(found) == 10 and [member["seed"] for member in found] == 5 * [3] + 5 * [4]
    assert [{**member, "seed": 3} for member in found[5:]] == found[:5]
    for member in found:
        assert 0.01 <= member["alpha"] <= 1 and 0.7 <= member["values.expectile"] <= 0.9
        assert member["skills.kl_weight"] in (0.1, 0.2)
    path = tmp_path / "config.yaml"
    path.write_text(configs.to_yaml(config))
    assert configs.members(configs.from_yaml(path)) == found  # nothing is drawn again
    assert configs.members(load_config("antsoccer", "cpu", flags, [*sets, "scan.draw_seed=1"])) != found
    one_more = load_config("antsoccer", "cpu", flags, [*sets, "values.discount=uniform(0.9,0.99)"])
    assert one_more.skills.alpha == config.skills.alpha
    many = load_config("antsoccer", "cpu", {"scan.samples": 2000}, ["skills.alpha=loguniform(0.1,10)"]).skills.alpha
    assert abs(np.mean(np.asarray(many) < 1) - 0.5) < 0.04  # half of the draws below the geometric middle


def test_sizes_make_programs() -> None:
    sets = ["skills.horizon=10,20", "high_level.hidden=[[64,64],[128,128]]", "skills.alpha=0.1,0.2"]
    programs = configs.load_programs("antmaze", "cpu", sets=sets)
    assert list(programs) == [
        "horizon-10_hidden-64-64",
        "horizon-10_hidden-128-128",
        "horizon-20_hidden-64-64",
        "horizon-20_hidden-128-128",
    ]
    last = programs["horizon-20_hidden-128-128"]
    assert (last.skills.horizon, last.high_level.hidden, last.skills.alpha) == (20, (128, 128), (0.1, 0.2))
    both = configs.load_programs("antmaze", "cpu", sets=["policy.hidden=[[8],[16]]", "values.hidden=[[8],[16]]"])
    assert "values.hidden-16_policy.hidden-8" in both
    words = configs.load_programs(
        "antmaze", "cpu", sets=["skills.kl_weighted=true,false", "skills.advantage_scale=std,rank"]
    )
    assert [config.skills.kl_weighted for config in words.values()] == [True, True, False, False]
    assert list(configs.load_programs("antmaze", "cpu", sets=["high_level.hidden=64,64"])) == [""]


@pytest.mark.parametrize(
    ("flags", "sets", "message"),
    [
        ({"scan.combine": "zip", "skills.alpha": "0.1,0.2", "seed": "0,1,2"}, [], "lists of one length"),
        ({"scan.combine": "zip", "skills.alpha": "0.1,0.1", "seed": "0,0"}, [], "the same member twice"),
        ({"scan.combine": "zip"}, ["skills.horizon=10,20"], "skills.horizon shapes the program"),
        ({"scan.combine": "zip", "scan.samples": "2"}, ["skills.alpha=uniform(0,1)"], "leave out --zip"),
        ({"scan.samples": "2"}, [], "nothing to draw"),
        ({"scan.samples": "3"}, ["skills.alpha=0.1,0.2"], "more settings than there are"),
        ({"scan.samples": "-1"}, ["skills.alpha=0.1,0.2"], "scan.samples must be at least 0"),
        ({"scan.samples": "2"}, ["skills.alpha=0.1,0.2", "scan.draw_seed=-1"], "scan.draw_seed must be at least 0"),
        ({"scan.samples": "2,3"}, ["skills.alpha=0.1,0.2"], "scan.samples takes one value"),
        ({"scan.samples": "x"}, ["skills.alpha=0.1,0.2"], "scan.samples must be a whole number"),
        ({}, ["skills.alpha=uniform(0,1)"], "drawn from with --sample N"),
        ({"scan.samples": "2"}, ["skills.alpha=normal(0,1)"], "no distribution 'normal'"),
        ({"scan.samples": "2"}, ["skills.alpha=loguniform(0,1)"], "wants 0 < a < b"),
        ({"scan.samples": "2"}, ["skills.alpha=uniform(2,1)"], "wants a < b"),
        ({"scan.samples": "2"}, ["skills.alpha=uniform(a,1)"], "must be a number"),
        ({"scan.samples": "9"}, ["values.expectile=uniform(0.5,9)"], "at most 1"),
        ({"seed": "1,1"}, [], "seed holds the same value twice"),
        ({}, ["skills.horizon=10,10"], "asked for twice"),
        ({}, ["skills.horizon=10,x"], "whole number"),
        ({}, ["high_level.hidden=64,64;32,32"], "several lists of widths"),
        ({"members_per_program": "-1"}, [], "at least 0"),
    ],
)
def test_wrong_scans_are_one_line(flags: dict[str, str], sets: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        configs.load_programs("antmaze", "paper", flags, sets)
    assert "\n" not in str(caught.value)


def test_hyper_holds_what_can_be_scanned_and_no_more() -> None:
    tree = configs.hyper_tree(Config())
    assert {"skills.alpha", "skills.advantage_temperature", "values.expectile", "high_level.discount"} <= set(tree)
    assert not {"skills.horizon", "high_level.offline_fraction", "data.noise", "high_level.utd"} & set(tree)
    assert configs.members(Config()) == [{"seed": 0, "alpha": 0.2}]


def test_hash_tells_results_apart_and_nothing_else() -> None:
    config = load_config("antmaze", "paper")
    same = configs.replace(config, out="elsewhere", dataset="file.npz", **{"run.checkpoint_seconds": 1})
    assert configs.config_hash(same) == configs.config_hash(config)
    assert configs.config_hash(configs.replace(config, **{"skills.alpha": 0.25})) != configs.config_hash(config)


def test_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().env = "antsoccer"  # type: ignore[misc]


def test_every_field_says_what_it_means() -> None:
    for key, field in schema.leaves(Config):
        assert len(field.metadata["meaning"]) > 10, key
    for name, purpose in schema.groups().items():
        assert purpose.startswith("Configure ") and "\n" not in purpose, name


def test_layers_keep_their_names() -> None:
    layers = configs.run_layers("antsoccer", "cpu", {"method": "rlpd", "skills.alpha": 1}, ["high_level.utd=3"])
    assert [layer.name for layer in layers] == [
        "configs/antsoccer.yaml",
        "method rlpd",
        "preset cpu",
        "preset cpu, section low_level.action",
        "preset cpu, section families.antsoccer",
        "preset cpu, section families.antsoccer.low_level.action",
        "flag",
        "--set",
    ]
    by_name = {layer.name: layer.values for layer in layers}
    assert by_name["preset cpu, section families.antsoccer.low_level.action"] == {
        "skills.horizon": 1,
        "high_level.utd": 2,
        "high_level.actor_updates": 1,
        "high_level.discount": 0.995,
        "high_level.value_scale": 20,
    }
    assert by_name["flag"] == {"env": "antsoccer", "preset": "cpu", "method": "rlpd", "skills.alpha": 1}
    assert by_name["--set"] == {"high_level.utd": 3}
    unnamed = configs.run_layers("antsoccer")
    assert {"preset": configs.default_preset()} in [layer.values for layer in unnamed]


def test_a_member_keeps_the_value_of_a_labelled_key_under_its_label() -> None:
    """The schema marks the label; a member has it also where it does not vary, and the dotted key finds the value."""
    assert schema.labelled() == {"alpha": "skills.alpha"}
    config = load_config("antmaze", "smoke", {"skills.alpha": "0.1,0.2"}, ["skills.kl_weight=1,2"])
    member = configs.members(config)[3]
    assert member == {"seed": 0, "alpha": 0.2, "skills.kl_weight": 2.0}
    assert configs.values_by_key(member) == {"skills.alpha": 0.2, "skills.kl_weight": 2.0}
    with pytest.raises(KeyError, match="alpha"):
        configs.values_by_key({"seed": 0})


def test_pretrain_steps_are_marked_in_the_schema() -> None:
    """Every group that learns from the data alone has its budget under the mark, and no other key."""
    groups = ("values", "skills", "policy", "guide", "hilbert", "diveoff", "flow")
    assert schema.pretrain_keys() == [f"{group}.updates" for group in groups]
    assert [key for key, _ in schema.leaves(Config) if key.endswith(".updates")] == schema.pretrain_keys()
