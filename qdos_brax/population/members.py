"""The member axis: seeds and hyperparameter values, the first axis of everything that learns.

A phase writes its programs for one member; a ``Population`` makes programs of all members from them. One call of the
compiled program trains a group: some members at once on each device. More groups than one take turns on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, SingleDeviceSharding

_AXIS = "members"


class Program:
    """Run a compiled function of one member for all members of a population.

    Args:
        compiled: the jitted function of a group of members.
        call: calls it for all members.
        spread: how the members' own arguments lie on the devices when it is called; None where they are.
        slots: members of a group; 0 for all.

    Attributes:
        compiled: as given.
    """

    def __init__(
        self, compiled: Any, call: Callable[..., Any], spread: NamedSharding | None = None, slots: int = 0
    ) -> None:
        self.compiled, self._call, self._spread, self._slots = compiled, call, spread, slots

    def __call__(self, *args: Any) -> Any:
        """Return the function's results for trees with a leading member axis, and what the members share."""
        return self._call(*args)

    def compile(self, *args: Any) -> jax.stages.Compiled:
        """Return the program for arguments of the shapes of ``args``, compiled; a call finds it then.

        The arguments may be arrays or ``jax.ShapeDtypeStruct``; what the members share lies where it will be.
        """
        own = args[:-1] if self._spread is None else jax.tree.map(self._spread_shape, args[:-1])
        return self.compiled.lower(*own, args[-1]).compile()

    def _spread_shape(self, leaf: Any) -> jax.ShapeDtypeStruct:
        shape = (self._slots or leaf.shape[0], *leaf.shape[1:])
        weak = getattr(leaf, "weak_type", False)
        return jax.ShapeDtypeStruct(shape, leaf.dtype, sharding=self._spread, weak_type=weak)


class Population:
    """Run what is written for one member for all members of a run.

    With one member at a time on each device, a member's numbers do not depend on its company: the compiled program is
    that of a run of the member alone.

    Args:
        hyper: scannable numbers by dotted key, float32[members] each.
        per_program: members that one device trains at once; 0 for as many as there are.
        devices: to spread the members over; None for the default one alone.
        parked: whether the members' states wait for their turn in host memory.
    """

    def __init__(
        self,
        hyper: Mapping[str, Any],
        per_program: int = 0,
        devices: Sequence[jax.Device] | None = None,
        parked: bool = False,
    ) -> None:
        self.members = len(next(iter(hyper.values())))
        devices = list(devices or jax.local_devices()[:1])[: -(-self.members // (per_program or 1))]
        self.turns = -(-self.members // ((per_program or self.members) * len(devices)))
        self.per_program = -(-self.members // (self.turns * len(devices)))
        self.devices = devices[: -(-self.members // (self.turns * self.per_program))]
        self._slots = self.per_program * len(self.devices)
        self._mesh = jax.sharding.Mesh(np.asarray(self.devices), (_AXIS,))
        self._takes_turns = parked or self._slots != self.members
        self._spread = NamedSharding(self._mesh, PartitionSpec(_AXIS))
        self._home = SingleDeviceSharding(jax.local_devices(backend="cpu")[0] if parked else self.devices[0])
        self.hyper = {key: jnp.asarray(value) for key, value in hyper.items()}

    def shared(self, tree: Any) -> Any:
        """Return what all members read (the data set), on every device."""
        return tree if len(self.devices) == 1 else jax.device_put(tree, NamedSharding(self._mesh, PartitionSpec()))

    def program(self, function: Callable[..., Any], carries: bool = False) -> Program:
        """Return ``function(*member_trees, shared)`` of one member, compiled for trees with a leading member axis.

        Args:
            function: its last argument is what all members share, the others are one member's own.
            carries: whether its first argument is a state that is given up (donated) for the first of its results.
        """
        compiled = jax.jit(self._over_devices(function), donate_argnums=0 if carries else ())
        if self._takes_turns:
            return Program(compiled, partial(self._in_turn, compiled, carries), self._spread, self._slots)
        if len(self.devices) == 1:
            return Program(compiled, compiled)
        return Program(
            compiled, lambda *args: compiled(*jax.device_put(args[:-1], self._spread), args[-1]), self._spread
        )

    def _over_devices(self, function: Callable[..., Any]) -> Callable[..., Any]:
        group = over_members(function, self.per_program)
        if len(self.devices) == 1:
            return group

        def sharded(*args: Any) -> Any:
            own = PartitionSpec(_AXIS)
            specs = (*(own for _ in args[1:]), PartitionSpec())
            return jax.shard_map(group, mesh=self._mesh, in_specs=specs, out_specs=own, check_vma=False)(*args)

        return sharded

    def _in_turn(self, compiled: Callable[..., Any], carries: bool, *args: Any) -> Any:
        # What was made from the shared data lies on all devices, and one program takes from one place alone.
        own, shared = jax.device_put(args[:-1], self._home), args[-1]
        results = []
        for first in range(0, self.members, self._slots):
            # Slots beyond the last member are filled with it, and what becomes of them is dropped.
            index = np.minimum(np.arange(first, first + self._slots), self.members)
            result = compiled(*jax.device_put(_take(own, index), self._spread), shared)
            result = jax.device_put(result, self._home)
            if carries:
                state, result = result
                own = (_put(own[0], state, index), *own[1:])
            results.append(result)
        joined = jax.tree.map(lambda *parts: jnp.concatenate(parts)[: self.members], *results)
        return (own[0], joined) if carries else joined


def over_members(function: Callable[..., Any], members: int) -> Callable[..., Any]:
    """Return ``function(*member_trees, shared)`` for one member, made to act on trees with a leading member axis.

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


@jax.jit
def _take(tree: Any, index: jax.Array) -> Any:
    """The members at ``index``; the last one for what lies beyond."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(index, leaf.shape[0] - 1)], tree)


@partial(jax.jit, donate_argnums=0)
def _put(tree: Any, members: Any, index: jax.Array) -> Any:
    """``tree`` with ``members`` at ``index``, but for what lies beyond."""
    return jax.tree.map(lambda leaf, part: leaf.at[index].set(part, mode="drop"), tree, members)
