"""The arithmetic of ``benchmarks/regression.py``: how much of a latent is read off what happened."""

from __future__ import annotations

import numpy as np
import pytest
from regression import least_squares, r2, ridge


def test_ridge_is_least_squares_where_nothing_can_be_gained() -> None:
    """Of targets without noise the smallest penalty predicts best, and is as good as none."""
    rng = np.random.default_rng(0)
    inputs = np.concatenate([rng.normal(3, [1, 5, 0.1], (200, 3)), np.full((200, 1), 7.0), np.ones((200, 1))], axis=1)
    target = inputs[:, :3] @ rng.normal(size=(3, 2)) + 1
    np.testing.assert_allclose(inputs @ ridge(inputs, target), target, atol=1e-2)
    np.testing.assert_allclose(inputs @ least_squares(inputs, target), target, atol=1e-9)


def test_of_noise_ridge_makes_no_map() -> None:
    rng = np.random.default_rng(1)
    inputs = np.concatenate([rng.normal(size=(60, 40)), np.ones((60, 1))], axis=1)
    target = rng.normal(5, 1, (60, 1))
    assert np.abs(inputs @ ridge(inputs, target) - target.mean()).max() < 0.3
    assert np.abs(inputs @ least_squares(inputs, target) - target.mean()).max() > 1


def test_few_rows_of_heavy_tails_do_not_hide_what_is_known() -> None:
    """An arm: 16 draws in 200 states, a quarter of the latent's variance in the state, half in what happened."""
    rng = np.random.default_rng(2)
    states, draws = rng.normal(size=(200, 30)), 16
    seen = np.tile(states, (draws, 1))
    moved = rng.normal(size=(len(seen), 1))
    rest = rng.standard_t(1.5, (len(seen), 9)) ** 3  # things that are seldom touched, and then fly
    z = seen[:, :1] / 2 + moved * np.sqrt(0.5) + rng.normal(size=moved.shape) / 2
    happened = np.concatenate([moved, rest], axis=1)
    turned = (happened[:, :, None] * seen[:, None, :]).reshape(len(seen), -1)
    assert r2(z, seen) == pytest.approx(0.25, abs=0.06)
    assert 0.65 < r2(z, seen, happened, turned) < 0.75
    inputs = np.concatenate([seen, happened, turned, np.ones((len(seen), 1))], axis=1)
    half = len(z) // 2
    error = z[half:] - inputs[half:] @ least_squares(inputs[:half], z[:half])
    assert (error**2).mean() > z.var()  # least squares is worse than no map


def test_many_rows_are_fitted_by_least_squares() -> None:
    rng = np.random.default_rng(3)
    given, half = rng.normal(size=(400, 5)), np.random.default_rng(0).permutation(400) < 200
    z = given[:, :1] + rng.normal(size=(400, 1))
    inputs = np.concatenate([given, np.ones((400, 1))], axis=1)
    error = z[~half] - inputs[~half] @ np.linalg.lstsq(inputs[half], z[half], rcond=None)[0]
    assert r2(z, given) == 1 - (error**2).mean() / z[~half].var()
