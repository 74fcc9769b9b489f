"""A run whose skills are outcomes, from data to an agent, and when its information term is computed."""

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
from qdos_brax.skills.skill_phase import SkillPhase
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


def learned(config: configs.Config, folder: Path) -> Any:
    """Return the agent of a run."""
    context = build_context(config, Plane(), point_dataset(100))
    phases, members = build_phases(context), configs.members(config)
    bind_phases(phases, Population(configs.population_hyper(config)), context.data)
    run = RunFolder.create(str(folder))
    with run.held():
        _, artifacts = run_phases(phases, run, members, config=configs.config_hash(config), header={})
    trained = trained_run(config, Plane(), artifacts)
    return trained.agent(*jax.tree.map(lambda leaf: leaf[0], (trained.artifacts, trained.hyper)))


def test_what_is_asked_for_happens(tmp_path: Path) -> None:
    """A step takes it 0.09 m on, so that a way of 0.45 m takes the five steps that a skill looks ahead."""
    agent = learned(point_config(**OUTCOMES, **{"skills.alpha": 0.3}), tmp_path / "run")
    env = Plane()
    start = env.reset_to(jnp.array([0.2, -0.1]), jnp.zeros(2))

    @jax.jit
    def played(way: jax.Array) -> jax.Array:
        skill = agent.begin(start.obs, way)
        step = lambda state, index: (env.step(state, agent.play(state.obs, skill, index)), None)  # noqa: E731
        return jax.lax.scan(step, start, jnp.arange(5))[0].obs - start.obs

    for angle in np.arange(8) * np.pi / 4:
        way = 0.45 * jnp.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(played(way), way, atol=0.12)


@pytest.mark.quick
@pytest.mark.parametrize(("alpha", "computed"), [(0.0, False), (0.3, True), ((0.0, 0.3), True)])
def test_the_information_term_is_computed_only_where_it_counts(alpha: Any, computed: bool) -> None:
    context = build_context(point_config(**OUTCOMES, **{"skills.alpha": alpha}), Plane(), point_dataset(4))
    (phase,) = [phase for phase in build_phases(context) if isinstance(phase, SkillPhase)]
    assert (phase._information is not None) == computed
