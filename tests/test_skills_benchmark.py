"""What ``benchmarks/skills.py`` measures of macro steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import skill_search
import skill_truths
import skills

import envs
from envs.body_frame import BodyFrame
from envs.brax_base import State


class Physics(NamedTuple):
    qpos: Any


class Seen(NamedTuple):
    obs: Any
    pipeline_state: Physics


def state(qpos: Any, observation: Any = None) -> Any:
    return Seen(observation, Physics(np.asarray(qpos)))


def engine(frame_skip: int) -> Any:
    return SimpleNamespace(frame_skip=frame_skip, model=SimpleNamespace(opt=SimpleNamespace(timestep=0.02)))


def test_every_body_has_two_seconds_to_get_away_from_a_wall() -> None:
    """20 steps of an ant, at 10 a second, and 80 of a humanoid, at 40."""
    for name, steps in (("antmaze-medium", 20), ("humanoidmaze-medium", 80)):
        assert skill_truths.MazeTruth(envs.make(name, physics="mujoco")).reach_steps == steps


def test_the_table_has_a_line_per_measure() -> None:
    """A run of another task may have others; what is missing is left empty."""
    rows = [{"task": "a", "spread": 0.25, "freed": 1.0}, {"task": "bc", "spread": 0.5}]
    assert skills.table(rows).splitlines() == ["task    a      bc", "spread  0.250  0.500", "freed   1.000"]


class Linear:
    """Skills whose latent's first number says what happens, turned by the state, as loudly as ``heard``."""

    horizon = 2

    def __init__(self, heard: float) -> None:
        self.heard, self.env = heard, SimpleNamespace(extra_size=0)

    def reset_to(self, qpos: Any, qvel: Any, extra: Any) -> Any:
        return state(qpos, jnp.asarray(qpos))

    def play(self, before: Any, key: jax.Array) -> dict[str, Any]:
        place = np.asarray(before.pipeline_state.qpos)
        latent = np.asarray(jax.random.normal(key, (8, len(place), 3)))
        moved = self.heard * latent[..., :1] * place[:, :1] + place[:, 1:]
        return {"end": state(np.concatenate([place[:, :1] + 0 * moved, moved], axis=-1)), "latent": latent}


class Moved:
    """A truth about such a world: the second number is where the body is."""

    reach_name, reach_steps = "moved", 0

    def left(self, states: Any) -> np.ndarray:
        return -states.pipeline_state.qpos[..., 1]

    def outcome(self, before: Any, after: Any) -> np.ndarray:
        return after.pipeline_state.qpos[..., 1:]

    def reach(self, before: Any, after: Any) -> np.ndarray:
        return np.abs(self.outcome(before, after)[..., 0]) > 0


def test_what_happens_is_told_by_the_latent_only_where_it_is_heard() -> None:
    """Var(z s) is 1 beside the state's own 1 (s of either sign, unit size): half of what happens is the state's."""
    rng = np.random.default_rng(0)
    place = np.stack([rng.choice([-1.0, 1.0], 400), rng.normal(size=400)], axis=-1)
    ends = np.arange(400) == 399
    dataset = SimpleNamespace(qpos=place, qvel=place, observations=place, extra=None, ends=ends)
    heard, deaf = (skills.from_logged_states(Linear(size), Moved(), dataset, 400) for size in (1.0, 0.0))
    np.testing.assert_allclose(heard["r2_outcome_of_state"], 0.5, atol=0.06)
    np.testing.assert_allclose(heard["r2_outcome_of_state_and_latent"], 1.0, atol=1e-3)
    np.testing.assert_allclose(deaf["r2_outcome_of_state"], 1.0, atol=1e-3)
    assert abs(deaf["r2_state_and_outcome"]) < 0.05 < heard["r2_state_and_outcome"]


def test_the_log_is_asked_from_the_same_states_and_to_its_episodes_end() -> None:
    """Two episodes: one that has moved by its third row, one that has not; two steps ahead, the horizon."""
    place = np.array([[1.0, y] for y in (0, 0, 5, 0, 0, 0, 0, 5)])
    ends = np.isin(np.arange(8), (4, 7))
    dataset = SimpleNamespace(qpos=place, qvel=place, extra=None, ends=ends)
    for rows, share in (([0, 5, 6, 7], 1.0), ([1, 2, 3, 4], 0.0), ([0, 3, 4, 1], 0.25)):
        before = state(place[rows])
        assert skills.share_reached_by_log(Linear(1.0), Moved(), dataset, before, np.array(rows)) == share


