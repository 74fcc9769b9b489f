"""The layers of a configuration, each with its name: the task's YAML, the method, the preset, the flags, ``--set``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

import envs
from qdos_brax.config.methods import METHODS
from qdos_brax.config.methods import settings as method_settings
from qdos_brax.config.rules import nearest
from qdos_brax.config.schema import Config, leaves
from qdos_brax.errors import UserError

# The folder beside the packages: the repository's root in an editable install, site-packages in a built wheel.
CONFIG_DIR = Path(__file__).resolve().parents[2] / "configs"


@dataclasses.dataclass(frozen=True)
class Layer:
    """Hold values by dotted key, not converted yet, and the name of where they come from."""

    name: str
    values: Mapping[str, Any]


def merged(layers: Sequence[Layer]) -> dict[str, Any]:
    """Return the values of all layers by dotted key; later layers win."""
    return {key: value for layer in layers for key, value in layer.values.items()}


def run_layers(
    env: str | None = None,
    preset: str | None = None,
    flags: Mapping[str, Any] | None = None,
    sets: Sequence[str] = (),
) -> list[Layer]:
    """Return all layers over the defaults, lowest first.

    Args:
        env: a task's name or alias; None takes the default of ``Config``.
        preset: name of a preset; None takes ``default_preset()``.
        flags: values by dotted key, as the flags of the command line give them.
        sets: "key=value" texts.

    Raises:
        UserError: there is no such task, method, preset or key; the line proposes the nearest.
    """
    spec = _spec(Config.env if env is None else env)
    given = known_keys(flags or {}, "a flag")
    chosen = preset or default_preset()
    return [
        *family_layers(spec.family, given.get("method", Config.method), chosen, spec.variant),
        *([] if preset else [Layer("this machine's default", {"preset": chosen})]),
        Layer("flag", {key: value for key, value in (("env", env), ("preset", preset)) if value} | given),
        Layer("--set", dict(_parse_set(text) for text in sets)),
    ]


def family_layers(family: str, method: str, preset: str, variant: str | None = None) -> list[Layer]:
    """Return the layers below the flags: the family's YAML, the method, the preset and its sections.

    Args:
        family: a task family, registered in ``envs`` or with a YAML; without a YAML it has the defaults.
        method: name of a method.
        preset: name of a preset.
        variant: of the family's tasks, such as a maze; None leaves out what is for one variant alone.

    Raises:
        UserError: there is no such method or preset, or a file has a key that the configuration has not.
    """
    known_method(method)
    path = CONFIG_DIR / f"{family}.yaml"
    return [
        *([Layer(f"configs/{family}.yaml", read_values(path))] if family in families() else []),
        Layer(f"method {method}", known_keys(method_settings(method, family), f"method {method}")),
        *_preset_layers(preset, family, variant, method),
    ]


def default_preset() -> str:
    """Return the preset of this machine: "cpu" where jax has no accelerator, else "paper"."""
    import jax  # here, because reading a configuration must not start a device

    return "cpu" if jax.default_backend() == "cpu" else "paper"


def families() -> list[str]:
    """Return the task families that have a YAML."""
    return sorted(path.stem for path in CONFIG_DIR.glob("*.yaml"))


def presets() -> list[str]:
    """Return the presets that have a YAML."""
    return sorted(path.stem for path in (CONFIG_DIR / "presets").glob("*.yaml"))


def known_method(name: str) -> str:
    """Return ``name``.

    Raises:
        UserError: there is no such method.
    """
    if name not in METHODS:
        raise UserError(
            f"there is no method {name!r}{nearest(str(name), list(METHODS))}; there are {', '.join(METHODS)}"
        )
    return name


def known_keys(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return ``values`` as a dict.

    Raises:
        UserError: a key is unknown; the line begins with ``where`` and proposes the nearest.
    """
    known = [key for key, _ in leaves(Config)]
    for key, value in values.items():
        if key in known:
            continue
        if value is None and any(name.startswith(f"{key}.") for name in known):
            raise UserError(f"{where}: {key} is a group of keys; give one, such as {_first_of_group(key, known)}")
        raise UserError(f"{where}: unknown key {key!r}{nearest(key, known)}")
    return dict(values)


def read_values(path: Path) -> dict[str, Any]:
    """Return the values of a YAML file by dotted key, not converted yet.

    Raises:
        UserError: the file cannot be read, or has a key that the configuration has not.
    """
    return known_keys(flat(_read_mapping(path)), str(path))


def flat(nested: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested dicts as one, by dotted key."""
    found: dict[str, Any] = {}
    for key, value in nested.items():
        name = f"{prefix}{key}"
        found |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return found


def _spec(env: str) -> envs.TaskSpec:
    try:
        return envs.get_spec(env)
    except ValueError as error:  # envs does not know UserError; its lines are written for the user all the same
        raise UserError(str(error)) from error


def _preset_layers(name: str, family: str, variant: str | None, method: str) -> list[Layer]:
    """Return a preset's values, over them those of its sections ``low_level`` and ``methods`` and of the family.

    A family's section may have ``variants``, and over them ``low_level`` again, since how often a method decides
    weighs more than which of the family's tasks it plays, and over all of them ``methods``, for what one method alone
    can do.
    """
    low_level = METHODS[method].low_level
    if name not in presets():
        raise UserError(f"unknown preset {name!r}{nearest(name, presets())}; there are {', '.join(presets())}")
    path = CONFIG_DIR / "presets" / f"{name}.yaml"
    content, title = _read_mapping(path), f"preset {name}"
    kinds = sorted({method.low_level for method in METHODS.values()})
    sections = _take_section(content, "families", sorted({*families(), *envs.FAMILIES}), path)
    of_low_level = _take_section(content, "low_level", kinds, path)
    of_method = _take_section(content, "methods", list(METHODS), path)
    layers = [
        (title, content),
        (f"{title}, section low_level.{low_level}", of_low_level.get(low_level)),
        (f"{title}, section methods.{method}", of_method.get(method)),
    ]
    if of_family := sections.get(family):
        known = sorted(envs.FAMILIES[family].variants) if family in envs.FAMILIES else []
        of_variant = _take_section(of_family, "variants", known, path)
        of_low_level = _take_section(of_family, "low_level", kinds, path)
        of_method = _take_section(of_family, "methods", list(METHODS), path)
        title = f"{title}, section families.{family}"
        layers.append((title, of_family))
        if variant is not None:
            layers.append((f"{title}.variants.{variant}", of_variant.get(variant)))
        layers.append((f"{title}.low_level.{low_level}", of_low_level.get(low_level)))
        layers.append((f"{title}.methods.{method}", of_method.get(method)))
    return [Layer(title, known_keys(flat(part), str(path))) for title, part in layers if part]


def _take_section(content: dict[str, Any], name: str, known: Sequence[str], path: Path) -> dict[str, Any]:
    """Remove a section from a preset's content and return it, its names checked."""
    section = content.pop(name, None) or {}
    for key in section:
        if key not in known:
            raise UserError(f"{path}: unknown entry {key!r} in {name}{nearest(key, known)}")
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
    """Return ("key", value) of "key=value"; the value is read as YAML."""
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise UserError(f"--set needs key=value, not {text!r}")
    if key in ("env", "preset", "method"):
        raise UserError(f"--set {key} comes too late, because it decides which values are read; use --{key}")
    known_keys({key: None}, "--set")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise UserError(f"--set {key}: cannot read the value {value!r}") from error


def _first_of_group(group: str, known: list[str]) -> str:
    return next(name for name in known if name.startswith(f"{group}."))
