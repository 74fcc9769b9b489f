"""A goal first reached by the last step before the cap does not count, as in OGBench: online, in data, evaluated."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import ogbench  # noqa: F401  (registers the environments)
import pytest
from brax.envs.base import State

import envs
from envs.mazes.locomotion import AntMaze
from qdos_brax.commands.main import main
from qdos_brax.data import formats
from qdos_brax.high_level.acting import NEVER, with_first_goal
from qdos_brax.high_level.evaluation import evaluate

SPEED = 1.0  # m/s: a tenth of a metre per step
GAP = 0.52  # to the goal; 0.5 counts


class LateAnt(AntMaze):
    """Start episodes right before the goal and the cap, on the way: the first step reaches the goal."""

    def __init__(self, left: int) -> None:
        super().__init__(envs.get_spec("antmaze-medium-task1"), "mujoco")
        self._left = left

    def reset(self, rng: jax.Array, start_ij: Any = None, goal_ij: Any = None) -> State:
        qpos = jnp.asarray(self._init_qpos).at[:2].set(self.goal_xy - np.array([GAP, 0], np.float32))
        state = self.reset_to(qpos, jnp.zeros(self.engine.nv).at[0].set(SPEED), key=rng)
        steps = jnp.full_like(state.pipeline_state.steps, self.episode_length - self._left)
        return state.replace(pipeline_state=state.pipeline_state.replace(steps=steps))


@pytest.fixture(scope="module", params=[1, 2, 3], ids="{} steps before the cap".format)
def played(request: pytest.FixtureRequest) -> tuple[LateAnt, list[State]]:
    """The task, and the states of an episode from its start."""
    env = LateAnt(request.param)
    states, step = [env.reset(jax.random.key(0))], jax.jit(env.step)
    while not states[-1].done:
        states.append(step(states[-1], jnp.zeros(env.action_size)))
    return env, states


def test_the_step_that_reaches_the_goal_earns_nothing_and_the_next_one_ends(played: Any) -> None:
    env, states = played
    steps = len(states) - 1
    assert env.success(states[1].pipeline_state.qpos, env.goal_xy) and steps == min(env._left, 2)
    counts = env._left > 1
    last = states[-1]
    found = [float(x) for x in (last.reward, last.done, last.info["truncation"], last.metrics["success"])]
    assert found == ([0, 1, 0, 1] if counts else [-1, 1, 1, 0])
    assert float(states[1].reward) == -1.0


def test_ogbench_counts_the_same(played: Any) -> None:
    env, states = played
    theirs = gymnasium.make("antmaze-medium-singletask-task1-v0", max_episode_steps=env._left)
    theirs.reset(seed=0)
    theirs.unwrapped.set_state(*map(np.asarray, (states[0].pipeline_state.qpos, states[0].pipeline_state.qvel)))
    for n, state in enumerate(states[1:], 1):
        _, reward, terminated, truncated, info = theirs.step(np.zeros(8))
        assert (reward, info["success"]) == (float(state.reward), float(state.metrics["success"]))
        assert terminated == (n == 2) and (terminated or truncated) == bool(state.done)


@pytest.mark.parametrize("layout", ["ours", "ogbench"])
def test_data_labels_and_data_check_count_the_same(
    played: Any, layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env, states = played
    qpos, qvel = (np.stack([getattr(s.pipeline_state, name) for s in states]) for name in ("qpos", "qvel"))
    rows = {"observations": np.stack([s.obs for s in states]), "actions": np.zeros((len(states), 8), np.float32)}
    ends, path = np.arange(len(states)) == len(states) - 1, tmp_path / "set.npz"
    if layout == "ogbench":
        np.savez(path, **rows, terminals=ends, qpos=qpos, qvel=qvel)
    else:
        path = path.with_suffix(".hdf5")
        rows = {key: value[:-1] for key, value in rows.items()} | {"next_observations": rows["observations"][1:]}
        infos = {"infos/qpos": qpos[:-1], "infos/qvel": qvel[:-1]}
        formats.write_hdf5(path, rows | infos | {"terminals": 0 * ends[:-1], "timeouts": ends[1:]}, {})
    data = formats.read(path, env)
    np.testing.assert_array_equal(data.rewards, [float(s.reward) for s in states[1:]])
    np.testing.assert_array_equal(data.masks, [1 - float(s.metrics["success"]) for s in states[1:]])
    assert main(["data", "check", str(path), "--env", "antmaze-medium-task1", "--horizon", "1"]) == 0
    assert f"{int(env._left > 1)} episodes reach the goal" in capsys.readouterr().out


@pytest.mark.parametrize("horizon", [1, 5])
def test_evaluation_and_first_goals_count_the_same(played: Any, horizon: int) -> None:
    env, states = played
    play = partial(
        evaluate, env, lambda obs: jnp.zeros(1), lambda obs, z, t: jnp.zeros(8), jax.random.key(0), 1, horizon
    )
    episodes = jax.jit(play)()
    counts = env._left > 1
    assert float(episodes.success[0]) == counts and int(episodes.length[0]) == len(states) - 1
    assert float(episodes.episode_return[0]) == sum(float(s.reward) for s in states[1:])
    acting = SimpleNamespace(first_goal_step=jnp.full((), NEVER), env_steps=jnp.asarray(7))
    acting.replace = lambda first_goal_step: first_goal_step
    assert int(with_first_goal(acting, episodes.success)) == (7 if counts else NEVER)  # type: ignore[arg-type]
