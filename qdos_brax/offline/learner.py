"""What the offline phase asks of a learner."""

from __future__ import annotations

from typing import Any, Protocol

import jax

from qdos_brax.data.device import DeviceData


class Learner(Protocol):
    """Define a learner on the data set; everything it does is of one member of the population and can be jitted."""

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> Any:
        """Return its state, a pytree of arrays; ``hyper`` holds one member's numbers by dotted configuration key."""
        ...

    def update(
        self, state: Any, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Make one gradient step of everything that learns, on a batch that it draws from ``data`` with ``key``.

        Args:
            state: as ``init`` made it.
            data: the data set; observations are normalised.
            key: for this step alone.
            hyper: one member's numbers by dotted configuration key.

        Returns:
            (the state after, scalars for metrics.csv).
        """
        ...

    def params(self, state: Any) -> dict[str, Any]:
        """Return what the phases after and the evaluation need: nested dicts with text keys."""
        ...


class PolicyLearner(Learner, Protocol):
    """Define a learner of a policy that decides at every step."""

    def act(self, params: dict[str, Any], observation: jax.Array) -> jax.Array:
        """Return the policy's mode, [..., act] in [-1, 1], at normalised observations[..., obs]."""
        ...
