"""Collection on real physics with a stand-in expert: sizes, codes, true next states, one seed repeats, two differ."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes.locomotion import DROP_HEIGHT
from qdos_brax.collection.collect import collect, episode_length
from qdos_brax.collection.collector import CHUNK_STEPS, Collector
from qdos_brax.collection.experts import rising
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError
from tests.collection.stand_ins import collector

ROWS = 650  # three episodes of 200 steps and one that is cut


@pytest.fixture(scope="module", params=["antmaze-medium", "antsoccer-arena"])
def mixed(request: Any) -> Collector:
    return collector(request.param, "mixed")


@pytest.fixture(scope="module")
def rows(mixed: Collector) -> dict[str, np.ndarray]:
    seen: list[tuple[int, int]] = []
    rows = collect(mixed, ROWS, seed=0, num_envs=2, progress=lambda *at: seen.append(at))
    assert seen[-1] == (ROWS, ROWS) and seen == sorted(seen)
    return rows


def test_rows_fit_the_task(mixed: Collector, rows: dict[str, np.ndarray]) -> None:
    env = mixed.env
    assert {len(value) for value in rows.values()} == {ROWS}
    assert rows["observations"].shape[1] == env.observation_size
    assert np.abs(rows["actions"]).max() <= 1.0
    assert np.flatnonzero(rows["timeouts"]).tolist() == [299, 599, 649]
    assert not rows["terminals"].any()
    success = env.success(rows["infos/qpos"], env.goal_xy)
    np.testing.assert_array_equal(rows["rewards"], success - 1.0)
    for first in (0, 300, 600):
        assert len(np.unique(rows["infos/quality"][first : first + 50])) == 1  # one kind per episode


def test_next_observations_are_what_the_engine_makes_of_the_row(mixed: Collector, rows: dict[str, np.ndarray]) -> None:
    engine = mixed.env.engine
    inside = ~rows["timeouts"]
    inside[-1] = False
    shifted = np.roll(rows["observations"], -1, axis=0)
    np.testing.assert_array_equal(rows["next_observations"][inside], shifted[inside])
    np.testing.assert_array_equal(rows["observations"][:, : engine.nq], rows["infos/qpos"])
    for end in np.flatnonzero(rows["timeouts"]):
        state = engine.init(rows["infos/qpos"][end], rows["infos/qvel"][end])
        after = engine.step(state, rows["actions"][end])
        # Only the solver's warm start and the float32 rounding of the start tell the two apart.
        np.testing.assert_allclose(rows["next_observations"][end, : engine.nq], after.qpos, atol=2e-2)


# Soccer alone: it does all that a maze does, and a second collection takes time.
@pytest.mark.parametrize("mixed", ["antsoccer-arena"], indirect=True)
def test_one_seed_repeats_and_two_differ(mixed: Collector, rows: dict[str, np.ndarray]) -> None:
    again = collect(mixed, ROWS, seed=0, num_envs=2)
    for key, value in rows.items():
        np.testing.assert_array_equal(again[key], value, err_msg=key)
    other = collect(mixed, ROWS, seed=1, num_envs=2)
    assert not np.array_equal(other["actions"], rows["actions"])
    assert not np.array_equal(other["infos/qpos"][0], rows["infos/qpos"][0])


def test_teleporters_work_while_collecting() -> None:
    teleport = collector("antmaze-teleport", "mixed")
    env = teleport.env
    exits = env.layout.ij_to_xy(np.array(env.layout.teleporters.exits))
    entrances = jnp.asarray(env.layout.ij_to_xy(np.array(env.layout.teleporters.entrances)), jnp.float32)

    # Every environment starts at an entrance, so that the first step goes through it.
    starts = teleport.reset(jax.random.split(jax.random.key(0), 12))
    at_entrance = starts.pipeline.qpos.at[:, :2].set(entrances[jnp.arange(12) % len(entrances)])
    pipeline = jax.jit(jax.vmap(env.engine.init))(at_entrance, starts.pipeline.qvel)
    starts = starts.replace(pipeline=pipeline, observation=jax.vmap(env.observe)(pipeline))
    kinds = np.full(12, QUALITY["wander"], np.int8)
    rows = teleport.run(starts, kinds, CHUNK_STEPS, jax.random.key(1))[0]

    first = np.arange(12) * CHUNK_STEPS
    came_out = rows["infos/qpos"][first + 1, :2]
    assert {tuple(xy) for xy in came_out} == {tuple(xy) for xy in exits}
    # as online: the observation shows the entrance once more, the one after it the exit
    np.testing.assert_array_equal(rows["next_observations"][first], rows["observations"][first + 1])
    assert (np.linalg.norm(rows["observations"][first + 1, :2] - rows["observations"][first, :2], axis=1) < 1).all()
    assert (np.linalg.norm(rows["observations"][first + 2, :2] - came_out, axis=1) < 1).all()


def test_a_humanoid_begins_as_the_task_drops_it_and_is_got_up() -> None:
    falling = collector("humanoidmaze-medium", "mixed")
    rows = collect(falling, 400, seed=0, num_envs=2)
    assert np.flatnonzero(rows["timeouts"]).tolist() == [199, 399] and not rows["terminals"].any()
    qpos, qvel = rows["infos/qpos"], rows["infos/qvel"]
    np.testing.assert_allclose(qpos[[0, 200], 2], DROP_HEIGHT)
    follow, act = jax.jit(falling.recovery.follow), jax.jit(falling.recovery.act)
    memory, stages = falling.recovery.begin(), []
    for row in range(200):
        memory = follow(memory, qpos[row], qvel[row])
        stages.append(int(memory[0]))
        if stages[-1] != rising.WALKS:  # getting up is not shaken
            np.testing.assert_allclose(
                rows["actions"][row], act(memory, qpos[row], qvel[row], jnp.zeros(21)), atol=1e-4
            )
    assert {rising.LIES, rising.CROUCHES, rising.RISES} <= set(stages)
    inside = ~rows["timeouts"]
    shifted = np.roll(rows["observations"], -1, axis=0)
    np.testing.assert_array_equal(rows["next_observations"][inside], shifted[inside])


@pytest.mark.parametrize(
    ("transitions", "num_envs", "length"),
    [(200, 64, 200), (4_000, 16, 250), (64_000, 64, 1000), (1_000_000, 64, 1000)],
)
def test_small_sets_have_shorter_episodes(transitions: int, num_envs: int, length: int) -> None:
    assert episode_length(transitions, num_envs, 1000, CHUNK_STEPS) == length


@pytest.mark.parametrize("wrong", [{"transitions": 10}, {"num_envs": 0}, {"seed": -1}])
def test_arguments_out_of_range_are_refused(mixed: Collector, wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError):
        collect(mixed, **({"transitions": 200, "seed": 0, "num_envs": 2} | wrong))
