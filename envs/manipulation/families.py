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
    "cube": Family(
        make="envs.manipulation.cube:Cube",
        engines=("mujoco",),
        variants={
            "single": Variant(28, 5, episode_length=200, num_tasks=5),
            "double": Variant(37, 5, episode_length=500, num_tasks=5),
        },
        default_variant="single",
        default_task=2,
    ),
    "scene": Family(
        make="envs.manipulation.scene:SceneTask",
        engines=("mujoco",),
        variants={"": Variant(40, 5, episode_length=750, num_tasks=5)},
        default_variant="",
        default_task=2,
        alias_task=1,  # the paper's
    ),
}
