"""The member axis: seeds and hyperparameter values, the first axis of everything that learns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax


def over_members(function: Callable[..., Any], members: int) -> Callable[..., Any]:
    """``function(*member_trees, shared)`` for one member, made to act on trees with a leading member axis.

    With one member the axis is taken off and put back instead of mapped, so that branches stay branches and matmuls
    keep their shapes.

    Args:
        function: its last argument is what all members share (the data set), the others are one member's own.
        members: length of the axis.
    """

    def single(*args: Any) -> Any:
        own = jax.tree.map(lambda x: x[0], args[:-1])
        return jax.tree.map(lambda x: x[None], function(*own, args[-1]))

    def mapped(*args: Any) -> Any:
        return jax.vmap(lambda *own: function(*own, args[-1]))(*args[:-1])

    return single if members == 1 else mapped
