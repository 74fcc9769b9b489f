"""The high level's learning rate goes on as its schedule says, by environment steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level import replay
from qdos_brax.high_level.learning import Learners, Learning, Sources
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.skill_learning import FrozenSkills
from qdos_brax.labels.bonus import NoBonus
from qdos_brax.labels.offline_reward import DataReward
from tests.point import point_config

RATE = 1e-3
LAST = 1000  # environment steps


@pytest.mark.parametrize(
    ("schedule", "env_steps", "factor"), [("constant", 999, 1.0), ("cosine", 0, 1.0), ("cosine", 500, 0.5)]
)
def test_a_step_is_as_long_as_the_schedule_says(schedule: str, env_steps: int, factor: float) -> None:
    """Adam's first step moves a parameter by the rate, whatever the gradient."""
    config = point_config(
        **{
            "high_level.schedule": schedule,
            "high_level.env_steps": LAST,
            "high_level.learning_rate": RATE,
            "high_level.utd": 1,
            "high_level.offline_fraction": 0.0,
        }
    )
    sac = SAC(2, 2, config.high_level)
    learning = Learning(config, sac, cast(Any, None), DataReward(), NoBonus(), FrozenSkills())
    hyper = {key: jnp.asarray(value[0]) for key, value in configs.population_hyper(config).items()}
    row = Transition(jnp.ones(2), jnp.ones(2) / 2, jnp.ones(()), jnp.ones(()), -jnp.ones(2))
    rows = replay.insert(replay.create(row, 4), jax.tree.map(lambda x: x[None], row))
    before = learning.init(Learners(*jax.random.split(jax.random.key(0), 4)), hyper)
    no_data = cast(Any, SimpleNamespace(starts=jnp.zeros(0, jnp.int32)))
    sources = Sources(rows, no_data, {}, {}, hyper)
    after, _ = learning.step(before, (jax.random.key(1), row), jnp.asarray(env_steps), sources)
    for part in ("actor", "critic"):
        old, new = (jax.tree.leaves(getattr(learners.high_level, part)) for learners in (before, after))
        moved = max(float(jnp.abs(a - b).max()) for a, b in zip(old, new, strict=True))
        np.testing.assert_allclose(moved, RATE * factor, rtol=2e-3)


def test_runs_from_before_there_was_a_schedule_keep_their_hash() -> None:
    plain = configs.config_hash(point_config())
    assert configs.config_hash(point_config(**{"high_level.schedule": "constant"})) == plain
    assert configs.config_hash(point_config(**{"high_level.schedule": "cosine"})) != plain
