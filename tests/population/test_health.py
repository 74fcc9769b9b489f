"""One member diverges, one simulation breaks: neither changes a bit of the others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.data.device import to_device
from qdos_brax.high_level.macro_step import macro_step, reset_done
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.labels.bonus import NoBonus
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.labels.offline_reward import DataReward
from qdos_brax.offline.bc import BC
from qdos_brax.offline.offline_phase import OfflinePhase
from qdos_brax.population import health
from qdos_brax.report.write import write_report
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.loop import run_phases
from qdos_brax.runs.metrics import read_rows
from qdos_brax.skills.chunks import ActionChunks
from qdos_brax.skills.information import PhysicsRollout
from qdos_brax.skills.information_terms import SegmentTerm
from qdos_brax.skills.low_level import TrajectorySkills
from qdos_brax.skills.segment_weights import LoggedWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL
from tests.point import PointEnv, bound, point_config, point_dataset

SMALL = {"values.updates": 20, "skills.updates": 20, "skills.mi_every": 10, "values.estimator": "iql"}
SEEDS = (0, 1, 2)
RATES = ("values.learning_rate", "skills.learning_rate", "policy.learning_rate", "high_level.learning_rate")
SIZES = configs.SkillsConfig(latent_dim=2, encoder_hidden=8, encoder_layers=1, decoder_hidden=(16,), prior_hidden=(16,))
ABSURD = 1e30  # no user can ask for it; it stands for whatever makes a member diverge


@pytest.fixture(scope="module")
def phases() -> dict[str, Any]:
    """Every kind of phase that learns, for three members; ``hyper`` is to be set."""
    config = configs.replace(point_config(**SMALL), seed=SEEDS)
    data, normaliser = to_device(point_dataset(episodes=40), config.skills.horizon)
    model = SkillModel(2, 2, SIZES)
    information = SegmentTerm(model, PhysicsRollout(PointEnv(), model, normaliser, config.skills.horizon))
    low_level = TrajectorySkills(model, "box")
    policy = BC(2, 2, configs.PolicyConfig(hidden=(16,), batch_size=16))
    sac, warm_up = SAC(2, low_level.width, config.high_level), RandomWarmUp(config.high_level.warmup_env_steps)
    online = OnlinePhase(
        config, PointEnv(), normaliser, low_level, sac, warm_up, DataReward(), NoBonus(), steps_per_chunk=100
    )
    phases = {
        "values": ValuePhase(config, IQL(2, 2, (16,)), updates_per_chunk=10),
        "skills": SkillPhase(config, model, LoggedWeights(), information, blocks_per_chunk=1),
        "policy": OfflinePhase("policy", policy, normaliser, 20, updates_per_chunk=10),
        "label": LabelPhase(config.skills.horizon, len(data.starts), low_level),
        "online": online,
    }
    return {name: bound(phase, config, data) for name, phase in phases.items()}


def hyper_of(config: Config) -> dict[str, jax.Array]:
    return {key: jnp.asarray(value) for key, value in configs.population_hyper(config).items()}


def run(phases: dict[str, Any], path: Path, diverging: str | None = None) -> Path:
    """The folder of a run of all phases; at ``diverging`` the second member learns absurdly fast."""
    config = configs.replace(point_config(**SMALL), seed=SEEDS)
    hyper = hyper_of(config)
    if diverging is not None:
        hyper[diverging] = hyper[diverging].at[1].set(ABSURD)
    folder = RunFolder.create(path)
    folder.config.write_text(configs.to_yaml(config), encoding="utf-8")
    for phase in phases.values():
        phase.hyper = hyper
    header = {"env": "the plane", "method": "qdos", "preset": "smoke", "physics": "toy"}
    run_phases(list(phases.values()), folder, configs.members(config), config="0" * 16, header=header)
    return path


@pytest.fixture(scope="module")
def sane(phases: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(phases, tmp_path_factory.mktemp("health") / "sane")


def rows_of(path: Path, member: int) -> list[dict[str, str]]:
    rows = [row for row in read_rows(path / "metrics.csv") if row["member"] == str(member)]
    return [{name: cell for name, cell in row.items() if name != "sps"} for row in rows]


@pytest.mark.slow
@pytest.mark.parametrize("rate", RATES)
def test_the_others_are_bit_for_bit_as_without_the_one_that_diverges(
    phases: dict[str, Any], sane: Path, rate: str, tmp_path: Path
) -> None:
    broken = run(phases, tmp_path / "broken", rate)
    members = [json.loads((path / "summary.json").read_text())["members"] for path in (broken, sane)]
    assert [member["status"] for member in members[0]] == ["ok", "nan", "ok"]
    assert [member["status"] for member in members[1]] == ["ok", "ok", "ok"]
    for index in (0, 2):
        assert rows_of(broken, index) == rows_of(sane, index)
        assert members[0][index] == members[1][index]
    first = next(row["phase"] for row in rows_of(broken, 1) if row["status_ok"] == "0")
    assert first == rate.partition(".")[0].replace("high_level", "online")
    assert "was frozen: its numbers were no longer finite" in write_report([broken], broken).text
    assert "was frozen" in (broken / "report.html").read_text()


def test_a_frozen_member_keeps_what_it_last_knew() -> None:
    old, new = {"w": jnp.ones(2), "n": jnp.int32(1)}, {"w": jnp.array([2.0, jnp.inf]), "n": jnp.int32(2)}
    kept, healthy = health.keep_finite(jnp.array(True), new, old)
    assert not healthy and int(kept["n"]) == 1
    np.testing.assert_array_equal(kept["w"], [1, 1])
    kept, healthy = health.keep_finite(healthy, {"w": 3 * jnp.ones(2), "n": jnp.int32(3)}, old)
    assert not healthy and int(kept["n"]) == 1  # finite again, and frozen all the same


class BreakingEnv(PointEnv):
    """Breaks for good where the body comes to x < -1: the simulator's numbers are no longer finite."""

    def step(self, state: Any, action: jax.Array) -> Any:
        state = super().step(state, action)
        broken = state.pipeline_state.qpos[0] < -1
        obs = jnp.where(broken, jnp.nan, state.obs)
        return state.replace(obs=obs, info=state.info | {"final_obs": obs})


