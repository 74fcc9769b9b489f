"""The reward and mask that an offline macro transition is given: three options behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.data.transitions import Transition
from qdos_brax.labels.reward_model import RewardModel, RewardModelState


class OfflineReward(Protocol):
    """Define a labeller of offline rows; it may learn from online rows."""

    def init(self, key: jax.Array) -> Any:
        """Return what the labeller carries between steps."""
        ...

    def learn(self, state: Any, rows: Transition, learning_rate: Any, active: jax.Array) -> Any:
        """Make one gradient step on online rows[B], if ``active``."""
        ...

    def label(self, state: Any, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """Return (reward[B], mask[B]) of offline rows[B]; ``discount`` is the one within a macro step."""
        ...


class DataReward:
    """Label rows with the data set's own rewards and masks (rewards are present: the QDOS setting)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Return nothing to carry."""
        return {}

    def learn(self, state: Any, rows: Transition, learning_rate: Any, active: jax.Array) -> Any:
        """Return ``state`` as it is."""
        return state

    def label(self, state: Any, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """Return the rows' own reward and mask."""
        return rows.reward, rows.mask


class PredictedReward:
    """Label rows with the reward model's prediction and mask (SUPE on the kitchen; what the paper describes).

    Args:
        model: the reward model.
        see: what it is shown of normalised observations[..., obs].
    """

    def __init__(self, model: RewardModel, see: Callable[[jax.Array], jax.Array]) -> None:
        self._model, self._see = model, see

    def init(self, key: jax.Array) -> RewardModelState:
        """Return a fresh model."""
        return self._model.init(key)

    def learn(
        self, state: RewardModelState, rows: Transition, learning_rate: Any, active: jax.Array
    ) -> RewardModelState:
        """Make one step of both heads."""
        new = self._model.update(state, self._see(rows.observation), rows.action, rows.reward, rows.mask, learning_rate)
        return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, state)

    def label(self, state: RewardModelState, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """Return the predicted reward, and the probability of going on as mask."""
        reward, logit = self._model.predict(state.params, self._see(rows.observation), rows.action)
        return reward, jax.nn.sigmoid(logit)


class MinimumReward(PredictedReward):
    """Label rows with the lowest macro reward and the model's mask (SUPE on the mazes).

    Args:
        model: the reward model.
        see: what it is shown of normalised observations[..., obs].
        horizon: environment steps of a macro step.
        lowest: the lowest reward of an environment step.
    """

    def __init__(self, model: RewardModel, see: Callable[[jax.Array], jax.Array], horizon: int, lowest: float) -> None:
        super().__init__(model, see)
        self._horizon, self._lowest = horizon, lowest

    def label(self, state: RewardModelState, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """Return the lowest macro reward, and the probability of going on as mask."""
        _, mask = super().label(state, rows, discount)
        return jnp.full_like(rows.reward, self._lowest * jnp.sum(discount ** jnp.arange(self._horizon))), mask
