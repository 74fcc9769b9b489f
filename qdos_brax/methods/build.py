"""From a method and a configuration to the phases of a run.

A new kind of low-level policy, guide or flat policy is a learner, a section of the configuration and an entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from envs.body_frame import BodyFrame
from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS, Method
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, Normaliser, to_device
from qdos_brax.data.requirements import refuse, unmet
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
from qdos_brax.offline.flat_policy import FlatPolicy
from qdos_brax.offline.hilbert import Hilbert
from qdos_brax.offline.iql_policy import IQLPolicy
from qdos_brax.offline.learner import Learner, PolicyLearner
from qdos_brax.offline.offline_phase import Evaluation, OfflinePhase
from qdos_brax.population import memory
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.graph_phase import GraphPhase
from qdos_brax.skills.information import LoggedStates, PhysicsRollout
from qdos_brax.skills.low_level import (
    DirectionSkills,
    LowLevelPolicy,
    PrimitiveActions,
    TrajectorySkills,
    TransitionSkills,
)
from qdos_brax.skills.segment_weights import LatentWeights, LoggedWeights, SegmentWeights, UniformWeights
from qdos_brax.skills.skill_phase import Information, SkillPhase
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL
from qdos_brax.skills.views import fit_view, make_view


class SpaceSizes(Protocol):
    """Give the sizes of a task's observations and actions, and how they turn; every environment does."""

    observation_size: int
    action_size: int
    body_frame: BodyFrame | None


class BuildContext(NamedTuple):
    """Hold what every phase of a run is made from.

    Attributes:
        config: the run's configuration.
        method: its method.
        env: the task.
        dataset: the data, labelled for that task.
        data: the same on the default device, normalised.
        normaliser: of observations.
    """

    config: Config
    method: Method
    env: Any
    dataset: Dataset
    data: DeviceData
    normaliser: Normaliser


def build_context(config: Config, env: Any, dataset: Dataset) -> BuildContext:
    """Move the data to the device, once for all phases and members.

    Raises:
        UserError: a setting does not suit the method, or the data does not meet a need of the configuration.
    """
    configs.check_method(config)
    refuse(dataset.source, unmet(dataset, env, config))
    data, normaliser = to_device(dataset, config.skills.horizon)
    return BuildContext(config, METHODS[config.method], env, dataset, data, normaliser)


def build_phases(context: BuildContext) -> list[MemberPhase]:
    """Return the phases of ``context.method`` in order, to be bound to a population."""
    config, method, env = context.config, context.method, context.env
    low_level = make_low_level(config, env)
    if method.policy is not None:
        return [_policy_phase(context, method.policy)]
    labelled = round(config.high_level.batch_size * config.high_level.offline_fraction) > 0
    guide = None if method.guide is None else _GUIDES[method.guide](config, env)
    return [
        *_LOW_LEVEL[method.low_level].phases(context),
        *([] if guide is None else [_offline_phase(context, "guide", guide.learner, config.guide.updates)]),
        *(
            [LabelPhase(config.skills.horizon, len(context.data.starts), low_level, config.labels.latent)]
            if labelled
            else []
        ),
        OnlinePhase(
            config,
            env,
            context.normaliser,
            low_level,
            _labeller(context, low_level),
            _bonus(context, low_level),
            None if guide is None else guide.jump_start,
        ),
    ]


def plan_members(
    context: BuildContext, phases: Sequence[MemberPhase], members: Sequence[Mapping[str, Any]]
) -> memory.MemoryPlan:
    """Return how the members run on this process's devices, by an estimate of their memory where there is a choice."""
    if len(members) == 1:
        return memory.MemoryPlan((jax.local_devices()[0],), 1, False, "1 member")
    config, dataset = context.config, context.dataset
    bind_phases(phases, Population(configs.population_hyper(config, members[:1])), context.data)
    shared = sum(value.nbytes for value in vars(dataset).values() if isinstance(value, np.ndarray))
    need = memory.estimate(phases, shared)
    devices = jax.local_devices()
    return memory.plan(need, len(members), devices, memory.room_of(devices[0]), config.members_per_program)


def bind_phases(phases: Sequence[MemberPhase], population: Population, data: DeviceData) -> None:
    """Compile the phases' programs for ``population``; the data is put on all of its devices, once."""
    shared = population.shared(data)
    for phase in phases:
        phase.bind(population, shared)


