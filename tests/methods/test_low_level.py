"""What segments are labelled with by each low-level policy, and every method as a program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.analysis.finished import evaluate_run
from qdos_brax.commands.train import train_main
from qdos_brax.config.methods import METHODS
from qdos_brax.nn.networks import gaussian_log_prob
from qdos_brax.skills.chunks import ActionChunks
from qdos_brax.skills.latent_map import Prior, latent_map
from qdos_brax.skills.low_level import DirectionSkills, TransitionSkills
from qdos_brax.skills.vae import Segments


def segments() -> tuple[Segments, jax.Array]:
    keys = jax.random.split(jax.random.key(0), 3)
    observations = jax.random.normal(keys[0], (4, 3, 2))
    actions = jax.random.uniform(keys[1], (4, 3, 2), minval=-1.0)
    return Segments(observations, actions), jax.random.normal(keys[2], (4, 2))


def test_an_action_is_its_own_label() -> None:
    source, (batch, after) = ActionChunks(2), segments()
    mean, log_std = source.posterior({}, batch, after)
    np.testing.assert_array_equal(mean + jnp.exp(log_std), batch.actions[:, 0])
    action = source.to_action({}, mean, after, 2.0)
    np.testing.assert_array_equal(source.act({}, after, source.to_latent({}, action, after, 2.0), 0), mean)


def test_a_direction_is_that_from_first_to_last_state() -> None:
    source = DirectionSkills(
        2, lambda p, a, b: (b - a) / jnp.linalg.norm(b - a, axis=-1, keepdims=True), lambda p, o, z: z
    )
    batch, after = segments()
    way = after - batch.observations[:, 0]
    latent = source.posterior({}, batch, after).mean
    np.testing.assert_allclose(latent, way / np.linalg.norm(way, axis=-1, keepdims=True), rtol=1e-5)
    action = source.to_action({}, 0.3 * latent, after, 2.0)  # every u that points there plays it
    np.testing.assert_allclose(source.to_latent({}, action, after, 2.0), latent, rtol=1e-5)


def test_a_segments_latent_is_the_mean_over_its_transitions() -> None:
    class Model:
        latent_dim = 2

        def prior(self, params: Any, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jnp.zeros_like(observation), jnp.zeros_like(observation)

        def act(self, params: Any, observation: jax.Array, latent: jax.Array) -> jax.Array:
            return latent

    source = TransitionSkills(Model(), lambda p, o, a: (o + a, jnp.full_like(a, jnp.log(0.3))), "box")
    batch, after = segments()
    mean, log_std = source.posterior({}, batch, after)
    np.testing.assert_allclose(mean, (batch.observations + batch.actions).mean(axis=1), rtol=1e-5)
    np.testing.assert_allclose(jnp.exp(log_std), 0.3 / np.sqrt(3), rtol=1e-5)


@pytest.mark.parametrize("name", ["arctanh", "box", "prior"])
def test_the_priors_density_over_actions_has_mass_one(name: str) -> None:
    """What a map changes of the density is its Jacobian: integrated over (-1, 1), what is left inside is left."""
    prior = Prior(jnp.array([0.2]), jnp.array([-1.0]))
    mapping = latent_map(name, 2.0)
    u = jnp.linspace(-1, 1, 200_001)[1:-1, None]
    density = jnp.exp(gaussian_log_prob(mapping.to_latent(u, prior), *prior) + mapping.log_jacobian(u, prior))
    inside = {"arctanh": 1.0, "box": 1.0, "prior": 0.9545}[name]  # two standard deviations
    np.testing.assert_allclose(jnp.trapezoid(density, u[:, 0]), inside, atol=1e-3)


# --- The real program ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_by_name_and_is_evaluated(method: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert train_main(["--env", "antmaze-medium", "--preset", "smoke", "--method", method, "--out", str(out)]) == 0
    (member,) = json.loads((out / "summary.json").read_text())["members"]
    assert member["status"] == "ok" and member["eval_episodes"] == 2
    (played,) = evaluate_run(out, 1)
    assert played["return"] >= -1000