@pytest.fixture(scope="module")
def breaking() -> tuple[SkillPhase, dict[str, jax.Array]]:
    """(a skill phase of three members whose rollouts break here and there, what it starts from)."""
    config = configs.replace(point_config(**SMALL, **{"skills.alpha": 1.0}), seed=SEEDS)
    data, normaliser = to_device(point_dataset(episodes=40), config.skills.horizon)
    model = SkillModel(2, 2, SIZES)
    information = SegmentTerm(model, PhysicsRollout(BreakingEnv(), model, normaliser, config.skills.horizon))
    phase = bound(SkillPhase(config, model, LoggedWeights(), information, blocks_per_chunk=1), config, data)
    return phase, {"advantage": jnp.zeros((3, data.starts.shape[0]))}


def test_what_breaks_in_the_skill_phase_stays_where_it_arose(breaking: tuple[SkillPhase, dict[str, jax.Array]]) -> None:
    phase, artifacts = breaking
    found = []
    for rate in (1e-3, ABSURD):
        phase.hyper["skills.learning_rate"] = jnp.array([1e-3, rate, 1e-3])
        keys = jax.vmap(jax.random.key)(np.asarray(SEEDS, np.uint32))
        start, constants = phase.init(keys, artifacts)
        initial = jax.tree.map(np.asarray, start.params)
        state, metrics = phase.chunk(start, constants)
        found.append((jax.tree.map(np.asarray, state.params), metrics))
    (sane, metrics), (params, after) = found
    # Simulations that break are counted, and cost no member its health.
    assert (metrics["broken_envs"] > 0).any() and (metrics["broken_envs"] < phase._skills.mi_batch).all()
    assert metrics["status_ok"].all() and np.isfinite(metrics["information_loss"]).all()
    # A member that diverges is frozen where it was, and the others are bit for bit as without it.
    np.testing.assert_array_equal(after["status_ok"], [True, False, True])
    for a, b, c in zip(*map(jax.tree.leaves, (params, sane, initial)), strict=True):
        np.testing.assert_array_equal(a[[0, 2]], b[[0, 2]])
        np.testing.assert_array_equal(a[1], c[1])
    handed_on = phase.finish(state, artifacts)
    np.testing.assert_array_equal(phase.init(keys, handed_on)[0].healthy, [True, False, True])


