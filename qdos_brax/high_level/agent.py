"""A trained agent: which skill to play, and what the skill does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax

from qdos_brax.data.device import Normaliser
from qdos_brax.high_level.sac import SAC
from qdos_brax.latent_map import LatentMap, Prior
from qdos_brax.skills.vae import SkillModel


@dataclass(frozen=True)
class Agent:
    """Both levels with their parameters.

    Attributes:
        normaliser: of observations.
        model: the skill model.
        sac: the high level.
        latent_map: from its action to the skill.
        skills: parameters of the skill model.
        actor: parameters of the high level's actor.
    """

    normaliser: Normaliser
    model: SkillModel
    sac: SAC
    latent_map: LatentMap
    skills: Any
    actor: Any

    def choose(self, observation: jax.Array) -> jax.Array:
        """The skill z[..., latent] for observation[..., obs]: the mode of the high level's policy."""
        normal = self.normaliser(observation)
        return self.latent_map.to_latent(self.sac.mode(self.actor, normal), self.prior(normal))

    def prior(self, normal: jax.Array) -> Prior:
        """p(z | s) at normalised observations[..., obs]."""
        return Prior(*self.model.prior(self.skills, normal))

    def play(self, observation: jax.Array, latent: jax.Array) -> jax.Array:
        """The action[..., act] of skill z at an observation."""
        return self.model.act(self.skills, self.normaliser(observation), latent)
