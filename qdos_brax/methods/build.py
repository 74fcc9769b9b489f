"""From a recipe and a configuration to the phases of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS, Method
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, Normaliser, to_device
from qdos_brax.errors import UserError
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.labels.bonus import Bonus, NoBonus, RNDBonus
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.labels.offline_reward import DataReward, MinimumReward, OfflineReward, PredictedReward
from qdos_brax.labels.reward_model import RewardModel
from qdos_brax.labels.rnd import RND
from qdos_brax.offline.bc import BC
from qdos_brax.offline.diffusion import DiffusionBC
from qdos_brax.offline.diveoff import DiveOff
from qdos_brax.offline.hilbert import Hilbert
from qdos_brax.offline.iql_policy import IQLPolicy
from qdos_brax.offline.learner import Learner, PolicyLearner
from qdos_brax.offline.offline_phase import Evaluation, OfflinePhase
from qdos_brax.offline.player import FlatPlayer
from qdos_brax.population import memory
from qdos_brax.population.members import Population
from qdos_brax.runs.loop import Phase
from qdos_brax.skills.graph_phase import GraphPhase
from qdos_brax.skills.information import LoggedStates, PhysicsRollout
from qdos_brax.skills.segment_weights import LatentWeights, LoggedWeights, SegmentWeights, UniformWeights
from qdos_brax.skills.skill_phase import Information, SkillPhase
from qdos_brax.skills.source import ActionSource, DirectionSource, SkillSource, TrajectorySource, TransitionSource
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL


class RunPhase(Phase, memory.Sized, Protocol):
    """A phase that the loop can run, and whose memory is known before."""


def build_phases(config: Config, env: Any, dataset: Dataset, population: Population) -> list[RunPhase]:
    """The phases of ``config.method``, in order.

    Args:
        config: the run's configuration.
        env: the task's environment, as ``envs.make`` gives it.
        dataset: the data, labelled for that task.
        population: the run's members.

    Raises:
        UserError: the data cannot serve this configuration.
    """
    task = _task(config, env, dataset, population)
    high = config.high_level
    source = make_source(config, env)
    if task.recipe.policy is not None:
        return [_policy_phase(task, task.recipe.policy)]
    labelled = round(high.batch_size * high.offline_fraction) > 0
    guide = None if task.recipe.guide is None else _GUIDES[task.recipe.guide](config, env)
    return [
        *_SOURCES[task.recipe.low_level].phases(task),
        *([] if guide is None else [_offline_phase(task, "guide", guide.learner, config.guide.updates)]),
        *([LabelPhase(config, task.data, population, source)] if labelled else []),
        OnlinePhase(
            config,
            env,
            task.data,
            task.normaliser,
            population,
            source,
            _labeller(config, env, source),
            _bonus(config, env, source),
            None if guide is None else guide.jump_start,
        ),
    ]


def plan_members(config: Config, env: Any, dataset: Dataset, members: Sequence[Mapping[str, Any]]) -> memory.Plan:
    """How the members run on this process's devices, by an estimate of their memory where there is a choice.

    Raises:
        UserError: the data cannot serve this configuration.
    """
    if len(members) == 1:
        return memory.Plan((jax.local_devices()[0],), 1, False, "1 member")
    one = Population(configs.population_hyper(config, members[:1]))
    shared = sum(value.nbytes for value in vars(dataset).values() if isinstance(value, np.ndarray))
    need = memory.estimate(build_phases(config, env, dataset, one), shared)
    devices = jax.local_devices()
    return memory.plan(need, len(members), devices, memory.room_of(devices[0]), config.members_per_program)


def make_source(config: Config, env: Any) -> SkillSource:
    """The method's source of low-level behaviour."""
    return _SOURCES[METHODS[config.method].low_level].make(config, env)


class _Task(NamedTuple):
    """What every phase of a run is made from."""

    config: Config
    recipe: Method
    env: Any
    dataset: Dataset
    data: DeviceData
    normaliser: Normaliser
    population: Population


def _task(config: Config, env: Any, dataset: Dataset, population: Population) -> _Task:
    data, normaliser = to_device(dataset, config.skills.horizon)
    if data.starts.shape[0] == 0:
        raise UserError(
            f"no episode of {dataset.source} has {config.skills.horizon} steps, the length of a skill "
            "(--set skills.horizon=N shortens it)"
        )
    return _Task(config, METHODS[config.method], env, dataset, population.shared(data), normaliser, population)


class _Source(NamedTuple):
    """A kind of low-level behaviour: how it is made, and the phases that learn it."""

    make: Callable[[Config, Any], SkillSource]
    phases: Callable[[_Task], list[RunPhase]]


def _trajectory_source(config: Config, env: Any) -> SkillSource:
    return TrajectorySource(_skill_model(config, env), config.high_level.latent_map)


def _trajectory_phases(task: _Task) -> list[RunPhase]:
    config, recipe, env, data = task.config, task.recipe, task.env, task.data
    if recipe.weighted and config.values.n_step > config.skills.horizon:
        raise UserError(
            f"values.n_step ({config.values.n_step}) must not exceed skills.horizon ({config.skills.horizon})"
        )
    model = _skill_model(config, env)
    information = _information(config, recipe, env, model, task.normaliser, data)
    return [
        *([value_phase(config, env, task.dataset, data, task.population)] if recipe.weighted else []),
        SkillPhase(config, data, task.population, model, _weights(config, recipe, env), information),
    ]


def _hilbert(config: Config, env: Any) -> Hilbert:
    own = config.hilbert
    return Hilbert(
        env.observation_size,
        env.action_size,
        config.skills.latent_dim,
        own.hidden,
        own.batch_size,
        own.random_goals,
    )


