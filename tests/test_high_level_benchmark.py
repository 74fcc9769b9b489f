"""What ``benchmarks/high_level.py`` trains anew."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from benchmarks import high_level
from qdos_brax.errors import UserError


def names(*every: str) -> list[str]:
    """Return the names of those phases that are trained anew."""
    return [phase.name for phase in high_level.after_skills([SimpleNamespace(name=name) for name in every])]


def test_all_that_comes_after_the_skills_is_trained() -> None:
    """A warm start stands between labels and the online phase; left out, its setting would change nothing."""
    assert names("values", "skills", "label", "agent", "online") == ["label", "agent", "online"]


def test_a_method_without_skills_and_one_with_a_guide_are_trained_too() -> None:
    assert names("label", "online") == ["label", "online"]
    assert names("guide", "label", "online") == ["label", "online"]


@pytest.mark.parametrize(
    "key", ["observation.view", "skills.horizon", "values.estimator", "exchange.share", "guide.hidden"]
)
def test_a_setting_of_what_stays_is_refused(key: str) -> None:
    with pytest.raises(UserError, match=f"{key} would change nothing"):
        high_level.check_settings("qdos", ["high_level.utd=4", f"{key}=1"])


def test_what_the_high_level_reads_may_change() -> None:
    """A flow is what a noise policy's skills are, and how long a warm start of the others takes."""
    high_level.check_settings("qdos", ["skills.latent_box=1", "labels.offline_reward=data", "flow.updates=9"])
    with pytest.raises(UserError, match=r"flow\.updates"):
        high_level.check_settings("dsrl", ["flow.updates=9"])


@pytest.mark.parametrize("after", [[0, 0, 1, 1], [2, 3], [0]])
def test_members_stay_on_their_own_skills(after: list[int]) -> None:
    """A list of values makes twice as many, a seed others, and either would be paired with another one's skills."""
    before = [{"seed": 0}, {"seed": 1}]
    high_level.check_members(before, before)
    with pytest.raises(UserError, match="one value per key, and no seed"):
        high_level.check_members(before, [{"seed": seed} for seed in after])
