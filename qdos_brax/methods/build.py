"""From a method and a configuration to the phases of a run.

A new kind of low-level policy, guide or flat policy is a learner, a section of the configuration and an entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS, Method
from qdos_brax.data.dataset import Dataset, longest_episode
from qdos_brax.data.device import DeviceData, to_device
from qdos_brax.data.requirements import refuse, unmet
from qdos_brax.high_level.actor_critic import AGENT, ActorCritic
from qdos_brax.high_level.batches import make_batches
from qdos_brax.high_level.jump_start import JumpStart
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.skill_learning import FrozenSkills, SkillLearning
from qdos_brax.high_level.tuned_skills import TunedSkills
from qdos_brax.high_level.warm_up import OfflineWarmUp, RandomWarmUp, WarmUp
from qdos_brax.labels.bonus import Bonus, NoBonus, RNDBonus
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.labels.offline_reward import DataReward, MinimumReward, OfflineReward, PredictedReward
from qdos_brax.labels.reward_model import RewardModel
from qdos_brax.labels.rnd import RND
from qdos_brax.methods.actor_critics import make_actor_critic
from qdos_brax.methods.context import BuildContext, SpaceSizes, offline_phase
from qdos_brax.methods.given_skills import GivenSkills, read_skills
from qdos_brax.methods.learners_view import learners_env, run_dataset
from qdos_brax.methods.low_level_kinds import make_low_level, skill_phases
from qdos_brax.offline.actor_critic import OfflineActorCritic
from qdos_brax.offline.bc import BC
from qdos_brax.offline.cal_ql import CalQL
from qdos_brax.offline.diffusion import DiffusionBC
from qdos_brax.offline.flat_policy import FlatPolicy
from qdos_brax.offline.iql_policy import IQLPolicy
from qdos_brax.offline.learner import Learner, PolicyLearner
from qdos_brax.offline.offline_phase import Evaluation, OfflinePhase
from qdos_brax.offline.warm_start import WarmStart
from qdos_brax.population import memory
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.low_level import LowLevelPolicy, TrajectorySkills
from qdos_brax.skills.values import IQL


def build_context(config: Config, env: Any, dataset: Dataset) -> BuildContext:
    """Move the data to the device, once for all phases and members.

    Raises:
        UserError: a setting does not suit the method, the data does not meet a need of the configuration, or given
            skills are of another task or of other sizes.
    """
    configs.check_method(config)
    refuse(dataset.source, unmet(dataset, env, config))
    env = learners_env(config, env)
    dataset, given = run_dataset(config, env, dataset), _given_skills(config, env)
    data, normaliser = to_device(dataset, config.skills.horizon, None if given is None else given.normaliser)
    return BuildContext(config, METHODS[config.method], env, dataset, data, normaliser, given)


def check_skills(config: Config, env: Any) -> None:
    """Refuse skills that a run cannot begin on, before data is read or collected.

    Raises:
        UserError: as ``read_skills``.
    """
    _given_skills(config, learners_env(config, env))


def _given_skills(config: Config, env: Any) -> GivenSkills | None:
    return None if config.skills_file is None else read_skills(config, env, make_low_level(config, env))


def build_phases(context: BuildContext) -> list[MemberPhase]:
    """Return the phases of ``context.method`` in order, to be bound to a population."""
    config, method, env = context.config, context.method, context.env
    low_level, high_level = make_low_level(config, env), make_actor_critic(config, env)
    if method.policy is not None:
        return [_policy_phase(context, method.policy)]
    labelled = make_batches(config).offline > 0 or config.high_level.initial != "random"
    guide = None if method.guide is None else _GUIDES[method.guide](config, env)
    return [
        *skill_phases(context),
        *([] if guide is None else [offline_phase(context, "guide", guide.learner, config.guide.updates)]),
        *_continued_phases(context),
        *([_label_phase(context, low_level)] if labelled else []),
        *_warm_start_phases(context, low_level),
        OnlinePhase(
            config,
            env,
            context.normaliser,
            low_level,
            high_level,
            _warm_up(config, method),
            _labeller(context, low_level),
            _bonus(context, low_level),
            None if guide is None else guide.jump_start,
            _skill_learning(config, env, low_level, high_level),
        ),
    ]


def _skill_learning(
    config: Config, env: SpaceSizes, low_level: LowLevelPolicy, high_level: ActorCritic
) -> SkillLearning:
    """Return what becomes of the skills online; only those that can be tuned get here with ``tuning.skills`` on."""
    if config.tuning.skills == "frozen":
        return FrozenSkills()
    assert isinstance(low_level, TrajectorySkills) and isinstance(high_level, SAC)
    return TunedSkills(config, low_level, high_level, env.observation_size, env.action_size)


def _label_phase(context: BuildContext, low_level: LowLevelPolicy) -> LabelPhase:
    config = context.config
    return LabelPhase(config.skills.horizon, len(context.data.starts), low_level, config.labels.latent)


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


def _continued_phases(context: BuildContext) -> list[MemberPhase]:
    """Return the phase that learns the actor-critic from the data, where the method has one."""
    config, method = context.config, context.method
    if not method.offline:
        return []
    learner = OfflineActorCritic(make_actor_critic(config, context.env), config.skills.horizon, config.flow.batch_size)
    return [offline_phase(context, AGENT, learner, config.flow.updates)]


def _warm_start_phases(context: BuildContext, low_level: LowLevelPolicy) -> list[MemberPhase]:
    """Return the phase that learns SAC's first networks from the labelled data, if they are not random."""
    config = context.config
    if config.high_level.initial == "random":
        return []
    sac, horizon = SAC(context.env.observation_size, low_level.width, config.high_level), config.skills.horizon
    learner: Learner
    if config.high_level.initial == "iql":
        learner = WarmStart(sac, config.high_level.hidden, horizon, config.flow)
    else:
        learner = CalQL(sac, horizon, longest_episode(context.dataset.ends), config.flow)
    labels = ("labels",)
    drops = () if make_batches(config).offline else labels
    return [offline_phase(context, AGENT, learner, config.flow.updates, reads=labels, drops=drops)]


def _warm_up(config: Config, method: Method) -> WarmUp:
    high = config.high_level
    played_first = method.offline or high.initial != "random"
    return (OfflineWarmUp if played_first else RandomWarmUp)(high.warmup_env_steps)


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
    return offline_phase(context, "policy", learner, config.policy.updates, evaluation)


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
