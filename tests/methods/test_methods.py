"""Every method builds; flat methods learn, guide, go on after a crash, and are evaluated."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.config.methods import METHODS
from qdos_brax.config.methods import settings as method_settings
from qdos_brax.data.device import to_device
from qdos_brax.data.transitions import Transition
from qdos_brax.errors import UserError
from qdos_brax.high_level.acting import Acting
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.learning import Sources
from qdos_brax.high_level.replay import insert
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.skill_learning import FrozenSkills
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.methods.build import build_context, build_phases
from qdos_brax.nn.networks import gaussian_log_prob
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.loop import run_phases
from qdos_brax.skills.chunks import ActionChunks
from qdos_brax.skills.latent_map import Prior, latent_map
from tests.point import (
    GOAL,
    STEP,
    TOLERANCE,
    PointEnv,
    bound,
    first_member,
    point_config,
    point_dataset,
    run_phase,
)

PHASES = {
    "qdos": ["values", "skills", "label", "online"],
    "supe": ["skills", "label", "online"],
    "trajectory-skills": ["skills", "online"],
    "explore": ["label", "online"],
    "rlpd": ["label", "online"],
    "hilp": ["skills", "label", "online"],
    "hilp-online": ["skills", "online"],
    "diffusion-jsrl": ["guide", "online"],
    "iql": ["policy"],
    "bc": ["policy"],
    "diveoff": ["skills", "label", "online"],
    "qc": ["agent", "label", "online"],
    "qc-fql": ["agent", "label", "online"],
    "fql": ["agent", "label", "online"],
    "dsrl": ["skills", "online"],
    "wsrl": ["label", "agent", "online"],
}


def config_of(method: str, **values: Any) -> configs.Config:
    """The plane's configuration for a method."""
    horizon = method_settings(method, "antmaze").get("skills.horizon", 5)
    return point_config(**{"method": method, "skills.horizon": horizon, "values.n_step": horizon} | values)


def phases_of(config: configs.Config, dataset: Any) -> list[Any]:
    context = build_context(config, PointEnv(), dataset)
    return [bound(phase, config, context.data) for phase in build_phases(context)]


def test_every_method_of_the_issue_is_there() -> None:
    assert set(METHODS) == set(PHASES)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_builds_its_phases(method: str) -> None:
    phases = phases_of(config_of(method), point_dataset(20))
    assert [phase.name for phase in phases] == PHASES[method]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("family", configs.families())
def test_every_method_has_values_for_every_family(method: str, family: str) -> None:
    """Published values are those of the configuration, and stand below the preset and ``--set``."""
    published = method_settings(method, family)
    layers = configs.family_layers(family, method, "paper")
    config = configs.from_layers(layers)
    for key, value in published.items():
        found = configs.schema.get(config, key)
        assert found == (tuple(value) if isinstance(value, list) else value), key
    own = configs.from_layers([*layers, configs.Layer("--set", {"labels.rnd_coefficient": 3})])
    assert own.labels.rnd_coefficient == 3.0


def test_published_values() -> None:
    maze = {method: configs.load_config("antmaze-large", "paper", {"method": method}) for method in METHODS}
    assert maze["supe"].labels.offline_reward == maze["explore"].labels.offline_reward == "min"
    assert maze["qdos"].labels.offline_reward == maze["rlpd"].labels.offline_reward == "data"
    assert (maze["explore"].labels.rnd_coefficient, maze["rlpd"].labels.rnd_coefficient) == (2.0, 0.0)
    assert maze["trajectory-skills"].high_level.offline_fraction == 0.0
    assert (maze["diffusion-jsrl"].guide.ratio, maze["iql"].policy.inverse_temperature) == (0.9, 10.0)
    kitchen = {method: configs.from_layers(configs.family_layers("kitchen", method, "paper")) for method in METHODS}
    assert kitchen["supe"].labels.offline_reward == kitchen["hilp"].labels.offline_reward == "pred"
    assert (kitchen["diffusion-jsrl"].guide.ratio, kitchen["iql"].values.expectile) == (0.75, 0.7)
    warm = maze["wsrl"].high_level
    assert (warm.warmup_env_steps, warm.ensemble, warm.target_subset, warm.utd) == (5_000, 10, 2, 4)
    assert (warm.offline_fraction, warm.batch_size, maze["wsrl"].flow.updates) == (0.0, 256, 1_000_000)
    assert (kitchen["wsrl"].values.expectile, kitchen["wsrl"].flow.updates) == (0.7, 250_000)


