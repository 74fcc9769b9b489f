"""The macro step on an environment whose every number is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from qdos_brax.high_level.evaluation import Episodes, evaluate, summary
from qdos_brax.high_level.macro_step import macro_step, reset_done
from qdos_brax.skills.latent_map import Prior, latent_map

pytestmark = pytest.mark.quick


class Line(Env):
    """x grows by the action; success (read before the action) at x >= goal; a cap on steps. obs = [x]."""

    def __init__(self, goal=3.0, cap=100):
        self.goal, self.cap = goal, cap

    def reset(self, rng):
        zero, obs = jnp.zeros(()), jnp.zeros(1)
        info = {"truncation": zero, "final_obs": obs, "steps": jnp.zeros((), jnp.int32), "reset_key": rng}
        return State(zero, obs, zero, zero, {"success": zero}, info)

    def step(self, state, action):
        success = (state.pipeline_state >= self.goal).astype(jnp.float32)
        x = state.pipeline_state + action[0]
        steps = state.info["steps"] + 1
        capped = (steps >= self.cap).astype(jnp.float32)
        info = state.info | {"steps": steps, "truncation": capped * (1 - success), "final_obs": x[None]}
        return state.replace(
            pipeline_state=x, obs=x[None], reward=success - 1, done=jnp.maximum(success, capped),
            metrics={"success": success}, info=info,
        )  # fmt: skip

    observation_size = 1
    action_size = 1
    backend = "toy"


def play(env, horizon, discount, action=1.0, state=None):
    state = env.reset(jax.random.key(0)) if state is None else state
    return macro_step(env, lambda obs, step: jnp.full(1, action), state, horizon, discount)


def test_reward_is_discounted_and_the_mask_stays_without_an_end():
    _, result = play(Line(goal=100.0), horizon=4, discount=0.5)
    assert float(result.reward) == -1 - 0.5 - 0.25 - 0.125
    assert (float(result.mask), int(result.steps), float(result.success)) == (1.0, 4, 0.0)
    assert float(result.next_observation[0]) == 4.0 and float(result.episode_return) == -4.0


def test_success_ends_it_early_and_what_follows_idles():
    # x = 0, 1, 2, 3: the fourth step reads success, earns 0 and ends; the other two are not lived.
    state, result = play(Line(goal=3.0), horizon=6, discount=0.5)
    assert float(result.reward) == -1 - 0.5 - 0.25
    assert (float(result.mask), int(result.steps), float(result.success)) == (0.0, 4, 1.0)
    assert float(result.next_observation[0]) == 4.0 and float(state.pipeline_state) == 4.0


def test_the_cap_ends_it_early_but_bootstraps():
    _, result = play(Line(goal=100.0, cap=3), horizon=6, discount=1.0)
    assert (float(result.reward), float(result.mask), int(result.steps)) == (-3.0, 1.0, 3)
    assert float(result.next_observation[0]) == 3.0 and float(result.success) == 0.0


def test_a_finished_episode_gives_no_live_steps():
    state, _ = play(Line(goal=3.0), horizon=6, discount=1.0)
    _, result = play(Line(goal=3.0), horizon=6, discount=1.0, state=state)
    assert int(result.steps) == 0 and float(result.reward) == 0.0


class DenseLine(Line):
    """A reward that depends on x, which idle states lack, as MuJoCo C's lack qpos."""

    def step(self, state, action):
        new = super().step(state, action)
        return new.replace(reward=-state.pipeline_state)

    def idle(self, state, over):
        return state.replace(pipeline_state=jnp.where(over, jnp.nan, state.pipeline_state))


@pytest.mark.parametrize("env", [DenseLine(goal=2.0), DenseLine(goal=100.0, cap=3)])
def test_idle_steps_of_a_dense_reward_earn_nothing(env):
    # x = 0, 1, 2 before the three live steps; the other three are not lived.
    state = env.reset(jax.random.key(0))
    _, result = macro_step(env, lambda obs, step: jnp.ones(1), state, 6, 0.5, record=lambda step: step.reward)
    assert (int(result.steps), bool(result.finite)) == (3, True)
    assert float(result.reward) == -0.5 * 1 - 0.25 * 2
    assert float(result.episode_return) == -3.0
    np.testing.assert_array_equal(result.track, [0, -1, -2, 0, 0, 0])


