"""Demonstrations of cubes and scene: OGBench's oracles do what they do there, goals are visited, failing costs."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import numpy as np
import pytest

import envs
from qdos_brax.collection import recipes
from qdos_brax.collection.collect import collect
from qdos_brax.collection.makers import maker_of
from qdos_brax.collection.scripted import oracles
from qdos_brax.collection.scripted.manipspace import CubeDemonstrator
from qdos_brax.collection.scripted.table import TableReader, TableTarget, TableView
from qdos_brax.collection.scripted.targets import GoalSeeker
from qdos_brax.data.quality import QUALITY


@cache
def task(name: str) -> Any:
    return envs.make(name, physics="mujoco")


def table_of(env: Any, state: Any, seed: int = 0) -> TableView:
    """A table with everything as in ``state``, in a simulation that was started there."""
    qpos = np.zeros((1, env.engine.nq), np.float32)
    qpos[:, :6] = env.rig.arm_start(np.array([[0.4, 0.0, 0.25]]), np.array([0.3]))
    cubes = np.concatenate([state.cubes, np.tile([1, 0, 0, 0], (len(state.cubes), 1))], axis=1).ravel()
    qpos[:, 14:] = np.concatenate([cubes, state.fixtures])
    simulations = env.engine.simulations(np.random.default_rng(seed))
    simulations.start(qpos, np.zeros((1, env.engine.nv)), state.extra[None])
    return TableReader(env).read(simulations)[0]


def test_a_table_is_seen_as_ogbenchs_oracles_see_it() -> None:
    from tests.envs.manipspace_reference import place, reference

    env = task("scene-task2")
    state = env.start_of(env.description)
    table = table_of(env, state)
    their = reference(env)
    qpos = np.zeros(env.engine.nq, np.float32)
    qpos[:6] = env.rig.arm_start(np.array([[0.4, 0.0, 0.25]]), np.array([0.3]))[0]
    qpos[14:] = np.concatenate([state.cubes[0], [1, 0, 0, 0], state.fixtures])
    place(their, qpos, np.zeros(env.engine.nv), state.extra)
    their._mode = "data_collection"
    for kind, value in (("drawer", -0.16), ("window", 0.2), ("button", 1), ("cube", 0)):
        their._target_task, their._target_button = kind, 1
        their._model.site("drawer_handle_center_target").pos[1] = -0.16
        their._model.site("window_handle_center_target").pos[0] = 0.2
        their._target_button_states[:] = 1
        importlib.import_module("mujoco").mj_kinematics(their._model, their._data)
        expected = their.compute_ob_info()
        target = TableTarget(kind, int(kind == "button"), their._data.mocap_pos[0], 0.0, value)
        for name, number in table.info(target, 0.0).items():
            if name != "time":
                np.testing.assert_allclose(
                    number, expected[name], atol=2e-3 if "target" in name else 1e-5, err_msg=name
                )


@pytest.mark.parametrize("kind", ["cube", "button", "drawer", "window"])
def test_plans_are_those_of_ogbench(kind: str) -> None:
    """OGBench's own oracle goes from point to point of its plan, with the same random numbers."""
    env = task("scene-task2")
    table = table_of(env, env.start_of(env.description))
    target = TableTarget(kind, 0, np.array([0.4, 0.1, 0.02]), 2.5, value=0.0)
    state = np.random.get_state()[1]
    ours = oracles.Oracle(env, "plan", 0.0)
    ours.set_target(table, target, np.random.default_rng(4))
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # NumPy's own generator is as it was
    module = importlib.import_module(f"ogbench.manipspace.oracles.plan.{kind}_plan")
    theirs = getattr(module, f"{kind.capitalize()}PlanOracle")(env=oracles._stand_in(env), noise=0.0)
    with oracles._numpy_draws_from(np.random.default_rng(4)):
        theirs.reset(None, table.info(target, 0.0))
    np.testing.assert_allclose(ours._oracle._plan, theirs._plan, atol=1e-6)
    for step in range(3):
        action = theirs.select_action(None, table.info(target, 0.05 * step))
        np.testing.assert_allclose(ours.act(table), action, atol=1e-4)


