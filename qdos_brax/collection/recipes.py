"""What is collected: OGBench's recipes for mazes and soccer, and mixtures of good and degraded behaviour.

Behaviours, one per episode: ``expert`` goes to goals (soccer: brings the ball there), ``noisy`` does under heavy action
noise, ``wander`` walks in random directions, ``fail`` turns round half-way and undoes what it did.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from qdos_brax.collection.bodies import Conduct
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

BEHAVIOURS = {"expert": QUALITY["navigate"], **{name: code for name, code in QUALITY.items() if name != "navigate"}}
"""Code of each behaviour in ``infos/quality``."""

NAMES = ("navigate", "stitch", "explore", "mixed")

NOISE = 0.2  # standard deviation on actions, as OGBench's: the experts do their work under it
EXPLORE_STEPS = 500  # of an episode of explore


@dataclass(frozen=True)
class Recipe:
    """A kind of data.

    Attributes:
        name: "navigate", "stitch", "explore" or "mixed".
        mix: share of the episodes of each behaviour; sums to 1.
        noise: standard deviation of the Gaussian noise on actions, but for noisy episodes.
        heavy_noise: that of noisy episodes.
        episode_steps: length of an episode; None takes the task's cap.
        goal_cells: goals are this many cells away and kept to the end; None draws them anywhere, again on arrival.
        heading_seconds: time between two draws of a wanderer's direction; None draws at random times.
    """

    name: str
    mix: Mapping[str, float]
    noise: float
    heavy_noise: float
    episode_steps: int | None = None
    goal_cells: int | None = None
    heading_seconds: float | None = None


def mixed(mix: Mapping[str, float], body: Conduct, noise: float = NOISE) -> Recipe:
    """A mixture of behaviours that go to goals anywhere.

    Raises:
        UserError: shares are negative or do not sum to 1, a behaviour is unknown, or the noise is negative.
    """
    for name, share in mix.items():
        if name not in BEHAVIOURS:
            raise UserError(f"there is no behaviour {name!r}; a mix names {', '.join(BEHAVIOURS)}")
        if not 0.0 <= share <= 1.0:
            raise UserError(f"the share of {name} must lie in [0, 1], got {share}")
    if abs(sum(mix.values()) - 1.0) > 1e-6:
        raise UserError(f"the shares of a mix must sum to 1, these sum to {sum(mix.values()):g}: {mix_text(mix)}")
    if not noise >= 0.0:
        raise UserError(f"the action noise must be 0 or more, got {noise}")
    return Recipe("mixed", mix, noise, body.heavy_noise)


def degraded(share: float, body: Conduct, noise: float = NOISE) -> Recipe:
    """The default sets: a share of the episodes is degraded, each bad behaviour in equal parts; errors as above."""
    if not 0.0 <= share <= 1.0:
        raise UserError(f"the degraded share must lie in [0, 1], got {share}")
    others = [name for name in BEHAVIOURS if name != "expert"]
    return mixed({"expert": 1.0 - share, **dict.fromkeys(others, share / len(others))}, body, noise)


def named(name: str, body: Conduct, noise: float | None = None) -> Recipe:
    """OGBench's "navigate", "stitch" or "explore"; None takes its noise, of ``explore`` the body's heavy one.

    Errors as ``mixed``.
    """
    to_goals = mixed({"expert": 1.0}, body, NOISE if noise is None else noise)
    about = mixed({"wander": 1.0}, body, body.heavy_noise if noise is None else noise)
    recipes = {
        "navigate": to_goals,
        "stitch": replace(to_goals, episode_steps=body.stitch_steps, goal_cells=4),
        "explore": replace(about, episode_steps=EXPLORE_STEPS, heading_seconds=1.0),
    }
    return replace(recipes[name], name=name)


def parse_mix(text: str) -> dict[str, float]:
    """ "expert=0.3,noisy=0.7" as a mapping.

    Raises:
        UserError: it does not read so.
    """
    mix: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            value = float(share)
        except ValueError:
            raise UserError(f"--mix {text}: write it as expert=0.5,noisy=0.5; {part!r} is no share") from None
        if name.strip() in mix:
            raise UserError(f"--mix {text}: {name.strip()} is there twice")
        mix[name.strip()] = value
    return mix


def episode_kinds(mix: Mapping[str, float], episodes: int, seed: int) -> np.ndarray:
    """int8[episodes], a behaviour's code per episode in random order.

    The number of episodes that are not the expert's is the nearest whole one; the largest remainders share it out.
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
    """What ``parse_mix`` reads."""
    return ",".join(f"{name}={share}" for name, share in mix.items())
