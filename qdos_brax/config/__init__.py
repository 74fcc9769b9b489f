"""The configuration: frozen dataclasses, named layers over their defaults, and one clear line for every mistake.

Layers, each laid over the one before: the defaults of the fields (the paper's values), ``configs/<family>.yaml``, the
method's published values (``config/methods.py``), ``configs/presets/<preset>.yaml`` with its own sections
(``low_level:``, by the method's low-level policy, over it ``methods:``, and over both ``families:``, which may hold
``variants:``, such as one maze, and over them ``low_level:`` and ``methods:`` again), the flags of the command line,
``--set key=value``. ``python -m qdos_brax config KEY`` shows which layer set a value.

The mark ``metadata["scan"]`` of a field separates two kinds. A scannable field is a number that a learner takes as an
argument of its jitted program: it may hold a list, and every member of the scan gets its own value without a new
compilation (``hyper_tree``, ``members``). Every other field shapes the program: several values of it make several
programs, each with a Config of its own (``load_programs``).
"""

from __future__ import annotations

from qdos_brax.config.baseline_groups import DiveOffConfig, FlowConfig, GuideConfig, HilbertConfig, PolicyConfig
from qdos_brax.config.layers import Layer, default_preset, families, family_layers, presets, run_layers
from qdos_brax.config.load import (
    check_method,
    config_hash,
    from_layers,
    from_plain,
    from_yaml,
    load_config,
    load_programs,
    programs_of,
    replace,
    to_yaml,
)
from qdos_brax.config.online_groups import EvalConfig, HighLevelConfig, LabelsConfig, TuningConfig
from qdos_brax.config.rules import nearest
from qdos_brax.config.run_groups import RunConfig, ScanConfig
from qdos_brax.config.scan import asks_auto, hyper_tree, is_auto, members, population_hyper, values_by_key
from qdos_brax.config.schema import Config, plain
from qdos_brax.config.skill_groups import DataConfig, SkillsConfig, ValuesConfig

__all__ = [
    "Config",
    "DataConfig",
    "DiveOffConfig",
    "EvalConfig",
    "FlowConfig",
    "GuideConfig",
    "HighLevelConfig",
    "HilbertConfig",
    "LabelsConfig",
    "Layer",
    "PolicyConfig",
    "RunConfig",
    "ScanConfig",
    "SkillsConfig",
    "TuningConfig",
    "ValuesConfig",
    "asks_auto",
    "check_method",
    "config_hash",
    "default_preset",
    "families",
    "family_layers",
    "from_layers",
    "from_plain",
    "from_yaml",
    "hyper_tree",
    "is_auto",
    "load_config",
    "load_programs",
    "members",
    "nearest",
    "plain",
    "population_hyper",
    "presets",
    "programs_of",
    "replace",
    "run_layers",
    "to_yaml",
    "values_by_key",
]