def test_an_outcome_counts_from_where_the_body_faces() -> None:
    """A body that moves along y gets 2 m ahead and 1 m to its right, whatever qpos holds beside its place."""
    truth = skill_truths.MazeTruth(SimpleNamespace(body_frame=BodyFrame(course=2), engine=engine(5)))
    before = state([[1.0, 1.0, 0.0]], jnp.array([[1.0, 1.0, 0.0, 0.5]]))
    after = state([[[2.0, 3.0, 0.0]], [[1.0, 1.0, 0.0]]])
    np.testing.assert_allclose(truth.outcome(before, after), [[[2.0, -1.0]], [[0.0, 0.0]]], atol=1e-6)


def test_with_a_ball_the_way_leads_around_it() -> None:
    """The goal lies east of the ball in an open arena: who stands a metre west of the ball has no way left to walk."""
    env = envs.make("antsoccer-arena-task1", physics="mujoco")
    truth = skill_truths.BallTruth(env)
    goal = np.asarray(env.goal_xy, float)
    qpos = np.zeros((3, 22))
    qpos[:, 15:17] = goal - [4.0, 0.0]
    for row, body in enumerate(([-5.0, 0.0], [-3.0, 0.0], [-5.0, 3.0])):
        qpos[row, :2] = goal + body
    np.testing.assert_allclose(truth.left(state(qpos)), [8.0, 2.0 + 8.0, 3.0 + 8.0], atol=1e-3)


class Walk:
    """Skills of two steps that go one to the left or one to the right; success is ``far`` to the right."""

    horizon = 2

    def __init__(self, far: int, length: int) -> None:
        self.far = far
        self.env = SimpleNamespace(episode_length=length, reset=self._reset)

    def _reset(self, key: jax.Array) -> State:
        zero = jnp.zeros(())
        return State(None, jnp.zeros(1), zero, zero, {"score": zero})

    def play(self, states: State, key: jax.Array) -> dict[str, Any]:
        place = states.obs[:, 0] + jax.random.rademacher(key, (len(states.obs),), jnp.float32)
        end = states.replace(obs=place[:, None], metrics={"score": place / self.far})
        success = place >= self.far
        row = {"end": end, "success": success, "score": place / self.far, "steps": jnp.where(success, 1, 2)}
        return jax.tree.map(lambda leaf: leaf[None], row)


class Line:
    """A truth about walks on a line: one gets away from 0 by getting more than 2.5 to either side."""

    reach_name, reach_steps = "away", 6

    def outcome(self, before: State, after: State) -> np.ndarray:
        return np.asarray(after.obs - before.obs)

    def reach(self, before: State, after: State) -> np.ndarray:
        return np.abs(self.outcome(before, after)[..., 0])[:, np.asarray(before.obs)[:, 0] == 0] > 2.5


class Both(Walk):
    """Skills of which two draws are tried: one step to the left, one to the right."""

    def play(self, states: State, key: jax.Array) -> dict[str, Any]:
        return {
            "end": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), states).replace(
                obs=states.obs + jnp.array([-1.0, 1.0])[:, None, None]
            )
        }


def test_short_skills_have_as_long_as_a_long_one_to_get_away() -> None:
    """Three skills of two steps lead 3 away, each from where the one before got furthest; one or two do not."""
    walk, truth = Both(30, 120), Line()
    zero = jnp.zeros(3)
    before = State(None, jnp.array([[0.0], [0.0], [9.0]]), zero, zero, {"score": zero})
    found = walk.play(before, jax.random.key(0))
    assert skills.share_reached(walk, truth, before, found) == 1.0
    for steps in (0, 2, 5):
        truth.reach_steps = steps
        assert skills.share_reached(walk, truth, before, found) == 0.0


def test_those_behind_go_on_from_those_ahead() -> None:
    """Score counts first, then what is left; all but the last quarter keep their state."""
    score = np.array([0.5, 0.0, 0.25, 0.5, 0.25, 0.0, 0.0, 0.0])
    left = np.array([4.0, 9.0, 7.0, 3.0, 5.0, 8.0, 6.0, 7.0])
    np.testing.assert_array_equal(skill_search.selection(score, left, 0.25), [0, 0, 2, 3, 4, 3, 6, 7])


def test_a_search_finds_what_chance_does_not() -> None:
    """A walk of 60 steps is 30 to the right with a probability of 2^-60; selection gets there, and says when."""
    walk = Walk(30, 120)
    found = skill_search.searches(walk, lambda states: 30 - np.asarray(states.obs[:, 0]), 2)
    assert found["search_success"] == 1 and found["search_score"] == 1
    # No way is shorter than 30 skills, the last of which succeeds in its first step.
    assert 59 <= found["search_steps"] <= 120 and found["search_steps"] % 2 == 1


def test_a_search_without_success_tells_the_best_score() -> None:
    """In 4 skills at most 4 of 30 can be gone."""
    found = skill_search.search(Walk(30, 8), lambda states: 30 - np.asarray(states.obs[:, 0]), 0)
    assert not found.success and np.isnan(found.steps)
    assert found.score == np.float32(4 / 30)
