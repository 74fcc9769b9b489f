"""The weight of the mutual-information loss: a number, or a multiplier that holds a constraint.

With ``skills.alpha=auto`` the skills minimise the VAE loss subject to E <= e, where E is the share of z's variance that
cannot be read back from what random skills do: L_info over d c^2 / 3, its value for a decoder of z that says 0 always
(each of the d coordinates of z is uniform in [-c, c]). alpha is the constraint's multiplier, whose logarithm ascends by
``skills.alpha_rate`` (E - e) per gradient step, so that alpha stays positive. E is measured on fresh rollouts, before a
gradient step has seen them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from qdos_brax.config import is_auto

START, LOWEST, HIGHEST = 0.2, 0.02, 2.0  # the default of skills.alpha, a tenth of it and ten times as much


def unreadable_share(loss: jax.Array, weight: jax.Array, box: Any, latent_dim: int) -> jax.Array:
    """Return L_info over what it is where nothing of z, uniform in [-box, box]^d, can be read back: d box^2 / 3.

    Args:
        loss: L_info, with the weights in it.
        weight: [B], the weights, whose mean is divided out.
        box: half the side of the box that z, or the place it is drawn at, comes from.
        latent_dim: d.
    """
    return loss / jnp.maximum(jnp.mean(weight) * latent_dim * box**2 / 3, 1e-6)


class Alpha(Protocol):
    """Define what weighs the mutual-information loss."""

    def start(self) -> dict[str, jax.Array]:
        """Return what is carried between gradient steps."""
        ...

    def after_rollouts(
        self, state: Any, error: Callable[[], jax.Array], steps: int, hyper: dict[str, jax.Array]
    ) -> dict[str, jax.Array]:
        """Return the state for the next ``steps`` gradient steps.

        Args:
            state: as before.
            error: gives E on fresh rollouts; a function, so that only who needs it pays for it.
            steps: gradient steps that the rollouts serve.
            hyper: one member's numbers by dotted key.
        """
        ...

    def weight(self, state: Any, hyper: dict[str, jax.Array]) -> jax.Array:
        """Return alpha."""
        ...

    def metrics(self, state: Any, hyper: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Return scalars for metrics.csv."""
        ...


class FixedAlpha:
    """Hold alpha at the member's number."""

    def start(self) -> dict[str, jax.Array]:
        """Return nothing to carry."""
        return {}

    def after_rollouts(
        self, state: Any, error: Callable[[], jax.Array], steps: int, hyper: dict[str, jax.Array]
    ) -> dict[str, jax.Array]:
        """Return nothing to carry."""
        return {}

    def weight(self, state: Any, hyper: dict[str, jax.Array]) -> jax.Array:
        """Return ``skills.alpha``."""
        return hyper["skills.alpha"]

    def metrics(self, state: Any, hyper: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Return nothing: the member's own column says it."""
        return {}


class AdaptiveAlpha:
    """Move the multiplier where a member's ``skills.alpha`` is auto; the other members keep their numbers."""

    def start(self) -> dict[str, jax.Array]:
        """Return log alpha, and the last E, not measured yet."""
        return {"log_alpha": jnp.log(jnp.asarray(START)), "error": jnp.ones(())}

    def after_rollouts(
        self, state: Any, error: Callable[[], jax.Array], steps: int, hyper: dict[str, jax.Array]
    ) -> dict[str, jax.Array]:
        """Return the state after an ascent of ``steps`` steps, within a tenth and ten times the start."""
        found = error()
        ascent = steps * hyper["skills.alpha_rate"] * (found - hyper["skills.alpha_error"])
        return {
            "log_alpha": jnp.clip(state["log_alpha"] + ascent, jnp.log(LOWEST), jnp.log(HIGHEST)),
            "error": found,
        }

    def weight(self, state: Any, hyper: dict[str, jax.Array]) -> jax.Array:
        """Return the multiplier, or the member's number."""
        return jnp.where(is_auto(hyper["skills.alpha"]), jnp.exp(state["log_alpha"]), hyper["skills.alpha"])

    def metrics(self, state: Any, hyper: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Return alpha as "information_weight", and E as "information_error"."""
        return {"information_weight": self.weight(state, hyper), "information_error": state["error"]}
