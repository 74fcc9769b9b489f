"""Programs of later phases are compiled before those phases run, and found by them."""

from __future__ import annotations

import logging
import threading
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from qdos_brax import config as configs
from qdos_brax.data.device import to_device
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.labels.bonus import NoBonus
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.labels.offline_reward import DataReward
from qdos_brax.population.members import Population
from qdos_brax.runs.beside import compile_beside
from qdos_brax.runs.checkpoint import as_device_arrays
from qdos_brax.skills.information import PhysicsRollout
from qdos_brax.skills.information_terms import SegmentTerm
from qdos_brax.skills.low_level import TrajectorySkills
from qdos_brax.skills.segment_weights import LoggedWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL
from tests.point import PointEnv, point_config, point_dataset

SMALL = {"values.updates": 10, "skills.updates": 10, "skills.mi_every": 10, "values.estimator": "iql"}
SIZES = configs.SkillsConfig(latent_dim=2, encoder_hidden=8, encoder_layers=1, decoder_hidden=(16,), prior_hidden=(16,))


def bound_phases(seeds: tuple[int, ...], per_program: int, devices: list[jax.Device]) -> list[Any]:
    config = configs.replace(point_config(**SMALL), seed=seeds)
    data, normaliser = to_device(point_dataset(episodes=20), config.skills.horizon)
    model = SkillModel(2, 2, SIZES)
    information = SegmentTerm(model, PhysicsRollout(PointEnv(), model, normaliser, config.skills.horizon))
    low_level, warm_up = TrajectorySkills(model, "box"), RandomWarmUp(config.high_level.warmup_env_steps)
    sac = SAC(2, low_level.width, config.high_level)
    phases = [
        ValuePhase(config, IQL(2, 2, (16,)), updates_per_chunk=10),
        SkillPhase(config, model, LoggedWeights(), information, blocks_per_chunk=1),
        LabelPhase(config.skills.horizon, len(data.starts), low_level),
        OnlinePhase(
            config, PointEnv(), normaliser, low_level, sac, warm_up, DataReward(), NoBonus(), steps_per_chunk=40
        ),
    ]
    population = Population(configs.population_hyper(config), per_program, devices)
    for phase in phases:
        phase.bind(population, population.shared(data))
    return phases


def compiled_in_chunks(phases: list[Any], members: int, caplog: pytest.LogCaptureFixture) -> int:
    """Run the phases as the loop does; how many of their programs were compiled when a chunk asked for them."""
    artifacts: dict[str, Any] = {}
    found = 0
    for index, phase in enumerate(phases):
        keys = jax.vmap(jax.random.key)(jnp.arange(members, dtype=jnp.uint32))
        state, constants = phase.init(keys, artifacts)
        caplog.clear()
        for _ in range(2 if phase.name == "online" else 1):
            state, _ = phase.chunk(state, constants)
        if index:
            found += sum(record.getMessage().startswith("Compiling jit(") for record in caplog.records)
        artifacts = as_device_arrays(phase.finish(state, artifacts))
    return found


@pytest.mark.parametrize(("seeds", "per_program"), [((0,), 1), ((0, 1, 2), 1)])
def test_a_later_phase_finds_its_programs(
    seeds: tuple[int, ...], per_program: int, caplog: pytest.LogCaptureFixture
) -> None:
    """One member; three in turns on one device. Without the thread each compiles its own."""
    found = []
    with jax.log_compiles(), caplog.at_level(logging.WARNING, "jax"):
        for ahead in (False, True):
            phases = bound_phases(seeds, per_program, jax.local_devices()[:1])
            if ahead:
                compile_beside(phases, len(seeds)).join()
            found.append(compiled_in_chunks(phases, len(seeds), caplog))
    assert found[0] >= 3 and found[1] < found[0] - 2, found


def test_what_fails_on_the_thread_is_left_to_the_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        begun = 0

        def init(self, key: Any, artifacts: Any) -> Any:
            Broken.begun += 1
            raise RuntimeError("told where the phase runs")

    told: list[Any] = []
    monkeypatch.setattr(threading, "excepthook", told.append)
    compile_beside([Broken()], 1).join()
    assert Broken.begun == 1 and told == []
