"""What stands beside an observation stands there wherever something learns or plays."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax import config as configs
from qdos_brax.analysis.finished import trained_run
from qdos_brax.config.schema import skill_keys
from qdos_brax.data.requirements import unmet_by_task
from qdos_brax.methods.build import bind_phases, build_context, build_phases
from qdos_brax.methods.learners_view import learners_env, learners_observations
from qdos_brax.population.members import Population
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.loop import run_phases
from tests.point import GOAL, PointEnv, point_config, point_dataset


class Gap:
    """See the way to the goal, twice as long."""

    def beside(self, observation: jax.Array) -> jax.Array:
        return 2 * (GOAL - observation)


class SeeingPoint(PointEnv):
    """The plane, for a body that sees the goal."""

    body_frame = Gap()


BODY = point_config(**{"observation.view": "body"})


@pytest.mark.quick
def test_states_show_what_stands_beside_them() -> None:
    env = envs.AutoReset(learners_env(BODY, SeeingPoint()))
    assert env.observation_size == 4 and isinstance(env.unwrapped, SeeingPoint)
    state = env.reset_to(jnp.array([0.5, 0.25]), jnp.zeros(2))
    np.testing.assert_allclose(state.obs, [0.5, 0.25, 1.0, -0.5])
    after = env.step(state, jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(after.obs, [0.6, 0.25, 0.8, -0.5], atol=1e-6)
    np.testing.assert_allclose(after.info["final_obs"], after.obs)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, env.reset(jax.random.key(0)))


@pytest.mark.quick
def test_it_is_put_there_once_and_by_name() -> None:
    task = SeeingPoint()
    once = learners_env(BODY, task)
    assert learners_env(BODY, once).observation_size == once.observation_size == 4
    assert learners_env(point_config(), task) is task
    rows = point_dataset(2).observations
    assert learners_observations(task, rows) is rows


def test_the_data_show_what_the_simulator_shows() -> None:
    context = build_context(BODY, SeeingPoint(), point_dataset(8))
    dataset, env = context.dataset, context.env
    for name in ("observations", "next_observations"):
        rows = getattr(dataset, name)
        np.testing.assert_array_equal(rows[:, :2], getattr(point_dataset(8), name))
        np.testing.assert_allclose(rows[:, 2:], 2 * (GOAL - rows[:, :2]), atol=1e-6)
    state = env.reset_to(jnp.asarray(dataset.qpos[7]), jnp.zeros(2))
    np.testing.assert_allclose(context.normaliser(state.obs), context.data.observations[7], atol=1e-5)


@pytest.mark.parametrize("method", ["qdos", "bc"])
def test_a_run_learns_and_plays_with_it(method: str, tmp_path: Path) -> None:
    config = configs.replace(BODY, method=method, **({"skills.horizon": 1} if method == "bc" else {}))
    context = build_context(config, SeeingPoint(), point_dataset(8))
    phases, members = build_phases(context), configs.members(config)
    bind_phases(phases, Population(configs.population_hyper(config)), context.data)
    folder = RunFolder.create(str(tmp_path / "run"))
    with folder.held():
        _, learned = run_phases(phases, folder, members, config=configs.config_hash(config), header={})
    trained = trained_run(config, SeeingPoint(), learned)
    agent = trained.agent(*jax.tree.map(lambda leaf: leaf[0], (trained.artifacts, trained.hyper)))
    state = trained.env.reset(jax.random.key(0))
    assert agent.normaliser.mean.shape == state.obs.shape == (4,)
    action = agent.play(state.obs, agent.choose(state.obs), 0)
    assert action.shape == (2,) and bool(jnp.isfinite(action).all())


@pytest.mark.quick
def test_a_task_without_a_body_is_one_line() -> None:
    task = SimpleNamespace(body_frame=None, things=(), spec=SimpleNamespace(family="point"))
    line = "observation.view=body: point offers no frame of a body: use observation.view=task"
    assert unmet_by_task(task, BODY) == [line]
    assert unmet_by_task(task, point_config()) == []


@pytest.mark.quick
def test_skills_are_of_one_view() -> None:
    assert "observation.view" in skill_keys("trajectory")


@pytest.mark.parametrize(
    "name", ["antmaze-medium", "antsoccer-arena", "cube-double", "humanoidmaze-medium", "kitchen-mixed"]
)
def test_what_a_body_sees_beside_is_the_end_of_its_view(name: str) -> None:
    env = envs.make(name)
    observation = jax.jit(env.reset)(jax.random.key(0)).obs
    frame = env.body_frame
    seen = frame.see(observation, frame.pose(observation))
    beside = frame.beside(observation)
    np.testing.assert_allclose(beside, seen[len(seen) - len(beside) :], atol=1e-6)