class BreakingStartEnv(PointEnv):
    """Breaks in the first step of episodes that start on the right, about half of them."""

    def step(self, state: Any, action: jax.Array) -> Any:
        broken = (state.info["steps"] == 0) & (state.pipeline_state.qpos[0] > 0)
        state = super().step(state, action)
        obs = jnp.where(broken, jnp.nan, state.obs)
        return state.replace(obs=obs, info=state.info | {"final_obs": obs})


def test_a_simulation_that_breaks_before_anything_is_stored_costs_no_member_its_health() -> None:
    """There is nothing to learn from yet, and nothing is learned."""
    values = {"high_level.num_envs": 1, "high_level.offline_fraction": 0.0, "high_level.utd": 2}
    config = configs.replace(point_config(**values), seed=(0, 1, 2, 3))
    data, normaliser = to_device(point_dataset(episodes=4), config.skills.horizon)
    low_level = ActionChunks(2, config.skills.horizon)
    sac, warm_up = SAC(2, low_level.width, config.high_level), RandomWarmUp(0)
    phase = OnlinePhase(
        config, BreakingStartEnv(), normaliser, low_level, sac, warm_up, DataReward(), NoBonus(), steps_per_chunk=5
    )
    bound(phase, config, data)
    start, constants = phase.init(jax.vmap(jax.random.key)(np.arange(4, dtype=np.uint32)), {})
    before = jax.tree.map(np.asarray, start.learners.high_level)
    state, metrics = phase.chunk(start, constants)
    broke = metrics["broken_envs"] == 1
    assert broke.any() and not broke.all() and metrics["status_ok"].all()
    np.testing.assert_array_equal(metrics["update"], np.where(broke, 0, 2))
    for a, b in zip(*map(jax.tree.leaves, (before, jax.tree.map(np.asarray, state.learners.high_level))), strict=True):
        np.testing.assert_array_equal(a[broke], b[broke])
    for _ in range(8):
        state, metrics = phase.chunk(state, constants)
    assert metrics["status_ok"].all() and (metrics["update"] > 0).all()


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_one_broken_simulation_is_reset_and_the_others_go_on_as_without_it(engine: str) -> None:
    env = envs.make("antmaze-medium", physics=engine)
    keys = jax.random.split(jax.random.key(0), 3)

    @jax.jit
    def iteration(state: Any, keys: jax.Array) -> Any:
        play = lambda obs, step: jnp.tanh(obs[: env.action_size])  # noqa: E731
        state, result = jax.vmap(lambda one: macro_step(env, play, one, 3, 0.99))(state)
        after = jax.vmap(lambda one, broken, key: reset_done(env, one, broken, key))(state, ~result.finite, keys)
        return after, result

    state = jax.jit(jax.vmap(env.reset))(keys)
    pipeline = state.pipeline_state
    hit = state.replace(pipeline_state=pipeline.replace(qvel=pipeline.qvel.at[1, 0].set(jnp.nan)))
    sane, expected = iteration(state, keys)
    after, result = iteration(hit, keys)
    np.testing.assert_array_equal(result.finite, [True, False, True])
    assert bool(expected.finite.all())
    assert np.isfinite(np.asarray(after.obs)).all() and int(after.pipeline_state.steps[1]) == 0  # a fresh episode
    for a, b in zip(jax.tree.leaves((after, result)), jax.tree.leaves((sane, expected)), strict=True):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a)[[0, 2]], np.asarray(b)[[0, 2]])
    again, result = iteration(after, keys)
    assert bool(result.finite.all()) and np.isfinite(np.asarray(again.obs)).all()
