"""The mutual-information term on outcomes: random skills are told apart by what happened, not by how.

An encoder of states and actions is content with skills that differ in small movements. Here it reads the change of slow
features alone, with noise, so that outcomes must differ by more than the noise to count. The place u at which z was
drawn does not depend on the start s_0, so that I(u; outcome) bounds I(u; outcome | s_0) from below: skills are asked to
mean the same wherever they begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.nn.networks import MLP
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.skills.forward_model import ForwardModel
from qdos_brax.skills.information import StateSource
from qdos_brax.skills.information_terms import Rollout
from qdos_brax.skills.outcomes import Outcomes
from qdos_brax.skills.vae import Segments, SkillModel

NOISE = 0.3  # standard deviation, in units of the data's root mean square outcome
_LEARNING_RATE = 1e-3
_BATCHES = 16  # of rollouts that are remembered
_ROWS = 256  # remembered outcomes, steps of rollouts and steps of the data per gradient step, each


class PlayedSkills(NamedTuple):
    """Hold skills that were played: seen[B, H + 1, seen], actions[B, H, act], and of ``Rollout`` the rest."""

    seen: jax.Array
    actions: jax.Array
    latent: jax.Array
    place: jax.Array
    weight: jax.Array


class OutcomeState(struct.PyTreeNode):
    """Hold what the term learns, {"encoder", "model"}, Adam's state, and the skills it remembers.

    Attributes:
        params: of encoder and forward model.
        opt_state: Adam's.
        memory: the last ``_BATCHES`` batches of played skills, a ring.
        batches: received so far.
    """

    params: Any
    opt_state: optax.OptState
    memory: PlayedSkills
    batches: jax.Array


class OutcomeTerm:
    """Identify skills by their outcomes alone.

    States of the simulator carry no gradient; a forward model, learned beside from the data and from the rollouts, says
    how the outcome of a rollout changes with its actions (``ForwardModel.follow``).

    Args:
        model: the skills.
        source: the simulator.
        outcomes: what counts as one.
        forward: the model of the next state.
        hidden: hidden widths of the encoder.
        batch: rollouts that are received at once.
        horizon: H.
    """

    def __init__(
        self,
        model: SkillModel,
        source: StateSource,
        outcomes: Outcomes,
        forward: ForwardModel,
        hidden: Sequence[int],
        batch: int,
        horizon: int,
    ) -> None:
        self.source, self._model, self._outcomes, self._forward = source, model, outcomes, forward
        self._encoder = MLP((*hidden, model.latent_dim))
        self._batch, self._horizon = batch, horizon

    def init(self, key: jax.Array) -> OutcomeState:
        """Return fresh networks and an empty memory."""
        encoder_key, model_key = jax.random.split(key)
        params = {
            "encoder": self._encoder.init(encoder_key, jnp.zeros((1, self._outcomes.directions.shape[1]))),
            "model": self._forward.init(model_key),
        }
        size, steps, model = self._batch * _BATCHES, self._horizon, self._model
        memory = PlayedSkills(
            jnp.zeros((size, steps + 1, model.seen_dim)),
            jnp.zeros((size, steps, model.action_dim)),
            jnp.zeros((size, model.latent_dim)),
            jnp.zeros((size, model.latent_dim)),
            jnp.zeros(size),
        )
        return OutcomeState(params, ADAM.init(params), memory, jnp.zeros((), jnp.int32))

    def receive(self, state: OutcomeState, params: Any, rollout: Rollout) -> tuple[OutcomeState, PlayedSkills]:
        """Keep the rollouts, in place of the oldest ones."""
        seen = self._model.see_along(params, rollout.observations)
        actions = self._act(params, seen[:, :-1], rollout.latent[:, None])
        played = PlayedSkills(seen, actions, rollout.latent, rollout.place, rollout.weight)
        first = state.batches % _BATCHES * self._batch
        memory = jax.tree.map(
            lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, first, axis=0), state.memory, played
        )
        return state.replace(memory=memory, batches=state.batches + 1), played

    def learn(
        self, state: OutcomeState, params: Any, segments: Segments, key: jax.Array
    ) -> tuple[OutcomeState, dict[str, jax.Array]]:
        """Make one gradient step of encoder and forward model."""
        skill_key, noise_key, step_key, data_key = jax.random.split(key, 4)
        filled = jnp.minimum(state.batches, _BATCHES) * self._batch
        index = jax.random.randint(skill_key, (_ROWS,), 0, filled)
        some = jax.tree.map(lambda leaf: leaf[index], state.memory)
        seen = self._model.see_along(params, segments.observations[:_ROWS])
        valid = some.weight > 0  # not of a simulation that broke
        played, played_from = _steps(step_key, some.seen, some.actions)
        logged, _ = _steps(data_key, seen, segments.actions)

        def loss(learned: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            error = self.error(learned["encoder"], some.seen[:, 0], some.seen[:, -1], some.place, noise_key)
            encoder_loss = jnp.mean(jnp.where(valid, error, 0.0))
            played_loss = jnp.mean(jnp.where(valid[played_from], self._forward.error(learned["model"], *played), 0.0))
            model_loss = (played_loss + jnp.mean(self._forward.error(learned["model"], *logged))) / 2
            return encoder_loss + model_loss, {"outcome_loss": encoder_loss, "forward_model_loss": model_loss}

        grads, info = jax.grad(loss, has_aux=True)(state.params)
        learned, opt_state = adam_step(state.params, state.opt_state, grads, _LEARNING_RATE)
        return state.replace(params=learned, opt_state=opt_state), info

    def loss(self, params: Any, state: OutcomeState, played: PlayedSkills, key: jax.Array) -> jax.Array:
        """Return mean_i w_i ||u_hat_i - u_i||^2 of the outcomes that ``params`` would have now; the decoder's loss."""
        end = self._forward.follow(
            state.params["model"], played.seen, played.actions, lambda x: self._act(params, x, played.latent)
        )
        encoder = jax.lax.stop_gradient(state.params["encoder"])
        return jnp.mean(played.weight * self.error(encoder, played.seen[:, 0], end, played.place, key))

    def error(self, encoder: Any, start: jax.Array, end: jax.Array, place: jax.Array, key: jax.Array) -> jax.Array:
        """Return ||u_hat - u||^2, [B], of what the encoder makes of the outcome, seen with noise."""
        outcome = self._outcomes.between(start, end)
        outcome = outcome + NOISE * jax.random.normal(key, outcome.shape)
        return jnp.sum((self._encoder.apply(encoder, outcome) - place) ** 2, axis=-1)

    def _act(self, params: Any, seen: jax.Array, latent: jax.Array) -> jax.Array:
        latent = jnp.broadcast_to(latent, (*seen.shape[:-1], latent.shape[-1]))
        return jnp.clip(self._model.decode_seen(params, seen, latent)[0], -1.0, 1.0)


def _steps(
    key: jax.Array, seen: jax.Array, actions: jax.Array
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
    """Return ``_ROWS`` random steps (before, action, after) of seen[B, T, seen] and actions[B, >= T - 1, act], and in
    which of the B each is.
    """
    which, when = jax.random.split(key)
    row = jax.random.randint(which, (_ROWS,), 0, seen.shape[0])
    time = jax.random.randint(when, (_ROWS,), 0, seen.shape[1] - 1)
    return (seen[row, time], actions[row, time], seen[row, time + 1]), row