def test_a_broken_simulation_is_told():
    _, result = play(Line(), horizon=2, discount=1.0, action=jnp.nan)
    assert not bool(result.finite)
    _, result = play(Line(), horizon=2, discount=1.0)
    assert bool(result.finite)


def test_reset_only_where_the_episode_is_over():
    env = Line(goal=3.0)
    over, _ = play(env, horizon=6, discount=1.0)
    going, _ = play(env, horizon=2, discount=1.0)
    assert float(reset_done(env, over, jnp.array(False), jax.random.key(1)).pipeline_state) == 0.0
    assert float(reset_done(env, going, jnp.array(False), jax.random.key(1)).pipeline_state) == 2.0
    assert float(reset_done(env, going, jnp.array(True), jax.random.key(1)).pipeline_state) == 0.0


@pytest.mark.parametrize(("goal", "success", "total", "length"), [(7.0, 1.0, -7.0, 8), (1000.0, 0.0, -20.0, 20)])
def test_evaluation_plays_whole_episodes(goal, success, total, length):
    env = Line(goal=goal, cap=20)
    episodes = evaluate(env, lambda obs: jnp.ones(1), lambda obs, z, step: z, jax.random.key(0), episodes=3, horizon=6)
    np.testing.assert_array_equal(episodes.success, [success] * 3)
    np.testing.assert_array_equal(episodes.episode_return, [total] * 3)
    np.testing.assert_array_equal(episodes.length, [length] * 3)
    assert episodes.score is None and "eval/score" not in summary(Episodes(*(x[None] for x in episodes[:3])))
    assert episodes.parts is None


class ScoredLine(Line):
    """The share of the way to the goal is a score."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(metrics=state.metrics | {"score": jnp.zeros(())})

    def step(self, state, action):
        state = super().step(state, action)
        return state.replace(metrics=state.metrics | {"score": jnp.minimum(state.pipeline_state / self.goal, 1.0)})


@pytest.mark.parametrize(("goal", "score"), [(8.0, 1.0), (40.0, 0.5)])
def test_a_score_is_that_of_the_episodes_end(goal, score):
    """Also where the last macro step reaches beyond it: 20 steps are three macro steps of 6, and two more."""
    env = ScoredLine(goal=goal, cap=20)
    episodes = evaluate(env, lambda obs: jnp.ones(1), lambda obs, z, step: z, jax.random.key(0), episodes=2, horizon=6)
    np.testing.assert_array_equal(episodes.score, [score] * 2)
    of_members = jax.tree.map(lambda x: x[None], episodes)
    assert summary(of_members)["eval/score"].tolist() == [score]


PRIOR = Prior(jnp.array([1.0, -1.0, 0.0]), jnp.log(jnp.array([0.5, 1.0, 2.0])))


@pytest.mark.parametrize("name", ["arctanh", "box", "prior"])
def test_latent_maps_are_inverses_and_labels_stay_inside(name):
    mapping = latent_map(name, 2.0)
    u = jnp.array([-0.9, 0.0, 0.5])
    np.testing.assert_allclose(mapping.to_action(mapping.to_latent(u, PRIOR), PRIOR), u, atol=1e-6)
    assert float(jnp.max(jnp.abs(mapping.to_action(jnp.array([50.0, -50.0, 50.0]), PRIOR)))) < 1.0


def test_latent_maps_by_hand():
    u = jnp.array([0.5, 0.5, 0.5])
    np.testing.assert_allclose(latent_map("arctanh", 2.0).to_latent(u, PRIOR), [0.5493061] * 3, rtol=1e-5)
    np.testing.assert_allclose(latent_map("box", 2.0).to_latent(u, PRIOR), [1.0] * 3)
    np.testing.assert_allclose(latent_map("prior", 2.0).to_latent(u, PRIOR), [1.5, 0.0, 2.0], rtol=1e-6)
