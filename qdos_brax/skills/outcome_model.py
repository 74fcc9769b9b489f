"""Skills that are outcomes: z says how far body and things get in the next K steps, the decoder makes it happen.

The posterior of a trajectory VAE may fill z with the noise of a segment's actions, and what is left of it says little
about where things go. Here z is read off the data, K steps ahead, and the decoder learns to act as the data did before
it happened: outcome-conditioned behaviour cloning (GCSL, Ghosh et al. 2021; RvS, Emmons et al. 2022). K may be longer
than a macro step: the high level says what shall have happened K steps on, and thinks again after H.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp

from envs.body_frame import BodyFrame, Frame
from qdos_brax.config import SkillsConfig
from qdos_brax.data.device import Normaliser
from qdos_brax.errors import UserError
from qdos_brax.nn.networks import gaussian_log_prob
from qdos_brax.skills.vae import Params, Posterior, Segments, SkillModel
from qdos_brax.skills.views import BodyView, in_own_units

_USUAL_WAY = 3.0  # m; what the decoder sees as 1


class OutcomeView:
    """Show the observation from the body's present pose, then each point's gap d to it once more as d / (1 + |d|), d in
    m, which tells near ones apart, then the body's place (normalised) and (cos, sin) of its yaw.

    Args:
        frame: the task's.
    """

    pose_size = 0

    def __init__(self, frame: BodyFrame) -> None:
        self._frame, self._body = frame, BodyView(frame)

    def size(self, observation_size: int) -> int:
        """Return the numbers of the frame, of the gaps and of a pose."""
        return self._body.size(observation_size) + 2 * len(self._frame.points) + self._frame.pose_size

    def fit(self, windows: jax.Array, normaliser: Normaliser) -> dict[str, Any]:
        """Return what the body's view must know of the data."""
        return self._body.fit(windows, normaliser)

    def pose(self, params: Any, observation: jax.Array) -> jax.Array:
        """Return an empty pose."""
        return self._body.pose(params, observation)

    def see(self, params: Any, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return what the body sees, then where it is."""
        own, place = in_own_units(params, observation), observation[..., self._frame.place : self._frame.place + 2]
        gaps = self._frame.gaps(own)
        near = gaps / (1 + jnp.linalg.norm(gaps, axis=-1, keepdims=True))
        near = near.reshape(*near.shape[:-2], -1)
        parts = [self._body.see(params, observation, pose), near, place, self._frame.pose(own)[..., 2:]]
        return jnp.concatenate(parts, axis=-1)


class OutcomeModel(SkillModel):
    """Combine a prior over outcomes and a decoder that is told one; the posterior is the outcome itself.

    z holds the ways of the body and of the task's other points in the plane, x and y of each in m, in the world's axes,
    and behind them the levels that the body will have, such as the height of a humanoid's head. The decoder sees them
    turned the way the body faces, and as what is still to happen in K steps, however long the skill has been playing.

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        config: K (``outcome_steps``), widths, and the dimension of z, which must be that of the ways.
        frame: the task's.

    Raises:
        UserError: the task's frame tells no ways, or z has another dimension.
    """

    def __init__(self, observation_dim: int, action_dim: int, config: SkillsConfig, frame: Frame | None) -> None:
        if not isinstance(frame, BodyFrame):
            raise UserError("this task tells no ways of bodies for skills.model=outcome; use --set skills.model=vae")
        if config.latent_dim != frame.ways_size:
            raise UserError(
                f"outcomes of this task have {frame.ways_size} numbers, skills.latent_dim is {config.latent_dim}; "
                f"use --set skills.latent_dim={frame.ways_size}"
            )
        super().__init__(observation_dim, action_dim, config, OutcomeView(frame))
        self._frame, self.reach = frame, config.outcome_steps
        self.context_size = self.seen_dim - frame.pose_size + self.latent_dim

    def init(self, key: jax.Array, view: Mapping[str, Params] = MappingProxyType({})) -> dict[str, Params]:
        """Return fresh parameters: {"prior", "decoder", "view"}."""
        prior_key, decoder_key = jax.random.split(key)
        prior = self._prior.init(prior_key, jnp.zeros((1, self._frame.pose_size + self._frame.ways_size - 2)))
        decoder = self._decoder.init(decoder_key, jnp.zeros((1, self.context_size)))
        return {"prior": prior, "decoder": decoder, "view": dict(view)}

    def prior(self, params: dict[str, Params], observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return p(z | places), of where body and points are, how the body faces and how high the levels are:
        (mean[..., z], log_std[..., z]).

        Speed and joints would tell where the data went on to, and leave the high level little else to choose.
        """
        pose = self.view.see(params["view"], observation, observation[..., :0])[..., -self._frame.pose_size :]
        points = [observation[..., index : index + 2] for index in self._frame.points]
        levels = self._frame.levels_of(observation)
        return self._prior.apply(params["prior"], jnp.concatenate([pose, *points, levels], axis=-1))

    def encode(self, params: dict[str, Params], segments: Segments) -> Posterior:
        """Return what happens from a segment's first observation to ``segments.later``; log_std is -inf."""
        assert segments.later is not None  # who asks for the posterior of this model sees to it
        first, later = (in_own_units(params["view"], x) for x in (segments.observations[:, 0], segments.later))
        outcome = self._frame.ways(first, later)
        return Posterior(outcome, jnp.full_like(outcome, -jnp.inf))

    def shown(self, seen: jax.Array, latent: jax.Array) -> jax.Array:
        """Return what the body sees, and the outcome as it would look from there."""
        pose = seen[..., -self._frame.pose_size :]
        ahead = self._frame.turned_ways(latent, pose) / _USUAL_WAY
        return jnp.concatenate([seen[..., : -self._frame.pose_size], ahead], axis=-1)

    def divergence_and_likelihood(
        self, params: dict[str, Params], segments: Segments, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return -log p(z | s) and log pi(a | s, z) of each segment's first step, z its outcome, [B] each.

        A posterior that is a point has no entropy to count, and nothing is sampled.
        """
        first, outcome = segments.observations[:, 0], self.encode(params, segments).mean
        log_likelihood = gaussian_log_prob(segments.actions[:, 0], *self.decode(params, first, outcome))
        return -gaussian_log_prob(outcome, *self.prior(params, first)), log_likelihood
