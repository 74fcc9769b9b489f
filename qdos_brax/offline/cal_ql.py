"""Another warm start for SAC: calibrated conservative Q-learning on labelled data (Cal-QL).

Nakamoto et al. 2023 (arXiv 2303.05479, eq. 5.1; code nakamotoo/Cal-QL), the offline phase of WSRL (Zhou, Peng, Li,
Levine, Kumar 2025, arXiv 2412.07762; code zhouzypaul/wsrl): SAC's own losses on the data, and a term that holds Q down
on decisions which the data lacks (CQL, Kumar et al. 2020), but on the actor's never below what the data went on to
earn. The conservative weight is fixed, as theirs for OGBench; on ant mazes theirs is a Lagrange multiplier.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from flax.serialization import to_state_dict

from qdos_brax.config import FlowConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import macro_return
from qdos_brax.data.transitions import Transition, macro_transitions
from qdos_brax.high_level.sac import SAC, SACHyper, SACState
from qdos_brax.nn.networks import tanh_gaussian_sample
from qdos_brax.nn.optim import Params


class CalQLHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: SAC's own, and the weight of the conservative term."""

    sac: SACHyper
    weight: jax.Array | float


class Proposals(struct.PyTreeNode):
    """Hold decisions that the data need not have: action[n, B, width] and their log density[n, B]."""

    action: jax.Array
    log_density: jax.Array


def decision_returns(
    data: DeviceData, starts: jax.Array, horizon: int, decisions: int, discount: jax.Array | float
) -> jax.Array:
    """Return what the data earned from each start on, [B], as a critic of decisions counts it.

    Windows follow each other until a mask is 0. An episode that is cut off goes on as in its last row for ever: at a
    step's cost of 1 its return ends in 1 / (1 - discount), as in the published code.

    Args:
        data: the data set.
        starts: int32[B].
        horizon: H, steps of a window, which is one decision.
        decisions: windows that reach the end of every episode.
        discount: within windows per environment step, between them per decision, as in ``macro_transitions``.
    """
    last = data.last[starts][:, None]
    rows = starts[:, None] + jnp.arange(decisions * horizon)
    inside = rows <= last
    rows = jnp.minimum(rows, last)
    rewards, masks = data.rewards[rows], jnp.where(inside, data.masks[rows], 1.0)
    shape = (len(starts), decisions, horizon)
    earned, _ = macro_return(*macro_return(rewards.reshape(shape), masks.reshape(shape), discount), discount)
    beyond, _ = macro_return(jnp.broadcast_to(rewards[:, -1:], (len(starts), horizon)), jnp.ones(horizon), discount)
    # A discount of 1 has no finite end: the bound is minus infinity, and bounds nothing.
    end = jnp.where(beyond == 0, 0.0, beyond / (1 - jnp.asarray(discount)))
    alive = jnp.prod(masks, axis=-1)
    return earned + jnp.where(alive == 0, 0.0, jnp.asarray(discount) ** decisions * end)