def make_low_level(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    """Return the method's low-level policy; its parameters are what its phases learn."""
    return _LOW_LEVEL[METHODS[config.method].low_level].make(config, env)


class _LowLevelKind(NamedTuple):
    """A kind of low-level policy: how it is made, and the phases that learn it."""

    make: Callable[[Config, SpaceSizes], LowLevelPolicy]
    phases: Callable[[BuildContext], list[MemberPhase]]


def make_skill_model(config: Config, env: SpaceSizes) -> SkillModel:
    """Return the trajectory VAE of a configuration."""
    view = make_view(config.skills.view, env.body_frame)
    return SkillModel(env.observation_size, env.action_size, config.skills, view)


def _trajectory_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    return TrajectorySkills(make_skill_model(config, env), config.high_level.latent_map)


def _trajectory_phases(context: BuildContext) -> list[MemberPhase]:
    config, method = context.config, context.method
    model = make_skill_model(config, context.env)
    view = fit_view(model.view, context.data, context.normaliser, config.skills.horizon)
    skills = SkillPhase(config, model, _weights(config, method, context.env), _information(context, model), view)
    return [value_phase(config, context.env, context.dataset.ends), skills] if method.weighted else [skills]


def _hilbert(config: Config, env: SpaceSizes) -> Hilbert:
    return Hilbert(env.observation_size, env.action_size, config.skills.latent_dim, config.hilbert)


def _direction_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    learner = _hilbert(config, env)
    return DirectionSkills(learner.latent_dim, learner.direction, learner.act)


def _direction_phases(context: BuildContext) -> list[MemberPhase]:
    learner = _hilbert(context.config, context.env)
    return [_offline_phase(context, "skills", learner, context.config.hilbert.updates)]


def _diveoff(config: Config, env: SpaceSizes) -> DiveOff:
    return DiveOff(env.observation_size, env.action_size, config.skills.latent_dim, config.diveoff)


def _transition_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    learner = _diveoff(config, env)
    return TransitionSkills(learner, learner.encode, config.high_level.latent_map)


def _transition_phases(context: BuildContext) -> list[MemberPhase]:
    learner = _diveoff(context.config, context.env)
    return [_offline_phase(context, "skills", learner, context.config.diveoff.updates)]


def _primitive_actions(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    return PrimitiveActions(env.action_size)


_LOW_LEVEL = {
    "trajectory": _LowLevelKind(_trajectory_skills, _trajectory_phases),
    "transition": _LowLevelKind(_transition_skills, _transition_phases),
    "direction": _LowLevelKind(_direction_skills, _direction_phases),
    "action": _LowLevelKind(_primitive_actions, lambda context: []),
}


def _offline_phase(
    context: BuildContext, name: str, learner: Learner, updates: int, evaluation: Evaluation | None = None
) -> OfflinePhase:
    return OfflinePhase(name, learner, context.normaliser, updates, evaluation)


class _Guide(NamedTuple):
    """What acts for the first steps of an episode online: how it is learned, and how it is called."""

    learner: Learner
    jump_start: JumpStart


def _diffusion_guide(config: Config, env: SpaceSizes) -> _Guide:
    learner = DiffusionBC(env.observation_size, env.action_size, config.guide)
    return _Guide(learner, JumpStart(learner.sample, config.guide.ratio, config.guide.persistence))


_GUIDES = {"diffusion": _diffusion_guide}


def _bc(config: Config, env: SpaceSizes) -> PolicyLearner:
    return BC(env.observation_size, env.action_size, config.policy)


def _iql(config: Config, env: SpaceSizes) -> PolicyLearner:
    values = IQL(env.observation_size, env.action_size, config.values.hidden)
    return IQLPolicy(env.observation_size, env.action_size, config.policy, values)


_POLICIES = {"bc": _bc, "iql": _iql}


def make_policy(config: Config, env: SpaceSizes, name: str) -> PolicyLearner:
    """Return the learner of the flat policy called ``name``, a method's ``policy``."""
    return _POLICIES[name](config, env)


def _policy_phase(context: BuildContext, name: str) -> OfflinePhase:
    """Return the one phase of a policy that is learned from the data alone, with its learning curve."""
    config, learner = context.config, make_policy(context.config, context.env, name)
    evaluation = Evaluation(
        context.env,
        lambda params: FlatPolicy(context.normaliser, learner.act, params),
        config.eval.episodes,
        config.skills.horizon,
        config.policy.every_updates,
    )
    return _offline_phase(context, "policy", learner, config.policy.updates, evaluation)


def value_phase(config: Config, env: SpaceSizes, ends: np.ndarray) -> GraphPhase | ValuePhase:
    """Return the phase that finds the segments' advantages, by ``config.values.estimator``.

    Args:
        config: the run's configuration.
        env: the task.
        ends: bool[N], the last row of each episode of the data.
    """
    if config.values.estimator == "graph":
        return GraphPhase(config.values, config.skills, ends)
    return ValuePhase(config, IQL(env.observation_size, env.action_size, config.values.hidden))


def _weights(config: Config, method: Method, env: SpaceSizes) -> SegmentWeights:
    if not method.weighted:
        return UniformWeights()
    if config.skills.advantage != "latent":
        return LoggedWeights()
    skills = config.skills
    return LatentWeights(env.observation_size, skills.latent_dim, config.values.hidden, skills.advantage_scale)


def _information(context: BuildContext, model: SkillModel) -> Information | None:
    skills = context.config.skills
    if not context.method.information:
        return None
    if skills.mi_rollout == "logged":
        return LoggedStates(skills.horizon)
    return PhysicsRollout(context.env, model, context.normaliser, skills.horizon)


def _labeller(context: BuildContext, low_level: LowLevelPolicy) -> OfflineReward:
    labels = context.config.labels
    if labels.offline_reward == "data":
        return DataReward()
    model = RewardModel(context.env.observation_size + low_level.width, labels.reward_hidden)
    if labels.offline_reward == "pred":
        return PredictedReward(model, _shown_to_labels(context))
    lowest = float(context.dataset.rewards.min())
    return MinimumReward(model, _shown_to_labels(context), context.config.skills.horizon, lowest)


def _bonus(context: BuildContext, low_level: LowLevelPolicy) -> Bonus:
    labels = context.config.labels
    if labels.rnd_coefficient == 0:
        return NoBonus()
    rnd = RND(context.env.observation_size + low_level.width, labels.rnd_hidden, labels.rnd_features)
    return RNDBonus(rnd, _shown_to_labels(context))


def _shown_to_labels(context: BuildContext) -> Callable[[jax.Array], jax.Array]:
    """Return what makes of normalised observations what bonus and reward model see."""
    return context.normaliser.restored if context.config.labels.inputs == "raw" else lambda observation: observation
