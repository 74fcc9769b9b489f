"""The configuration: frozen dataclasses, YAML layers over them, and one clear line for every wrong key or value.

Layers, each laid over the one before: the defaults below (the paper's values), ``configs/<family>.yaml``, the method's
recipe (``qdos_brax.methods``), ``configs/presets/<preset>.yaml`` (with its own sections: ``sources:``, by the recipe's
source of behaviour, and over it ``families:``, which may hold ``sources:`` again), the command line's flags,
``--set key=value``.

Two kinds of field are told apart by ``metadata["scan"]``. A scannable field is a number that a learner takes as an
argument of its jitted program: it may hold a list, and every member of the scan gets its own value without a new
compilation (``hyper_tree``, ``members``). Every other field shapes the program: several values of it make several
programs, each a Config of its own (``load_programs``).
"""

from __future__ import annotations

from qdos_brax.config.layers import (
    config_hash,
    default_preset,
    families,
    from_yaml,
    load_config,
    load_programs,
    presets,
    replace,
    to_yaml,
)
from qdos_brax.config.rules import nearest
from qdos_brax.config.scan import hyper_tree, members, population_hyper
from qdos_brax.config.schema import (
    Config,
    DataConfig,
    DiveOffConfig,
    EvalConfig,
    GuideConfig,
    HighLevelConfig,
    HilbertConfig,
    LabelsConfig,
    PolicyConfig,
    RunConfig,
    ScanConfig,
    SkillsConfig,
    ValuesConfig,
)

__all__ = [
    "Config",
    "DataConfig",
    "DiveOffConfig",
    "EvalConfig",
    "GuideConfig",
    "HighLevelConfig",
    "HilbertConfig",
    "LabelsConfig",
    "PolicyConfig",
    "RunConfig",
    "ScanConfig",
    "SkillsConfig",
    "ValuesConfig",
    "config_hash",
    "default_preset",
    "families",
    "from_yaml",
    "hyper_tree",
    "load_config",
    "load_programs",
    "members",
    "nearest",
    "population_hyper",
    "presets",
    "replace",
    "to_yaml",
]
