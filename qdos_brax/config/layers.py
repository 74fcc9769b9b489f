"""From YAML layers, flags and ``--set`` to one checked Config."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

import envs
from qdos_brax.config import scan
from qdos_brax.config.methods import METHODS
from qdos_brax.config.methods import settings as method_settings
from qdos_brax.config.rules import choices_in, convert, nearest
from qdos_brax.config.schema import Config, leaves, plain
from qdos_brax.errors import UserError

# The folder beside the packages: the repository's root in an editable install, site-packages in a built wheel.
CONFIG_DIR = Path(__file__).resolve().parents[2] / "configs"


def load_config(
    env: str, preset: str | None = None, flags: Mapping[str, Any] | None = None, sets: Sequence[str] = ()
) -> Config:
    """The configuration of a run.

    Args:
        env: the task's name; its first word is the family whose YAML applies.
        preset: name of a preset; None takes ``default_preset()``.
        flags: values by dotted key, as the command line's own flags give them.
        sets: "key=value" texts; they win over everything else.

    Returns:
        The checked configuration.

    Raises:
        UserError: an unknown family, preset or key (the nearest is named), or a value out of its range.
    """
    return _asked(_layers(env, preset, flags, sets))


def load_programs(
    env: str, preset: str | None = None, flags: Mapping[str, Any] | None = None, sets: Sequence[str] = ()
) -> dict[str, Config]:
    """As ``load_config``, but several values of what shapes the program make several configurations: their product.

    Returns:
        The configurations by what they do not share ("horizon-4_utd-5"); by "" if there is but one.
    """
    values = _layers(env, preset, flags, sets)
    chosen: dict[str, list[Any]] = {}
    for key, field in leaves(Config):
        if key in values and _splits(key, field):
            options = choices_in(key, values[key], field.metadata["rule"])
            if len(options) > 1:
                chosen[key] = options
    if chosen and values.get("scan.combine") == "zip":
        raise UserError(f"--zip pairs what one program can vary; {next(iter(chosen))} shapes the program, give one")
    last = [key.rpartition(".")[2] for key in chosen]
    short = {key: name if last.count(name) == 1 else key for key, name in zip(chosen, last, strict=True)}
    programs: dict[str, Config] = {}
    for combination in itertools.product(*chosen.values()):
        own = dict(zip(chosen, combination, strict=True))
        name = "_".join(f"{short[key]}-{_file_name(value)}" for key, value in own.items())
        if name in programs:
            raise UserError(f"the same program is asked for twice: {name.replace('_', ', ')}")
        programs[name] = _asked(values | own)
    return programs


def _splits(key: str, field: Any) -> bool:
    """Whether several values of the field make several programs."""
    rule = field.metadata["rule"]
    fixed = key.startswith(("run.", "scan.")) or key == "members_per_program"
    free = rule.kind in ("path", "seeds") or (rule.kind == "text" and not rule.choices)
    return not (field.metadata["scan"] or fixed or free)


def _file_name(value: Any) -> str:
    return "-".join(map(str, value)) if isinstance(value, list) else str(value)


def _asked(values: Mapping[str, Any]) -> Config:
    """The configuration of what was asked for, its scan drawn and checked."""
    config = _build(scan.drawn(values))
    scan.check(config)
    return config


def _layers(env: str, preset: str | None, flags: Mapping[str, Any] | None, sets: Sequence[str]) -> dict[str, Any]:
    """All layers laid over one another, by dotted key."""
    family = _family_of(env)
    flags = _checked_keys(flags or {}, "a flag")
    method = _known_method(flags.get("method", Config.method))
    preset = preset or default_preset()
    values: dict[str, Any] = {}
    values |= _read_layer(CONFIG_DIR / f"{family}.yaml") if family in families() else {}
    values |= _checked_keys(method_settings(method, family), f"the recipe of {method}")
    values |= _read_preset(preset, family, METHODS[method].source)
    values |= {"env": env, "preset": preset}
    values |= flags
    values |= dict(_parse_set(text) for text in sets)
    return values


def _family_of(env: str) -> str:
    """Return the family of a task's name.

    Raises:
        UserError: there is no such task.
    """
    try:
        return envs.get_spec(env).family
    except ValueError as error:  # envs knows nothing of UserError; its lines are made for the user all the same
        raise UserError(str(error)) from None


def default_preset() -> str:
    """The preset of this machine: "cpu" where jax has no accelerator, else "paper"."""
    import jax  # here, because reading a configuration must not start a device

    return "cpu" if jax.default_backend() == "cpu" else "paper"


def families() -> list[str]:
    """The task families that have a YAML."""
    return sorted(path.stem for path in CONFIG_DIR.glob("*.yaml"))


def presets() -> list[str]:
    """The presets that have a YAML."""
    return sorted(path.stem for path in (CONFIG_DIR / "presets").glob("*.yaml"))


def from_yaml(path: str | Path) -> Config:
    """The configuration that ``to_yaml`` wrote."""
    return _build(_read_layer(Path(path)))


def to_yaml(config: Config) -> str:
    """The whole configuration as YAML text, in the order of the fields."""
    return yaml.safe_dump(plain(config), sort_keys=False, default_flow_style=None, width=110)


def replace(config: Config, **values: Any) -> Config:
    """A copy with some values changed, checked; keys are dotted ("skills.alpha")."""
    return _build(_flat(plain(config)) | _checked_keys(values, "replace()"))


def config_hash(config: Config) -> str:
    """16 hex digits over everything that decides the result: not the folders, and not the ``run`` group.

    What says nothing is left out too, so that a run from before there was such a key can be read: how lists combine
    where they do as ever, and how many members share a program where there is but one or that was never said.
    """
    content = plain(config)
    for key in ("out", "dataset", "run"):
        del content[key]
    if config.scan == Config().scan:
        del content["scan"]
    if config.members_per_program == 0 or len(scan.members(config)) == 1:
        del content["members_per_program"]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _read_layer(path: Path) -> dict[str, Any]:
    """A YAML file as a flat dict by dotted key, its keys checked."""
    return _checked_keys(_flat(_read_mapping(path)), str(path))


def _known_method(name: str) -> str:
    if name not in METHODS:
        raise UserError(
            f"there is no method {name!r}{nearest(str(name), list(METHODS))}; there are {', '.join(METHODS)}"
        )
    return name


def _read_preset(name: str, family: str, source: str) -> dict[str, Any]:
    if name not in presets():
        raise UserError(f"unknown preset {name!r}{nearest(name, presets())}; there are {', '.join(presets())}")
    path = CONFIG_DIR / "presets" / f"{name}.yaml"
    content = _read_mapping(path)
    by_family = _section(content, "families", families(), path)
    layer: dict[str, Any] = {}
    for own in (content, by_family.get(family) or {}):
        by_source = _section(own, "sources", sorted({recipe.source for recipe in METHODS.values()}), path)
        for part in (own, by_source.get(source) or {}):
            layer |= _checked_keys(_flat(part), str(path))
    return layer


def _section(content: dict[str, Any], name: str, known: list[str], path: Path) -> dict[str, Any]:
    """Takes a preset's section out of its content, its names checked."""
    section = content.pop(name, None) or {}
    for key in section:
        if key not in known:
            raise UserError(f"{path}: {key!r} is none of its {name}{nearest(key, known)}")
    return section


