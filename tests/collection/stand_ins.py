"""Stand-in experts and compiled collectors that the tests of this folder share."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import envs
from qdos_brax.collection.collector import Collector
from qdos_brax.collection.profiles import profile_of
from qdos_brax.collection.recipes import CollectionRecipe, degraded, named


class StandIn:
    """Act on everything a walker sees, without knowing how to walk."""

    params = np.ones(3, np.float32)

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return jnp.sin(jnp.concatenate([3 * direction, qvel[:3], qpos[2:3], qpos[7:9]]))


class StandInDribbler(StandIn):
    """Do the same with a ball: turn the other way."""

    walker = StandIn()

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return -super().act(qpos, qvel, direction)


class Limp(StandIn):
    """Let a humanoid fall, within a second or so."""

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return jnp.zeros(21)


EXPERTS = {"antmaze": StandIn, "antsoccer": StandInDribbler, "humanoidmaze": Limp}

make_env = cache(lambda name: envs.make(name, physics="mujoco"))


@cache
def collector(task: str, recipe: str) -> Collector:
    """Return a task's collector with its stand-in; "mixed" has half of the episodes degraded.

    The same object is returned to every test, so that its programs are compiled once.
    """
    env = make_env(task)
    return Collector(env, recipe_of(env, recipe), EXPERTS[env.spec.family]())


def recipe_of(env: envs.Task, name: str) -> CollectionRecipe:
    return degraded(0.5, profile_of(env)) if name == "mixed" else named(name, profile_of(env))
