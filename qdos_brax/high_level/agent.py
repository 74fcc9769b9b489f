"""A trained agent: which latent to play, and what that does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax

from qdos_brax.data.device import Normaliser
from qdos_brax.high_level.actor_critic import ActorCritic
from qdos_brax.skills.low_level import LowLevelPolicy


class Policy(Protocol):
    """Define what plays episodes: a decision every H environment steps, and actions in between."""

    def choose(self, observation: jax.Array) -> jax.Array:
        """Return the decision at observation[obs], as the environment gives it."""
        ...

    def play(self, observation: jax.Array, decision: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the action[act] of a decision at an observation, ``step`` steps after it was made."""
        ...


@dataclass(frozen=True)
class Agent:
    """Play with both levels and their parameters.

    Attributes:
        normaliser: of observations.
        low_level: what the high level's action does.
        high_level: chooses that action.
        box: half the side of the box of latents.
        skills: parameters of the low-level policy.
        actor: parameters of what chooses it.
    """

    normaliser: Normaliser
    low_level: LowLevelPolicy
    high_level: ActorCritic
    box: jax.Array | float
    skills: Any
    actor: Any

    def choose(self, observation: jax.Array) -> jax.Array:
        """Return the skill[..., s] to play from observation[..., obs] on, by the mode of the high level's policy.

        Its first ``low_level.width`` numbers are the latent z.
        """
        normal = self.normaliser(observation)
        return self.skill(self.high_level.mode(self.actor, normal), normal)

    def skill(self, action: jax.Array, normal: jax.Array) -> jax.Array:
        """Return the skill[..., s] that u[..., width] plays from normal[..., obs] on, a normalised observation."""
        latent = self.low_level.to_latent(self.skills, action, normal, self.box)
        return self.low_level.begin(self.skills, latent, normal)

    def begin(self, observation: jax.Array, latent: jax.Array) -> jax.Array:
        """Return the skill[..., s] of z[..., width] that is played from observation[..., obs] on."""
        return self.low_level.begin(self.skills, latent, self.normaliser(observation))

    def play(self, observation: jax.Array, decision: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the action[..., act] of a skill at an observation, ``step`` steps after it began."""
        return self.low_level.act(self.skills, self.normaliser(observation), decision, step)
