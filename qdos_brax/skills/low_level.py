"""Where low-level behaviour comes from, behind one interface: what the high level's action u does, and what played it.

The high level acts by u in (-1, 1)^d. A source says which latent z that is in a state, which action z takes, and which
z a segment of the data played. ``params`` is always what the source's own learner left, one member's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.nn.networks import gaussian_log_prob, gaussian_sample
from qdos_brax.nn.vectors import unit_vector
from qdos_brax.skills.latent_map import MARGIN, Prior, latent_map
from qdos_brax.skills.vae import Posterior, Segments, SkillModel

Box = jax.Array | float  # half the side of the box of latents, ``skills.latent_box``


class LowLevelPolicy(Protocol):
    """Define a low-level policy: what the high level's action does. Observations are normalised; leading axes are free
    but for ``posterior``.

    Attributes:
        width: of u and z.
        reach: steps from a segment's first observation to the one that tells the posterior what came after, or None:
            those of the segment.
    """

    width: int
    reach: int | None

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return q(z | segment), [B, width] each; log_std is -inf where z is known exactly.

        Args:
            params: of the source.
            segments: windows of the data.
            after: [B, obs], the observation ``reach`` steps after each window's first, or the episode's last.
        """
        ...

    def to_latent(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return z[..., width] that u[..., width] plays, begun at observation[..., obs]."""
        ...

    def to_action(self, params: Any, latent: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u[..., width] that plays z, inside the box."""
        ...

    def first(self, params: Any, key: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return a random u[..., width], for the first steps online."""
        ...

    def log_prior(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Log density[...] at u of what the actor may be held near: the skill prior, or uniform where there is none."""
        ...

    def begin(self, params: Any, latent: jax.Array, observation: jax.Array) -> jax.Array:
        """Return skill[..., s]: z, then whatever must be remembered of observation[..., obs], where it begins."""
        ...

    def act(self, params: Any, observation: jax.Array, skill: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the action[..., act] of a skill that began ``step`` steps ago, in [-1, 1]."""
        ...


class TunableSkills(LowLevelPolicy, Protocol):
    """Define skills whose actions can be corrected: parameters that hold a "correction" play with it.

    Attributes:
        skill_size: numbers of a skill, as ``begin`` returns it.
        context_size: numbers that ``context`` returns.
    """

    skill_size: int
    context_size: int

    def context(self, params: Any, observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return what the decoder is shown, [..., context_size]."""
        ...

    def init_correction(self, key: jax.Array, bound: jax.Array | float) -> dict[str, Any]:
        """Return a correction that is zero everywhere: {"network": parameters, "bound": its largest component}."""
        ...

    def correction(self, params: Any, observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return what is added to the decoder's action, [..., act]."""
        ...


class LatentModel(Protocol):
    """Define a latent-variable model of behaviour: its prior and its decoder."""

    latent_dim: int

    def prior(self, params: Any, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return p(z | s): (mean[..., z], log standard deviation[..., z])."""
        ...

    def act(self, params: Any, observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return the action[..., act] of a skill, in [-1, 1]."""
        ...


class AnywhereSkills:
    """Play skills that remember nothing of where they begin."""

    reach: int | None = None

    def begin(self, params: Any, latent: jax.Array, observation: jax.Array) -> jax.Array:
        """Return z."""
        return latent


class LatentSkills(AnywhereSkills):
    """Play the latents of a model with a state prior; subclasses add the posterior.

    Args:
        model: the model.
        map_name: of the map between u and z ("arctanh", "box" or "prior").
    """

    def __init__(self, model: LatentModel, map_name: str) -> None:
        self.width = model.latent_dim
        self._model, self._map_name = model, map_name

    def to_latent(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return z[..., width] of u[..., width] by the latent map."""
        return latent_map(self._map_name, box).to_latent(action, self._prior(params, observation))

    def to_action(self, params: Any, latent: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u[..., width] of z[..., width] by the latent map."""
        return latent_map(self._map_name, box).to_action(latent, self._prior(params, observation))

    def first(self, params: Any, key: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u of a sample z ~ p(z | s) (SUPE)."""
        prior = self._prior(params, observation)
        return latent_map(self._map_name, box).to_action(gaussian_sample(key, *prior), prior)

    def log_prior(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return log p(z(u) | s) + log |dz / du|."""
        prior = self._prior(params, observation)
        mapping = latent_map(self._map_name, box)
        latent = mapping.to_latent(action, prior)
        return gaussian_log_prob(latent, *prior) + mapping.log_jacobian(action, prior)

    def act(self, params: Any, observation: jax.Array, skill: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the decoder's mean action."""
        return self._model.act(params, observation, skill)

    def _prior(self, params: Any, observation: jax.Array) -> Prior:
        return Prior(*self._model.prior(params, observation))


class TrajectorySkills(LatentSkills):
    """Play the latents of the trajectory VAE: z says what a whole segment does, or, of outcomes, what comes of it.

    Args:
        model: posterior, prior and decoder.
        map_name: of the map between u and z.
    """

    def __init__(self, model: SkillModel, map_name: str) -> None:
        super().__init__(model, map_name)
        self._skills, self.reach = model, model.reach
        self.skill_size, self.context_size = model.skill_size, model.context_size

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return the model's posterior."""
        return self._skills.encode(params, segments._replace(later=after))

    def begin(self, params: Any, latent: jax.Array, observation: jax.Array) -> jax.Array:
        """Return z and the pose in which it begins."""
        return self._skills.begin(params, latent, observation)

    def context(self, params: Any, observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return the view of the observation, and z."""
        return self._skills.context(params, observation, skill)

    def init_correction(self, key: jax.Array, bound: jax.Array | float) -> dict[str, Any]:
        """Return a network like the decoder whose last layer is zero."""
        return self._skills.init_correction(key, bound)

    def correction(self, params: Any, observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return the bound times tanh of the network."""
        return self._skills.correction(params, observation, skill)


class TransitionSkills(LatentSkills):
    """Play latents that are read off single transitions (DiveOff): a segment's is the mean over its own.

    Args:
        model: prior and decoder.
        encode: (parameters, observation, action) -> (mean, log standard deviation) of the transition's latent.
        map_name: of the map between u and z.
    """

    def __init__(
        self,
        model: LatentModel,
        encode: Callable[[Any, jax.Array, jax.Array], tuple[jax.Array, jax.Array]],
        map_name: str,
    ) -> None:
        super().__init__(model, map_name)
        self._encode = encode

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return the posterior of the mean of the transitions' independent latents."""
        mean, log_std = self._encode(params, segments.observations, segments.actions)
        variance = jnp.mean(jnp.exp(2 * log_std), axis=1) / log_std.shape[1]
        return Posterior(jnp.mean(mean, axis=1), 0.5 * jnp.log(variance))


class DirectionSkills(AnywhereSkills):
    """Play directions of travel in a representation of states: z is a unit vector, and so is every u's (HILP).

    Args:
        width: of the representation.
        direction: (parameters, observation from, observation to) -> unit vector[..., width].
        act: (parameters, observation, z) -> action.
    """

    def __init__(
        self,
        width: int,
        direction: Callable[[Any, jax.Array, jax.Array], jax.Array],
        act: Callable[[Any, jax.Array, jax.Array], jax.Array],
    ) -> None:
        self.width = width
        self._direction, self._act = direction, act

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return the direction from the segment's first state to the one behind its last."""
        latent = self._direction(params, segments.observations[:, 0], after)
        return Posterior(latent, jnp.full_like(latent, -jnp.inf))

    def to_latent(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return z = u / ||u||."""
        return unit_vector(action)

    def to_action(self, params: Any, latent: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u = z: of all u that point in the direction, the one of length 1."""
        return jnp.clip(latent, -1 + MARGIN, 1 - MARGIN)

    def first(self, params: Any, key: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return a direction, uniform over the sphere."""
        latent = unit_vector(jax.random.normal(key, (*observation.shape[:-1], self.width)))
        return self.to_action(params, latent, observation, box)

    def log_prior(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return the log density of the uniform distribution over u."""
        return jnp.full(action.shape[:-1], -self.width * jnp.log(2.0))

    def act(self, params: Any, observation: jax.Array, skill: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the directional policy's action."""
        return self._act(params, observation, skill)
