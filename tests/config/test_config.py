"""Layers, ranges, scans, and one line for every wrong key."""

from __future__ import annotations

from pathlib import Path

import pytest

import envs
from qdos_brax import config as configs
from qdos_brax.config import Config, load_config, schema
from qdos_brax.config.methods import METHODS
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("preset", configs.presets())
@pytest.mark.parametrize("family", configs.families())
def test_every_family_loads_with_every_preset(family: str, preset: str, tmp_path: Path) -> None:
    config = configs.from_layers(configs.family_layers(family, "qdos", preset))
    path = tmp_path / "config.yaml"
    path.write_text(configs.to_yaml(config))
    assert configs.from_yaml(path) == config
    assert hash(config) == hash(configs.from_yaml(path))


@pytest.mark.parametrize("name", dict.fromkeys([*envs.ALIASES, *(spec.name for spec in envs.list_tasks())]))
def test_every_task_takes_the_layers_of_its_family(name: str) -> None:
    family = envs.get_spec(name).family
    layers = configs.run_layers(name, "paper")
    alpha = 0.2 if family in ("cube", "kitchen", "scene") else 0.3  # the paper's
    assert layers[0].name == f"configs/{family}.yaml" and layers[0].values["skills.alpha"] == alpha
    assert load_config(name, "paper").env == name


def test_every_registered_family_has_a_yaml() -> None:
    assert set(envs.FAMILIES) <= set(configs.families())


def test_a_family_without_a_yaml_takes_the_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "tiny.yaml").write_text("families: {antmaze: {skills: {horizon: 7}}}")
    monkeypatch.setattr(configs.layers, "CONFIG_DIR", tmp_path)
    config = load_config("antmaze", "tiny")
    assert config.skills.horizon == 7
    assert configs.replace(config, preset="paper", **{"skills.horizon": 20}) == Config(env="antmaze")


def test_the_papers_values() -> None:
    soccer, maze = load_config("antsoccer", "paper"), load_config("antmaze-large", "paper")
    assert (soccer.skills.encoder_hidden, soccer.skills.encoder_layers) == (512, 3)
    assert (maze.skills.encoder_hidden, maze.skills.encoder_layers) == (256, 2)
    assert soccer.high_level.hidden == (512, 512, 512) and maze.high_level.hidden == (256, 256, 256)
    assert soccer.high_level.discount == soccer.values.discount == 0.995 and maze.high_level.discount == 0.99
    scene = configs.from_layers(configs.family_layers("scene", "qdos", "paper"))
    assert scene.skills.kl_weight == 0.2 and maze.skills.kl_weight == 0.1
    for config in (soccer, maze):
        assert (config.skills.horizon, config.skills.latent_dim, config.skills.batch_size) == (20, 8, 256)
        assert (config.high_level.ensemble, config.high_level.utd, config.high_level.batch_size) == (10, 20, 256)
        assert (config.values.expectile, config.labels.rnd_coefficient) == (0.9, 8.0)
    kitchen = configs.from_layers(configs.family_layers("kitchen", "qdos", "paper")).high_level
    assert (kitchen.target_subset, kitchen.init_temperature) == (2, 1.0)


