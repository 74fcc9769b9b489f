"""What acting and learning ask of the high level, whatever its policy and its losses are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax

from qdos_brax.data.transitions import Transition

AGENT = "agent"  # under which a phase leaves the whole state of an actor-critic, for the online phase to go on with
# (observation[B], action[B]) -> log density[B] that the actor is held against; without one, it is uniform (SAC).
Reference = Callable[[jax.Array, jax.Array], jax.Array]


class ActorCritic(Protocol):
    """Define a learner of decisions u in (-1, 1)^d from transitions, one member's; observations are normalised.

    Attributes:
        observation_dim: width of observations.
        action_dim: d.
    """

    observation_dim: int
    action_dim: int

    def start(self, key: jax.Array, hyper: dict[str, jax.Array]) -> Any:
        """Return its first state, a pytree of arrays.

        Args:
            key: for this member alone.
            hyper: one member's numbers by dotted configuration key.
        """
        ...

    def hyper(self, values: dict[str, jax.Array]) -> Any:
        """Return what the updates read of one member's numbers by dotted configuration key."""
        ...

    def update_critic(
        self, state: Any, batch: Transition, key: jax.Array, hyper: Any, reference: Reference | None = None
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Make one step of the critics and of their targets: (the state after, scalars for metrics.csv)."""
        ...

    def update_actor(
        self, state: Any, batch: Transition, key: jax.Array, hyper: Any, reference: Reference | None = None
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Make one step of whatever acts: (the state after, scalars for metrics.csv)."""
        ...

    def actor_params(self, state: Any) -> Any:
        """Return what ``act`` and ``mode`` need: nested dicts with text keys."""
        ...

    def act(self, actor: Any, key: jax.Array, observation: jax.Array) -> jax.Array:
        """Return a sampled decision[..., d] at observation[..., obs]."""
        ...

    def mode(self, actor: Any, observation: jax.Array) -> jax.Array:
        """Return the decision[..., d] of an evaluation at observation[..., obs]."""
        ...
