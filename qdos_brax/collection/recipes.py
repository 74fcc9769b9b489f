"""Recipes for collecting data: OGBench's for mazes and soccer, and mixtures of good and degraded behaviour.

Every episode follows one behaviour: ``expert`` goes to goals (soccer: brings the ball there), ``noisy`` does so under
heavy action noise, ``wander`` walks in random directions, ``fail`` turns round half-way and goes back. What they are
where nothing walks, the task's demonstrator says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from qdos_brax.collection.profiles import CollectionProfile
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

BEHAVIOURS = {"expert": QUALITY["navigate"], **{name: code for name, code in QUALITY.items() if name != "navigate"}}
"""Code of each behaviour in ``infos/quality``."""

NAMES = ("navigate", "stitch", "explore", "mixed")

NOISE = 0.2  # standard deviation of the action noise, as in OGBench; the experts succeed under it
EXPLORE_STEPS = 500  # control steps of an episode of explore


class HeavyNoise(Protocol):
    """Give the action noise of noisy episodes: a body's profile, or who makes the collectors of a task."""

    @property
    def heavy_noise(self) -> float:
        """Return its standard deviation."""


@dataclass(frozen=True)
class CollectionRecipe:
    """Describe a kind of data.

    Attributes:
        name: "navigate", "stitch", "explore" or "mixed".
        mix: share of the episodes of each behaviour; sums to 1.
        noise: standard deviation of the Gaussian action noise, except in noisy episodes.
        heavy_noise: standard deviation in noisy episodes.
        episode_steps: length of an episode in control steps; None takes the task's cap.
        goal_cells: a goal lies this many cells away and is kept to the end; None draws goals anywhere, a new one on
            arrival.
        heading_seconds: time between two draws of a wandering body's direction; None draws at random times.
    """

    name: str
    mix: Mapping[str, float]
    noise: float
    heavy_noise: float
    episode_steps: int | None = None
    goal_cells: int | None = None
    heading_seconds: float | None = None


def mixed(mix: Mapping[str, float], body: HeavyNoise, noise: float = NOISE) -> CollectionRecipe:
    """Return the recipe for a mixture of behaviours, with goals anywhere.

    Raises:
        UserError: shares are negative or do not sum to 1, a behaviour is unknown, or the noise is negative.
    """
    for name, share in mix.items():
        if name not in BEHAVIOURS:
            raise UserError(f"unknown behaviour {name!r} in the mix; choose from {', '.join(BEHAVIOURS)}")
        if not 0.0 <= share <= 1.0:
            raise UserError(f"the share of {name} must lie in [0, 1], got {share}")
    if abs(sum(mix.values()) - 1.0) > 1e-6:
        raise UserError(f"the shares of a mix must sum to 1, these sum to {sum(mix.values()):g}: {mix_text(mix)}")
    if not noise >= 0.0:
        raise UserError(f"the action noise must be 0 or more, got {noise}")
    return CollectionRecipe("mixed", mix, noise, body.heavy_noise)


def degraded(share: float, body: HeavyNoise, noise: float = NOISE) -> CollectionRecipe:
    """Return the default sets' recipe: ``share`` of the episodes is degraded, each bad behaviour in equal parts.

    Raises:
        UserError: the share is not in [0, 1], or the noise is negative.
    """
    if not 0.0 <= share <= 1.0:
        raise UserError(f"the degraded share must lie in [0, 1], got {share}")
    others = [name for name in BEHAVIOURS if name != "expert"]
    return mixed({"expert": 1.0 - share, **dict.fromkeys(others, share / len(others))}, body, noise)


def named(name: str, body: CollectionProfile, noise: float | None = None) -> CollectionRecipe:
    """Return OGBench's recipe "navigate", "stitch" or "explore".

    Args:
        name: which one.
        body: the body's profile.
        noise: standard deviation of the action noise; None takes OGBench's, for ``explore`` the body's heavy noise.

    Raises:
        UserError: the noise is negative.
    """
    to_goals = mixed({"expert": 1.0}, body, NOISE if noise is None else noise)
    wandering = mixed({"wander": 1.0}, body, body.heavy_noise if noise is None else noise)
    recipes = {
        "navigate": to_goals,
        "stitch": replace(to_goals, episode_steps=body.stitch_steps, goal_cells=4),
        "explore": replace(wandering, episode_steps=EXPLORE_STEPS, heading_seconds=1.0),
    }
    return replace(recipes[name], name=name)


def parse_mix(text: str) -> dict[str, float]:
    """Parse "expert=0.3,noisy=0.7" into a mapping.

    Raises:
        UserError: the text has another form, or names a behaviour twice.
    """
    mix: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            value = float(share)
        except ValueError:
            raise UserError(
                f"--mix {text}: {part!r} is not of the form NAME=SHARE; write, for example, expert=0.5,noisy=0.5"
            ) from None
        if name.strip() in mix:
            raise UserError(f"--mix {text}: {name.strip()} appears twice; give each behaviour one share")
        mix[name.strip()] = value
    return mix


def episode_kinds(mix: Mapping[str, float], episodes: int, seed: int) -> np.ndarray:
    """Return int8[episodes], the code of each episode's behaviour, in random order.

    The number of degraded episodes is the nearest integer to their share; largest remainders divide it among the
    behaviours.
    """
    shares = {BEHAVIOURS[name]: share for name, share in mix.items() if name != "expert" and share > 0.0}
    total = sum(shares.values())
    count = round(episodes * round(total, 9))
    exact = np.round([count * share / total for share in shares.values()], 6)
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact, kind="stable")[: count - counts.sum()]] += 1
    # One of each degraded behaviour in turn, then the expert's: the order that the permutation starts from.
    turns = sorted((turn, code) for code, n in zip(shares, counts, strict=True) for turn in range(n))
    kinds = [code for _, code in turns] + [BEHAVIOURS["expert"]] * (episodes - count)
    return np.random.default_rng(seed).permutation(np.asarray(kinds, np.int8))


def mix_text(mix: Mapping[str, float]) -> str:
    """Format a mix as text that ``parse_mix`` reads."""
    return ",".join(f"{name}={share}" for name, share in mix.items())
