"""HILP (Park, Kreiman, Levine 2024): distances as norms in a representation phi, skills as directions in it.

phi is learned by goal-conditioned implicit Q-learning with V(s, g) = -||phi(s) - phi(g)||, which at its optimum is the
(discounted) number of steps from s to g. A skill is a unit vector z, its reward <phi(s') - phi(s), z>, and pi(a | s, z)
is learned from that by IQL with advantage-weighted regression. Losses, goals and numbers follow the authors' code for
goal-conditioned control (github.com/seohongpark/HILP, hilp_gcrl): batch 1024, three layers of 512, expectile 0.95 for
phi and 0.9 for the skills, beta 10, discount 0.99, d = 32, 10^6 updates (kitchen: 5 x 10^5).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import HilbertConfig, PolicyConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.nn.networks import MLP
from qdos_brax.nn.optim import ADAM, adam_step, polyak
from qdos_brax.nn.vectors import unit_vector
from qdos_brax.offline.iql_policy import IQLPolicy, IQLPolicyHyper, IQLPolicyState
from qdos_brax.offline.rows import random_rows
from qdos_brax.skills.values import IQL, ValueBatch, ValueHyper

Params = Any
_HEADS = 2  # phi and its twin; skills and distances are those of the first


class GoalBatch(NamedTuple):
    """Hold transitions with goals, leading axis B; ``reached``[B] is 1 where the state is its goal."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    goal: jax.Array
    reached: jax.Array


class HilbertHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary.

    Attributes:
        learning_rate: Adam's, of all networks.
        expectile: of phi's value.
        skill_expectile: of the skills' value.
        discount: per step, of both.
        target_rate: Polyak rate of both targets.
        inverse_temperature: beta of the skills' weights exp(beta A).
    """

    learning_rate: jax.Array | float
    expectile: jax.Array | float
    skill_expectile: jax.Array | float
    discount: jax.Array | float
    target_rate: jax.Array | float
    inverse_temperature: jax.Array | float


class HilbertState(struct.PyTreeNode):
    """Hold phi's two heads (first axis of every leaf), their target, Adam's state, and the learner of skills."""

    phi: Params
    target_phi: Params
    phi_opt_state: optax.OptState
    skills: IQLPolicyState


def goal_rows(
    data: DeviceData, rows: jax.Array, key: jax.Array, discount: jax.Array | float, random_share: jax.Array | float
) -> jax.Array:
    """Return int32[B], a goal for each of ``rows``[B]: a later row of its episode, or any row of the data.

    Args:
        data: the data set.
        rows: int32[B].
        key: for the draw.
        discount: later rows are a geometric number of steps ahead, 1 / (1 - discount) on average, at most the last.
        random_share: share of goals that are any row.
    """
    ahead_key, any_key, kind_key = jax.random.split(key, 3)
    uniform = jax.random.uniform(ahead_key, rows.shape, minval=1e-6)
    ahead = jnp.ceil(jnp.log(uniform) / jnp.log(discount)).astype(jnp.int32)
    future = jnp.minimum(rows + ahead, data.last[rows])
    anywhere = random_rows(data, any_key, rows.shape[0])
    return jnp.where(jax.random.uniform(kind_key, rows.shape) < random_share, anywhere, future)


class Hilbert:
    """Learn phi and its skills, one step each per update (``qdos_brax.offline.learner.Learner``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        latent_dim: dimension of phi and of z.
        config: widths of all networks, batch size, and share of random goals.
    """

    def __init__(self, observation_dim: int, action_dim: int, latent_dim: int, config: HilbertConfig) -> None:
        self.observation_dim, self.latent_dim = observation_dim, latent_dim
        self.batch_size, self.random_goals = config.batch_size, config.random_goals
        self._phi = MLP((*config.hidden, latent_dim), layer_norm=True)
        width = observation_dim + latent_dim
        policy = PolicyConfig(hidden=config.hidden, batch_size=config.batch_size)
        self.skills = IQLPolicy(width, action_dim, policy, IQL(width, action_dim, config.hidden))

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> HilbertState:
        """Return fresh parameters; the target starts as a copy."""
        phi_key, skills_key = jax.random.split(key)
        heads = jax.random.split(phi_key, _HEADS)
        phi = jax.vmap(self._phi.init, in_axes=(0, None))(heads, jnp.zeros((1, self.observation_dim)))
        return HilbertState(phi, jax.tree.map(jnp.copy, phi), ADAM.init(phi), self.skills.init(skills_key, hyper))

    # --- What it gives to others, from ``params`` ------------------------------------------------------------

    def represent(self, params: dict[str, Any], observation: jax.Array) -> jax.Array:
        """Return phi(s), [..., latent]; ``observation`` is normalised."""
        return self._first(params["phi"], observation)

    def direction(self, params: dict[str, Any], start: jax.Array, end: jax.Array) -> jax.Array:
        """Return the skill that leads from observation ``start`` to ``end``[..., obs]: phi(end) - phi(start) of
        length 1.

        Where the two coincide it is 0.
        """
        return unit_vector(self.represent(params, end) - self.represent(params, start))

    def act(self, params: dict[str, Any], observation: jax.Array, latent: jax.Array) -> jax.Array:
        """Return the mode of pi(a | s, z), [..., act] in [-1, 1]."""
        return self.skills.act({"actor": params["policy"]}, jnp.concatenate([observation, latent], axis=-1))

    def params(self, state: HilbertState) -> dict[str, Any]:
        """Return {"phi", "policy"}."""
        return {"phi": state.phi, "policy": state.skills.actor}

    # --- Learning --------------------------------------------------------------------------------------------

    def distance(self, phi: Params, observation: jax.Array, goal: jax.Array) -> jax.Array:
        """Return ||phi(s) - phi(g)|| of both heads, [2, B], at least 1e-3 (where its gradient would not be finite)."""
        both = jax.vmap(self._phi.apply, in_axes=(0, None))
        squared = jnp.sum((both(phi, observation) - both(phi, goal)) ** 2, axis=-1)
        return jnp.sqrt(jnp.maximum(squared, 1e-6))

    def distance_loss(self, phi: Params, target_phi: Params, batch: GoalBatch, hyper: HilbertHyper) -> jax.Array:
        """Return the loss of the expectile regression of V = -distance to -1 + discount V(s', g), each head to its
        own target.

        The side of the expectile is that of the smaller next value against the mean of the heads, both of the target.
        """
        live = 1 - batch.reached
        next_value = -self.distance(target_phi, batch.next_observation, batch.goal)
        target = -live + hyper.discount * live * next_value
        advantage = target.min(axis=0) + self.distance(target_phi, batch.observation, batch.goal).mean(axis=0)
        weight = jax.lax.stop_gradient(jnp.where(advantage < 0, 1 - hyper.expectile, hyper.expectile))
        error = jax.lax.stop_gradient(target) + self.distance(phi, batch.observation, batch.goal)
        return jnp.mean(jnp.sum(weight * error**2, axis=0))

    def skill_batch(self, phi: Params, batch: GoalBatch, latent: jax.Array, discount: jax.Array | float) -> ValueBatch:
        """Return the transitions as skills z = ``latent``[B, d] see them: endless, reward <phi(s') - phi(s), z>."""
        moved = self._first(phi, batch.next_observation) - self._first(phi, batch.observation)
        return ValueBatch(
            observation=jnp.concatenate([batch.observation, latent], axis=-1),
            action=batch.action,
            reward=jax.lax.stop_gradient(jnp.sum(moved * latent, axis=-1)),
            discount=jnp.broadcast_to(discount, batch.reached.shape),
            next_observation=jnp.concatenate([batch.next_observation, latent], axis=-1),
        )

    def step(
        self, state: HilbertState, batch: GoalBatch, latent: jax.Array, hyper: HilbertHyper
    ) -> tuple[HilbertState, dict[str, jax.Array]]:
        """Make one step of phi and its target on ``batch``, and one of the skills ``latent``[B, d] on it."""
        loss, grads = jax.value_and_grad(self.distance_loss)(state.phi, state.target_phi, batch, hyper)
        phi, opt_state = adam_step(state.phi, state.phi_opt_state, grads, hyper.learning_rate)
        target_phi = polyak(state.target_phi, phi, hyper.target_rate)
        values = ValueHyper(hyper.learning_rate, hyper.skill_expectile, hyper.target_rate)
        skill_hyper = IQLPolicyHyper(values, hyper.learning_rate, hyper.inverse_temperature)
        seen = self.skill_batch(state.phi, batch, latent, hyper.discount)
        skills, info = self.skills.step(state.skills, seen, skill_hyper)
        return HilbertState(phi, target_phi, opt_state, skills), info | {"distance_loss": loss}

    def update(
        self, state: HilbertState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[HilbertState, dict[str, jax.Array]]:
        """Make one step on a batch of the data with random goals and random skills.

        Reads ``hilbert.learning_rate``, ``.expectile``, ``.skill_expectile``, ``.discount``, ``.target_rate`` and
        ``.inverse_temperature``.
        """
        own = HilbertHyper(**{name: hyper[f"hilbert.{name}"] for name in HilbertHyper.__dataclass_fields__})
        rows_key, goal_key, latent_key = jax.random.split(key, 3)
        rows = random_rows(data, rows_key, self.batch_size)
        goals = goal_rows(data, rows, goal_key, own.discount, self.random_goals)
        batch = GoalBatch(
            observation=data.observations[rows],
            action=data.actions[rows],
            next_observation=data.next_observations[rows],
            goal=data.observations[goals],
            reached=(goals == rows).astype(jnp.float32),
        )
        return self.step(state, batch, random_directions(latent_key, self.batch_size, self.latent_dim), own)

    def _first(self, phi: Params, observation: jax.Array) -> jax.Array:
        return self._phi.apply(jax.tree.map(lambda p: p[0], phi), observation)


def random_directions(key: jax.Array, size: int, dim: int) -> jax.Array:
    """Return float32[size, dim], uniform on the unit sphere."""
    return unit_vector(jax.random.normal(key, (size, dim)))
