"""The axis of seeds and hyperparameters: what a scan varies without a new compilation."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from qdos_brax.config.schema import Config, Scannable, get, leaves
from qdos_brax.errors import UserError


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
    for key, field in leaves(Config):
        if field.metadata["scan"]:
            value = chosen.get(key, get(config, key))
            if isinstance(value, tuple):
                raise UserError(f"{key} holds {len(value)} values where one is wanted")
            tree[key] = float(value)
    return tree


def members(config: Config) -> list[dict[str, Any]]:
    """The product of the seeds and of every list-valued field: one dict per member of the population.

    Each holds "seed", "alpha", and the dotted key of every other field that varies.
    """
    varied = {"seed": config.seed, "alpha": _as_tuple(config.skills.alpha)}
    for key, field in leaves(Config):
        value = get(config, key)
        if field.metadata["scan"] and isinstance(value, tuple) and key != "skills.alpha":
            varied[key] = value
    return [dict(zip(varied, values, strict=True)) for values in itertools.product(*varied.values())]


def population_hyper(config: Config) -> dict[str, np.ndarray]:
    """``hyper_tree`` of every member, stacked: float32[members] by dotted key."""
    trees = [hyper_tree(config, member) for member in members(config)]
    return {key: np.asarray([tree[key] for tree in trees], np.float32) for key in trees[0]}


def _as_tuple(value: Scannable) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)