def test_what_a_goal_asks_for_comes_in_an_order_that_works() -> None:
    env, rng = task("scene-task2"), np.random.default_rng(0)
    wanted = {}
    for description in env.descriptions:
        target = GoalSeeker(env, description).next_target(table_of(env, env.start_of(description)), rng)
        assert target is not None
        wanted[description["task_name"].split("_")[0]] = (target.kind, target.index, target.value)
        assert GoalSeeker(env, description).next_target(table_of(env, env.goal_state(description)), rng) is None
    assert wanted == {
        "task1": ("drawer", 0, -0.16),  # both are free
        "task2": ("button", 0, 1),  # to shut what is locked
        "task3": ("cube", 0, 0.0),
        "task4": ("button", 0, 1),  # to open the drawer for the cube
        "task5": ("button", 0, 1),
    }
    stack = GoalSeeker(task("cube-double"), task("cube-double").descriptions[4])
    apart = task("cube-double").start_of(task("cube-double").descriptions[4])
    first = stack.next_target(table_of(task("cube-double"), apart), rng)
    assert first is not None and first.index == 0  # the lower one
    swap = task("cube-double").descriptions[3]
    aside = GoalSeeker(task("cube-double"), swap).next_target(
        table_of(task("cube-double"), task("cube-double").start_of(swap)), rng
    )
    assert aside is not None and np.abs(swap["goal_xyzs"][:, :2] - aside.place[:2]).max(axis=1).min() > 0.04


@pytest.fixture(scope="module")
def rows() -> dict[str, np.ndarray]:
    env = task("cube-single")
    maker = maker_of(env)
    collector = maker.collector(recipes.degraded(0.5, maker, noise=0.1))
    return collect(collector, 16 * 200, seed=1, num_envs=16)


def test_good_episodes_visit_goals_and_bad_ones_lose_what_they_had(rows: dict[str, np.ndarray]) -> None:
    env, quality = task("cube-single"), rows["infos/quality"].reshape(16, 200)
    assert np.unique(quality[:, 0], return_counts=True)[1].tolist() == [8, 3, 3, 2]
    placed = np.array([
        env.in_place(rows["infos/qpos"], env.goal_of(description))[:, 0].reshape(16, 200)
        for description in env.descriptions
    ])  # fmt: skip
    arrives = (placed[:, :, 1:] & ~placed[:, :, :-1]).any(axis=2)
    assert arrives[:, quality[:, 0] == QUALITY["navigate"]].any(axis=0).sum() >= 4
    fails = quality[:, 0] == QUALITY["fail"]
    assert placed[:, fails, 0].any(axis=0).all() and not placed[:, fails, -1].any(axis=0).all()
    assert np.abs(rows["actions"]).max() <= 1 and rows["infos/qpos"][:, 16].max() > 0.1


def test_one_seed_gives_one_set(rows: dict[str, np.ndarray]) -> None:
    demonstrator = CubeDemonstrator(task("cube-single"), 4, 0.1)
    kinds = np.arange(4, dtype=np.int8)
    starts = [demonstrator.begin(kinds, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(starts[0].qpos, starts[1].qpos)
    assert (starts[0].qpos != starts[2].qpos).any()
    env = task("cube-single")
    simulations = env.engine.simulations(np.random.default_rng(0))
    played = []
    for _ in range(2):
        rng = np.random.default_rng(5)
        start = demonstrator.begin(kinds, rng)
        simulations.start(start.qpos, start.qvel, start.extra)
        actions = []
        for _ in range(8):
            action, quality = demonstrator.act(simulations, rng)  # type: ignore[arg-type]
            np.testing.assert_array_equal(quality, kinds)
            simulations.step(action)
            actions.append(action)
        played.append(actions)
    np.testing.assert_array_equal(*played)
