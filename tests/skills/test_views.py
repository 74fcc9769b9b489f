"""What skills see: in the frame of the start, a skill does the same wherever and whichever way it begins."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.body_frame import BodyFrame
from qdos_brax.config import SkillsConfig
from qdos_brax.data.device import Normaliser
from qdos_brax.errors import UserError
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.skills.vae import Segments, SkillModel
from qdos_brax.skills.views import make_view

pytestmark = pytest.mark.quick
FRAME = BodyFrame(heading=2, vectors=(6,))  # x, y, quaternion, velocity
SIZES = SkillsConfig(encoder_hidden=8, encoder_layers=1, decoder_hidden=(16,), prior_hidden=(16,), latent_dim=2)
NORMALISER = Normaliser(jnp.linspace(-1, 1, 8), jnp.linspace(0.5, 2, 8))


def walks(turn: float, shift: complex) -> jax.Array:
    """Return observations[B, H, 8] of walks on curves, in a world that is turned and shifted; normalised."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(-3, 3, (32, 1)) + np.cumsum(rng.normal(0, 0.3, (32, 6)), axis=1)
    place = rng.normal(size=(32, 1)) + np.cumsum(np.exp(1j * heading), axis=1)
    place, heading = place * np.exp(1j * turn) + shift, heading + turn
    zero, speed = np.zeros_like(heading), np.exp(1j * heading)
    columns = [place.real, place.imag, np.cos(heading / 2), zero, zero, np.sin(heading / 2), speed.real, speed.imag]
    return NORMALISER(jnp.asarray(np.stack(columns, axis=-1), jnp.float32))


HERE, THERE = walks(0.0, 0.0), walks(2.0, 5 - 3j)


def skills(name: str) -> tuple[SkillModel, Any]:
    model = SkillModel(8, 3, SIZES, make_view(name, FRAME))
    return model, model.init(jax.random.key(0), model.view.fit(HERE, NORMALISER))


def everything(name: str, observations: jax.Array) -> dict[str, np.ndarray]:
    """Return posterior, prior and decoded actions along segments."""
    model, params = skills(name)
    actions = jax.random.normal(jax.random.key(1), (*observations.shape[:2], 3))
    latent = jax.random.normal(jax.random.key(2), (len(observations), 2))
    found = {
        "posterior": model.encode(params, Segments(observations, actions)).mean,
        "prior": model.prior(params, observations[:, 0])[0],
        "actions": model.decode_along(params, observations, latent)[0],
    }
    return {key: np.asarray(value) for key, value in found.items()}


@pytest.mark.parametrize("name", ["start", "body"])
def test_skills_are_the_same_wherever_they_begin(name: str) -> None:
    here, there = everything(name, HERE), everything(name, THERE)
    for part in here:
        np.testing.assert_allclose(here[part], there[part], atol=2e-4, err_msg=part)


def test_the_worlds_view_tells_places_and_headings_apart() -> None:
    here, there = everything("world", HERE), everything("world", THERE)
    assert all(np.abs(here[part] - there[part]).max() > 0.05 for part in here)


def test_the_start_is_remembered_and_the_body_forgets_it() -> None:
    """The same present observation after two starts: another action from the start, the same from the body."""
    for name, size, same in (("start", 4, False), ("body", 0, True), ("world", 0, True)):
        model, params = skills(name)
        begun = [model.begin(params, jnp.zeros(2), HERE[i, 0]) for i in (0, 1)]
        actions = [model.act(params, HERE[0, 3], skill) for skill in begun]
        assert begun[0].shape == (2 + size,)
        assert np.allclose(*actions) == same


def test_what_is_seen_has_mean_0_and_deviation_1_over_the_data() -> None:
    view = make_view("start", FRAME)
    params = view.fit(HERE, NORMALISER)
    seen = np.asarray(view.see(params, HERE, view.pose(params, HERE[:, 0])[:, None]))
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), 0, atol=1e-4)
    varies = [0, 1, 2, 5, 6, 7]
    np.testing.assert_allclose(seen.std(axis=(0, 1))[varies], 1, rtol=1e-3)


def test_training_leaves_what_the_view_knows_as_it_is() -> None:
    model, params = skills("start")
    segments = Segments(HERE, jnp.zeros((*HERE.shape[:2], 3)))
    loss = lambda p: model.vae_loss(p, segments, jnp.ones(32), 0.1, jax.random.key(0), True)[0]  # noqa: E731
    after, _ = adam_step(params, ADAM.init(params), jax.grad(loss)(params), 1e-2)
    moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), params, after)
    assert not any(jax.tree.leaves(moved["view"])) and any(jax.tree.leaves(moved["decoder"]))


def test_a_task_without_a_frame_says_what_helps() -> None:
    with pytest.raises(UserError, match=r"offers no frame .* --set skills.view=world"):
        make_view("start", None)
