"""The planner's rules on states placed by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.collection.rollout_state import RolloutState
from qdos_brax.data.quality import QUALITY
from tests.collection.stand_ins import collector

KINDS = jnp.zeros(32, jnp.int8)


def starts() -> RolloutState:
    return collector("antsoccer-arena", "stitch").reset(jax.random.split(jax.random.key(0), 32))


def test_stitch_begins_four_cells_from_its_goal_and_half_of_it_at_the_ball() -> None:
    states, layout = starts(), collector("antsoccer-arena", "stitch").env.layout
    qpos = states.pipeline.qpos
    target_object = np.where(states.has_ball[:, None], qpos[:, 15:17], qpos[:, :2])
    steps = np.abs(layout.xy_to_ij(target_object) - layout.xy_to_ij(np.asarray(states.goal_xy))).sum(axis=1)
    assert (steps == 4).all()  # an open field: cells to go are those of rows and columns
    assert 4 < int(states.has_ball.sum()) < 28


def test_stitch_keeps_its_goal_and_navigate_draws_another() -> None:
    states, planner = starts(), collector("antsoccer-arena", "stitch").planner
    at_goal = states.replace(has_ball=jnp.zeros(32, bool), goal_xy=states.pipeline.qpos[:, :2])
    draws = jax.vmap(planner.draw)(jax.random.split(jax.random.key(1), 32))  # the same of every recipe
    after = jax.jit(jax.vmap(planner.plan))(at_goal, KINDS, draws)
    np.testing.assert_array_equal(after.goal_xy, at_goal.goal_xy)
    navigate = collector("antsoccer-arena", "navigate").planner
    after = jax.jit(jax.vmap(navigate.plan))(at_goal, KINDS, draws)
    assert after.arrivals.tolist() == [1] * 32 and not np.array_equal(after.goal_xy, at_goal.goal_xy)


def test_explore_keeps_its_heading_for_a_second() -> None:
    states, planner = starts(), collector("antsoccer-arena", "explore").planner
    plan = jax.jit(jax.vmap(planner.plan))
    draws = jax.vmap(planner.draw)(jax.random.split(jax.random.key(2), 32))
    for steps, changes in ((10, True), (11, False), (19, False), (20, True)):
        after = plan(states.replace(episode_steps=jnp.full(32, steps)), KINDS + QUALITY["wander"], draws).heading
        assert bool((after != states.heading).any(axis=1).all()) == changes == bool((after != states.heading).any())


def test_a_failing_attempt_turns_half_way_and_takes_a_new_goal_when_it_is_back() -> None:
    planner = collector("antsoccer-arena", "navigate").planner
    plan = jax.jit(jax.vmap(planner.plan))
    draws = jax.vmap(planner.draw)(jax.random.split(jax.random.key(3), 32))
    here = starts().pipeline.qpos[:, :2]
    on_way = starts().replace(has_ball=jnp.zeros(32, bool), origin_xy=here - 3.0, goal_xy=here + 4.0)
    fails = KINDS + QUALITY["fail"]
    assert not plan(on_way, fails, draws).returning.any()
    past_half = on_way.replace(goal_xy=here + 2.0)
    assert not plan(past_half, KINDS, draws).returning.any()  # the expert goes on
    turned = plan(past_half, fails, draws)
    assert turned.returning.all() and not turned.attempt_steps.any()
    np.testing.assert_array_equal(turned.goal_xy, past_half.goal_xy)
    back = plan(turned.replace(origin_xy=here + 0.1), fails, draws)
    assert not back.returning.any()
    np.testing.assert_array_equal(back.goal_xy, draws.goal_xy)
    np.testing.assert_array_equal(back.origin_xy, here)


def test_a_body_that_hardly_moved_walks_elsewhere() -> None:
    planner = collector("antsoccer-arena", "navigate").planner
    plan = jax.jit(jax.vmap(planner.plan))
    draws = jax.vmap(planner.draw)(jax.random.split(jax.random.key(4), 32))
    states = starts().replace(episode_steps=jnp.full(32, 60))  # six seconds: the time of a check
    here = states.pipeline.qpos[:, :2]
    stuck = plan(states.replace(checked_body=here + 0.1), KINDS, draws)
    assert (stuck.escape_steps == 30).all()
    np.testing.assert_array_equal(stuck.escape_xy, draws.escape_xy)
    np.testing.assert_array_equal(stuck.goal_xy, draws.goal_xy)
    moved = states.replace(has_ball=jnp.zeros(32, bool), checked_body=here + 1.0)
    assert not plan(moved, KINDS, draws).escape_steps.any()
    between = states.replace(checked_body=here, episode_steps=jnp.full(32, 61))
    assert not plan(between, KINDS, draws).escape_steps.any()