@pytest.mark.parametrize("preset", ["cpu", "paper"])
@pytest.mark.parametrize(
    ("task", "discount"),
    [("antmaze-medium", 0.99), ("antsoccer", 0.995), ("cube-single", 0.99), ("scene", 0.99), ("kitchen-mixed", 0.99)],
)
def test_flows_learn_as_published_whatever_the_preset(preset: str, task: str, discount: float) -> None:
    """Two critics, the discount of a control step, data and experience in one buffer (Q-chunking, FQL)."""
    for method in ("qc", "qc-fql", "fql"):
        high = configs.from_layers(configs.run_layers(task, preset, {"method": method})).high_level
        assert (high.ensemble, high.discount, high.offline_fraction) == (2, discount, "auto"), method


@pytest.mark.parametrize("preset", ["cpu", "paper", "smoke"])
def test_rivals_with_a_bonus_have_the_labels_of_supes_code_in_every_preset(preset: str) -> None:
    """Of normalised observations the bonus is small, and supe found no goal of antmaze-large (results.md)."""
    for method in ("supe", "explore", "hilp", "hilp-online", "trajectory-skills", "diffusion-jsrl"):
        labels = configs.load_config("antmaze-large", preset, {"method": method}).labels
        assert (labels.inputs, labels.latent) == ("raw", "mean"), method


def test_a_flat_method_refuses_skills() -> None:
    with pytest.raises(UserError, match=r"rlpd has no skills.*horizon must stay 1, not 5"):
        phases_of(config_of("rlpd", **{"skills.horizon": 5}), point_dataset(20))


# --- The flat learner, on a task whose optimum is known ------------------------------------------------------


def fewest_steps(start: np.ndarray) -> int:
    """Steps from ``start`` until the task is over: each coordinate moves at most STEP, success is read a step later."""
    for moves in range(100):
        gap = np.maximum(np.abs(GOAL - start) - moves * STEP, 0)
        if np.linalg.norm(gap) <= TOLERANCE:
            return moves + 1
    raise AssertionError


def mean_fewest_steps() -> float:
    """Of starts as the task draws them."""
    starts = 0.1 * np.random.default_rng(0).normal(size=(1000, 2))
    return float(np.mean([fewest_steps(start) for start in starts]))


def test_rlpd_reaches_the_optimum_of_the_plane() -> None:
    config = config_of(
        "rlpd",
        **{
            "high_level.env_steps": 2_000,
            "high_level.utd": 4,
            "high_level.learning_rate": 1e-3,
            "high_level.target_rate": 0.02,
            "high_level.warmup_env_steps": 200,
            "eval.episodes": 50,
            "eval.every_env_steps": 2_000,
        },
    )
    artifacts: dict[str, Any] = {}
    for phase in phases_of(config, point_dataset()):
        _, history, artifacts = run_phase(phase, jax.random.split(jax.random.key(0), 1), artifacts)
        metrics = history[-1]
    best = mean_fewest_steps()
    assert 8 < best < 10
    assert metrics["eval/success"][0] == 1.0
    assert metrics["eval/length"][0] < best + 1.0


# --- The guide -------------------------------------------------------------------------------------------------


def test_the_guides_steps_are_geometric() -> None:
    """P(0) = 1 - ratio, P(n) = ratio (1 - p) p^(n - 1): each within five standard errors."""
    ratio, persistence, episodes = 0.75, 0.9, 100_000
    steps = np.asarray(JumpStart(lambda *_: None, ratio, persistence).draw(jax.random.key(0), episodes))
    for n in range(12):
        expected = 1 - ratio if n == 0 else ratio * (1 - persistence) * persistence ** (n - 1)
        error = np.sqrt(expected * (1 - expected) / episodes)
        assert abs(np.mean(steps == n) - expected) < 5 * error, n
    assert abs(steps.mean() - ratio / (1 - persistence)) < 0.2


def test_the_guide_acts_first_and_only_so_long() -> None:
    """What is stored is the guide's action for the drawn number of steps, and the actor's after."""
    config = config_of("diffusion-jsrl", **{"high_level.warmup_env_steps": 0})
    guide = JumpStart(lambda params, key, observation: jnp.full((observation.shape[0], 2), 0.123), 0.9, 0.99)
    _, normaliser = to_device(point_dataset(20), 1)
    acting = Acting(config, PointEnv(), normaliser, 10, RandomWarmUp(0), guide, FrozenSkills())
    sac, hyper = SAC(2, 2, config.high_level), first_member(configs.population_hyper(config))
    agent = Agent(normaliser, ActionChunks(2), sac, 1.0, {}, sac.init(jax.random.key(1), 1.0).actor)
    row = Transition(jnp.zeros(2), jnp.zeros(2), jnp.zeros(()), jnp.zeros(()), jnp.zeros(2))
    state = acting.start(jax.random.key(0), row).replace(guided=jnp.array([3, 0]))
    act = jax.jit(lambda state, key: acting.step(state, key, agent, {}, hyper)[0])
    for n in range(5):
        state = act(state, jax.random.key(n))
    actions = np.asarray(state.replay.data.action[:10]).reshape(5, 2, 2)
    guided = (np.abs(actions - 0.123) < 1e-6).all(axis=-1)
    np.testing.assert_array_equal(guided, [[True, False]] * 3 + [[False, False]] * 2)


