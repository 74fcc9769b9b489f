"""The methods, each a recipe of the same parts; ``build`` puts the parts together. To add a method is to add a recipe.

A recipe holds the numbers that its authors published, by dotted configuration key; they are laid over the task's YAML
and under the preset, the flags and ``--set`` (``qdos_brax.config``). Published numbers that agree with the defaults
are not repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Recipe:
    """What a method is made of.

    Attributes:
        summary: one line for a list of methods.
        source: of low-level behaviour: "trajectory" (a VAE of segments), "transition" (a VAE of single transitions),
            "direction" (in a Hilbert representation) or "action" (none: the policy acts itself).
        weighted: segments are weighted by their advantage (else all count the same, and no values are learned).
        information: the mutual-information term is on.
        guide: what acts for the first steps of an episode online: "diffusion", or None.
        policy: the flat policy that is learned from the data alone, "bc" or "iql", and then nothing is learned online.
        settings: published values by dotted key.
        by_family: the same, for single task families.
    """

    summary: str
    source: str = "trajectory"
    weighted: bool = False
    information: bool = False
    guide: str | None = None
    policy: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    by_family: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


_MANIPULATION = ("cube", "kitchen", "scene")

# What an offline row earns without its reward: the least there is on the mazes, what a model of the online rewards
# predicts in manipulation (Wilcoxson et al. 2025, appendix and published commands; the ball's tasks as the mazes).
_UNLABELLED = {"labels.offline_reward": "min"}
_UNLABELLED_BY_FAMILY = {family: {"labels.offline_reward": "pred"} for family in _MANIPULATION}

# The dimension that HILP was published with on mazes and kitchen.
_DIRECTIONS = {"skills.latent_dim": 32}

# Nothing of the data but the skills.
_ONLINE_ONLY = {"high_level.offline_fraction": 0.0, "labels.bonus_rows": "online"}

# One action per decision, one step per segment.
_FLAT = {"skills.horizon": 1}

# Widths of the published offline policies: 2 x 256 on D4RL's tasks (Kostrikov et al. 2022), 3 x 512 on OGBench's
# (Park et al. 2025).
_OFFLINE_WIDTHS = {
    family: {"policy.hidden": [512, 512, 512], "values.hidden": [512, 512, 512]}
    for family in ("antsoccer", "cube", "humanoidmaze", "scene")
}

METHODS = {
    "qdos": Recipe("advantage-weighted, diverse skills; rewards of the data", weighted=True, information=True),
    # Wilcoxson et al. 2025, "Leveraging Skills from Unlabeled Prior Data for Efficient Online Exploration". Their code
    # has skills.horizon=4, the comparison in the QDOS paper 20.
    "supe": Recipe(
        "unweighted skills; the data without its rewards, novelty made up for (Wilcoxson et al. 2025)",
        settings=_UNLABELLED,
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    # Ajay et al. 2021 (OPAL), Pertsch et al. 2020 (SPiRL: with high_level.regulariser=prior); online as in
    # Wilcoxson et al. 2025, "online w/ trajectory skills".
    "trajectory-skills": Recipe(
        "SUPE's skills, learned with online alone (OPAL, Ajay et al. 2021; SPiRL, Pertsch et al. 2020)",
        settings=_ONLINE_ONLY,
        # SPiRL's target divergence: 1 in the maze, 5 in the kitchen (appendix).
        by_family={family: {"high_level.target_divergence": 5.0} for family in _MANIPULATION},
    ),
    # Li et al. 2023, "Accelerating exploration with unlabeled prior data"; the coefficient as SUPE's authors run it.
    "explore": Recipe(
        "no skills; the data without its rewards, novelty made up for (ExPLORe, Li et al. 2023)",
        source="action",
        settings=_FLAT | _UNLABELLED | {"labels.rnd_coefficient": 2.0},
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    # Ball et al. 2023, "Efficient online reinforcement learning with offline data".
    "rlpd": Recipe(
        "no skills; SAC with an ensemble, half of each batch from the data (RLPD, Ball et al. 2023)",
        source="action",
        settings=_FLAT | {"labels.rnd_coefficient": 0.0},
    ),
    # Park et al. 2024, "Foundation policies with Hilbert representations"; online as in Wilcoxson et al. 2025.
    "hilp": Recipe(
        "directions in a Hilbert representation as skills, online as SUPE (HILP, Park et al. 2024)",
        source="direction",
        settings=_UNLABELLED | _DIRECTIONS,
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    "hilp-online": Recipe(
        "HILP's skills, learned with online alone",
        source="direction",
        settings=_ONLINE_ONLY | _DIRECTIONS,
    ),
    # Uchendu et al. 2022, "Jump-start reinforcement learning", with the diffusion policy, the schedule and the numbers
    # of Wilcoxson et al. 2025 (published commands): online ExPLORe without the data.
    "diffusion-jsrl": Recipe(
        "no skills; a diffusion clone of the data acts for an episode's first steps (JSRL, Uchendu et al. 2022)",
        source="action",
        guide="diffusion",
        settings=_FLAT | _ONLINE_ONLY | {"labels.rnd_coefficient": 2.0, "high_level.init_temperature": 1.0},
        by_family={family: {"guide.ratio": 0.75} for family in _MANIPULATION},
    ),
    # Kostrikov et al. 2022, "Offline reinforcement learning with implicit Q-learning": expectile 0.9 and beta 10 in
    # mazes, 0.7 and 0.5 in the kitchen; Park et al. 2025 (OGBench): 0.9 and 10.
    "iql": Recipe(
        "no skills, offline alone: implicit Q-learning (Kostrikov et al. 2022)",
        source="action",
        policy="iql",
        settings=_FLAT | {"values.estimator": "iql", "values.expectile": 0.9, "policy.inverse_temperature": 10.0},
        by_family=_OFFLINE_WIDTHS | {"kitchen": {"values.expectile": 0.7, "policy.inverse_temperature": 0.5}},
    ),
    "bc": Recipe(
        "no skills, offline alone: behaviour cloning",
        source="action",
        policy="bc",
        settings=_FLAT,
        by_family=_OFFLINE_WIDTHS,
    ),
    # Osa and Harada 2024, "Discovering multiple solutions from a single task in offline reinforcement learning": z of
    # dimension 2 from [-2, 2], which the high level draws on as the paper does on its own skills.
    "diveoff": Recipe(
        "latents of single transitions, good and diverse, as skills (DiveOff, Osa and Harada 2024)",
        source="transition",
        settings={"skills.latent_dim": 2, "skills.latent_box": 2.0, "high_level.latent_map": "box"},
    ),
}


def settings(method: str, family: str) -> dict[str, Any]:
    """A recipe's published values for a task family, by dotted key."""
    recipe = METHODS[method]
    return {**recipe.settings, **recipe.by_family.get(family, {})}
