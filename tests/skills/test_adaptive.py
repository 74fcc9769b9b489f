"""Alpha as a multiplier and lambda from a share of effective segments, against numbers derived by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.config import SkillsConfig
from qdos_brax.data.device import to_device
from qdos_brax.errors import UserError
from qdos_brax.skills.alpha import HIGHEST, LOWEST, AdaptiveAlpha, FixedAlpha, unreadable_share
from qdos_brax.skills.information import LoggedStates
from qdos_brax.skills.information_terms import SegmentTerm
from qdos_brax.skills.segment_weights import LoggedWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.temperature import effective_share, member_temperature, temperature_for
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.weights import advantage_weights, normal_scores
from tests.point import bound, point_config, point_dataset, run_phase

HYPER = {"skills.alpha": jnp.asarray(-1.0), "skills.alpha_rate": 0.01, "skills.alpha_error": 0.25}


def test_one_ascent_by_hand() -> None:
    """20 steps at rate 0.01 and 0.5 too much error: alpha grows by e^0.1; a member's own number stays."""
    part = AdaptiveAlpha()
    state = part.after_rollouts(part.start(), lambda: jnp.asarray(0.75), 20, HYPER)
    np.testing.assert_allclose(part.weight(state, HYPER), 0.2 * np.exp(0.1), rtol=1e-6)
    np.testing.assert_allclose(part.metrics(state, HYPER)["information_error"], 0.75)
    back = part.after_rollouts(state, lambda: jnp.asarray(0.0), 40, HYPER)
    np.testing.assert_allclose(part.weight(back, HYPER), 0.2, rtol=1e-6)  # 40 steps at 0.25 too little
    assert part.weight(state, HYPER | {"skills.alpha": jnp.asarray(0.3)}) == jnp.float32(0.3)


def test_alpha_stays_within_a_tenth_and_ten_times_its_start() -> None:
    part = AdaptiveAlpha()
    for error, bound_ in ((9.0, HIGHEST), (-9.0, LOWEST)):
        state = part.after_rollouts(part.start(), lambda error=error: jnp.asarray(error), 10_000, HYPER)
        np.testing.assert_allclose(part.weight(state, HYPER), bound_, rtol=1e-6)


def test_a_fixed_alpha_carries_and_measures_nothing() -> None:
    def fail() -> jax.Array:
        raise AssertionError

    part = FixedAlpha()
    assert part.start() == part.after_rollouts({}, fail, 20, HYPER) == part.metrics({}, HYPER) == {}


def test_the_error_is_one_where_nothing_can_be_read_back() -> None:
    """Parameters of zeros say z = 0; weights whose mean is not 1 do not count as error."""
    config = SkillsConfig(encoder_hidden=4, encoder_layers=1, decoder_hidden=(4,), prior_hidden=(4,), latent_dim=3)
    model = SkillModel(2, 2, config)
    params = jax.tree.map(jnp.zeros_like, model.init(jax.random.key(0)))
    latent = 2.0 * jax.random.uniform(jax.random.key(1), (4096, 3), minval=-1.0)
    weight = jnp.full(4096, 0.7)
    loss = jax.jit(model.information_loss)(params, jnp.zeros((4096, 2, 2)), latent, weight)
    error = unreadable_share(loss, weight, 2.0, 3)
    np.testing.assert_allclose(error, 1.0, atol=0.03)


def test_effective_shares_by_hand() -> None:
    np.testing.assert_allclose(effective_share(jnp.ones(5)), 1.0)
    np.testing.assert_allclose(effective_share(jnp.array([1.0, 0.0, 0.0, 0.0])), 0.25)
    np.testing.assert_allclose(effective_share(jnp.array([3.0, 1.0])), 16 / 10 / 2, rtol=1e-6)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_bisection_reaches_the_share(share: float) -> None:
    """Of normal scores the answer is known; of a skewed distribution under a clip the share itself is."""
    skewed = jax.random.exponential(jax.random.key(0), (20_000,))
    scores = normal_scores(skewed)
    np.testing.assert_allclose(temperature_for(scores, share, 1e9), 1 / np.sqrt(-np.log(share)), rtol=0.03)
    found = temperature_for(skewed, share, 20.0)
    np.testing.assert_allclose(effective_share(advantage_weights(skewed, found, 20.0)), share, rtol=1e-3)
    hyper = {"skills.effective_share": share, "skills.weight_clip": 20.0}
    given = member_temperature(skewed, hyper | {"skills.advantage_temperature": jnp.asarray(0.7)})
    assert given == jnp.float32(0.7)


def test_a_scan_may_mix_numbers_and_auto() -> None:
    """The multiplier of the one member moves and is logged, the other's alpha stays; both are found again by name."""
    asked = {"skills.alpha": "0.3,auto", "skills.advantage_temperature": "auto", "skills.mi_rollout": "logged"}
    config = point_config(**asked, **{"skills.updates": 20, "skills.mi_every": 5, "skills.alpha_rate": 0.01})
    assert [member["alpha"] for member in configs.members(config)] == [0.3, "auto"]
    np.testing.assert_allclose(configs.population_hyper(config)["skills.alpha"], [0.3, -1.0])
    assert configs.from_plain(configs.plain(config), "here") == config
    data, _ = to_device(point_dataset(20), 5)
    model = SkillModel(2, 2, config.skills)
    phase = bound(SkillPhase(config, model, LoggedWeights(), SegmentTerm(model, LoggedStates(5))), config, data)
    advantage = jnp.tile(normal_scores(jax.random.normal(jax.random.key(0), data.starts.shape)), (2, 1))
    state, history, _ = run_phase(phase, jax.random.split(jax.random.key(1), 2), {"advantage": advantage})
    alpha, error = history[-1]["information_weight"], history[-1]["information_error"]
    np.testing.assert_allclose(alpha[0], 0.3, rtol=1e-5)  # a mean over the chunk's steps
    assert abs(alpha[1] - 0.2) > 1e-3 and np.isfinite(error).all()
    np.testing.assert_allclose(history[-1]["weight_temperature"], 1 / np.sqrt(np.log(2)), rtol=0.1)
    assert np.all(np.isfinite(state.alpha["log_alpha"])) and state.update.tolist() == [20, 20]


def test_bad_values_are_one_clear_line_and_old_hashes_stay() -> None:
    with pytest.raises(UserError, match=r"skills\.alpha must be a number or auto, not 'automatic'"):
        point_config(**{"skills.alpha": "automatic"})
    with pytest.raises(UserError, match=r"skills\.kl_weight must be a number, not 'auto'"):
        point_config(**{"skills.kl_weight": "auto"})
    with pytest.raises(UserError, match=r"skills\.effective_share must be above 0 and at most 1, not 0"):
        point_config(**{"skills.effective_share": 0})
    with pytest.raises(UserError, match=r"needs skills\.mi_latent=box"):
        point_config(**{"skills.alpha": "auto", "skills.mi_latent": "played"})
    drawn = point_config(**{"skills.alpha": ["auto", 0.1], "scan.samples": 2})
    assert set(drawn.skills.alpha) == {"auto", 0.1}
    assert configs.config_hash(point_config()) != configs.config_hash(point_config(**{"skills.alpha": "auto"}))
