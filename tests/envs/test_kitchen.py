"""The kitchen is gymnasium-robotics' FrankaKitchen-v1, bit for bit, given its sensors' errors."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
import envs.gym_api
from envs import render
from envs.manipulation.kitchen_rig import START_QPOS, SUBTASKS
from envs.physics.mujoco.engine import _SENSORS
from qdos_brax.collection.scripted.kitchen import KitchenDemonstrator
from qdos_brax.commands import doctor
from qdos_brax.high_level.evaluation import evaluate, summary
from tests.collection.scripted.kitchen_player import play
from tests.envs.broken_state import assert_reset_alone
from tests.envs.kitchen_reference import kitchen, reference, rollout
from tests.envs.saved_state import saved_and_restored


@pytest.fixture(scope="module")
def env() -> Any:
    return kitchen("kitchen-mixed")


Start = tuple[np.ndarray, np.ndarray] | None  # (qpos, qvel) in float32; None: the task's


@pytest.fixture(scope="module")
def three(env: Any) -> Any:
    """Three kitchens at once, which start anew by themselves."""
    auto = envs.AutoReset(env)
    return SimpleNamespace(reset=jax.jit(jax.vmap(auto.reset)), step=jax.jit(jax.vmap(auto.step)))


def played(env: Any, actions: np.ndarray, key: jax.Array, start: Start) -> tuple[Any, Any, np.ndarray]:
    """The first state, all that follow, and the errors float32[T + 1, 59] that were drawn."""

    def step(state: Any, action: jax.Array) -> tuple[Any, tuple[Any, jax.Array]]:
        noise = env.engine._draw(state.pipeline_state.carry.key)[0][0]
        state = env.step(state, action)
        return state, (state, noise)

    begin = (lambda key: env.reset(key)) if start is None else (lambda key: env.reset_to(*start, key=key))
    first = jax.jit(begin)(key)
    _, (states, noise) = jax.jit(lambda state: jax.lax.scan(step, state, actions))(first)
    first_noise = env.engine._draw(jax.random.fold_in(key, _SENSORS))[0][0]
    return first, states, np.concatenate([first_noise[None], noise])


def assert_the_same(
    env: Any, actions: np.ndarray, patch: pytest.MonkeyPatch, seed: int = 3, start: Start = None
) -> dict[str, np.ndarray]:
    """Compare an episode with the reference's; return the reference's."""
    first, states, noise = played(env, actions, jax.random.key(seed), start)
    expected = rollout(reference(patch, env), actions, noise, start)
    steps = len(expected["reward"])
    exact = np.concatenate(env.engine.exact_state(states.pipeline_state), axis=-1)
    np.testing.assert_array_equal(exact[:steps], expected["state"])
    observations = np.concatenate([first.obs[None], states.obs])[: steps + 1]
    np.testing.assert_array_equal(observations, expected["observation"].astype(np.float32))
    completed = np.concatenate([[0], 4 * np.asarray(states.metrics["score"])])[: steps + 1]
    np.testing.assert_array_equal(completed[1:], expected["completed"])
    np.testing.assert_array_equal(np.diff(completed), expected["reward"])
    np.testing.assert_array_equal(states.reward[:steps], completed[:-1] - 4)
    done, truncated = np.asarray(states.done)[:steps], np.asarray(states.info["truncation"])[:steps]
    np.testing.assert_array_equal(done, expected["terminated"] | expected["truncated"])
    np.testing.assert_array_equal(done * (1 - truncated), expected["terminated"])
    np.testing.assert_array_equal(states.metrics["success"][:steps], expected["terminated"])
    return expected


def random_actions(steps: int, seed: int) -> np.ndarray:
    """Random actions that last for a while, beyond the range too: both clip."""
    held = np.random.default_rng(seed).uniform(-1.3, 1.3, (-(-steps // 10), 9))
    return np.repeat(held, 10, axis=0)[:steps].astype(np.float32)


def test_random_steps_equal_the_reference_bit_for_bit(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = assert_the_same(env, random_actions(280, 0), monkeypatch)
    assert expected["truncated"].tolist() == [False] * 279 + [True]


def almost_done() -> tuple[np.ndarray, np.ndarray]:
    """A start with the microwave's door, the kettle and the burner's knob on their way, and the light on."""
    qpos, qvel = START_QPOS.astype(np.float32), np.zeros(29, np.float32)
    qpos[[17, 18]] = -0.69, -0.05
    qpos[[11, 12]], qvel[11] = (-0.5785, -0.01), -6.0
    qpos[22], qvel[22] = -0.42, -4.0
    qpos[23:30], qvel[24] = (-0.23, 0.3, 1.62, 0.99, 0, 0, -0.06), 2.0
    return qpos, qvel


def test_subtasks_count_once_and_the_last_one_ends_the_episode_as_in_the_reference(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = assert_the_same(env, 0.3 * random_actions(10, 1), monkeypatch, start=almost_done())
    steps = len(expected["reward"])
    assert 2 <= steps < 10 and expected["reward"].tolist() == [3, *[0] * (steps - 2), 1]
    assert expected["terminated"].tolist() == [False] * (steps - 1) + [True]


def scripted_actions(env: Any, plans: list[list[str]], steps: int) -> np.ndarray:
    """Actions float32[n, steps, 9] of demonstrations, which touch and move things."""
    demonstrator, plan = KitchenDemonstrator(env, len(plans), 0.05), iter(plans)
    demonstrator._plan = lambda rng: next(plan)  # type: ignore[method-assign]
    *played, _ = play(env, demonstrator, np.zeros(len(plans), np.int8), steps)
    return np.stack([actions for _, actions, _ in played], axis=1)


def test_scripted_steps_equal_the_reference_bit_for_bit(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for actions in scripted_actions(env, [["kettle"], ["light switch"]], 60):
        expected = assert_the_same(env, actions, monkeypatch)
        assert expected["reward"].sum() == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitchen-mixed", "kitchen-partial"])
def test_two_thousand_scripted_steps_equal_the_reference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = kitchen(name)
    others = [subtask for subtask in SUBTASKS if subtask not in env.subtasks]
    plans = [[*np.roll(env.subtasks, shift), *others] for shift in range(4)]
    plans += [[env.subtasks[index % 4], *others] for index in range(6)]  # these end at the cap
    found = [
        assert_the_same(env, actions, monkeypatch, seed)
        for seed, actions in enumerate(scripted_actions(env, plans, 280))
    ]
    assert sum(len(episode["reward"]) for episode in found) >= 2000
    assert any(episode["terminated"][-1] for episode in found)
    assert sum(episode["reward"].sum() for episode in found) >= 16


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitchen-mixed", "kitchen-partial"])
def test_two_thousand_random_steps_equal_the_reference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = kitchen(name)
    for seed in range(8):
        assert_the_same(env, random_actions(280, 100 + seed), monkeypatch, seed)


def test_a_batch_equals_single_steps_and_a_saved_state_goes_on_where_it_was(
    env: Any, three: Any, tmp_path: Path
) -> None:
    actions = random_actions(6, 2)
    batch = np.repeat(actions[:, None], 3, axis=1)
    keys = jax.random.split(jax.random.key(5), 3)
    states = [three.reset(keys)]
    for action in (*batch, *batch[3:]):
        last = saved_and_restored(tmp_path, states[3]) if len(states) == 7 else states[-1]
        states.append(three.step(last, action))
    np.testing.assert_array_equal(states[6].obs, states[9].obs)
    assert len(np.unique(states[6].obs[:, 0])) == 3  # the sensors err differently
    _, singles, _ = played(env, actions, keys[1], None)
    np.testing.assert_array_equal(states[6].obs[1], singles.obs[-1])


def test_completed_subtasks_are_state_that_can_be_given_and_decide_reward_and_success(env: Any) -> None:
    assert env.subtasks == ("microwave", "kettle", "bottom burner", "light switch")
    extra = np.zeros((3, 7), np.int32)
    extra[1, [SUBTASKS.index("microwave"), SUBTASKS.index("top burner")]] = 1  # of which mixed asks for the first
    extra[2] = 1
    state = jax.jit(jax.vmap(lambda extra: env.reset_to(START_QPOS, np.zeros(29), extra=extra)))(extra)
    after = jax.jit(jax.vmap(env.step))(state, np.zeros((3, 9)))
    np.testing.assert_array_equal(after.pipeline_state.extra, extra)
    np.testing.assert_array_equal(after.reward, [-4, -3, 0])
    np.testing.assert_array_equal(after.metrics["score"], [0, 0.25, 1])
    np.testing.assert_array_equal(after.done, [0, 0, 1])
    assert env.distance_left(np.zeros((3, 30)), extra).tolist() == [4, 3, 0]
    rows: Any = SimpleNamespace(qpos=None, extra=extra)
    for labelled in (env.labels(rows), env.labels(SimpleNamespace(qpos=None, extra=jnp.asarray(extra)))):
        np.testing.assert_array_equal(labelled, [[-4, -3, 0], [1, 1, 0]])
    done = {name: value.tolist() for name, value in env.parts(rows).items()}
    assert done.pop("microwave") == [False, True, True] and set(done) == set(env.subtasks[1:])
    assert list(done.values()) == [[False, False, True]] * 3
    assert kitchen("kitchen-partial").score(extra).tolist() == [0, 0.25, 1]


def test_what_no_stop_holds_is_noticed(env: Any) -> None:
    qpos = np.tile(START_QPOS, (4, 1))
    rows: Any = SimpleNamespace(qpos=qpos, observations=np.zeros((4, 59), np.float32))
    seen = [*range(9), *range(18, 39)]
    rows.observations[:, seen] = qpos
    assert env.check_steps(rows) == []
    qpos[1, 22], qpos[2, 25] = 0.6, 0.9  # the microwave's door pushed in, the kettle on the floor
    rows.observations[:, seen] = qpos
    assert env.check_steps(rows) == [
        "microwave is beyond its range in 1 row (first 1)",
        "the kettle has fallen off the stove in 1 row (first 2)",
    ]


def test_an_evaluation_tells_the_share_of_the_four(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envs.Task, "episode_length", 4)  # three are completed in the first step, the kettle never
    qpos, qvel = almost_done()
    qvel[24] = 0
    monkeypatch.setattr(env, "reset", lambda key: env.reset_to(qpos, qvel, key=key))
    found = evaluate(env, lambda obs: obs[:1], lambda obs, latent, step: jnp.zeros(9), jax.random.key(0), 2, 2)
    assert found.score is not None and found.score.tolist() == [0.75, 0.75]
    members = jax.tree.map(lambda x: x[None], found)
    assert summary(members)["eval/score"].tolist() == [0.75] and summary(members)["eval/success"].tolist() == [0]
    done = {name: summary(members)[f"eval/done/{name}"].tolist() for name in env.subtasks}
    assert done == {"microwave": [1], "kettle": [0], "bottom burner": [1], "light switch": [1]}
    assert "eval/score" not in summary(members._replace(score=None))


def test_a_broken_state_is_reset_alone(three: Any) -> None:
    assert_reset_alone(three.reset(jax.random.split(jax.random.key(0), 3)), three.step, 9)


def test_gymnasium_makes_one_and_a_batch() -> None:
    single = gymnasium.make("qdos/kitchen-mixed-v0", disable_env_checker=True)
    check_env(single.unwrapped, skip_render_check=True)
    batch = gymnasium.make_vec("qdos/kitchen-mixed-v0", num_envs=3)
    assert batch.reset(seed=0)[0].shape == (3, 59)
    _, rewards, terminated, truncated, _ = batch.step(np.zeros((3, 9), np.float32))
    assert rewards.tolist() == [-4] * 3 and not (terminated | truncated).any()


@pytest.mark.usefixtures("opengl")
def test_a_picture_shows_the_arm_and_what_it_moves(env: Any) -> None:
    opened = START_QPOS.copy()
    opened[22] = -1.0
    with render.Renderer(env, 96) as renderer:
        shut, moved = renderer.frame(START_QPOS, ()), renderer.frame(opened, ())
    assert shut.shape == (96, 128, 3) and shut.std() > 20 and (shut != moved).any()


def test_doctor_says_where_the_models_are(monkeypatch: pytest.MonkeyPatch) -> None:
    passed, line = doctor._models()
    assert passed and "kitchen (gymnasium-robotics 1.4." in line and "not" not in line
    monkeypatch.setattr(doctor, "_MODELS", {"kitchen": "no-such-package"})
    passed, line = doctor._models()  # which is no fault of the machine's
    assert passed and line.startswith("models: mazes; not kitchen: no-such-package is not installed; run: pip install")


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r"gymnasium-robotics, which is not installed; run: pip install .*manipulation"
    ):
        envs.make("kitchen", physics="mujoco")
