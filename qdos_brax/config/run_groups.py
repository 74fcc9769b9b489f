"""Configuration of how a run proceeds: scans over several values, and what is written where."""

from __future__ import annotations

import dataclasses

from qdos_brax.config.rules import Rule, choice, count, field, flag, number


@dataclasses.dataclass(frozen=True)
class ScanConfig:
    """Configure how the lists among the other values become members; the lists hold all values, drawn ones too."""

    combine: str = choice(
        "product", "product (every value with every other) or zip (first with first, and so on)", "product", "zip"
    )
    samples: int = count(0, "settings drawn at random, each trained with every seed; 0 draws none", low=0)
    draw_seed: int = count(0, "seed of the draw; adding a key leaves the values of the others as they are", low=0)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Configure where and how often a run writes, which never changes what it computes."""

    checkpoint_seconds: float = number(
        30.0, "seconds of work between two checkpoints; 0 saves after every chunk", scan=False
    )
    root: str = field("runs", "folder of the run folders that are not named with --out", Rule("text"))
    tensorboard: bool = flag(True, "whether TensorBoard event files are written into the run folder")
    wandb: bool = flag(False, "whether the same numbers go to Weights & Biases")