def test_layers_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "presets").mkdir()
    (tmp_path / "antmaze.yaml").write_text("skills: {alpha: 0.3, kl_weight: 0.1, horizon: 10}\nvalues: {n_step: 5}")
    (tmp_path / "antsoccer.yaml").write_text("")
    preset = """
skills: {alpha: 0.4, kl_weight: 0.5, horizon: 8}
low_level: {action: {high_level: {utd: 3, discount: 0.9}}}
methods: {rlpd: {high_level: {utd: 7, discount: 0.95}}}
families:
  antmaze:
    skills: {kl_weight: 0.6}
    high_level: {discount: 0.8}
    low_level: {action: {high_level: {discount: 0.7}}}
    variants: {medium: {high_level: {discount: 0.6}}}
    methods: {rlpd: {high_level: {discount: 0.5}}}
"""
    (tmp_path / "presets" / "tiny.yaml").write_text(preset)
    monkeypatch.setattr(configs.layers, "CONFIG_DIR", tmp_path)
    config = load_config("antmaze", "tiny", {"skills.alpha": "0.7", "skills.horizon": 6}, ["skills.alpha=0.8"])
    assert config.values.n_step == 5  # family over default
    assert config.skills.kl_weight == 0.6  # the preset's section over the preset over the family
    assert config.skills.horizon == 6  # flag over preset
    assert config.skills.alpha == 0.8  # --set over flag
    assert load_config("antsoccer", "tiny").skills.kl_weight == 0.5
    flat = load_config("antmaze", "tiny", {"method": "explore"}, ["labels.rnd_coefficient=1"])
    assert flat.labels.offline_reward == "min"  # method over family and default
    assert flat.skills.horizon == 8  # preset over method
    assert (flat.high_level.utd, config.high_level.utd) == (3, 20)  # the preset's section for the low-level policy
    # A section for the low-level policy, over it one for the family, over it the family's for the low-level policy.
    assert (config.high_level.discount, flat.high_level.discount) == (0.8, 0.7)
    assert load_config("antsoccer", "tiny", {"method": "explore"}).high_level.discount == 0.9
    assert flat.labels.rnd_coefficient == 1.0  # --set over method
    # A variant over its family, for all of its tasks; over it the family's for the low-level policy.
    assert load_config("antmaze-medium-task3", "tiny").high_level.discount == 0.6
    assert load_config("antmaze-medium", "tiny", {"method": "explore"}).high_level.discount == 0.7
    assert load_config("antmaze-large", "tiny").high_level.discount == 0.8
    # Over everything else of the preset, what is for one method.
    assert load_config("antmaze-medium", "tiny", {"method": "rlpd"}).high_level.discount == 0.5
    alone = load_config("antsoccer", "tiny", {"method": "rlpd"}).high_level
    assert (alone.utd, alone.discount) == (7, 0.95)  # of one method, over its low-level policy's
    assert load_config("antmaze", "tiny", {"method": "rlpd"}).high_level.utd == 7  # under the family's, which is silent
    with pytest.raises(UserError, match="unknown entry 'rldp' in methods, did you mean 'rlpd'"):
        (tmp_path / "presets" / "tiny.yaml").write_text(
            preset.replace("methods: {rlpd: {high_level: {utd", "methods: {rldp: {high_level: {utd")
        )
        load_config("antsoccer", "tiny")
    (tmp_path / "presets" / "tiny.yaml").write_text(preset.replace("medium", "medum"))
    with pytest.raises(UserError, match="unknown entry 'medum' in variants, did you mean 'medium'"):
        load_config("antmaze-large", "tiny")
    (tmp_path / "presets" / "tiny.yaml").write_text(preset.replace("rlpd", "rpld"))
    with pytest.raises(UserError, match="unknown entry 'rpld' in methods, did you mean 'rlpd'"):
        load_config("antmaze-large", "tiny")


