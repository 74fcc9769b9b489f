"""Recipes: shares exact to the episode, and mixes that make no sense."""

from typing import Any

import numpy as np
import pytest

from qdos_brax.collection import recipes
from qdos_brax.collection.profiles import ANT
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_share_of_degraded_episodes_is_as_stated(share: float) -> None:
    kinds = recipes.episode_kinds(recipes.degraded(share, ANT).mix, 100, seed=0)
    assert (kinds != QUALITY["navigate"]).sum() == round(100 * share)
    counts = [int((kinds == code).sum()) for code in QUALITY.values() if code != QUALITY["navigate"]]
    assert max(counts) - min(counts) <= 1


def test_a_mix_is_exact_to_the_episode_and_comes_from_the_seed() -> None:
    mix = recipes.parse_mix("expert=0.3,noisy=0.3,wander=0.2,fail=0.2")
    kinds = recipes.episode_kinds(mix, 50, seed=3)
    assert np.bincount(kinds).tolist() == [15, 15, 10, 10]
    np.testing.assert_array_equal(kinds, recipes.episode_kinds(mix, 50, seed=3))
    assert not np.array_equal(kinds, recipes.episode_kinds(mix, 50, seed=4))
    # 7 episodes: 2.1, 2.1, 1.4, 1.4; five are bad, of which 2.14, 1.43, 1.43: the first of the largest remainders gains
    assert np.bincount(recipes.episode_kinds(mix, 7, seed=0)).tolist() == [2, 2, 2, 1]
    assert set(recipes.episode_kinds({"wander": 1.0}, 9, seed=0).tolist()) == {QUALITY["wander"]}
    assert recipes.parse_mix(recipes.mix_text(mix)) == mix


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("expert=0.5,noisy=0.4", "sum to 0.9"),
        ("expert=1.5,noisy=-0.5", r"must lie in \[0, 1\]"),
        ("expert=0.5,noisey=0.5", "unknown behaviour 'noisey'"),
        ("expert=0.5,expert=0.5", "expert appears twice"),
        ("expert", "'expert' is not of the form NAME=SHARE"),
        ("expert=nan", "must lie in"),
    ],
)
def test_a_mix_that_makes_no_sense_is_refused(text: str, line: str) -> None:
    with pytest.raises(UserError, match=line):
        recipes.mixed(recipes.parse_mix(text), ANT)


@pytest.mark.parametrize(
    "make", [lambda: recipes.degraded(1.5, ANT), lambda: recipes.named("explore", ANT, noise=-1.0)]
)
def test_a_recipe_out_of_range_is_refused(make: Any) -> None:
    with pytest.raises(UserError):
        make()
