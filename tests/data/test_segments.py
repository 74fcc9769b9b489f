"""Windows stay inside episodes; the macro step's reward and mask, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.data.dataset import episode_bounds
from qdos_brax.data.segments import episode_last, macro_return, segment_starts, window

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("seed", range(20))
def test_windows_are_exactly_those_inside_one_episode(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, horizon = int(rng.integers(1, 60)), int(rng.integers(1, 8))
    ends = rng.random(n) < 0.15
    episode = np.concatenate([[0], np.cumsum(ends)[:-1]])
    expected = [t for t in range(n - horizon + 1) if episode[t] == episode[t + horizon - 1]]
    assert segment_starts(ends, horizon).tolist() == expected


def test_no_rows_give_no_windows() -> None:
    assert segment_starts(np.zeros(0, bool), 4).shape == (0,)
    assert episode_bounds(np.zeros(0, bool)).shape == (0, 2)


def test_last_row_of_every_episode() -> None:
    assert episode_last(np.array([0, 0, 1, 1, 0, 0], bool)).tolist() == [2, 2, 2, 3, 5, 5]  # an open end ends too
    assert episode_last(np.zeros(0, bool)).shape == (0,)


def test_horizon_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="horizon"):
        segment_starts(np.ones(3, bool), 0)


def test_window_reads_every_leaf() -> None:
    tree = {"x": jnp.arange(10), "y": jnp.arange(20.0).reshape(10, 2)}
    cut = jax.jit(window, static_argnums=2)(tree, jnp.array([0, 7]), 3)
    assert cut["x"].tolist() == [[0, 1, 2], [7, 8, 9]]
    assert cut["y"].shape == (2, 3, 2)
    assert cut["y"][1, 2].tolist() == [18.0, 19.0]


def test_macro_return_by_hand() -> None:
    rewards = jnp.array([[-1.0, -1.0, -1.0], [-1.0, 0.0, -1.0], [0.0, -1.0, -1.0], [-1.0, -1.0, 0.0]])
    masks = jnp.array([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 0.0]])
    reward, mask = macro_return(rewards, masks, 0.5)
    np.testing.assert_allclose(reward, [-1.75, -1.0, 0.0, -1.5])
    np.testing.assert_array_equal(mask, [1.0, 0.0, 0.0, 0.0])
