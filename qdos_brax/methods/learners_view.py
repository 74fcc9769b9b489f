"""What learners see of a task: its observations, or beside them what its body sees; the same in data and simulator."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np

import envs
from qdos_brax.config import Config
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.exchange import exchanged


def learners_env(config: Config, env: Any) -> Any:
    """Return a task as its learners see it (``observation.view``).

    Args:
        config: the run's configuration.
        env: the task, which offers that view, or what this function made of it.
    """
    return env if config.observation.view == "task" else envs.BesideBody(env.unwrapped)


def learners_dataset(env: Any, dataset: Dataset) -> Dataset:
    """Return the data of a task as the learners of ``env``, a ``learners_env``, see it."""
    return dataclasses.replace(
        dataset,
        observations=learners_observations(env, dataset.observations),
        next_observations=learners_observations(env, dataset.next_observations),
    )


def run_dataset(config: Config, env: Any, dataset: Dataset) -> Dataset:
    """Return what a run learns from, of the data as logged: things exchanged, and as the learners of ``env`` see it.

    Args:
        config: the run's configuration.
        env: its ``learners_env``.
        dataset: the data of the task.
    """
    return learners_dataset(env, exchanged(dataset, env, config.exchange.share, config.exchange.seed))


def learners_observations(env: Any, observations: np.ndarray) -> np.ndarray:
    """Return observations[..., obs] of the data as the learners of ``env``, a ``learners_env``, see them."""
    return np.asarray(_shown(env, observations)) if isinstance(env, envs.BesideBody) else observations


@partial(jax.jit, static_argnums=0)  # of this module: a jitted ``env.show`` would be compiled anew at every call
def _shown(env: envs.BesideBody, observations: jax.Array) -> jax.Array:
    return env.show(observations)
