"""DiveOff on a task with two equally good solutions among bad ones: it finds both, and only them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import DiveOffConfig
from qdos_brax.offline.diveoff import DiveOff
from qdos_brax.skills.values import ValueBatch
from tests.offline.gridworld import device_data
from tests.offline.training import train_members

SOLUTIONS = np.array([[0.6, 0.0], [-0.6, 0.0]])
FAILURES = np.array([[0.0, 0.6], [0.0, -0.6]])


def constant(width_in, biases):
    """Parameters of an MLP without hidden layers whose output is ``biases`` whatever its input."""
    return {"params": {"MLP_0": {"Dense_0": {"kernel": jnp.zeros((width_in, len(biases))), "bias": jnp.array(biases)}}}}


def test_the_losses_by_hand():
    learner = DiveOff(1, 1, 1, DiveOffConfig(hidden=(), batch_size=2))
    batch = ValueBatch(
        observation=jnp.array([[1.0], [0.0]]),
        action=jnp.array([[0.5], [0.0]]),
        reward=jnp.zeros(2),
        discount=jnp.zeros(2),
        next_observation=jnp.zeros((2, 1)),
    )
    mean, log_std = 0.5, -1.0
    encoder = constant(2, [mean, log_std])
    autoencoder = {"encoder": encoder, "decoder": constant(1, [0.2, -0.1])["params"]["MLP_0"]}
    autoencoder["decoder"] = {"params": autoencoder["decoder"]}
    key, weight = jax.random.key(0), jnp.array([2.0, 1.0])

    @jax.jit
    def look(sharpness):
        information = learner.information_loss(
            encoder, constant(2, [0.0]), batch.observation, jnp.array([[2.0], [0.0]])
        )
        return learner.autoencoder_loss(autoencoder, batch, weight, sharpness, key, 10.0), information

    # Reconstruction: mean of (0.8^2, 0.6^2) = 0.5 and of (0.2^2, 0.1^2) = 0.025, weighted: (2 x 0.5 + 0.025) / 2.
    # KL of N(0.5, e^-2) from N(0, 1): (e^-2 + 0.25 - 1) / 2 + 1.
    kl = (np.exp(-2) + 0.25 - 1) / 2 + 1
    loss, information = look(jnp.zeros(2))
    assert float(loss) == pytest.approx(0.5125 + 10 * 1.5 * kl, rel=1e-5)
    # An encoder that always says 0.5 is off by 1.5 and 0.5.
    assert float(information) == pytest.approx((1.5**2 + 0.5**2) / 2)
    # log q of its own sample: -eps^2 / 2 - log sigma - log(2 pi) / 2.
    eps = np.asarray(jax.random.normal(key, (2, 1)))[:, 0]
    sharp = -(eps**2) / 2 - log_std - np.log(2 * np.pi) / 2
    assert float(look(jnp.array([1.0, 3.0]))[0] - loss) == pytest.approx(-(sharp[0] + 3 * sharp[1]) / 2, rel=1e-4)


def near(actions, centres):
    """Share of actions[N, 2] within 0.3 of each of centres[C, 2], [C]."""
    return (np.linalg.norm(actions[:, None] - centres[None], axis=-1) < 0.3).mean(axis=0)


@pytest.mark.slow
def test_it_finds_both_solutions_and_no_failure():
    """Any state; half of the logged actions solve the task, one way or the other, half fail and cost 5.

    Without the weights (scale 0) failures are played too. z -> action is continuous, so that some z lie between the
    solutions.
    """
    rng = np.random.default_rng(0)
    kind = rng.integers(0, 4, 2000)
    actions = np.concatenate([SOLUTIONS, FAILURES])[kind] + 0.1 * rng.normal(size=(2000, 2))
    states = rng.uniform(-1, 1, (2000, 1))
    data = device_data(states, actions, rewards=np.where(kind < 2, 0.0, -5.0), masks=np.zeros(2000))
    learner = DiveOff(1, 2, 1, DiveOffConfig(hidden=(32, 32), batch_size=128, autoencoder_updates=300))
    hyper = {
        "skills.latent_box": 2.0,
        "diveoff.learning_rate": 3e-3,
        "diveoff.autoencoder_rate": 0.1,
        "diveoff.discount": 0.99,
        "diveoff.target_rate": 0.02,
        "diveoff.kl_weight": 0.1,
        "diveoff.information": 0.2,
    }
    scales = np.array([3.0, 0.0])
    hyper = {name: np.full(2, value) for name, value in hyper.items()} | {"diveoff.scale": scales}
    both = train_members(learner, data, hyper, 3000)

    @jax.jit
    @jax.vmap
    def play(state):
        latent = jnp.linspace(-1, 1, 1000)[:, None]  # the box that the authors evaluate on
        params, at = learner.params(state), jnp.zeros((1000, 1))
        action = learner.act(params, at, latent)
        return action, jnp.mean((learner.encode(params, at, action)[0] - latent) ** 2)

    actions, unread = map(np.asarray, play(both))
    for scale, played in zip(scales, actions, strict=True):
        print(f"scale {scale}: solutions {near(played, SOLUTIONS)}, failures {near(played, FAILURES)}")
    print("variance of z that its actions do not tell:", unread / (1 / 3))
    assert near(actions[0], SOLUTIONS).min() > 0.15 and near(actions[0], FAILURES).sum() < 0.03
    assert near(actions[1], FAILURES).sum() > 0.3
    assert unread[0] < 0.1 / 3
