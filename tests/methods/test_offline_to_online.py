"""A method that is learned offline first: what it hands on, when it begins to learn again, and that it plays."""

from __future__ import annotations

import jax
import numpy as np
from flax.serialization import to_state_dict

from tests.methods.test_methods import config_of, phases_of
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
