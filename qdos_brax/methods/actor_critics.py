"""The kinds of actor-critics by name: what decides online, over whatever the low-level policy plays."""

from __future__ import annotations

from collections.abc import Callable

from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.high_level.actor_critic import ActorCritic
from qdos_brax.high_level.best_of_n import BestOfN
from qdos_brax.high_level.distilled_flow import DistilledFlow
from qdos_brax.high_level.sac import SAC
from qdos_brax.methods.context import SpaceSizes
from qdos_brax.methods.low_level_kinds import make_low_level


def make_actor_critic(config: Config, env: SpaceSizes) -> ActorCritic:
    """Return the method's actor-critic, for decisions as wide as its low-level policy takes."""
    width = make_low_level(config, env).width
    return _ACTOR_CRITICS[METHODS[config.method].actor_critic](config, env.observation_size, width)


def _sac(config: Config, observation_dim: int, action_dim: int) -> ActorCritic:
    return SAC(observation_dim, action_dim, config.high_level)


def _best_of_n(config: Config, observation_dim: int, action_dim: int) -> ActorCritic:
    return BestOfN(observation_dim, action_dim, config.high_level, config.flow, config.skills.horizon)


def _distilled_flow(config: Config, observation_dim: int, action_dim: int) -> ActorCritic:
    return DistilledFlow(observation_dim, action_dim, config.high_level, config.flow, config.skills.horizon)


_ACTOR_CRITICS: dict[str, Callable[[Config, int, int], ActorCritic]] = {
    "sac": _sac,
    "best-of-n": _best_of_n,
    "distilled-flow": _distilled_flow,
}
