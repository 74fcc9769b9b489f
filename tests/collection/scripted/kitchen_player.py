"""Play scripted demonstrations in the batch stepper, without a collector."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from qdos_brax.collection.scripted.demonstrator import SimStates
from qdos_brax.collection.scripted.kitchen import KitchenDemonstrator


def play(
    env: Any, demonstrator: KitchenDemonstrator, kinds: np.ndarray, steps: int, seed: int = 0
) -> Iterator[tuple[SimStates, np.ndarray, np.ndarray]]:
    """Yield (states before, actions, quality) of every step, and at last the states after with no actions."""
    rng, stepper, n = np.random.default_rng(seed), env.engine._stepper, len(kinds)

    def noise() -> np.ndarray:
        return rng.uniform(-1, 1, (n, 59)).astype(np.float32)

    states = demonstrator.begin(kinds, rng)
    qpos, qvel = states.qpos.astype(np.float32), states.qvel.astype(np.float32)
    memory, sensed = stepper.start(qpos, qvel, states.extra, noise())
    exact = np.concatenate([np.zeros((n, stepper.nstate)), memory], axis=1)
    states = states._replace(sensed=sensed)
    for index in range(steps):
        actions, quality = demonstrator.act(states, rng)
        yield states, actions, quality
        exact, extra, sensed = stepper.step(exact, np.full(n, index == 0), qpos, qvel, states.extra, actions, noise())
        states = SimStates(*stepper.positions(exact), extra, sensed)
        qpos, qvel = states.qpos.astype(np.float32), states.qvel.astype(np.float32)
    yield states, np.zeros((n, 0)), np.zeros(n, np.int8)
