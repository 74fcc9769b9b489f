"""The guard of fine-tuned skills, against numbers derived by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.high_level.guard import Guard, GuardState


def guard_after(guard: Guard, episodes: list[tuple[bool, float]]) -> GuardState:
    """The comparison after single episodes, (of the tuned decoder?, return), one macro step each."""
    state = guard.start(1)
    for tuned, earned in episodes:
        state = state.replace(tuned=jnp.array([tuned]))
        state = guard.observe(
            state, jax.random.key(0), jnp.array([earned]), jnp.array([True]), jnp.array([True]), jnp.array(True)
        )
    return state


def test_the_guard_by_hand() -> None:
    guard = Guard(window=2, trial_share=0.25)  # an episode counts half after the next one
    state = guard_after(guard, [(False, -10.0), (True, -4.0), (False, -20.0)])
    np.testing.assert_allclose(state.episodes, [1.25, 0.5])
    np.testing.assert_allclose(guard.means(state), [(-20 - 10 / 4) / 1.25, -4.0])
    assert not guard.prefers_tuned(state)  # too few episodes yet
    assert np.isnan(guard.means(guard.start(1))).all() and not guard.prefers_tuned(guard.start(1))


@pytest.mark.parametrize(("advantage", "preferred"), [(0.1, True), (-0.1, False)])
def test_the_tuned_decoder_is_preferred_while_it_earns_more(advantage: float, preferred: bool) -> None:
    """Returns rise from episode to episode, as a high level's do: that favours neither."""
    guard = Guard(window=40, trial_share=0.25)
    state = guard_after(guard, [(tuned, n + advantage * tuned) for n in range(100) for tuned in (False, True)])
    np.testing.assert_allclose(np.diff(guard.means(state)), advantage, atol=1e-3)
    assert bool(guard.prefers_tuned(state)) == preferred


def test_episodes_take_turns_as_the_guard_says_and_broken_ones_do_not_count() -> None:
    guard, many = Guard(window=40, trial_share=0.25), 20_000
    yes = jnp.ones(many, bool)
    for total, share in (([-30.0, -20.0], 0.75), ([-20.0, -30.0], 0.25)):
        state = guard.start(many).replace(episodes=jnp.array([5.0, 5.0]), total=jnp.array(total))
        after = guard.observe(state, jax.random.key(1), jnp.zeros(many), yes, ~yes, jnp.array(True))
        np.testing.assert_array_equal(after.episodes, state.episodes)
        assert abs(float(after.tuned.mean()) - share) < 0.02
        none = guard.observe(state, jax.random.key(1), jnp.zeros(many), yes, ~yes, jnp.array(False))
        assert not none.tuned.any()
    going = guard.observe(guard.start(many), jax.random.key(1), -jnp.ones(many), ~yes, yes, jnp.array(True))
    assert not going.tuned.any() and float(going.earned[0]) == -1.0


def test_of_equal_returns_the_frozen_decoder_is_preferred() -> None:
    """Before the first goal of a sparse task every episode earns the same."""
    guard = Guard(window=40, trial_share=0.25)
    state = guard_after(guard, [(tuned, -1000.0) for _ in range(20) for tuned in (False, True)])
    assert float(state.episodes.min()) > 3 and not guard.prefers_tuned(state)
