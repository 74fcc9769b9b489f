"""The phases of a run followed by the shapes of what they hold: nothing is compiled and nothing runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import jax

from qdos_brax.population import health


class ShapedPhase(Protocol):
    """Define what is known of a phase before it runs."""

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[Any, Any]:
        """Return the state before the first chunk, and the constants of all chunks."""
        ...

    def compile(self, state: Any, constants: Any) -> None:
        """Compile the programs of chunks for arguments of these shapes."""
        ...

    def working_bytes(self, state: Any, constants: Any) -> int:
        """Return what a chunk needs beside its arguments, which may be shapes alone."""
        ...

    def finish(self, state: Any, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return what the next phases need."""
        ...


class Shapes(NamedTuple):
    """Hold a phase and the shapes of what it begins with: its state, its constants, what earlier phases left."""

    phase: ShapedPhase
    state: Any
    constants: Any
    artifacts: dict[str, Any]


def shapes_of(phases: Sequence[ShapedPhase], members: int) -> Iterator[Shapes]:
    """Yield what each of the phases of a population of ``members`` begins with, in order."""
    key = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), members))
    artifacts: dict[str, Any] = {}
    for phase in phases:
        state, constants = jax.eval_shape(phase.init, key, artifacts)
        yield Shapes(phase, state, constants, artifacts)
        artifacts = jax.eval_shape(phase.finish, state, artifacts)
        artifacts.pop(health.KEY, None)  # a copy is made of it, and shapes cannot be copied
