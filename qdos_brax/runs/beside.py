"""Work that a run does on a thread, beside its training, so that later phases and its end need not wait for it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence

from qdos_brax.population.shapes import ShapedPhase, shapes_of


def start_beside(work: Callable[[], None], name: str) -> threading.Thread:
    """Start ``work`` on a thread of that name, which is returned.

    What it raises is dropped: whoever needs its result can do the work again, and says what is wrong there. (A process
    that is about to end allows no executors any more, for instance, and its last line is to stay the last.)
    """

    def run() -> None:
        with contextlib.suppress(Exception):
            work()

    # No daemon: a process that ends early waits for it, since a thread that is killed within a C++ library aborts.
    thread = threading.Thread(target=run, name=name)
    thread.start()
    return thread


def compile_beside(phases: Sequence[ShapedPhase], members: int) -> threading.Thread:
    """Compile all phases' programs but the first one's on a thread, which is returned.

    A later phase then finds its programs as if it had compiled them itself; a phase that begins before the thread has
    got to it compiles its own.
    """

    def compile_all() -> None:
        for index, found in enumerate(shapes_of(phases, members)):
            if index:
                found.phase.compile(found.state, found.constants)

    return start_beside(compile_all, "compile")
