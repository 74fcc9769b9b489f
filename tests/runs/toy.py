"""A learner of two phases that costs nothing, with every kind of leaf a real state has; also a program to be killed.

``python -m tests.runs.toy DIR [SECONDS]`` runs it in DIR, sleeping SECONDS in every chunk.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.loop import run_phases
from qdos_brax.runs.metrics import Observer

MEMBERS = [{"seed": seed, "alpha": alpha} for seed in (0, 7) for alpha in (0.1, 0.3)]
ADAM = optax.adam(1e-2)
HEADER = {"env": "toy", "method": "qdos", "preset": "smoke", "physics": "none"}


class Optimizer(NamedTuple):
    count: jax.Array
    state: Any


@struct.dataclass
class ToyState:
    keys: jax.Array
    params: dict[str, jax.Array]
    optimizer: Optimizer
    bits: jax.Array
    flags: jax.Array
    nothing: Any
    empty: jax.Array


class ToyPhase:
    """Follows a random gradient; ``chunks_run`` counts the chunks of this process."""

    def __init__(self, name: str, num_chunks: int, sleep: float = 0.0) -> None:
        self.name, self.num_chunks, self.sleep = name, num_chunks, sleep
        self.part = name
        self.chunks_run = 0

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[ToyState, None]:
        start = artifacts["policy"]["w"] if artifacts else jnp.zeros((len(MEMBERS), 3))
        params = {"w": start + jax.vmap(lambda k: jax.random.normal(k, (3,)))(key)}
        state = ToyState(
            keys=key,
            params=params,
            optimizer=Optimizer(jnp.zeros((), jnp.int32), ADAM.init(params)),
            bits=jnp.full((2,), 0xFFFFFFF0, jnp.uint32),
            flags=jnp.zeros((len(MEMBERS),), bool),
            nothing=None,
            empty=jnp.zeros((0, 4)),
        )
        return state, None

    def chunk(self, state: ToyState, constants: None) -> tuple[ToyState, dict[str, Any]]:
        time.sleep(self.sleep)
        self.chunks_run += 1
        state, loss = _many_steps(state)
        update = int(state.optimizer.count)
        metrics: dict[str, Any] = {"update": update, "env_steps": 0, "loss": np.asarray(loss)}
        if self.name == "online":
            metrics |= {"env_steps": 20 * update, "status_ok": np.asarray([1, 1, 0, 1]), "eval_seconds": 0.001}
            goal = np.asarray([np.nan, 40.0, np.nan, np.nan])
            metrics["first_goal_step"] = goal if update > 8 else np.full(4, np.nan)
            if update % 8 == 0:  # a column that appears late
                success = np.asarray([0.0, 0.5, np.nan, 1.0]) if update == 8 else np.asarray([0.25, 0.25, np.nan, 0.75])
                metrics |= {"eval/success": success, "eval/return": -np.arange(4.0), "eval/episodes": 20}
        return state, metrics

    def finish(self, state: ToyState, artifacts: dict[str, Any]) -> dict[str, Any]:
        return {
            "policy": {"w": state.params["w"], "keys": state.keys},
            "history": {**artifacts.get("history", {}), self.name: np.asarray(state.bits)},
        }


@partial(jax.jit, donate_argnums=0)
def _many_steps(state: ToyState) -> tuple[ToyState, jax.Array]:
    def step(state: ToyState, _: None) -> tuple[ToyState, jax.Array]:
        keys = jax.vmap(lambda k: jax.random.split(k)[0])(state.keys)
        noise = jax.vmap(lambda k: jax.random.normal(k, (3,)))(keys)

        def loss_of(params: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
            losses = ((params["w"] - jnp.arange(3.0) + noise) ** 2).sum(-1)
            return losses.sum(), losses

        (_, losses), grads = jax.value_and_grad(loss_of, has_aux=True)(state.params)
        updates, inner = ADAM.update(grads, state.optimizer.state)
        return state.replace(
            keys=keys,
            params=optax.apply_updates(state.params, updates),
            optimizer=Optimizer(state.optimizer.count + 1, inner),
            bits=state.bits + 3,
            flags=losses > 5,
        ), losses

    state, losses = jax.lax.scan(step, state, None, 4)
    return state, losses.mean(0)


def phases(sleep: float = 0.0) -> list[ToyPhase]:
    return [ToyPhase("pretrain", 5, sleep), ToyPhase("label", 0), ToyPhase("online", 6, sleep)]


def run(
    path: Path,
    toy_phases: list[ToyPhase] | None = None,
    checkpoint_seconds: float = 0.0,
    observers: Sequence[Observer] = (),
) -> dict[str, Any]:
    """Run the toy in ``path``, or continue it; return its summary."""
    if path.exists():
        folder = RunFolder.open(path)
    else:
        folder = RunFolder.create(path)
        folder.config.write_text("env: antmaze-medium-task1\n", encoding="utf-8")
    with folder.held():
        summary, _ = run_phases(
            toy_phases or phases(),
            folder,
            MEMBERS,
            config="0123456789abcdef",
            header=HEADER,
            checkpoint_seconds=checkpoint_seconds,
            data_seconds=0.5,
            observers=observers,
        )
    return summary


if __name__ == "__main__":
    run(Path(sys.argv[1]), phases(float(sys.argv[2]) if len(sys.argv) > 2 else 0.0))