def _written(value: object) -> str:
    """A value as a user types it after ``--set key=``."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value).lower()


def test_every_key_can_be_set() -> None:
    """What ``to_yaml`` writes can be given back key by key."""
    config = load_config("antsoccer", "cpu")
    plain = {key: schema.get(config, key) for key, _ in schema.leaves(Config)}
    sets = [f"{key}={_written(value)}" for key, value in plain.items() if value is not None]
    sets = [text for text in sets if not text.startswith(("env=", "preset=", "method="))]
    assert load_config("antsoccer", "cpu", sets=sets) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("skils.alpha=1", "unknown key 'skils.alpha', did you mean 'skills.alpha'"),
        ("alpha=1", "did you mean 'skills.alpha'"),
        ("values.expectil=1", "did you mean 'values.expectile'"),
        ("skills=3", "group of keys"),
        ("foo", "key=value"),
        ("env=antmaze", "use --env"),
        ("data.noise=[1", "cannot read"),
        ("skills.alpha=nan", "finite"),
        ("skills.alpha=.inf", "finite"),
        ("skills.alpha=-0.1", "at least 0"),
        ("skills.alpha=", "a number"),
        ("skills.alpha=0.1,0.1", "same value twice"),
        ("values.expectile=0", "above 0"),
        ("values.expectile=1.5", "at most 1"),
        ("skills.batch_size=0", "at least 1"),
        ("skills.batch_size=true", "whole number"),
        ("skills.updates=1.5", "whole number"),
        ("high_level.utd=1,2", "cannot be scanned"),
        ("high_level.hidden=64,0", "at least 1"),
        ("high_level.target_subset=11", "must not exceed high_level.ensemble"),
        ("high_level.env_steps=10", "less than one macro step"),
        ("skills.kl_weighted=3", "true or false"),
        ("skills.advantage=segmnt", "did you mean 'segment'"),
        ("seed=-1", "at least 0"),
        ("seed=", "a whole number"),
    ],
)
def test_wrong_settings_are_one_line(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        load_config("antmaze", "paper", sets=[text])
    assert "\n" not in str(caught.value)


def test_unknown_names_propose_the_nearest() -> None:
    with pytest.raises(UserError, match="did you mean 'antmaze-large'"):
        load_config("antmase-large", "cpu")
    for name in ("cube-tripple", "kitchen-huge", "antmaze-huge", "antmaze-medium-task9"):  # a YAML alone makes no task
        with pytest.raises(UserError, match=f"there is no task '{name}'") as caught:
            configs.load_programs(name, "cpu")
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="did you mean 'smoke'"):
        load_config("antmaze", "smokey")


def test_broken_files_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    for content, message in [("a: [", "not valid YAML"), ("- 1", "keys and values"), ("skills: {alfa: 1}", "alpha")]:
        path.write_text(content)
        with pytest.raises(UserError, match=message) as caught:
            configs.from_yaml(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="No such file"):
        configs.from_yaml(tmp_path / "absent.yaml")


def test_numbers_as_people_write_them() -> None:
    sets = ["skills.updates=1e5", "values.updates=20_000", "values.learning_rate=1e-4", "high_level.hidden=[64, 32]"]
    config = load_config("antmaze", "paper", sets=sets)
    assert config.skills.updates == 100_000 and isinstance(config.skills.updates, int)
    assert config.values.updates == 20_000
    assert config.values.learning_rate == 1e-4
    assert config.high_level.hidden == (64, 32)
    assert load_config("antmaze", "paper", sets=["high_level.hidden=64"]).high_level.hidden == (64,)


def test_every_recipe_suits_every_preset() -> None:
    for preset in ("smoke", "cpu", "paper"):
        for method in METHODS:
            for family in ("antmaze", "antsoccer", "humanoidmaze"):
                configs.check_method(load_config(family, preset, {"method": method}))


def test_runs_from_before_a_key_existed_keep_their_hash() -> None:
    """The hash of such a run's configuration, as version 08c5c3e wrote it for ``--env antmaze --preset paper``."""
    settings = ["values.max_nodes=20000", "labels.inputs=normalised", "labels.latent=sample"]
    assert configs.config_hash(load_config("antmaze", "paper", sets=settings)) == "b1e5b68e2ed1b3c8"


def test_settings_must_suit_the_method() -> None:
    """Found before data is read or collected."""
    short = {"skills.horizon": 5}
    with pytest.raises(UserError, match=r"rlpd has no skills.*horizon must stay 1, not 5"):
        configs.check_method(load_config("antmaze", "smoke", {**short, "method": "rlpd"}))
    with pytest.raises(UserError, match=r"fql is learned offline by its own losses: .*initial must stay random"):
        configs.check_method(load_config("antmaze", "smoke", {"method": "fql", "high_level.initial": "iql"}))
    with pytest.raises(UserError, match=r"initial=iql learns from the data's rewards.*must be data, not min"):
        configs.check_method(load_config("antmaze", "smoke", {"method": "supe", "high_level.initial": "iql"}))
    held = {"high_level.initial": "cal-ql", "high_level.regulariser": "prior"}
    with pytest.raises(UserError, match=r"initial=cal-ql learns an actor of much entropy: .*must stay entropy"):
        configs.check_method(load_config("antmaze", "smoke", held))
    with pytest.raises(UserError, match=r"qc learns offline from the data's rewards: labels.*must be data, not min"):
        configs.check_method(load_config("antmaze", "smoke", {"method": "qc", "labels.offline_reward": "min"}))
    tuned = {"tuning.skills": "guarded", "tuning.window": 8}
    with pytest.raises(UserError, match=r"tuning\.window=8 and tuning\.trial_share=0\.25 leave 2 episodes"):
        configs.check_method(load_config("antmaze", "smoke", tuned))
    configs.check_method(load_config("antmaze", "smoke", {**tuned, "tuning.window": 16}))
    updates = {"high_level.utd": 10, "high_level.actor_updates": 4}
    with pytest.raises(UserError, match=r"utd \(10\) must be a multiple of high_level\.actor_updates \(4\)"):
        configs.check_method(load_config("antmaze", "smoke", updates))
    for other in ({"values.estimator": "iql"}, {"method": "supe"}, {"method": "iql", "skills.horizon": 1}):
        configs.check_method(load_config("antmaze", "smoke", {**short, **other}))
