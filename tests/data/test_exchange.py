"""Things that nobody touched are exchanged between episodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.manipulation.kitchen_rig import GOALS, SUBTASKS
from envs.things import Thing
from qdos_brax import config as configs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.exchange import exchanged
from qdos_brax.data.requirements import unmet
from qdos_brax.methods.build import build_context
from tests.point import PointEnv, point_dataset

LENGTH = 4


def drawers() -> Any:
    """A hand (number 0) and two drawers (1, 2); observed beside their speeds (3 to 5), done when open by 1."""
    things = tuple(Thing(f"drawer {n}", (n,), (n,), (n, n + 3), (n - 1,)) for n in (1, 2))

    def labels(states: Any) -> tuple[np.ndarray, np.ndarray]:
        done = states.extra.sum(axis=1)
        return (done - 2).astype(np.float32), (done < 2).astype(np.float32)

    return SimpleNamespace(things=things, labels=labels, extra_size=2)


def episode(opens: int, giver_speed: float = 0.0) -> dict[str, np.ndarray]:
    """Four steps in which the hand moves and drawer ``opens`` opens in the second, or none (0)."""
    after = np.zeros((LENGTH + 1, 3), np.float32)
    after[:, 0] = np.arange(LENGTH + 1) / 10
    qvel, extra = np.zeros_like(after), np.zeros((LENGTH + 1, 2), np.int32)
    if opens:
        after[2:, opens], extra[2:, opens - 1] = opens, 1
        qvel[LENGTH - 1 :, opens] = giver_speed
    seen = np.concatenate([after, qvel], axis=1)
    ends = np.arange(LENGTH) == LENGTH - 1
    rows = {"observations": seen[:-1], "next_observations": seen[1:], "qpos": after[:-1], "qvel": qvel[:-1]}
    actions = np.full((LENGTH, 1), opens, np.float32)
    return rows | {"extra": extra[:-1], "actions": actions, "ends": ends}


def dataset(*episodes: dict[str, np.ndarray]) -> Dataset:
    arrays = {name: np.concatenate([each[name] for each in episodes]) for name in episodes[0]}
    rewards, masks = drawers().labels(SimpleNamespace(extra=arrays["extra"]))
    return Dataset(**arrays, rewards=rewards, masks=masks)


def of_episodes(data: Dataset, name: str) -> np.ndarray:
    array = getattr(data, name)
    return array.reshape(-1, LENGTH, *array.shape[1:])


def test_two_drawers_are_open_together_though_no_episode_opens_both() -> None:
    data = dataset(*([episode(1), episode(2)] * 20))
    new = exchanged(data, drawers(), 0.5, 0)
    assert data.rewards.max() == -1 and new.rewards.max() == 0
    np.testing.assert_array_equal(new.rewards, new.extra.sum(axis=1) - 2)
    np.testing.assert_array_equal(new.masks, new.rewards < 0)
    others = [2, 1] * 20
    opened, changed = 0, 0
    for index, (other, own) in enumerate(zip(others, [1, 2] * 20, strict=True)):
        qpos, was = of_episodes(new, "qpos")[index], of_episodes(data, "qpos")[index]
        # The hand's way, and that of what the episode itself opens, are as they were.
        np.testing.assert_array_equal(qpos[:, [0, own]], was[:, [0, own]])
        # The other drawer stands as an episode left it, shut or open, from the first state to the one after the last.
        assert len(np.unique(qpos[:, other])) == 1 and qpos[0, other] in (0, other)
        np.testing.assert_array_equal(of_episodes(new, "extra")[index][:, other - 1], qpos[:, other] > 0)
        for name in ("observations", "next_observations"):
            np.testing.assert_array_equal(of_episodes(new, name)[index][:, other], qpos[:, other])
        opened += qpos[0, other] > 0
        changed += (qpos != was).any()
    # A half of 40 episodes is chosen, and half of the givers have opened the drawer.
    assert opened == changed and 4 <= opened <= 17
    for name in ("actions", "ends"):
        assert getattr(new, name) is getattr(data, name)
    np.testing.assert_array_equal(new.qvel, data.qvel)


def test_all_that_learns_is_given_the_exchanged_data() -> None:
    config = configs.replace(configs.Config(), **{"method": "bc", "skills.horizon": 1, "exchange.share": 1.0})
    context = build_context(config, drawers(), dataset(*([episode(1), episode(2)] * 20)))
    assert context.dataset.rewards.max() == 0
    np.testing.assert_array_equal(context.data.rewards, context.dataset.rewards)


def test_the_given_data_stays_and_a_share_of_0_is_that_data() -> None:
    data = dataset(episode(1), episode(2))
    before = {name: getattr(data, name).copy() for name in ("observations", "qpos", "extra", "rewards")}
    assert exchanged(data, drawers(), 0.0, 0) is data
    exchanged(data, drawers(), 1.0, 0)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(data, name), array)


def test_what_still_moves_at_the_end_is_not_given() -> None:
    data = dataset(*([episode(1, giver_speed=1.0), episode(0)] * 10))
    new = exchanged(data, drawers(), 1.0, 0)
    np.testing.assert_array_equal(of_episodes(new, "qpos")[1::2], of_episodes(data, "qpos")[1::2])
    standing = dataset(*([episode(1), episode(0)] * 10))
    new = exchanged(standing, drawers(), 1.0, 0)
    assert (of_episodes(new, "qpos")[1::2, 0, 1] == 1).any()


def test_the_choice_is_the_seeds() -> None:
    data = dataset(*([episode(1), episode(2)] * 20))
    first, again, other = (exchanged(data, drawers(), 0.5, seed).qpos for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_kitchens_things_are_the_numbers_that_the_sensors_show() -> None:
    """All numbers but the arm's belong to one thing; to move a thing changes what is said to show it, nothing else."""
    env = envs.make("kitchen-mixed")
    for kind, numbers in (("qpos", range(9, 30)), ("qvel", range(9, 29)), ("observed", range(18, 59))):
        assert sorted(number for thing in env.things for number in getattr(thing, kind)) == list(numbers)
    start, key = env.reset(jax.random.key(0)), jax.random.key(1)
    qpos, qvel = jnp.asarray(start.pipeline_state.qpos), jnp.zeros(env.engine.nv)
    rest = np.asarray(env.reset_to(qpos, qvel, key=key).obs)
    for thing in env.things:
        moved = env.reset_to(qpos.at[jnp.array(thing.qpos)].add(0.3), qvel.at[jnp.array(thing.qvel)].add(0.2), key=key)
        changed = np.flatnonzero(np.abs(np.asarray(moved.obs) - rest) > 1e-3)
        np.testing.assert_array_equal(changed, sorted(thing.observed))