# --- Bonus and regulariser -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", ["all", "online"])
def test_the_bonus_is_on_the_rows_it_is_asked_for(rows: str) -> None:
    config = config_of("explore", **{"labels.bonus_rows": rows, "labels.offline_reward": "data"})
    data = point_dataset(20)
    phase = phases_of(config, data)[-1]
    labels = {"labels": jnp.zeros((1, data.size, 2)), "skills": {}}
    state, constants = first_member(phase.init(jax.random.split(jax.random.key(0), 1), labels))
    row = Transition(jnp.ones((1, 2)), jnp.ones((1, 2)), -jnp.ones(1), jnp.ones(1), jnp.ones((1, 2)))
    replay = insert(state.acting.replay, row)
    sources = Sources(replay, phase.data, {}, constants["labels"], first_member(phase.hyper))
    batch = phase.learning.sample(state.learners, jax.random.key(2), sources)
    offline, online = np.split(np.asarray(batch.reward), 2)
    assert (online > -1).all()  # each earned -1 and a bonus
    assert np.isin(offline, [-1.0, 0.0]).all() == (rows == "online")


def test_divergence_from_the_skill_prior_by_hand() -> None:
    """An untrained actor of zeros is N(0, 1) before the squashing: KL 0 from that prior, d / 2 from N(1, 1)."""
    sac = SAC(2, 3, configs.HighLevelConfig(hidden=(8,), ensemble=2, target_subset=1))
    state = sac.init(jax.random.key(0), 1.0)
    actor = jax.tree.map(jnp.zeros_like, state.actor)
    mapping, observation = latent_map("arctanh", 1.0), jnp.zeros((20_000, 2))
    for mean, divergence in ((0.0, 0.0), (1.0, 1.5)):
        prior = Prior(jnp.full(3, mean), jnp.zeros(3))

        def log_prior(observation: jax.Array, action: jax.Array, prior: Prior = prior) -> jax.Array:
            return gaussian_log_prob(mapping.to_latent(action, prior), *prior) + mapping.log_jacobian(action, prior)

        _, entropy = sac.actor_loss(actor, state.critic, jnp.ones(()), observation, jax.random.key(1), log_prior)
        np.testing.assert_allclose(entropy, -divergence, atol=0.06)


# --- Going on after a crash ------------------------------------------------------------------------------------


class Crash(Exception):
    """What a phase dies of."""


def crash_at_the_second(chunk: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """``chunk``, which raises when it is called again."""
    calls = itertools.count()

    def crashing(state: Any) -> Any:
        if next(calls):
            raise Crash
        return chunk(state)

    return crashing


@pytest.mark.slow
@pytest.mark.parametrize("method", ["diffusion-jsrl", "explore", "iql"])
def test_a_crashed_run_ends_as_if_nothing_had_happened(method: str, tmp_path: Path) -> None:
    config = config_of(method, **{"labels.start_env_steps": 40, "policy.every_updates": 20, "guide.updates": 20})

    phases = phases_of(config, point_dataset(20))  # once: what they carry over is what ``init`` sets
    whole_chunk = phases[-1].chunk

    def run(path: Path, crash: bool) -> list[dict[str, str]]:
        phases[-1].chunk = crash_at_the_second(whole_chunk) if crash else whole_chunk
        folder = RunFolder.open(str(path)) if path.exists() else RunFolder.create(str(path))
        folder.config.write_text(configs.to_yaml(config))
        with folder.held():
            run_phases(
                phases,
                folder,
                configs.members(config),
                config=configs.config_hash(config),
                header={},
                checkpoint_seconds=0,
            )
        with folder.metrics.open(newline="") as file:
            return [{name: cell for name, cell in row.items() if name != "sps"} for row in csv.DictReader(file)]

    undisturbed = run(tmp_path / "whole", crash=False)
    assert undisturbed[-1]["eval/success"]
    with pytest.raises(Crash):
        run(tmp_path / "crashed", crash=True)
    assert run(tmp_path / "crashed", crash=False) == undisturbed


# --- Sources ---------------------------------------------------------------------------------------------------
