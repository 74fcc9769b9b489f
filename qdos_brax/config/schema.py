"""The configuration of a run, as frozen dataclasses; the defaults are the paper's values.

Each group's module holds its fields; every field has its meaning, its rule and its marks (``rules.field``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from qdos_brax.config.baseline_groups import DiveOffConfig, FlowConfig, GuideConfig, HilbertConfig, PolicyConfig
from qdos_brax.config.online_groups import EvalConfig, HighLevelConfig, LabelsConfig, TuningConfig
from qdos_brax.config.rules import Rule, choice, count, field
from qdos_brax.config.run_groups import RunConfig, ScanConfig
from qdos_brax.config.skill_groups import DataConfig, ExchangeConfig, ObservationConfig, SkillsConfig, ValuesConfig


@dataclasses.dataclass(frozen=True)
class Config:
    """Hold the whole configuration of one run."""

    env: str = field("antmaze", "task, as listed by `python -m qdos_brax tasks`", Rule("text"))
    method: str = field("qdos", "method, as listed by `python train.py --help`", Rule("text"))
    preset: str = field("paper", "sizes laid over the task's values: paper, cpu or smoke", Rule("text"))
    seed: tuple[int, ...] = field((0,), "seeds; several make a scan", Rule("seeds", low=0, high=2**32 - 1))
    physics: str = choice(
        "auto", "engine: auto (MuJoCo C), mjx, mjx-warp (CUDA) or mujoco", "auto", "mjx", "mjx-warp", "mujoco"
    )
    members_per_program: int = count(
        0,
        "members that one device trains at once; 0 chooses before the start, by speed on a CPU and by memory on an "
        "accelerator; it decides the order of sums, and thereby the last digits",
        low=0,
    )
    dataset: str | None = field(
        None, "data file or name of a public data set; none collects the task's default set", Rule("path")
    )
    skills_file: str | None = field(
        None, "file of skills to begin on, as `python -m qdos_brax export` writes it; none learns them", Rule("path")
    )
    out: str | None = field(None, "run folder; none names one under run.root", Rule("path"))
    data: DataConfig = DataConfig()
    observation: ObservationConfig = ObservationConfig()
    exchange: ExchangeConfig = ExchangeConfig()
    values: ValuesConfig = ValuesConfig()
    skills: SkillsConfig = SkillsConfig()
    labels: LabelsConfig = LabelsConfig()
    high_level: HighLevelConfig = HighLevelConfig()
    tuning: TuningConfig = TuningConfig()
    policy: PolicyConfig = PolicyConfig()
    guide: GuideConfig = GuideConfig()
    hilbert: HilbertConfig = HilbertConfig()
    diveoff: DiveOffConfig = DiveOffConfig()
    flow: FlowConfig = FlowConfig()
    eval: EvalConfig = EvalConfig()
    scan: ScanConfig = ScanConfig()
    run: RunConfig = RunConfig()


def leaves(kind: type[Any], prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Yield (dotted key, field) of every value, in order."""
    for leaf in dataclasses.fields(kind):
        if dataclasses.is_dataclass(leaf.default):
            yield from leaves(type(leaf.default), f"{prefix}{leaf.name}.")
        else:
            yield f"{prefix}{leaf.name}", leaf


def groups() -> dict[str, str]:
    """Return what each group of keys is for, by its name."""
    kinds = {leaf.name: leaf.default for leaf in dataclasses.fields(Config) if dataclasses.is_dataclass(leaf.default)}
    return {name: type(default).__doc__ or "" for name, default in kinds.items()}


def labelled() -> dict[str, str]:
    """Return the dotted keys that have a short name, by that name: {"alpha": "skills.alpha"}."""
    return {leaf.metadata["label"]: key for key, leaf in leaves(Config) if leaf.metadata["label"]}


def pretrain_keys() -> list[str]:
    """Return the dotted keys that ``--pretrain-steps`` sets."""
    return [key for key, leaf in leaves(Config) if leaf.metadata["pretrain"]]


def skill_keys(low_level: str) -> list[str]:
    """Return the dotted keys that say what skills are, for a kind of low-level policy (``methods.Method``)."""
    groups = (
        "observation",
        "skills",
        *{"direction": ("hilbert",), "transition": ("diveoff",), "noise": ("flow",)}.get(low_level, ()),
    )
    return [key for key, _ in leaves(Config) if key.partition(".")[0] in groups]


def get_field(key: str) -> dataclasses.Field[Any]:
    """Return the field under a dotted key."""
    return dict(leaves(Config))[key]


def get(config: Config, key: str) -> Any:
    """Return the value under a dotted key."""
    node: Any = config
    for name in key.split("."):
        node = getattr(node, name)
    return node


def plain(config: Config) -> dict[str, Any]:
    """Return nested dicts with lists for tuples, as YAML and JSON can hold them."""

    def listed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: listed(item) for key, item in value.items()}
        return [listed(item) for item in value] if isinstance(value, tuple) else value

    return {key: listed(value) for key, value in dataclasses.asdict(config).items()}


def format_value(value: Any) -> str:
    """Return a value of a configuration in few characters."""
    return f"{value:g}" if isinstance(value, float) else str(value)
