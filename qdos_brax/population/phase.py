"""What the phases of a run share: one member's programs run for all members, chunk by chunk."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from qdos_brax.population import health
from qdos_brax.population.members import Population
from qdos_brax.population.memory import working_bytes


def even_chunks(total: int, most: int) -> tuple[int, int]:
    """Return (chunks, steps of each) for ``total`` steps, of at most ``most`` each.

    They are alike, for they are one program, so that a total that they do not divide is passed: by less than one step
    per chunk.
    """
    chunks = -(-total // most)
    return chunks, -(-total // chunks)


class MemberPhase:
    """Run two programs that are written for one member, ``start_member`` and ``train_member``, for all members.

    Everything that a chunk reads is an argument: its state, which checkpoints hold; constants, which ``init`` takes
    from the artifacts of earlier phases; the members' hyperparameters; and the data that they share. The state has the
    fields ``update`` (gradient steps so far) and ``healthy`` (see ``health``).

    Args:
        name: column ``phase`` of metrics.csv.
        part: "pretrain", "label" or "online", the key of ``wall_seconds`` in summary.json.
        num_chunks: calls of ``chunk`` until the phase ends.
    """

    def __init__(self, name: str, part: str, num_chunks: int) -> None:
        self.name, self.part, self.num_chunks = name, part, num_chunks

    def bind(self, population: Population, data: Any) -> None:
        """Compile the programs for ``population``; must come before ``init``, and may come again for another one.

        Args:
            population: the members.
            data: the data set on the population's devices.
        """
        self.hyper, self.data = population.hyper, data
        self._start = population.program(self.start_member)
        self._chunk = population.program(self.train_member, carries=True)

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[Any, Any]:
        """Return the state before the first chunk and the constants of all chunks, each leaf [members, ...].

        Args:
            key: typed keys[members], for this phase alone.
            artifacts: what ``finish`` of the phase before returned.
        """
        state = self._start(key, self.hyper, None)
        return state.replace(healthy=health.inherited(artifacts, len(key))), self.constants(artifacts)

    def chunk(self, state: Any, constants: Any) -> tuple[Any, dict[str, Any]]:
        """Return the state after one chunk, and its metrics; ``state`` is donated."""
        state, info = self._chunk(state, constants, self.hyper, self.data)
        return state, self.metrics(state, jax.tree.map(np.asarray, info))

    def compile(self, state: Any, constants: Any) -> None:
        """Compile the programs of chunks for arguments of these shapes."""
        self._chunk.compile(state, constants, self.hyper, self.data)

    def working_bytes(self, state: Any, constants: Any) -> int:
        """Return the bytes that a chunk needs beside its arguments, which may be shapes alone."""
        return working_bytes(self._chunk, state, constants, self.hyper, self.data)

    def metrics(self, state: Any, info: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return the columns of metrics.csv after a chunk, [members] each, from what ``train_member`` returned."""
        return {"update": np.asarray(state.update), **info, "status_ok": np.asarray(state.healthy)}

    def constants(self, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return what chunks read of the artifacts."""
        return {}

    def finish(self, state: Any, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts for the next phases."""
        raise NotImplementedError

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> Any:
        """Return one member's first state."""
        raise NotImplementedError

    def train_member(self, state: Any, constants: Any, hyper: dict[str, jax.Array], data: Any) -> tuple[Any, Any]:
        """Return one member's state after a chunk, and scalars by metric."""
        raise NotImplementedError
