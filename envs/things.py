"""Name the parts of a scene that rest until something touches them."""

from __future__ import annotations

from typing import NamedTuple


class Thing(NamedTuple):
    """Hold which numbers of a state belong to one thing, whatever the others do.

    Attributes:
        name: for messages.
        qpos: numbers of qpos.
        qvel: numbers of qvel.
        observed: numbers of the observation that show these and nothing else.
        extra: numbers of the discrete state.
    """

    name: str
    qpos: tuple[int, ...]
    qvel: tuple[int, ...]
    observed: tuple[int, ...]
    extra: tuple[int, ...] = ()
