"""An actor-critic learned from the data alone, by the losses with which it goes on online."""

from __future__ import annotations

from typing import Any

import jax
from flax.serialization import to_state_dict

from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import window
from qdos_brax.data.transitions import macro_transitions
from qdos_brax.high_level.actor_critic import ActorCritic


class OfflineActorCritic:
    """Make critic and actor steps in turn on windows of the data (``qdos_brax.offline.learner.Learner``).

    A decision is the window's actions, one behind another.

    Args:
        actor_critic: what learns; its decisions are chunks of H actions.
        horizon: H.
        batch_size: windows per gradient step.
    """

    def __init__(self, actor_critic: ActorCritic, horizon: int, batch_size: int) -> None:
        self._actor_critic, self._horizon, self._batch_size = actor_critic, horizon, batch_size

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> Any:
        """Return fresh parameters."""
        return self._actor_critic.start(key, hyper)

    def update(
        self, state: Any, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Make one step of each on a batch of the data; reads the numbers of the group ``high_level``."""
        index_key, critic_key, actor_key = jax.random.split(key, 3)
        starts = data.starts[jax.random.randint(index_key, (self._batch_size,), 0, data.starts.shape[0])]
        actions = window(data.actions, starts, self._horizon).reshape(self._batch_size, -1)
        batch = macro_transitions(data, starts, self._horizon, hyper["high_level.discount"], actions)
        own = self._actor_critic.hyper(hyper)
        state, critic_info = self._actor_critic.update_critic(state, batch, critic_key, own)
        state, actor_info = self._actor_critic.update_actor(state, batch, actor_key, own)
        return state, critic_info | actor_info

    def params(self, state: Any) -> dict[str, Any]:
        """Return the whole state, Adam's included, as nested dicts: the online phase goes on with it."""
        return dict(to_state_dict(state))
