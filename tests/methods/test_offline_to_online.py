"""A method that is learned offline first: what it hands on, when it begins to learn again, and that it plays."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from flax.serialization import to_state_dict

from tests.methods.test_methods import config_of, mean_fewest_steps, phases_of
from tests.point import point_dataset, run_phase


def test_the_online_phase_goes_on_with_what_was_learned_offline() -> None:
    sizes = {"flow.updates": 10, "flow.hidden": [8], "high_level.hidden": [8], "eval.every_env_steps": 200}
    config = config_of("qc", **sizes, **{"high_level.warmup_env_steps": 100, "high_level.env_steps": 200})
    agent, label, online = phases_of(config, point_dataset(20))
    _, history, artifacts = run_phase(agent, jax.random.split(jax.random.key(0), 1), {})
    assert history[-1]["update"][0] == 10 and np.isfinite(history[-1]["critic_loss"]).all()
    _, _, artifacts = run_phase(label, jax.random.split(jax.random.key(1), 1), artifacts)
    assert artifacts["labels"].shape == (1, 20 * 26, 10)  # chunks of 5 actions of width 2
    state, constants = online.init(jax.random.split(jax.random.key(2), 1), artifacts)
    begun = jax.tree.map(np.asarray, to_state_dict(state.learners.high_level))
    jax.tree.map(np.testing.assert_array_equal, begun, artifacts["agent"])
    online._iterations = 10  # of 2 environments x 5 steps: the warm-up, which is not learned from
    state, metrics = online.chunk(state, constants)
    assert (metrics["env_steps"][0], metrics["update"][0]) == (100, 0)
    jax.tree.map(np.testing.assert_array_equal, to_state_dict(state.learners.high_level), artifacts["agent"])
    state, metrics = online.chunk(state, constants)
    assert metrics["env_steps"][0] > 100 and metrics["update"][0] > 0
    after = jax.tree.leaves(to_state_dict(state.learners.high_level))
    moved = [not np.array_equal(a, b) for a, b in zip(after, jax.tree.leaves(artifacts["agent"]), strict=True)]
    assert all(moved)
    assert set(online.finish(state, artifacts)) == {"actor", "normaliser", "healthy"}


def test_a_warm_start_goes_on_without_the_data_and_reaches_the_optimum_of_the_plane() -> None:
    """WSRL: actor and critics of an offline phase play first, unchanged, and then learn from what they met alone."""
    config = config_of(
        "wsrl",
        **{
            "flow.updates": 1_500,
            "flow.batch_size": 128,
            "high_level.env_steps": 2_000,
            "high_level.utd": 4,
            "high_level.learning_rate": 1e-3,
            "high_level.target_rate": 0.02,
            "high_level.warmup_env_steps": 400,
            "eval.episodes": 50,
            "eval.every_env_steps": 400,
        },
    )
    label, agent, online = phases_of(config, point_dataset())
    _, _, artifacts = run_phase(label, jax.random.split(jax.random.key(0), 1), {})
    _, _, artifacts = run_phase(agent, jax.random.split(jax.random.key(1), 1), artifacts)
    assert set(artifacts) == {"agent", "normaliser", "healthy"}  # the labels have served
    state, constants = online.init(jax.random.split(jax.random.key(2), 1), artifacts)
    history = []
    for _ in range(online.num_chunks):
        before = jax.tree.map(np.asarray, to_state_dict(state.learners.high_level))
        state, metrics = online.chunk(state, constants)
        history.append(metrics)
        if metrics["env_steps"][0] <= 400:
            jax.tree.map(np.testing.assert_array_equal, before, artifacts["agent"])
            assert metrics["update"][0] == 0
    warm, best = history[0], mean_fewest_steps()
    # Offline alone it mostly gets there, with detours; online it loses none of that, and the detours.
    assert warm["eval/success"][0] > 0.8 and warm["eval/length"][0] > best + 1.0
    assert min(metrics["eval/success"][0] for metrics in history) > 0.8
    assert history[-1]["eval/success"][0] == 1.0 and history[-1]["eval/length"][0] < best + 1.0


@pytest.mark.parametrize("initial", ["iql", "cal-ql"])
def test_skills_can_be_played_by_a_warm_start_too(initial: str) -> None:
    """Its decisions are the labels of the segments, u of width 2, and its rewards those of whole segments."""
    sizes = {"flow.updates": 10, "high_level.hidden": [8], "high_level.initial": initial}
    phases = phases_of(config_of("qdos", **sizes), point_dataset(20))
    assert [phase.name for phase in phases] == ["values", "skills", "label", "agent", "online"]
    labels = jax.random.uniform(jax.random.key(0), (1, 20 * 26, 2), minval=-0.9, maxval=0.9)
    _, history, artifacts = run_phase(phases[3], jax.random.split(jax.random.key(1), 1), {"labels": labels})
    assert history[-1]["update"][0] == 10 and np.isfinite(history[-1]["critic_loss"]).all()
    assert -5.5 < history[-1]["q"][0] < -4  # of 5 steps that mostly cost 1 each
    assert set(artifacts["agent"]) >= {"actor", "critic", "critic_opt_state"}
    np.testing.assert_array_equal(artifacts["labels"], labels)  # half of an online batch is labelled data
