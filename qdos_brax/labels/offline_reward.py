"""The reward and mask that an offline macro transition is given: three options behind one interface."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.data.transitions import Transition
from qdos_brax.labels.reward_model import RewardModel, RewardModelState


class OfflineReward(Protocol):
    """A labeller: it may learn from online rows."""

    def init(self, key: jax.Array) -> Any:
        """What it carries."""
        ...

    def learn(self, state: Any, rows: Transition, learning_rate: Any, active: jax.Array) -> Any:
        """One gradient step on online rows[B], if ``active``."""
        ...

    def label(self, state: Any, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """(reward[B], mask[B]) of offline rows[B]; ``discount`` is the one within a macro step."""
        ...


class DataReward:
    """The data set's own rewards and masks: rewards are present (the QDOS setting)."""

    def init(self, key: jax.Array) -> dict[str, Any]:
        """Carries nothing."""
        return {}

    def learn(self, state: Any, rows: Transition, learning_rate: Any, active: jax.Array) -> Any:
        """Learns nothing."""
        return state

    def label(self, state: Any, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """As they are."""
        return rows.reward, rows.mask


class PredictedReward:
    """The reward model's prediction, and its mask (SUPE on the kitchen; what the paper describes).

    Args:
        model: the reward model.
    """

    def __init__(self, model: RewardModel) -> None:
        self._model = model

    def init(self, key: jax.Array) -> RewardModelState:
        """A fresh model."""
        return self._model.init(key)

    def learn(
        self, state: RewardModelState, rows: Transition, learning_rate: Any, active: jax.Array
    ) -> RewardModelState:
        """One step of both heads."""
        new = self._model.update(state, rows.observation, rows.action, rows.reward, rows.mask, learning_rate)
        return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, state)

    def label(self, state: RewardModelState, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """Prediction, and the probability of going on."""
        reward, logit = self._model.predict(state.params, rows.observation, rows.action)
        return reward, jax.nn.sigmoid(logit)


class MinimumReward(PredictedReward):
    """The lowest macro reward, with the model's mask (SUPE on the mazes).

    Args:
        model: the reward model.
        horizon: environment steps of a macro step.
        lowest: the lowest reward of an environment step.
    """

    def __init__(self, model: RewardModel, horizon: int, lowest: float) -> None:
        super().__init__(model)
        self._horizon, self._lowest = horizon, lowest

    def label(self, state: RewardModelState, rows: Transition, discount: Any) -> tuple[jax.Array, jax.Array]:
        """The constant, and the probability of going on."""
        _, mask = super().label(state, rows, discount)
        return jnp.full_like(rows.reward, self._lowest * jnp.sum(discount ** jnp.arange(self._horizon))), mask
