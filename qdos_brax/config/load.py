"""From layers or a run's config.yaml to one checked Config, and back to YAML."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from qdos_brax.config import scan
from qdos_brax.config.layers import Layer, flat, known_keys, known_method, merged, read_values, run_layers
from qdos_brax.config.methods import METHODS
from qdos_brax.config.rules import choices_in, convert
from qdos_brax.config.schema import Config, leaves, plain
from qdos_brax.config.skill_groups import SkillsConfig
from qdos_brax.errors import UserError


def load_config(
    env: str, preset: str | None = None, flags: Mapping[str, Any] | None = None, sets: Sequence[str] = ()
) -> Config:
    """Return the configuration of a run.

    Args:
        env: the task's name or alias, as ``envs.get_spec`` knows it.
        preset: name of a preset; None takes ``default_preset()``.
        flags: values by dotted key, as the flags of the command line give them.
        sets: "key=value" texts; they win over everything else.

    Raises:
        UserError: an unknown task, preset or key (the nearest is named), or a value out of its range.
    """
    return from_layers(run_layers(env, preset, flags, sets))


def from_layers(layers: Sequence[Layer]) -> Config:
    """Return the configuration of layers over the defaults.

    Raises:
        UserError: a value is wrong.
    """
    return _drawn(merged(layers))


def load_programs(
    env: str, preset: str | None = None, flags: Mapping[str, Any] | None = None, sets: Sequence[str] = ()
) -> dict[str, Config]:
    """Return the configurations of several programs, as ``programs_of`` the layers of ``load_config``."""
    return programs_of(run_layers(env, preset, flags, sets))


def programs_of(layers: Sequence[Layer]) -> dict[str, Config]:
    """Return the configurations of layers: the product of all values that shape the program.

    Returns:
        The configurations by the values that they do not share ("horizon-4_utd-5"); by "" if there is only one.

    Raises:
        UserError: a value is out of its range, two programs are the same, or ``--zip`` is given with several.
    """
    values = merged(layers)
    chosen: dict[str, list[Any]] = {}
    for key, field in leaves(Config):
        if key in values and _splits(key, field):
            options = choices_in(key, values[key], field.metadata["rule"])
            if len(options) > 1:
                chosen[key] = options
    if chosen and values.get("scan.combine") == "zip":
        raise UserError(f"--zip pairs values within one program; {next(iter(chosen))} shapes the program, give one")
    last = [key.rpartition(".")[2] for key in chosen]
    short = {key: name if last.count(name) == 1 else key for key, name in zip(chosen, last, strict=True)}
    programs: dict[str, Config] = {}
    for combination in itertools.product(*chosen.values()):
        own = dict(zip(chosen, combination, strict=True))
        name = "_".join(f"{short[key]}-{_file_name(value)}" for key, value in own.items())
        if name in programs:
            raise UserError(f"the same program is asked for twice: {name.replace('_', ', ')}")
        programs[name] = _drawn(values | own)
    return programs


def from_yaml(path: str | Path) -> Config:
    """Return the configuration that ``to_yaml`` wrote.

    Raises:
        UserError: the file cannot be read, or holds an unknown key or a wrong value.
    """
    return _build(read_values(Path(path)))


def from_plain(values: Mapping[str, Any], where: str) -> Config:
    """Return the configuration of nested values, as ``plain`` makes them; what is absent has its default.

    Raises:
        UserError: a key is unknown or a value wrong; the line about a key begins with ``where``.
    """
    return _build(known_keys(flat(values), where))


def to_yaml(config: Config) -> str:
    """Return the whole configuration as YAML text, in the order of the fields."""
    return yaml.safe_dump(plain(config), sort_keys=False, default_flow_style=None, width=110)


def replace(config: Config, **values: Any) -> Config:
    """Return a checked copy with other values, by dotted key ("skills.alpha").

    Raises:
        UserError: a key is unknown, or a value is wrong.
    """
    return _build(flat(plain(config)) | known_keys(values, "replace()"))


def check_method(config: Config) -> None:
    """Check that the settings suit the method; training does so before it reads or collects data.

    Raises:
        UserError: they do not.
    """
    method, horizon = METHODS[config.method], config.skills.horizon
    if method.low_level == "action" and horizon != 1:
        raise UserError(
            f"{config.method} has no skills, it decides at every step: skills.horizon must stay 1, not {horizon}"
        )
    high = config.high_level
    if method.actor_critic != "sac" and high.regulariser != "entropy":
        raise UserError(
            f"{config.method} holds its actor near the data by itself: high_level.regulariser must stay entropy"
        )
    if high.initial != "random" and method.actor_critic != "sac":
        raise UserError(f"{config.method} is learned offline by its own losses: high_level.initial must stay random")
    if high.initial != "random" and config.labels.offline_reward != "data":
        raise UserError(
            f"high_level.initial={high.initial} learns from the data's rewards: labels.offline_reward must be data, "
            f"not {config.labels.offline_reward}; or use --set high_level.initial=random"
        )
    if high.initial == "cal-ql" and high.regulariser != "entropy":
        raise UserError(
            "high_level.initial=cal-ql learns an actor of much entropy: high_level.regulariser must stay entropy; or "
            "use --set high_level.initial=random"
        )
    if method.offline and config.labels.offline_reward != "data":
        raise UserError(
            f"{config.method} learns offline from the data's rewards: labels.offline_reward must be data, "
            f"not {config.labels.offline_reward}"
        )
    if config.tuning.skills != "frozen" and method.low_level != "trajectory":
        raise UserError(f"{config.method} has no trajectory skills to fine-tune: tuning.skills must stay frozen")
    tuning, trials = config.tuning, config.tuning.window * config.tuning.trial_share
    if tuning.skills != "frozen" and trials < _LEAST_TRIALS:
        raise UserError(
            f"tuning.window={tuning.window} and tuning.trial_share={tuning.trial_share:g} leave {trials:g} episodes to "
            f"compare the tuned skills by, too few for them ever to be played; their product must be at least "
            f"{_LEAST_TRIALS}"
        )
    if high.utd % high.actor_updates:
        raise UserError(
            f"high_level.utd ({high.utd}) must be a multiple of high_level.actor_updates ({high.actor_updates}): the "
            "same number of critic steps lies between any two of the actor's"
        )


_LEAST_TRIALS = 4  # within the window, about; the guard counts three before it prefers any
_AS_BEFORE = {
    ("skills", "model"): "vae",
    ("skills", "outcome_steps"): 40,
    ("skills", "view"): "world",
    ("skills", "schedule"): "constant",
    ("skills", "least_std"): 0.0,
    ("skills", "mi_encoder"): "segment",
    ("skills", "mi_latent"): "box",
    ("skills", "effective_share"): 0.5,
    ("skills", "alpha_error"): 0.25,
    ("skills", "alpha_rate"): 0.001,
    ("high_level", "actor_updates"): 1,
    ("high_level", "schedule"): "constant",
    ("high_level", "actor_average"): 1.0,
    ("high_level", "initial"): "random",
    ("flow", "conservative_weight"): 5.0,
    ("flow", "conservative_actions"): 10,
    ("labels", "latent"): "sample",
    ("labels", "inputs"): "normalised",
}
_GROUPS_AS_BEFORE = ("observation", "exchange", "scan", "flow", "tuning")  # left out if they have their defaults


def config_hash(config: Config) -> str:
    """Return 16 hex digits over everything that decides the result, which neither folders nor the ``run`` group do.

    Values without effect are left out too, so that runs from before such a key existed can be read: the groups of
    ``_GROUPS_AS_BEFORE`` if they have their defaults, the keys of ``_AS_BEFORE`` at the values that say what was done
    before there was a choice, and the members per program if there is one member or no number was given.
    """
    content = plain(config)
    for key in ("out", "dataset", "skills_file", "run"):
        del content[key]
    for group in _GROUPS_AS_BEFORE:
        if getattr(config, group) == getattr(Config(), group):
            del content[group]
    for (group, key), value in _AS_BEFORE.items():
        if content.get(group, {}).get(key) == value:
            del content[group][key]
    if config.members_per_program == 0 or len(scan.members(config)) == 1:
        del content["members_per_program"]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _splits(key: str, field: dataclasses.Field[Any]) -> bool:
    """Return whether several values of the field make several programs."""
    rule = field.metadata["rule"]
    fixed = key.startswith(("run.", "scan.")) or key == "members_per_program"
    free = rule.kind in ("path", "seeds") or (rule.kind == "text" and not rule.choices)
    return not (field.metadata["scan"] or fixed or free)


def _file_name(value: Any) -> str:
    return "-".join(map(str, value)) if isinstance(value, list) else str(value)


def _drawn(values: Mapping[str, Any]) -> Config:
    """Return the configuration of merged values, its scan drawn and checked."""
    config = _build(scan.drawn(values))
    scan.check(config)
    return config


def _build(values: Mapping[str, Any]) -> Config:
    """Return the Config of values by dotted key; absent ones keep their default."""
    checked = {key: convert(key, values[key], field) for key, field in leaves(Config) if key in values}
    groups: dict[str, dict[str, Any]] = {}
    top: dict[str, Any] = {}
    for key, value in checked.items():
        group, dot, name = key.partition(".")
        if dot:
            groups.setdefault(group, {})[name] = value
        else:
            top[key] = value
    for group, entries in groups.items():
        top[group] = dataclasses.replace(getattr(Config(), group), **entries)
    config = Config(**top)
    _check_together(config)
    return config


def _check_together(config: Config) -> None:
    """Check what no single field's rule can."""
    known_method(config.method)
    high = config.high_level
    if high.target_subset > high.ensemble:
        raise UserError(
            f"high_level.target_subset ({high.target_subset}) must not exceed high_level.ensemble ({high.ensemble})"
        )
    if high.env_steps < config.skills.horizon * high.num_envs:
        raise UserError(
            f"high_level.env_steps ({high.env_steps}) is less than one macro step of every environment "
            f"({config.skills.horizon} x {high.num_envs}); raise it with --steps"
        )
    if config.skills.advantage == "transition" and config.values.estimator == "graph":
        raise UserError("skills.advantage=transition needs values.estimator=iql; on a graph it is the same as segment")
    if scan.asks_auto(config.skills.alpha) and (config.skills.mi_encoder, config.skills.mi_latent) == (
        "segment",
        "played",
    ):
        raise UserError(
            "skills.alpha=auto with skills.mi_encoder=segment needs skills.mi_latent=box: it asks how much of a latent "
            "of known spread can be read back"
        )
    skills = config.skills
    if skills.has_information and skills.mi_encoder == "outcome" and skills.mi_rollout != "physics":
        raise UserError(
            "skills.mi_encoder=outcome needs skills.mi_rollout=physics: logged states are no outcome of z; without "
            "simulator states leave the term out with --alpha 0"
        )
    if skills.model == "outcome":
        _check_outcomes(skills)
    elif skills.mi_encoder == "outcome" and skills.view == "body":
        raise UserError(
            "skills.mi_encoder=outcome needs skills.view=start or world: the body's present frame hides where it got"
        )


def _check_outcomes(skills: SkillsConfig) -> None:
    """Check what skills that are outcomes need."""
    if skills.view != "body":
        raise UserError(f"skills.model=outcome needs skills.view=body, not {skills.view}: it says where its body faces")
    if skills.mi_encoder != "outcome":
        raise UserError("skills.model=outcome needs skills.mi_encoder=outcome: there is no posterior of actions")
