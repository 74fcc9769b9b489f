"""A run whose skills are outcomes: from data to an agent, with the information term and without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.body_frame import BodyFrame
from qdos_brax import config as configs
from qdos_brax.analysis.finished import trained_run
from qdos_brax.methods.build import bind_phases, build_context, build_phases
from qdos_brax.population.members import Population
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.loop import run_phases
from tests.point import PointEnv, point_config, point_dataset

OUTCOMES = {
    "skills.model": "outcome",
    "skills.view": "body",
    "skills.mi_encoder": "outcome",
    "skills.mi_latent": "played",
    "skills.outcome_steps": 5,
    "skills.updates": 800,
    "skills.mi_every": 100,
    "skills.batch_size": 128,
    "skills.learning_rate": 0.003,
}


class Plane(PointEnv):
    """The plane, for a body that always faces east."""

    body_frame = BodyFrame()


def learned(config: configs.Config, folder: Path) -> tuple[Any, set[str]]:
    """Return the agent of a run, and the columns of what its skills reported."""
    context = build_context(config, Plane(), point_dataset(100))
    phases, members = build_phases(context), configs.members(config)
    bind_phases(phases, Population(configs.population_hyper(config)), context.data)
    run = RunFolder.create(str(folder))
    with run.held():
        _, artifacts = run_phases(phases, run, members, config=configs.config_hash(config), header={})
    trained = trained_run(config, Plane(), artifacts)
    rows = run.metrics.read_text(encoding="utf-8").splitlines()
    return trained.agent(*jax.tree.map(lambda leaf: leaf[0], (trained.artifacts, trained.hyper))), set(
        rows[0].split(",")
    )


@pytest.mark.parametrize("alpha", [0.0, 0.3])
def test_what_is_asked_for_happens(alpha: float, tmp_path: Path) -> None:
    """A step takes it 0.09 m on, so that a way of 0.45 m takes the five steps that a skill looks ahead."""
    agent, columns = learned(point_config(**OUTCOMES, **{"skills.alpha": alpha}), tmp_path / "run")
    assert ("information_loss" in columns) == (alpha > 0)  # at 0 it is not computed
    env = Plane()
    for angle in np.arange(8) * np.pi / 4:
        way = 0.45 * jnp.array([np.cos(angle), np.sin(angle)])
        state = env.reset_to(jnp.array([0.2, -0.1]), jnp.zeros(2))
        start = state.obs
        skill = agent.begin(state.obs, way)
        for step in range(5):
            state = env.step(state, agent.play(state.obs, skill, step))
        np.testing.assert_allclose(state.obs - start, way, atol=0.12)
