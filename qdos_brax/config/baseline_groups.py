"""Configuration of the parts that only the other methods use: flat policies, the guide, flows, HILP and DiveOff."""

from __future__ import annotations

import dataclasses

from qdos_brax.config.rules import choice, count, number, rate, widths
from qdos_brax.config.skill_groups import Scannable


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """Configure the flat policies that are learned from the data alone (BC, IQL)."""

    hidden: tuple[int, ...] = widths((256, 256), "hidden layers of the policy")
    batch_size: int = count(256, "transitions per gradient step")
    learning_rate: Scannable = rate(3e-4)
    inverse_temperature: Scannable = number(10.0, "(IQL) beta in the weights exp(beta A)")
    updates: int = count(1_000_000, "gradient steps", pretrain=True)
    every_updates: int = count(100_000, "gradient steps between two evaluations")


@dataclasses.dataclass(frozen=True)
class GuideConfig:
    """Configure the diffusion policy that clones the data's behaviour and guides the first steps of an episode."""

    hidden: int = count(256, "width of the denoiser's residual blocks")
    steps: int = count(5, "denoising steps")
    batch_size: int = count(256, "transitions per gradient step")
    learning_rate: Scannable = rate(3e-4)
    average_rate: Scannable = number(
        0.001, "rate of the moving average of the parameters, which acts", high=1.0, above=True
    )
    updates: int = count(3_000_000, "gradient steps", pretrain=True)
    ratio: float = number(0.9, "share of the episodes that begin with the guide", high=1.0, scan=False)
    persistence: float = number(0.99, "probability that the guide continues after a step", high=0.9999, scan=False)


@dataclasses.dataclass(frozen=True)
class HilbertConfig:
    """Configure the Hilbert representation and the policy that follows its directions (HILP, Park et al. 2024)."""

    hidden: tuple[int, ...] = widths((512, 512, 512), "hidden layers of all networks")
    batch_size: int = count(1024, "transitions per gradient step")
    learning_rate: Scannable = rate(3e-4, "Adam learning rate of all networks")
    expectile: Scannable = number(0.95, "expectile of the distance's regression", high=1.0, above=True)
    skill_expectile: Scannable = number(0.9, "expectile of the directions' values", high=1.0, above=True)
    discount: Scannable = number(0.99, "discount per environment step", above=True, high=0.9999)
    target_rate: Scannable = number(0.005, "Polyak rate of the targets", high=1.0, above=True)
    inverse_temperature: Scannable = number(10.0, "beta in the directional policy's weights exp(beta A)")
    random_goals: float = number(
        0.375, "share of goals that are any state; the others lie ahead in the same episode", high=1.0, scan=False
    )
    updates: int = count(1_000_000, "gradient steps", pretrain=True)


@dataclasses.dataclass(frozen=True)
class DiveOffConfig:
    """Configure quality and diversity on single transitions (DiveOff, Osa and Harada 2024)."""

    hidden: tuple[int, ...] = widths((256, 256), "hidden layers of all networks")
    batch_size: int = count(256, "transitions per gradient step")
    learning_rate: Scannable = rate(3e-4, "Adam learning rate of actor and critic")
    autoencoder_rate: Scannable = number(
        0.3, "learning rate of autoencoder and information, as a share of learning_rate"
    )
    discount: Scannable = number(0.99, "discount per environment step", high=1.0)
    target_rate: Scannable = number(0.005, "Polyak rate of the targets", high=1.0, above=True)
    scale: Scannable = number(3.0, "scale of the advantage in the weights exp(scale A)")
    # The authors' code has 50, with which the posterior collapses here, see ``qdos_brax.offline.diveoff``.
    kl_weight: Scannable = number(
        0.1, "weight of the posterior's divergence, against a mean squared error of reconstruction"
    )
    information: Scannable = number(2.0, "weight of the information term")
    autoencoder_updates: int = count(
        10_000, "first gradient steps, without weights and without the information term", low=0
    )
    updates: int = count(
        1_000_000, "gradient steps of actor and autoencoder; critics make two each time", pretrain=True
    )


@dataclasses.dataclass(frozen=True)
class FlowConfig:
    """Configure flow policies and what is learned offline before it goes on online (QC, FQL, WSRL, DSRL)."""

    hidden: tuple[int, ...] = widths((512, 512, 512, 512), "hidden layers of the velocity field and one-step policy")
    steps: int = count(10, "steps of Euler's method from noise to actions")
    candidates: int = count(32, "(qc) proposals among which the critics choose")
    target: str = choice("mean", "what the critics' heads make of a value: mean or min", "mean", "min")
    distillation: Scannable = number(10.0, "(fql) weight alpha of the distance between the one-step and flow policies")
    batch_size: int = count(256, "transitions per gradient step offline")
    learning_rate: Scannable = rate(3e-4, "(dsrl) Adam learning rate of the cloned flow")
    updates: int = count(1_000_000, "gradient steps offline", pretrain=True)
    conservative_weight: Scannable = number(
        5.0, "(high_level.initial cal-ql) weight of what holds Q down on decisions that the data lacks"
    )
    conservative_actions: int = count(
        10, "(high_level.initial cal-ql) such decisions per row: uniform ones, and of the actor's, there and one later"
    )
