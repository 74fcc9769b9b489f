"""How often data reach their goals, counted by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import goal_visits
import numpy as np
import pytest

from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError


def test_a_visit_begins_where_a_goal_is_reached_or_an_episode_starts_in_it() -> None:
    at_goal = np.array([1, 1, 0, 1, 1, 0, 1], bool)
    ends = np.array([0, 0, 0, 1, 0, 0, 1], bool)
    np.testing.assert_array_equal(goal_visits.visits(at_goal, ends), [1, 0, 0, 1, 1, 0, 1])


def test_parts_are_counted_one_by_one_and_together() -> None:
    """Two episodes: the kettle in both, by good behaviour in the first, the light in the second."""
    kettle, light = np.array([0, 1, 1, 1, 1], bool), np.array([0, 0, 0, 0, 1], bool)
    env: Any = SimpleNamespace(
        spec=SimpleNamespace(full_name="kitchen"), parts=lambda rows: {"kettle": kettle, "light": light}
    )
    quality = np.full(5, QUALITY["noisy"])
    quality[:3] = QUALITY["navigate"]
    rows: Any = SimpleNamespace(
        qpos=np.zeros((5, 1)), ends=np.array([0, 0, 1, 0, 1], bool), quality=quality, size=5, extra=None
    )
    found = goal_visits.counts(env, rows)
    keys = ("goal", "visits", "visits in good rows", "steps", "episodes")
    assert [tuple(row[key] for key in keys) for row in found] == [
        ("kettle", 2, 1, 4, 2),
        ("light", 1, 0, 1, 1),
        ("all of them", 1, 0, 1, 1),
    ]


def test_a_task_without_goals_to_count_is_refused() -> None:
    env: Any = SimpleNamespace(parts=lambda rows: None)
    with pytest.raises(UserError, match="no parts"):
        list(goal_visits.at_goals(env, SimpleNamespace(qpos=np.zeros((1, 1)))))  # type: ignore[arg-type]