class CalQL:
    """Learn SAC's networks by Cal-QL on labelled windows (``qdos_brax.offline.learner.Learner``).

    Args:
        sac: what the online phase goes on with.
        horizon: H, steps of a window, which is one decision.
        longest: environment steps of the longest episode of the data.
        config: ``batch_size``, windows per gradient step, and ``conservative_actions``, proposals of each kind.
    """

    def __init__(self, sac: SAC, horizon: int, longest: int, config: FlowConfig) -> None:
        self._sac, self._horizon, self._batch_size = sac, horizon, config.batch_size
        self._decisions, self._proposals = -(-longest // horizon), config.conservative_actions

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> SACState:
        """Return fresh parameters."""
        return self._sac.start(key, hyper)

    def uniform(self, key: jax.Array, observation: jax.Array) -> Proposals:
        """Return decisions drawn from the whole box, for observation[B, obs]."""
        shape = (self._proposals, len(observation), self._sac.action_dim)
        action = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        return Proposals(action, jnp.full(shape[:2], -self._sac.action_dim * jnp.log(2.0)))

    def own(self, actor: Params, key: jax.Array, observation: jax.Array) -> Proposals:
        """Return decisions drawn from the actor at observation[B, obs]."""
        mean, log_std = self._sac.actor.apply(actor, observation)
        repeated = (jnp.broadcast_to(x, (self._proposals, *x.shape)) for x in (mean, log_std))
        return Proposals(*tanh_gaussian_sample(key, *repeated))

    def gap(
        self,
        critic: Params,
        batch: Transition,
        anywhere: Proposals,
        likely: tuple[Proposals, ...],
        returns: jax.Array,
    ) -> jax.Array:
        """Return by how much Q of proposals exceeds Q of the data's decisions, averaged over the batch, [critics].

        The soft maximum, log sum exp(Q - log density), of all proposals in the batch's states.

        Args:
            critic: parameters of the critics.
            batch: B decisions of the data.
            anywhere: uniform proposals, which nothing bounds.
            likely: the actor's, whose Q counts as at least the returns[B] of the data.
            returns: float[B], as ``decision_returns``.
        """
        states = jnp.broadcast_to(batch.observation, (self._proposals, *batch.observation.shape))
        q = [self._sac.values(critic, states, anywhere.action)]
        q += [jnp.maximum(self._sac.values(critic, states, some.action), returns) for some in likely]
        densities = [some.log_density for some in (anywhere, *likely)]
        soft = [value - density for value, density in zip(q, densities, strict=True)]
        most = jax.nn.logsumexp(jnp.concatenate(soft, axis=1), axis=1)
        return jnp.mean(most - self._sac.values(critic, batch.observation, batch.action), axis=-1)

    def step(
        self, state: SACState, batch: Transition, returns: jax.Array, key: jax.Array, hyper: CalQLHyper
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Make one step of the critics, their targets, the actor and the temperature.

        The bootstrap value is that of the best of the actor's proposals in the next state (``cql_max_target_backup``).
        """
        uniform_key, here_key, next_key, subset_key, actor_key = jax.random.split(key, 5)
        here = self.own(state.actor, here_key, batch.observation)
        ahead = self.own(state.actor, next_key, batch.next_observation)
        later = jnp.broadcast_to(batch.next_observation, (self._proposals, *batch.next_observation.shape))
        best = self._sac.smallest_of_subset(state.target_critic, subset_key, later, ahead.action).max(axis=0)
        target = batch.reward + hyper.sac.discount * batch.mask * best
        anywhere = self.uniform(uniform_key, batch.observation)

        def loss(critic: Params) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            error = self._sac.critic_loss(critic, batch, target)
            gap = self.gap(critic, batch, anywhere, (here, ahead), returns)
            return error + hyper.weight * gap.sum(), (error, gap.mean())

        grads, (error, gap) = jax.grad(loss, has_aux=True)(state.critic)
        state = self._sac.move_critic(state, grads, hyper.sac)
        state, info = self._sac.update_actor(state, batch, actor_key, hyper.sac)
        info |= {"critic_loss": error / self._sac.ensemble, "conservative_gap": gap, "q": jnp.mean(target)}
        return state, info

    def update(
        self, state: SACState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Make one step on a batch of labelled windows, with the data's own rewards.

        Reads the numbers of the group ``high_level`` and ``flow.conservative_weight``.
        """
        assert data.labels is not None  # the phase before this one made them
        index_key, step_key = jax.random.split(key)
        index = jax.random.randint(index_key, (self._batch_size,), 0, data.starts.shape[0])
        starts, discount = data.starts[index], hyper["high_level.discount"]
        batch = macro_transitions(data, starts, self._horizon, discount, data.labels[index])
        returns = decision_returns(data, starts, self._horizon, self._decisions, discount)
        own = CalQLHyper(self._sac.hyper(hyper), hyper["flow.conservative_weight"])
        return self.step(state, batch, returns, step_key, own)

    def params(self, state: SACState) -> dict[str, Any]:
        """Return SAC's whole state, Adam's included, as nested dicts: the online phase goes on with it."""
        return dict(to_state_dict(state))
