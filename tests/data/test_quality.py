"""AUC against a brute-force count; progress and the report by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from qdos_brax.data import quality
from qdos_brax.data.dataset import Dataset

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("seed", range(5))
def test_auc_equals_the_count_over_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, 6, 40).astype(float)  # many ties
    positive = rng.random(40) < 0.4
    pairs = [(p > n) + 0.5 * (p == n) for p in scores[positive] for n in scores[~positive]]
    assert quality.auc(scores, positive) == pytest.approx(np.mean(pairs))


def test_auc_of_one_kind_is_nan() -> None:
    assert np.isnan(quality.auc(np.arange(3.0), np.ones(3, bool)))


def test_progress_is_the_distance_gained_and_stays_in_the_episode() -> None:
    qpos = np.array([[9.0], [7.0], [4.0], [100.0], [90.0], [80.0]], np.float32)
    blank = np.zeros((6, 1), np.float32)
    dataset = Dataset(
        blank, blank, blank[:, 0], blank[:, 0], np.array([0, 0, 1, 0, 0, 1], bool), blank, qpos=qpos, source="toy"
    )
    env = SimpleNamespace(distance_left=lambda q, extra: q[:, 0])
    gains = quality.progress(env, dataset, np.array([0, 1, 3, 4]), 2)
    np.testing.assert_allclose(gains, [5.0, 3.0, 20.0, 10.0])


def test_progress_where_there_is_no_way() -> None:
    qpos = np.array([[9.0], [np.inf], [np.inf], [np.inf]], np.float32)  # a teleporter's exit without a way out
    blank = np.zeros((4, 1), np.float32)
    dataset = Dataset(blank, blank, blank[:, 0], blank[:, 0], np.zeros(4, bool), blank, qpos=qpos, source="toy")
    env = SimpleNamespace(distance_left=lambda q, extra: q[:, 0])
    gains = quality.progress(env, dataset, np.array([0, 1]), 2)
    np.testing.assert_array_equal(gains, [-np.inf, 0.0])
    numbers = quality.report(np.array([0.0, 1.0]), np.ones(2), gains, 1.5)
    assert numbers["losing_share"] == 0.5 and numbers["gaining_share"] == 0.0


def test_parts_that_changed_by_hand() -> None:
    """Two parts, read off the discrete state; a segment that ends its episode is judged by its last state."""
    extra = np.array([[0, 0], [1, 0], [1, 1], [0, 0], [0, 1], [0, 1]], np.int32)
    blank = np.zeros((6, 1), np.float32)
    dataset = Dataset(
        blank, blank, blank[:, 0], blank[:, 0], np.array([0, 0, 1, 0, 0, 1], bool), blank, blank, blank, extra
    )
    env = SimpleNamespace(
        extra_size=2, parts=lambda rows: {"left": rows.extra[:, 0] == 1, "right": rows.extra[:, 1] == 1}
    )
    codes, names = quality.changed_parts(env, dataset, np.array([0, 1, 3, 4]), 2)
    assert [str(names[code]) for code in codes] == ["several", "right", "right", "none"]
    codes, _ = quality.changed_parts(env, dataset, np.array([0, 3]), 1)
    assert [str(names[code]) for code in codes] == ["left", "right"]
    assert quality.changed_parts(env, replace(dataset, extra=None), np.array([0]), 2) is None
    env.parts = lambda rows: None
    assert quality.changed_parts(env, dataset, np.array([0]), 2) is None


def test_report_by_hand() -> None:
    gains = np.array([3.0, 2.0, -2.0, 0.0])
    numbers = quality.report(
        scores=np.array([2.0, 0.0, 1.0, 5.0]),
        weights=np.array([2.0, 1.0, 1.0, 0.0]),
        gains=gains,
        margin=1.5,
        degraded=np.array([False, False, True, True]),
    )
    assert numbers["auc_progress"] == pytest.approx(0.5)
    assert numbers["auc_degraded"] == pytest.approx(0.25)
    assert numbers["effective_share"] == pytest.approx(16 / 6 / 4)
    assert numbers["losing_weight"] == pytest.approx(0.25)
    assert numbers["gaining_weight"] == pytest.approx(0.75)
    assert numbers["losing_share"] == pytest.approx(0.25)
