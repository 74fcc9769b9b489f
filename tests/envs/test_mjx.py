"""MJX against MuJoCo C on states that rollouts visit; the figures of all tasks are in results/exactness.json.

With other seeds about one state in 250 is off by 1e-3: a contact begins at the margin, with a jump in force, and
float32 sees it one Runge-Kutta stage earlier or later. Not covered: a leg whose axis is inside a wall (8 cm deep),
where C has odd contacts of its own.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from benchmarks import exactness
from envs.mazes.bodies import ANT
from envs.mazes.families import MAZE_FAMILIES
from envs.mazes.maze import get_maze
from envs.mazes.walls import NearWalls
from envs.physics.mjx.engine import MjxEngine
from envs.physics.mjx.integrators import integrate

FREE_P99, TOUCHING_P99 = 1e-5, 1e-3  # of the error in qpos after one control step


def check_one_step(found: dict[str, Any]) -> None:
    assert found["free"]["count"] >= 100 and found["touching"]["count"] >= 100
    assert found["free"]["median"] <= 1e-6 and found["free"]["p99"] <= FREE_P99
    assert found["touching"]["median"] <= 1e-6 and found["touching"]["p99"] <= TOUCHING_P99
    assert found["share_beyond_cap"] == 0


def test_one_step_equals_c_in_a_maze() -> None:
    check_one_step(exactness.one_step_errors(*exactness.both_engines("antmaze-large")))


NAMES = dict.fromkeys(spec.name for spec in envs.list_tasks() if spec.family in MAZE_FAMILIES)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NAMES))
def test_every_maze_is_as_exact_on_mjx(name: str) -> None:
    check_one_step(exactness.one_step_errors(*exactness.both_engines(name)))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NAMES))
def test_every_maze_is_ogbenchs_on_mujoco_c(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    assert exactness.against_ogbench(env, jax.jit(jax.vmap(env.engine.step)))["largest_difference"] == 0


def test_models_it_cannot_step_are_refused() -> None:
    model = ANT.near(True)
    model.dof_frictionloss[6] = 1.0
    with pytest.raises(ValueError, match="without equalities and friction loss"):
        MjxEngine(model, NearWalls(get_maze("medium")), ANT.most_contacts)
    with pytest.raises(ValueError, match="contacts of dimension 3"):
        MjxEngine(ANT.near(True), NearWalls(get_maze("medium")), {})
    model = ANT.near(True)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
    with pytest.raises(ValueError, match="Euler or RK4"):
        integrate(
            model, lambda *motion: (motion[2], jnp.eye(model.nv)), (jnp.zeros(15), jnp.zeros(14), jnp.zeros(14)), 1
        )


@pytest.mark.slow
def test_mjx_task_runs_and_resets_in_jit() -> None:
    env = envs.AutoReset(envs.make("antmaze-medium", physics="mjx"))
    assert env.backend == "mjx"
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    state = state.replace(pipeline_state=state.pipeline_state.replace(steps=jnp.array([0, 0, 997, 999])))

    def body(state: Any, key: jax.Array) -> tuple[Any, Any]:
        after = jax.vmap(env.step)(state, jax.random.uniform(key, (4, 8), minval=-1, maxval=1))
        return after, after.done

    last, done = jax.jit(lambda s, k: jax.lax.scan(body, s, k))(state, jax.random.split(jax.random.key(1), 5))
    assert jax.tree.structure(last) == jax.tree.structure(state)
    np.testing.assert_array_equal(last.pipeline_state.steps, [5, 5, 2, 4])
    np.testing.assert_array_equal(done.sum(axis=0), [0, 0, 1, 1])
    assert bool(jnp.isfinite(last.obs).all()) and float(last.metrics["nan"].sum()) == 0