def _read_mapping(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict | None):
        raise UserError(f"{path} must hold keys and values, not a {type(content).__name__}")
    return content or {}


def _parse_set(text: str) -> tuple[str, Any]:
    """("key", value) of "key=value"; the value is read as YAML."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise UserError(f"--set wants key=value, not {text!r}")
    if key in ("env", "preset", "method"):
        raise UserError(f"--set {key} comes too late, it decides which values are read; use --{key}")
    _checked_keys({key: None}, "--set")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise UserError(f"--set {key}: cannot read the value {value!r}") from error


def _flat(nested: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in nested.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def _checked_keys(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    known = [key for key, _ in leaves(Config)]
    for key, value in values.items():
        if key in known:
            continue
        if value is None and any(name.startswith(f"{key}.") for name in known):
            raise UserError(f"{where}: {key} is a group of keys; give one, such as {_first_of_group(key, known)}")
        raise UserError(f"{where}: unknown key {key!r}{nearest(key, known)}")
    return dict(values)


def _first_of_group(group: str, known: list[str]) -> str:
    return next(name for name in known if name.startswith(f"{group}."))


def _build(values: Mapping[str, Any]) -> Config:
    """The Config of a flat dict by dotted key; what is absent keeps its default."""
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
    """What no field's own rule can say."""
    _known_method(config.method)
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