def _direction_source(config: Config, env: Any) -> SkillSource:
    learner = _hilbert(config, env)
    return DirectionSource(learner.latent_dim, learner.direction, learner.act)


def _direction_phases(task: _Task) -> list[RunPhase]:
    return [_offline_phase(task, "skills", _hilbert(task.config, task.env), task.config.hilbert.updates)]


def _diveoff(config: Config, env: Any) -> DiveOff:
    own = config.diveoff
    return DiveOff(
        env.observation_size,
        env.action_size,
        config.skills.latent_dim,
        own.hidden,
        own.batch_size,
        own.autoencoder_updates,
    )


def _transition_source(config: Config, env: Any) -> SkillSource:
    learner = _diveoff(config, env)
    return TransitionSource(learner, learner.encode, config.high_level.latent_map)


def _transition_phases(task: _Task) -> list[RunPhase]:
    return [_offline_phase(task, "skills", _diveoff(task.config, task.env), task.config.diveoff.updates)]


def _action_source(config: Config, env: Any) -> SkillSource:
    if config.skills.horizon != 1:
        raise UserError(
            f"{config.method} has no skills, it decides at every step: skills.horizon must stay 1, "
            f"not {config.skills.horizon}"
        )
    return ActionSource(env.action_size)


_SOURCES = {
    "trajectory": _Source(_trajectory_source, _trajectory_phases),
    "transition": _Source(_transition_source, _transition_phases),
    "direction": _Source(_direction_source, _direction_phases),
    "action": _Source(_action_source, lambda task: []),
}


def _offline_phase(
    task: _Task, name: str, learner: Learner, updates: int, evaluation: Evaluation | None = None
) -> OfflinePhase:
    return OfflinePhase(name, learner, task.data, task.normaliser, task.population, updates, evaluation)


class _Guide(NamedTuple):
    """What acts for the first steps of an episode online: how it is learned, and how it is called."""

    learner: Learner
    jump_start: JumpStart


def _diffusion_guide(config: Config, env: Any) -> _Guide:
    own = config.guide
    learner = DiffusionBC(env.observation_size, env.action_size, own.hidden, own.steps, own.batch_size)
    return _Guide(learner, JumpStart(learner.sample, own.ratio, own.persistence))


_GUIDES = {"diffusion": _diffusion_guide}


def _bc(config: Config, env: Any) -> PolicyLearner:
    return BC(env.observation_size, env.action_size, config.policy.hidden, config.policy.batch_size)


def _iql(config: Config, env: Any) -> PolicyLearner:
    values = IQL(env.observation_size, env.action_size, config.values.hidden)
    return IQLPolicy(env.observation_size, env.action_size, config.policy.hidden, values, config.policy.batch_size)


_POLICIES = {"bc": _bc, "iql": _iql}


def make_policy(config: Config, env: Any, name: str) -> PolicyLearner:
    """Return the learner of the flat policy called ``name``, a recipe's ``policy``."""
    return _POLICIES[name](config, env)


def _policy_phase(task: _Task, name: str) -> OfflinePhase:
    """The one phase of a policy that is learned from the data alone, with its learning curve."""
    config, learner = task.config, make_policy(task.config, task.env, name)
    evaluation = Evaluation(
        task.env,
        lambda params: FlatPlayer(task.normaliser, learner.act, params),
        config.eval.episodes,
        config.skills.horizon,
        config.policy.every_updates,
    )
    return _offline_phase(task, "policy", learner, config.policy.updates, evaluation)


def value_phase(
    config: Config, env: Any, dataset: Dataset, data: DeviceData, population: Population
) -> GraphPhase | ValuePhase:
    """The phase that finds the segments' advantages, by ``config.values.estimator``."""
    if config.values.estimator == "graph":
        return GraphPhase(config.values, config.skills, data, dataset.ends, population.members)
    return ValuePhase(config, data, population, IQL(env.observation_size, env.action_size, config.values.hidden))


def _skill_model(config: Config, env: Any) -> SkillModel:
    skills = config.skills
    return SkillModel(
        env.observation_size,
        env.action_size,
        skills.latent_dim,
        skills.encoder_hidden,
        skills.encoder_layers,
        skills.decoder_hidden,
        skills.prior_hidden,
    )


def _weights(config: Config, recipe: Method, env: Any) -> SegmentWeights:
    if not recipe.weighted:
        return UniformWeights()
    if config.skills.advantage != "latent":
        return LoggedWeights()
    skills = config.skills
    return LatentWeights(env.observation_size, skills.latent_dim, config.values.hidden, skills.advantage_scale)


def _information(
    config: Config, recipe: Method, env: Any, model: SkillModel, normaliser: Normaliser, data: DeviceData
) -> Information | None:
    if not recipe.information:
        return None
    if config.skills.mi_rollout == "logged":
        return LoggedStates(config.skills.horizon)
    return PhysicsRollout(env, model, normaliser, config.skills.horizon, data)


def _labeller(config: Config, env: Any, source: SkillSource) -> OfflineReward:
    labels = config.labels
    if labels.offline_reward == "data":
        return DataReward()
    model = RewardModel(env.observation_size + source.width, labels.reward_hidden)
    if labels.offline_reward == "pred":
        return PredictedReward(model)
    return MinimumReward(model, config.skills.horizon)


def _bonus(config: Config, env: Any, source: SkillSource) -> Bonus:
    labels = config.labels
    if labels.rnd_coefficient == 0:
        return NoBonus()
    return RNDBonus(RND(env.observation_size + source.width, labels.rnd_hidden, labels.rnd_features))
