"""The configuration: frozen dataclasses, YAML layers over them, and one clear line for every wrong key or value.

Layers, each laid over the one before: the defaults below (the paper's values), ``configs/<family>.yaml``,
``configs/presets/<preset>.yaml`` (with its own ``families:`` section), the command line's flags, ``--set key=value``.

Two kinds of field are told apart by ``metadata["scan"]``. A scannable field is a number that a learner takes as an
argument of its jitted program: it may hold a list, and every member of the scan gets its own value without a new
compilation (``hyper_tree``, ``members``). Every other field shapes the program.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from qdos_brax.errors import UserError

# The folder beside the packages: the repository's root in an editable install, site-packages in a built wheel.
CONFIG_DIR = Path(__file__).resolve().parents[1] / "configs"

Scannable = float | tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class _Rule:
    """What a field accepts.

    Attributes:
        kind: "int", "float", "bool", "text", "path", "widths" (a list of layer widths) or "seeds".
        low: smallest value accepted.
        high: largest value accepted.
        above: if True, ``low`` itself is refused.
        choices: the only texts accepted; empty for any.
    """

    kind: str
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[str, ...] = ()


def _field(default: Any, rule: _Rule, scan: bool = False) -> Any:
    return dataclasses.field(default=default, metadata={"rule": rule, "scan": scan})


def _count(default: int, low: int = 1) -> Any:
    return _field(default, _Rule("int", low=low, high=2**31 - 1))


def _number(default: float, low: float = 0.0, high: float = math.inf, above: bool = False, scan: bool = True) -> Any:
    return _field(default, _Rule("float", low, high, above), scan)


def _rate(default: float) -> Any:
    """A learning rate: above 0, at most 1."""
    return _number(default, high=1.0, above=True)


def _choice(default: str, *choices: str) -> Any:
    return _field(default, _Rule("text", choices=choices))


def _flag(default: bool) -> Any:
    return _field(default, _Rule("bool"))


def _widths(*default: int) -> Any:
    return _field(default, _Rule("widths", low=1, high=2**20))


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """The data set that is collected when none is given.

    Attributes:
        transitions: environment steps to collect.
        degraded_share: share of the episodes whose behaviour is made bad (heavy noise, wandering, failed attempts).
        noise: standard deviation of the action noise of the other episodes (actions lie in [-1, 1]).
        num_envs: environments stepped side by side.
        seed: seed of the collection; apart from the learner's, so that every seed learns from the same data.
    """

    transitions: int = _count(1_000_000)
    degraded_share: float = _number(0.5, high=1.0, scan=False)
    noise: float = _number(0.2, scan=False)
    num_envs: int = _count(64)
    seed: int = _count(0, low=0)


@dataclasses.dataclass(frozen=True)
class ValuesConfig:
    """Implicit Q-learning on the data: Q, V, and from them the segments' advantages.

    Attributes:
        hidden: widths of the hidden layers of Q and V.
        batch_size: transitions per gradient step.
        learning_rate: Adam's.
        expectile: tau of the expectile regression of V.
        discount: per environment step.
        target_rate: Polyak rate of the target critic.
        n_step: environment steps of the bootstrapped return.
        updates: gradient steps.
    """

    hidden: tuple[int, ...] = _widths(256, 256)
    batch_size: int = _count(256)
    learning_rate: Scannable = _rate(3e-4)
    expectile: Scannable = _number(0.9, high=1.0, above=True)
    discount: Scannable = _number(0.99, high=1.0)
    target_rate: Scannable = _number(0.005, high=1.0, above=True)
    n_step: int = _count(10)
    updates: int = _count(100_000)


@dataclasses.dataclass(frozen=True)
class SkillsConfig:
    """The advantage-weighted trajectory VAE and the mutual information of its skills.

    Attributes:
        horizon: H, environment steps of a segment and of a macro step.
        latent_dim: size of the skill z.
        encoder_hidden: width of the bidirectional GRU (the posterior).
        encoder_layers: its layers.
        decoder_hidden: widths of the low-level policy's hidden layers.
        prior_hidden: widths of the state prior's hidden layers.
        batch_size: segments per gradient step.
        learning_rate: Adam's.
        kl_weight: beta, the weight of KL(posterior || prior).
        kl_weighted: whether the advantage weight multiplies the KL too (Algorithm 1) or not (equation 4).
        advantage: estimator of a segment's advantage; "segment" is the H-step return plus V(s_H) minus V(s_0),
            "latent" is Q(s_0, z) - V(s_0), "transition" is the mean of Q(s_t, a_t) - V(s_t).
        advantage_temperature: lambda in exp(A / lambda).
        weight_clip: largest weight, after the batch's weights were brought to mean 1.
        alpha: weight of the mutual-information loss.
        mi_rollout: where skills are rolled out for that loss: "physics" (the simulator) or "logged" (the policy
            along the data's states).
        mi_every: gradient steps that one batch of rollouts serves.
        mi_batch: rollouts in such a batch.
        latent_box: half the side of the box that random skills are drawn from.
        updates: gradient steps.
    """

    horizon: int = _count(20)
    latent_dim: int = _count(8)
    encoder_hidden: int = _count(256)
    encoder_layers: int = _count(2)
    decoder_hidden: tuple[int, ...] = _widths(256, 256)
    prior_hidden: tuple[int, ...] = _widths(256, 256)
    batch_size: int = _count(256)
    learning_rate: Scannable = _rate(3e-4)
    kl_weight: Scannable = _number(0.1)
    kl_weighted: bool = _flag(True)
    advantage: str = _choice("segment", "segment", "latent", "transition")
    advantage_temperature: Scannable = _number(1.0, above=True)
    weight_clip: Scannable = _number(20.0, low=1.0)
    alpha: Scannable = _number(0.2)
    mi_rollout: str = _choice("physics", "physics", "logged")
    mi_every: int = _count(20)
    mi_batch: int = _count(64)
    latent_box: Scannable = _number(2.0, above=True)
    updates: int = _count(500_000)


@dataclasses.dataclass(frozen=True)
class LabelsConfig:
    """Pseudo-labels of the offline segments, and the bonus for novelty.

    Attributes:
        offline_reward: reward of an offline macro transition: the data's own ("data"), the lowest possible ("min"),
            or the reward model's ("pred").
        rnd_coefficient: weight of the random-network-distillation bonus.
        rnd_hidden: widths of the hidden layers of its two networks.
        rnd_features: size of their output.
        rnd_learning_rate: Adam's.
        reward_hidden: widths of the reward model's hidden layers.
        reward_learning_rate: Adam's.
        start_env_steps: environment steps before the bonus and the reward model are trained.
    """

    offline_reward: str = _choice("data", "data", "min", "pred")
    rnd_coefficient: Scannable = _number(8.0)
    rnd_hidden: tuple[int, ...] = _widths(256, 256, 256)
    rnd_features: int = _count(256)
    rnd_learning_rate: Scannable = _rate(3e-4)
    reward_hidden: tuple[int, ...] = _widths(256, 256, 256)
    reward_learning_rate: Scannable = _rate(3e-4)
    start_env_steps: int = _count(10_000, low=0)


@dataclasses.dataclass(frozen=True)
class HighLevelConfig:
    """The high-level policy: SAC over skills, learned online.

    Attributes:
        hidden: widths of the hidden layers of actor and critics.
        ensemble: critics.
        target_subset: critics drawn for the target's minimum.
        batch_size: macro transitions per gradient step.
        offline_fraction: share of them taken from the labelled data.
        utd: critic steps per macro step of experience.
        learning_rate: Adam's, of actor, critics and temperature.
        discount: per macro step.
        target_rate: Polyak rate of the target critics.
        init_temperature: first value of the entropy temperature.
        target_entropy_scale: the target entropy is minus this times the latent dimension.
        latent_map: from the action u in (-1, 1) to the skill z: "arctanh", "box" (z = latent_box * u), or "prior"
            (z = mean + latent_box * standard deviation * u of the state prior).
        num_envs: environments stepped side by side.
        warmup_env_steps: first environment steps, acted by the state prior instead of the actor.
        env_steps: environment steps of the online phase, over all environments.
        replay_capacity: macro transitions kept.
    """

    hidden: tuple[int, ...] = _widths(256, 256, 256)
    ensemble: int = _count(10)
    target_subset: int = _count(1)
    batch_size: int = _count(256, low=2)
    offline_fraction: float = _number(0.5, high=1.0, scan=False)
    utd: int = _count(20)
    learning_rate: Scannable = _rate(3e-4)
    discount: Scannable = _number(0.99, high=1.0)
    target_rate: Scannable = _number(0.005, high=1.0, above=True)
    init_temperature: Scannable = _number(0.05, above=True)
    target_entropy_scale: Scannable = _number(0.5)
    latent_map: str = _choice("arctanh", "arctanh", "box", "prior")
    num_envs: int = _count(1)
    warmup_env_steps: int = _count(5_000, low=0)
    env_steps: int = _count(200_000)
    replay_capacity: int = _count(100_000)


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluation on environments of its own.

    Attributes:
        episodes: episodes per evaluation.
        every_env_steps: online environment steps between two evaluations.
    """

    episodes: int = _count(20)
    every_env_steps: int = _count(10_000)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What changes where and how often a run writes, never what it computes.

    Attributes:
        checkpoint_seconds: seconds of work between two checkpoints; 0 saves after every chunk.
        root: folder that holds the run folders whose place is not given with ``--out``.
    """

    checkpoint_seconds: float = _number(30.0, scan=False)
    root: str = _field("runs", _Rule("text"))


@dataclasses.dataclass(frozen=True)
class Config:
    """One run, whole.

    Attributes:
        env: the task's name, as ``envs.make`` takes it.
        method: the name of a recipe in ``qdos_brax.methods``.
        preset: the sizes that were laid over the task's values: "paper", "cpu" or "smoke".
        seed: seeds; several make a scan.
        physics: engine: "auto" (MuJoCo C on a CPU, MJX on an accelerator), "mjx" or "mujoco".
        dataset: a data file, or None to collect the task's default set.
        out: the run folder, or None to name one under ``run.root``.
        data: collection.
        values: implicit Q-learning.
        skills: trajectory VAE.
        labels: pseudo-labels.
        high_level: online learner.
        eval: evaluation.
        run: writing.
    """

    env: str = _field("antmaze", _Rule("text"))
    method: str = _field("qdos", _Rule("text"))
    preset: str = _field("paper", _Rule("text"))
    seed: tuple[int, ...] = _field((0,), _Rule("seeds", low=0, high=2**32 - 1))
    physics: str = _choice("auto", "auto", "mjx", "mujoco")
    dataset: str | None = _field(None, _Rule("path"))
    out: str | None = _field(None, _Rule("path"))
    data: DataConfig = DataConfig()
    values: ValuesConfig = ValuesConfig()
    skills: SkillsConfig = SkillsConfig()
    labels: LabelsConfig = LabelsConfig()
    high_level: HighLevelConfig = HighLevelConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()


# --- From layers to a Config -----------------------------------------------------------------------------------


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
    family = env.split("-")[0]
    if family not in families():
        raise UserError(f"unknown task {env!r}{nearest(family, families())}; the families are {', '.join(families())}")
    preset = preset or default_preset()
    values: dict[str, Any] = {}
    values |= _read_layer(CONFIG_DIR / f"{family}.yaml")
    values |= _read_preset(preset, family)
    values |= {"env": env, "preset": preset}
    values |= _checked_keys(flags or {}, "a flag")
    values |= dict(_parse_set(text) for text in sets)
    return _build(values)


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
    return yaml.safe_dump(_plain(config), sort_keys=False, default_flow_style=None, width=110)


def replace(config: Config, **values: Any) -> Config:
    """A copy with some values changed, checked; keys are dotted ("skills.alpha")."""
    return _build(_flat(_plain(config)) | _checked_keys(values, "replace()"))


def config_hash(config: Config) -> str:
    """16 hex digits over everything that decides the result: not the folders, and not the ``run`` group."""
    plain = _plain(config)
    for key in ("out", "dataset", "run"):
        del plain[key]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


# --- The axis of seeds and hyperparameters ---------------------------------------------------------------------


def hyper_tree(config: Config, member: Mapping[str, Any] | None = None) -> dict[str, float]:
    """The numbers that a scan may vary, by dotted key ("skills.alpha").

    Args:
        config: the run.
        member: one of ``members(config)``; its values are taken where the configuration holds lists.

    Raises:
        UserError: a field holds a list and no member says which value of it is meant.
    """
    chosen = {("skills.alpha" if key == "alpha" else key): value for key, value in (member or {}).items()}
    tree = {}
    for key, field in _leaves(Config):
        if field.metadata["scan"]:
            value = chosen.get(key, _get(config, key))
            if isinstance(value, tuple):
                raise UserError(f"{key} holds {len(value)} values where one is wanted")
            tree[key] = float(value)
    return tree


def members(config: Config) -> list[dict[str, Any]]:
    """The product of the seeds and of every list-valued field: one dict per member of the population.

    Each holds "seed", "alpha", and the dotted key of every other field that varies.
    """
    varied = {"seed": config.seed, "alpha": _as_tuple(config.skills.alpha)}
    for key, field in _leaves(Config):
        value = _get(config, key)
        if field.metadata["scan"] and isinstance(value, tuple) and key != "skills.alpha":
            varied[key] = value
    return [dict(zip(varied, values, strict=True)) for values in itertools.product(*varied.values())]


def population_hyper(config: Config) -> dict[str, np.ndarray]:
    """``hyper_tree`` of every member, stacked: float32[members] by dotted key."""
    trees = [hyper_tree(config, member) for member in members(config)]
    return {key: np.asarray([tree[key] for tree in trees], np.float32) for key in trees[0]}


# --- Reading ---------------------------------------------------------------------------------------------------


def _read_layer(path: Path) -> dict[str, Any]:
    """A YAML file as a flat dict by dotted key, its keys checked."""
    return _checked_keys(_flat(_read_mapping(path)), str(path))


def _read_preset(name: str, family: str) -> dict[str, Any]:
    if name not in presets():
        raise UserError(f"unknown preset {name!r}{nearest(name, presets())}; there are {', '.join(presets())}")
    path = CONFIG_DIR / "presets" / f"{name}.yaml"
    content = _read_mapping(path)
    by_family = content.pop("families", None) or {}
    for key in by_family:
        if key not in families():
            raise UserError(f"{path}: unknown family {key!r}{nearest(key, families())}")
    layer = _checked_keys(_flat(content), str(path))
    return layer | _checked_keys(_flat(by_family.get(family) or {}), str(path))


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
    if key in ("env", "preset"):
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
    known = [key for key, _ in _leaves(Config)]
    for key, value in values.items():
        if key in known:
            continue
        if value is None and any(name.startswith(f"{key}.") for name in known):
            raise UserError(f"{where}: {key} is a group of keys; give one, such as {_first_of_group(key, known)}")
        raise UserError(f"{where}: unknown key {key!r}{nearest(key, known)}")
    return dict(values)


def _first_of_group(group: str, known: list[str]) -> str:
    return next(name for name in known if name.startswith(f"{group}."))


def nearest(word: str, known: Sequence[str]) -> str:
    """', did you mean ...?' with the most similar known word; empty if none is similar."""
    last_words: dict[str, str] = {}
    for name in known:
        last_words.setdefault(name.rpartition(".")[2], name)
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if not near:
        near = [last_words[last] for last in difflib.get_close_matches(word.rpartition(".")[2], last_words, 1, 0.6)]
    return f", did you mean {near[0]!r}?" if near else ""


# --- Checking --------------------------------------------------------------------------------------------------


def _build(values: Mapping[str, Any]) -> Config:
    """The Config of a flat dict by dotted key; what is absent keeps its default."""
    checked = {key: _convert(key, values[key], field) for key, field in _leaves(Config) if key in values}
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
    """Ranges that involve two fields."""
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


def _convert(key: str, value: Any, field: dataclasses.Field[Any]) -> Any:
    """``value`` in the field's type, within its range."""
    rule: _Rule = field.metadata["rule"]
    if rule.kind == "path":
        return _path(key, value)
    if rule.kind == "bool":
        if not isinstance(value, bool):
            raise UserError(f"{key} must be true or false, not {value!r}")
        return value
    if rule.kind == "text":
        return _text(key, value, rule)
    items = _items(value)
    if rule.kind == "widths":
        return tuple(int(_number_in(key, item, rule, whole=True)) for item in _some(key, items))
    if rule.kind == "seeds":
        return _distinct(key, tuple(int(_number_in(key, item, rule, whole=True)) for item in _some(key, items)))
    if isinstance(value, list | tuple) or len(items) > 1:
        if not field.metadata["scan"]:
            raise UserError(f"{key} takes one value, not a list: it shapes the program and cannot be scanned")
        numbers = _distinct(key, tuple(_number_in(key, item, rule) for item in _some(key, items)))
        return numbers if len(numbers) > 1 else numbers[0]
    number = _number_in(key, value, rule, whole=rule.kind == "int")
    return int(number) if rule.kind == "int" else number


def _path(key: str, value: Any) -> str | None:
    if value is None:
        return None
    if not isinstance(value, str | Path) or not str(value):
        raise UserError(f"{key} must be a path, not {value!r}")
    return str(value)


def _text(key: str, value: Any, rule: _Rule) -> str:
    if not isinstance(value, str) or not value:
        raise UserError(f"{key} must be a word, not {value!r}")
    if rule.choices and value not in rule.choices:
        raise UserError(f"{key} must be one of {', '.join(rule.choices)}, not {value!r}{nearest(value, rule.choices)}")
    return value


def _items(value: Any) -> list[Any]:
    if isinstance(value, str):
        return value.strip("()[] ").split(",") if value.strip("()[] ") else []
    return list(value) if isinstance(value, list | tuple) else [value]


def _some(key: str, items: list[Any]) -> list[Any]:
    if not items:
        raise UserError(f"{key} must not be empty")
    return items


def _distinct(key: str, values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) < len(values):
        raise UserError(f"{key} holds the same value twice: {', '.join(map(str, values))}")
    return values


def _number_in(key: str, value: Any, rule: _Rule, whole: bool = False) -> float:
    """``value`` as a number in the rule's range; texts such as "1e5" (a text in YAML) are read too."""
    kind = "a whole number" if whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise UserError(f"{key} must be {kind}, not {value!r}")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise UserError(f"{key} must be {kind}, not {value!r}") from None
    if not math.isfinite(number):
        raise UserError(f"{key} must be finite, not {value}")
    if whole and number != int(number):
        raise UserError(f"{key} must be {kind}, not {value}")
    if number < rule.low or number > rule.high or (rule.above and number == rule.low):
        raise UserError(f"{key} must be {_range(rule)}, not {value}")
    return number


def _range(rule: _Rule) -> str:
    low = f"{'above' if rule.above else 'at least'} {rule.low:.10g}"
    return low if rule.high in (math.inf, 2**31 - 1) else f"{low} and at most {rule.high:.10g}"


# --- Walking ---------------------------------------------------------------------------------------------------


def _leaves(kind: type[Any], prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """(dotted key, field) of every value, in order."""
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default):
            yield from _leaves(type(field.default), f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", field


def _get(config: Config, key: str) -> Any:
    node: Any = config
    for name in key.split("."):
        node = getattr(node, name)
    return node


def _as_tuple(value: Scannable) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _plain(config: Config) -> dict[str, Any]:
    """Nested dicts with lists for tuples: what YAML and JSON can hold."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, tuple) else value

    return {key: plain(value) for key, value in dataclasses.asdict(config).items()}
