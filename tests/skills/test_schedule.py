"""The learning rate of the skill phase goes on as its schedule says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.data.device import to_device
from qdos_brax.skills.segment_weights import UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from tests.point import bound, point_config, point_dataset

RATE = 1e-3


@pytest.mark.parametrize(
    ("schedule", "update", "factor"),
    [("constant", 9, 1.0), ("cosine", 0, 1.0), ("cosine", 5, 0.5), ("cosine", 9, (1 + np.cos(0.9 * np.pi)) / 2)],
)
def test_a_step_is_as_long_as_the_schedule_says(schedule: str, update: int, factor: float) -> None:
    """Adam's first step moves a parameter by the rate, whatever the gradient; a run of 10 steps is at ``update``."""
    values = {"skills.updates": 10, "skills.mi_every": 1, "skills.learning_rate": RATE, "skills.schedule": schedule}
    config = point_config(**values)
    data, _ = to_device(point_dataset(20), config.skills.horizon)
    model = SkillModel(2, 2, config.skills)
    phase = bound(SkillPhase(config, model, UniformWeights(), None, blocks_per_chunk=1), config, data)
    before, constants = phase.init(jax.random.split(jax.random.key(0), 1), {})
    start = jax.tree.map(np.array, before.params)
    after, _ = phase.chunk(before.replace(update=jnp.full(1, update, jnp.int32)), constants)
    moved = max(np.abs(a - b).max() for a, b in zip(jax.tree.leaves(after.params), jax.tree.leaves(start), strict=True))
    np.testing.assert_allclose(moved, RATE * factor, rtol=2e-3)


def test_runs_from_before_there_was_a_schedule_keep_their_hash() -> None:
    plain = configs.config_hash(point_config())
    assert configs.config_hash(point_config(**{"skills.schedule": "constant"})) == plain
    assert configs.config_hash(point_config(**{"skills.schedule": "cosine"})) != plain


@pytest.mark.parametrize(("mi_every", "updates"), [(50, 500), (100, 1_000), (400, 800), (1_500, 1_500)])
def test_a_chunk_ends_before_a_thousand_updates_unless_its_block_is_longer(mi_every: int, updates: int) -> None:
    """Signals are looked for, and checkpoints written, between chunks."""
    config = point_config(**{"skills.updates": 6_000, "skills.mi_every": mi_every})
    phase = SkillPhase(config, SkillModel(2, 2, config.skills), UniformWeights(), None)
    assert phase.num_chunks == -(-6_000 // updates)