@pytest.mark.parametrize("name", SUBTASKS)
def test_a_kitchens_thing_takes_its_subtask_along(name: str) -> None:
    """The numbers that a subtask asks for are those of the thing that has its number of the discrete state."""
    env = envs.make("kitchen-mixed")
    (thing,) = (thing for thing in env.things if thing.extra == (SUBTASKS.index(name),))
    assert set(GOALS[name]) <= set(thing.qpos)


def test_what_a_kitchen_episode_does_is_the_same_beside_other_things() -> None:
    """The truth of the exchange: away from a thing, actions lead the same way however that thing stands."""
    env = envs.make("kitchen-mixed")
    start, key = env.reset(jax.random.key(0)), jax.random.key(2)
    qpos, qvel = jnp.asarray(start.pipeline_state.qpos), jnp.zeros(env.engine.nv)
    (light,) = (thing for thing in env.things if thing.name == "light switch")
    (extra,) = light.extra
    on = qpos.at[jnp.array(light.qpos)].set(jnp.array([*GOALS["light switch"].values()]))
    ways = []
    for state in (
        env.reset_to(qpos, qvel, key=key),
        env.reset_to(on, qvel, key=key, extra=jnp.zeros(len(SUBTASKS), jnp.int32).at[extra].set(1)),
    ):
        seen = []
        for step in range(40):
            action = jnp.full(env.action_size, 0.5 * np.sin(step / 5.0))
            state = env.step(state, action)
            seen.append(np.asarray(state.obs))
        ways.append(np.stack(seen))
    others = np.setdiff1d(np.arange(env.observation_size), light.observed)
    np.testing.assert_allclose(ways[0][:, others], ways[1][:, others], atol=1e-3)
    assert (ways[0][:, list(light.observed)] != ways[1][:, list(light.observed)]).any()


def test_a_task_without_things_and_data_without_states_are_one_line() -> None:
    plane = SimpleNamespace(things=(), extra_size=0, spec=SimpleNamespace(family="antmaze"))
    config = configs.replace(configs.Config(), **{"method": "bc", "skills.horizon": 1, "exchange.share": 0.5})
    (line,) = unmet(point_dataset(8), plane, config)
    assert line == "exchange.share: antmaze has no things that rest until they are touched: leave it at 0"
    data = point_dataset(8)
    (line,) = unmet(data, drawers(), config)
    assert line == "no infos/extra, the simulator states in which things are exchanged: use --set exchange.share=0"
    assert unmet(data, PointEnv(), configs.replace(config, **{"exchange.share": 0.0})) == []
