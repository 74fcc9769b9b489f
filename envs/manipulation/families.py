"""Describe the manipulation families as plain data: variants, caps. Loads no jax."""

from __future__ import annotations

from envs.families import Family, Variant

MANIPULATION_FAMILIES = {
    "kitchen": Family(
        make="envs.manipulation.kitchen:Kitchen",
        engines=("mujoco",),
        variants=dict.fromkeys(("mixed", "partial", "complete"), Variant(59, 9, episode_length=280)),
        default_variant="mixed",
    ),
}
