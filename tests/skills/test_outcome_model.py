"""Skills that are outcomes: what z says, what the decoder is shown of it, and that it makes it happen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from envs.body_frame import BodyFrame
from qdos_brax.config import SkillsConfig
from qdos_brax.config.load import load_config
from qdos_brax.data.device import DeviceData, Normaliser
from qdos_brax.data.segments import rows_ahead
from qdos_brax.errors import UserError
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.population.members import Population
from qdos_brax.skills.low_level import TrajectorySkills
from qdos_brax.skills.outcome_model import OutcomeModel
from qdos_brax.skills.vae import segments_at

pytestmark = pytest.mark.quick
FRAME = BodyFrame(heading=2, points=(6,))  # x, y, quaternion, x and y of a ball
SIZES = SkillsConfig(
    horizon=2, outcome_steps=4, latent_dim=4, decoder_hidden=(32,), prior_hidden=(16,), encoder_hidden=4
)
NORMALISER = Normaliser(jnp.linspace(-1, 1, 8), jnp.linspace(0.5, 2, 8))
STEP = 0.5  # m


def observation(x: float, y: float, yaw: float, ball: tuple[float, float]) -> jax.Array:
    """Return an observation in its own units."""
    return jnp.array([x, y, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2), *ball])


def walks(count: int = 64, steps: int = 6, turn: float = 0.0) -> tuple[DeviceData, Any]:
    """Return episodes of a body that faces anywhere and goes one way, told by its action as it sees it; the ball stays.

    Everything is turned by ``turn``.
    """
    rng = np.random.default_rng(0)
    yaw, way = rng.uniform(-3, 3, (2, count, 1)) + turn * np.array([1, 1])[:, None, None]
    place = rng.normal(size=(count, 2)) @ [1, 1j] * np.exp(1j * turn)
    ball = rng.normal(size=(count, 2)) @ [1, 1j] * np.exp(1j * turn)
    path = place[:, None] + STEP * np.exp(1j * way) * np.arange(steps + 1)
    heading, zero = np.broadcast_to(yaw, path.shape), np.zeros(path.shape)
    ball = np.broadcast_to(ball[:, None], path.shape)
    columns = [path.real, path.imag, np.cos(heading / 2), zero, zero, np.sin(heading / 2), ball.real, ball.imag]
    seen = NORMALISER(jnp.asarray(np.stack(columns, axis=-1), jnp.float32))
    command = np.broadcast_to(np.exp(1j * (way - yaw)), (count, steps))
    actions = jnp.asarray(np.stack([command.real, command.imag], axis=-1).reshape(-1, 2), jnp.float32)
    rows = count * steps
    starts = (np.arange(count)[:, None] * steps + np.arange(steps - 1)).ravel()
    data = DeviceData(
        observations=seen[:, :-1].reshape(rows, 8),
        next_observations=seen[:, 1:].reshape(rows, 8),
        actions=actions,
        rewards=-jnp.ones(rows),
        masks=jnp.ones(rows),
        starts=jnp.asarray(starts, jnp.int32),
        last=jnp.asarray(np.repeat(np.arange(count) * steps + steps - 1, steps), jnp.int32),
        qpos=None,
        qvel=None,
    )
    return data, path


def model_and_params(data: DeviceData) -> tuple[OutcomeModel, Any]:
    model = OutcomeModel(8, 2, SIZES, FRAME)
    windows = segments_at(data, data.starts, 2, None).observations
    return model, model.init(jax.random.key(0), model.view.fit(windows, NORMALISER))


def test_ways_are_counted_in_the_worlds_axes_and_seen_turned() -> None:
    before, after = observation(1, 2, 0.3, (5, 5)), observation(4, 2, 1.0, (5, 6))
    ways = FRAME.ways(before, after)
    np.testing.assert_allclose(ways, [3, 0, 0, 1])
    facing_up = FRAME.pose(observation(0, 0, np.pi / 2, (0, 0)))
    # What lies east is to the right of a body that faces north, what lies north is ahead of it.
    np.testing.assert_allclose(FRAME.turned_ways(ways, facing_up), [0, -3, 1, 0], atol=1e-6)
    assert FRAME.ways_size == 4 and BodyFrame(heading=2).ways_size == 2


def test_a_level_is_told_as_it_will_be_and_no_turn_changes_it() -> None:
    """The last number of the observation, 6 now and 7 then."""
    frame = BodyFrame(heading=2, levels=(7,))
    ways = frame.ways(observation(1, 2, 0.3, (0, 6)), observation(1, 4, 1.0, (0, 7)))
    np.testing.assert_allclose(ways, [0, 2, 7])
    facing_up = frame.pose(observation(0, 0, np.pi / 2, (0, 0)))
    np.testing.assert_allclose(frame.turned_ways(ways, facing_up), [2, 0, 7], atol=1e-6)
    assert frame.ways_size == 3


def test_the_prior_of_a_level_is_told_the_present_one_and_of_ways_nothing_of_other_numbers() -> None:
    frame = BodyFrame(heading=2, levels=(7,))
    model = OutcomeModel(8, 2, replace(SIZES, latent_dim=3), frame)
    windows = segments_at(walks()[0], jnp.arange(0, 384, 6), 2, None).observations
    params = model.init(jax.random.key(0), model.view.fit(windows, NORMALISER))
    here = windows[:, 0]
    same, other = here.at[:, 6].add(1.0), here.at[:, 7].add(1.0)
    np.testing.assert_array_equal(model.prior(params, here)[0], model.prior(params, same)[0])
    assert np.all(np.abs(model.prior(params, here)[0] - model.prior(params, other)[0]).max(axis=-1) > 1e-4)


def test_the_row_ahead_never_leaves_the_episode() -> None:
    last = jnp.array([3, 3, 3, 3, 9, 9, 9, 9, 9, 9])
    np.testing.assert_array_equal(rows_ahead(jnp.array([0, 2, 3, 4, 7]), last, 4), [3, 3, 3, 7, 9])


def test_the_posterior_is_what_happens_in_so_many_steps_or_until_the_episode_ends() -> None:
    data, path = walks()
    model, params = model_and_params(data)
    posterior = model.encode(params, segments_at(data, data.starts, SIZES.horizon, model.reach))
    first = np.asarray(data.starts) % 6
    way = path[np.arange(64).repeat(5), np.minimum(first + 4, 6)] - path[:, :5].ravel()
    expected = np.stack([way.real, way.imag, 0 * way.real, 0 * way.real], axis=-1)
    np.testing.assert_allclose(posterior.mean, expected, atol=1e-5)
    assert np.all(np.isneginf(np.asarray(posterior.log_std)))


def test_labels_play_that_outcome() -> None:
    data, _ = walks()
    model, params = model_and_params(data)
    skills = TrajectorySkills(model, "box")
    phase = LabelPhase(SIZES.horizon, len(data.starts), skills)
    phase.bind(Population({"skills.latent_box": np.full(1, 20.0, np.float32)}, 1), data)
    state, constants = phase.init(
        jax.random.split(jax.random.key(0), 1), {"skills": jax.tree.map(lambda x: x[None], params)}
    )
    while int(state.update[0]) < len(data.starts):
        state, _ = phase.chunk(state, constants)
    outcome = model.encode(params, segments_at(data, data.starts, SIZES.horizon, model.reach)).mean
    np.testing.assert_allclose(20 * phase.finish(state, {})["labels"][0], outcome, atol=1e-4)


def test_the_loss_is_that_of_first_actions_and_of_the_prior() -> None:
    data, _ = walks(4)
    model, params = model_and_params(data)
    segments = segments_at(data, data.starts[:3], SIZES.horizon, model.reach)
    weight = jnp.array([0.0, 0.5, 2.5])
    outcome = model.encode(params, segments).mean
    actor, prior = (
        [np.asarray(part, np.float64) for part in gaussian]
        for gaussian in (
            model.decode(params, segments.observations[:, 0], outcome),
            model.prior(params, segments.observations[:, 0]),
        )
    )
    likely = norm.logpdf(np.asarray(segments.actions[:, 0]), actor[0], np.exp(actor[1])).sum(axis=-1)
    known = norm.logpdf(np.asarray(outcome), prior[0], np.exp(prior[1])).sum(axis=-1)
    for weighted, share in ((True, np.asarray(weight)), (False, np.ones(3))):
        loss, _ = model.vae_loss(params, segments, weight, 0.3, jax.random.key(0), weighted)
        np.testing.assert_allclose(loss, np.mean(-0.3 * share * known - np.asarray(weight) * likely), rtol=1e-4)


def test_skills_are_the_same_wherever_they_begin_and_whichever_way_the_body_faces() -> None:
    here, there = walks()[0], walks(turn=2.0)[0]
    model, params = model_and_params(here)
    outcome = jax.random.normal(jax.random.key(1), (len(here.starts), 4))
    turned = FRAME.turned_ways(outcome, jnp.array([0.0, 0.0, np.cos(-2.0), np.sin(-2.0)]))
    actions = [
        model.act(params, data.observations[data.starts], latent) for data, latent in ((here, outcome), (there, turned))
    ]
    np.testing.assert_allclose(*actions, atol=1e-4)


def test_the_decoder_makes_happen_what_it_is_told_and_the_prior_knows_how_far_things_get() -> None:
    data, _ = walks(512)
    model, params = model_and_params(data)
    starts = data.starts[data.starts % 6 < 3]  # four steps lie ahead

    @jax.jit
    def learn(params: Any, key: jax.Array) -> Any:
        def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
            params, opt_state = carry
            some = starts[jax.random.randint(key, (128,), 0, len(starts))]
            segments = segments_at(data, some, SIZES.horizon, model.reach)
            grads = jax.grad(lambda p: model.vae_loss(p, segments, jnp.ones(128), 1.0, key, True)[0])(params)
            return adam_step(params, opt_state, grads, 3e-3), None

        return jax.lax.scan(step, (params, ADAM.init(params)), jax.random.split(key, 1_500))[0][0]

    params = learn(params, jax.random.key(3))
    here = data.observations[starts[:50]]
    for angle in (0.0, 1.5, 3.0):  # asked for in the world's axes, wherever the body faces
        way = 4 * STEP * jnp.array([np.cos(angle), np.sin(angle)])
        command = model.act(params, here, jnp.broadcast_to(jnp.concatenate([way, jnp.zeros(2)]), (50, 4)))
        facing = FRAME.pose(NORMALISER.restored(here))[:, 2:]
        towards = (command[:, 0] + 1j * command[:, 1]) * (facing[:, 0] + 1j * facing[:, 1])
        np.testing.assert_allclose(np.angle(np.asarray(towards) * np.exp(-1j * angle)), 0, atol=0.3)
    mean, log_std = model.prior(params, here)
    assert np.abs(np.asarray(mean).mean(axis=0)).max() < 0.5
    spread = np.sqrt(2) * STEP * 2  # of a point on a circle of four steps, in x and in y
    np.testing.assert_allclose(np.exp(np.asarray(log_std))[:, :2].mean(), spread, rtol=0.25)
    assert np.exp(np.asarray(log_std))[:, 2:].max() < 0.1  # the ball stays


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["skills.view=start"], "skills.model=outcome needs skills.view=body, not start"),
        (["skills.mi_encoder=segment"], "skills.model=outcome needs skills.mi_encoder=outcome"),
        (["skills.mi_rollout=logged", "skills.alpha=0.3"], "skills.mi_encoder=outcome needs skills.mi_rollout=physics"),
    ],
)
def test_settings_that_do_not_go_with_outcomes_are_named(settings: list[str], message: str) -> None:
    whole = ["skills.model=outcome", "skills.view=body", "skills.mi_encoder=outcome", "skills.horizon=10"]
    with pytest.raises(UserError, match=message):
        load_config("antsoccer", "paper", sets=[*whole, *settings])


def test_a_task_without_ways_and_a_latent_of_another_size_are_refused() -> None:
    with pytest.raises(UserError, match="tells no ways of bodies"):
        OutcomeModel(8, 2, SIZES, None)
    with pytest.raises(UserError, match=r"outcomes of this task have 4 numbers, skills.latent_dim is 8"):
        OutcomeModel(8, 2, replace(SIZES, latent_dim=8), FRAME)
