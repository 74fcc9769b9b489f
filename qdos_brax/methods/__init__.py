"""The methods, each a recipe of the same parts; ``build`` puts the parts together."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """What a method switches on.

    Attributes:
        summary: one line for a list of methods.
        weighted: segments are weighted by their advantage (else all count the same, and no values are learned).
        information: the mutual-information term is on.
        offline_reward: reward of offline rows, or None for what ``labels.offline_reward`` says.
    """

    summary: str
    weighted: bool
    information: bool
    offline_reward: str | None = None


METHODS = {
    "qdos": Recipe("advantage-weighted, diverse skills; rewards of the data", weighted=True, information=True),
    "supe": Recipe(
        "unweighted skills; the lowest reward for offline rows (Wilcoxson et al. 2025)",
        weighted=False,
        information=False,
        offline_reward="min",
    ),
}
