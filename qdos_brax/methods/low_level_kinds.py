"""The kinds of low-level policies: how each is made from a configuration, and the phases that learn it.

A new kind is a policy (``qdos_brax.skills.low_level``), its learner, and an entry of the table here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS, Method
from qdos_brax.methods.context import BuildContext, SpaceSizes, offline_phase
from qdos_brax.methods.given_skills import GivenSkillsPhase
from qdos_brax.offline.diveoff import DiveOff
from qdos_brax.offline.flow_bc import FlowBC
from qdos_brax.offline.hilbert import Hilbert
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.chunks import ActionChunks, NoiseChunks
from qdos_brax.skills.flow_policy import FlowPolicy
from qdos_brax.skills.forward_model import ForwardModel, step_scale
from qdos_brax.skills.graph_phase import GraphPhase
from qdos_brax.skills.information import LoggedStates, PhysicsRollout
from qdos_brax.skills.information_terms import InformationTerm, SegmentTerm
from qdos_brax.skills.low_level import (
    DirectionSkills,
    LowLevelPolicy,
    TrajectorySkills,
    TransitionSkills,
)
from qdos_brax.skills.outcome_model import OutcomeModel
from qdos_brax.skills.outcome_term import OutcomeTerm
from qdos_brax.skills.outcomes import fit_outcomes, seen_paths
from qdos_brax.skills.segment_weights import LatentWeights, LoggedWeights, SegmentWeights, UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL
from qdos_brax.skills.views import fit_view, make_view


def make_low_level(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    """Return the method's low-level policy; its parameters are what its phases learn."""
    return _LOW_LEVEL[METHODS[config.method].low_level].make(config, env)


def skill_phases(context: BuildContext) -> list[MemberPhase]:
    """Return the phases that learn the low-level policy, or the one that hands on what is given."""
    if context.given is not None:
        return [GivenSkillsPhase(context.given)]
    return _LOW_LEVEL[context.method.low_level].phases(context)


class _LowLevelKind(NamedTuple):
    """A kind of low-level policy: how it is made, and the phases that learn it."""

    make: Callable[[Config, SpaceSizes], LowLevelPolicy]
    phases: Callable[[BuildContext], list[MemberPhase]]


def make_skill_model(config: Config, env: SpaceSizes) -> SkillModel:
    """Return the skill model of a configuration: the trajectory VAE, or outcomes in its place."""
    if config.skills.model == "outcome":
        return OutcomeModel(env.observation_size, env.action_size, config.skills, env.body_frame)
    view = make_view(config.skills.view, env.body_frame)
    return SkillModel(env.observation_size, env.action_size, config.skills, view)


def _trajectory_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    return TrajectorySkills(make_skill_model(config, env), config.high_level.latent_map)


def _trajectory_phases(context: BuildContext) -> list[MemberPhase]:
    config, method = context.config, context.method
    model = make_skill_model(config, context.env)
    view = fit_view(model.view, context.data, context.normaliser, config.skills.horizon)
    information = _information(context, model, view)
    skills = SkillPhase(config, model, _weights(config, method, context.env), information, view)
    return [value_phase(config, context.env, context.dataset.ends), skills] if method.weighted else [skills]


def _hilbert(config: Config, env: SpaceSizes) -> Hilbert:
    return Hilbert(env.observation_size, env.action_size, config.skills.latent_dim, config.hilbert)


def _direction_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    learner = _hilbert(config, env)
    return DirectionSkills(learner.latent_dim, learner.direction, learner.act)


def _direction_phases(context: BuildContext) -> list[MemberPhase]:
    learner = _hilbert(context.config, context.env)
    return [offline_phase(context, "skills", learner, context.config.hilbert.updates)]


def _diveoff(config: Config, env: SpaceSizes) -> DiveOff:
    return DiveOff(env.observation_size, env.action_size, config.skills.latent_dim, config.diveoff)


def _transition_skills(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    learner = _diveoff(config, env)
    return TransitionSkills(learner, learner.encode, config.high_level.latent_map)


def _transition_phases(context: BuildContext) -> list[MemberPhase]:
    learner = _diveoff(context.config, context.env)
    return [offline_phase(context, "skills", learner, context.config.diveoff.updates)]


def _action_chunks(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    return ActionChunks(env.action_size, config.skills.horizon)


def _flow(config: Config, env: SpaceSizes) -> FlowPolicy:
    """Return the flow policy over chunks of H actions."""
    width = config.skills.horizon * env.action_size
    return FlowPolicy(env.observation_size, width, config.flow.hidden, config.flow.steps)


def _noise_chunks(config: Config, env: SpaceSizes) -> LowLevelPolicy:
    return NoiseChunks(_flow(config, env), env.action_size)


def _noise_phases(context: BuildContext) -> list[MemberPhase]:
    config = context.config
    learner = FlowBC(_flow(config, context.env), config.skills.horizon, config.flow.batch_size)
    return [offline_phase(context, "skills", learner, config.flow.updates)]


_LOW_LEVEL = {
    "trajectory": _LowLevelKind(_trajectory_skills, _trajectory_phases),
    "transition": _LowLevelKind(_transition_skills, _transition_phases),
    "direction": _LowLevelKind(_direction_skills, _direction_phases),
    "action": _LowLevelKind(_action_chunks, lambda context: []),
    "chunk": _LowLevelKind(_action_chunks, lambda context: []),
    "noise": _LowLevelKind(_noise_chunks, _noise_phases),
}


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


def _information(context: BuildContext, model: SkillModel, view: Mapping[str, Any]) -> InformationTerm | None:
    skills = context.config.skills
    if not (context.method.information and skills.has_information):
        return None
    if skills.mi_rollout == "logged":
        return SegmentTerm(model, LoggedStates(skills.horizon))
    source = PhysicsRollout(context.env, model, context.normaliser, skills.horizon)
    if skills.mi_encoder == "segment":
        return SegmentTerm(model, source)
    seen = seen_paths(model, view, context.data, skills.horizon)
    forward = ForwardModel(step_scale(seen), model.action_dim, skills.prior_hidden)
    return OutcomeTerm(model, source, fit_outcomes(seen), forward, skills.prior_hidden, skills.mi_batch, skills.horizon)
