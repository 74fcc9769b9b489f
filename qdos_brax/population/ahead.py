"""Compile the programs of later phases on a thread, while the first ones run."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from typing import Any, Protocol

import jax

from qdos_brax.population import health


class Compiled(Protocol):
    """Define a phase whose programs can be compiled before it runs."""

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[Any, Any]:
        """Return the state before the first chunk, and the constants of all chunks."""
        ...

    def compile(self, state: Any, constants: Any) -> None:
        """Compile the programs of chunks for arguments of these shapes."""
        ...

    def finish(self, state: Any, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return what the next phases need."""
        ...


def compile_beside(phases: Sequence[Compiled], members: int) -> threading.Thread:
    """Compile all phases' programs but the first one's on a thread, which is returned.

    A later phase then finds its programs as if it had compiled them itself; a phase that begins before the thread has
    got to it compiles its own. What fails on the thread fails again where the phase runs, and is reported there.
    """
    # No daemon: a process that ends early waits for it, since a thread that is killed within XLA aborts.
    thread = threading.Thread(target=_compile, args=(phases, members), name="compile")
    thread.start()
    return thread


def _compile(phases: Sequence[Compiled], members: int) -> None:
    with contextlib.suppress(Exception):  # whatever it is, the phase meets it where it can be told
        key = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), members))
        artifacts: dict[str, Any] = {}
        for index, phase in enumerate(phases):
            state, constants = jax.eval_shape(phase.init, key, artifacts)
            if index:
                phase.compile(state, constants)
            artifacts = jax.eval_shape(phase.finish, state, artifacts)
            artifacts.pop(health.KEY, None)  # a copy is made of it, and shapes cannot be copied
