"""How many members train at once, and where: an estimate of their memory before anything runs, and a choice.

On an accelerator as many as fit share a program. On a CPU each has a core (a device) to itself, and those beyond take
turns. Measured on two idle cores (antmaze-medium, preset cpu, MuJoCo C, 4 members): each makes 470 environment steps a
second with a core to itself, 365 with all in one program, 330 in turns on both cores; skills train equally fast. And a
member's numbers do not depend on its company then (see ``Population``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from qdos_brax.population.shapes import ShapedPhase, shapes_of

_ROOM = 0.9  # share of a device's memory that is planned with; the rest is for fragments and for what XLA adds
_GB = 1e9


@dataclasses.dataclass(frozen=True)
class MemoryEstimate:
    """Hold an estimate of memory, in bytes.

    Attributes:
        shared: the data set, once per device.
        kept: of one member between chunks: state and what earlier phases left.
        working: of one member while a chunk runs, beside that.
    """

    shared: int
    kept: int
    working: int


@dataclasses.dataclass(frozen=True)
class MemoryPlan:
    """Hold how the members run.

    Attributes:
        devices: that they are spread over.
        per_program: members that one device trains at once.
        parked: whether their states wait in host memory.
        line: the estimate and the choice, in words.
    """

    devices: tuple[jax.Device, ...]
    per_program: int
    parked: bool
    line: str


def estimate(phases: Sequence[ShapedPhase], shared: int) -> MemoryEstimate:
    """Return the largest need of the phases of a population of one; nothing is compiled and nothing runs.

    Args:
        phases: in order; they are of no use afterwards, since what they hold are shapes.
        shared: bytes of the data set on a device.
    """
    kept = working = 0
    for phase, state, constants, artifacts in shapes_of(phases, 1):
        kept = max(kept, num_bytes(state) + num_bytes(artifacts))
        working = max(working, phase.working_bytes(state, constants))
    return MemoryEstimate(shared, kept, working)


def plan(need: MemoryEstimate, members: int, devices: Sequence[jax.Device], room: int, wanted: int) -> MemoryPlan:
    """Return how ``members`` run on ``devices``.

    Args:
        need: of the run.
        members: how many, at least two.
        devices: all of one kind.
        room: bytes that one of them has, or the host where they are its cores.
        wanted: members per program that the user or the run's first process chose; 0 for none.
    """
    each = need.kept + need.working
    states = members * need.kept
    if devices[0].platform == "cpu":  # the cores have one memory, in which every state lies
        per_program = min(wanted or 1, members)
        group = need.shared + per_program * need.working
        fitting = max(1, int((_ROOM * room - states) // group))
        used = min(len(devices), -(-members // per_program), fitting)
        parked, at_once = False, states + used * group
    else:
        fitting = max(1, int((_ROOM * room - need.shared) // each))
        per_program = min(wanted or fitting, -(-members // len(devices)))
        used = min(len(devices), -(-members // per_program))
        group = need.shared + per_program * each
        parked = used * per_program < members and group + states > _ROOM * room
        at_once = group if parked else group + states
    turns = -(-members // (used * per_program))
    words = [f"{members} members"]
    words.append("all in one program" if turns == 1 else f"{used * per_program} at a time, in {turns} turns")
    if used > 1:
        words.append(f"over {used} devices")
    words.append(f"about {_size(need.shared)} of data and {_size(each)} per member, of {_size(room)}")
    if parked:
        words.append("states wait in host memory")
    if at_once > room:
        words.append("which may be too little")
    return MemoryPlan(tuple(devices[:used]), per_program, parked, ", ".join(words))


def room_of(device: jax.Device) -> int:
    """Return bytes that the device may use; of a CPU, what the host has left."""
    if device.platform != "cpu":
        return int((device.memory_stats() or {}).get("bytes_limit", 0)) or 2**63
    lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024


def num_bytes(tree: Any) -> int:
    """Return the bytes of all arrays of the tree, or of what has their shapes."""
    return sum(_bytes(leaf) for leaf in jax.tree.leaves(tree))


def working_bytes(program: Any, *args: Any) -> int:
    """Return what a program needs at most beside its arguments, if what it is done with is freed at once and
    nothing fused.

    Its first argument is given up for the first of its results.
    """
    closed = jax.make_jaxpr(program)(*args)
    return max(0, _peak(closed.jaxpr) - num_bytes(args[0]))


def _peak(jaxpr: Any) -> int:
    """Most bytes of intermediate results and results that are alive at once."""
    last: dict[Any, int] = {}
    for place, equation in enumerate(jaxpr.eqns):
        last |= dict.fromkeys(_variables(equation.invars), place)
    last |= dict.fromkeys(_variables(jaxpr.outvars), len(jaxpr.eqns))
    given = {*jaxpr.invars, *jaxpr.constvars}
    alive = peak = 0
    for place, equation in enumerate(jaxpr.eqns):
        results = sum(_bytes(variable.aval) for variable in equation.outvars)
        # What is inside writes its results where this one's lie.
        inside = max((_peak(inner) - _results(inner) for inner in _inner(equation.params)), default=0)
        alive += results
        peak = max(peak, alive + max(0, inside))
        done = {v for v in _variables(equation.invars) if last[v] == place and v not in given}
        done |= {v for v in equation.outvars if v not in last}
        alive -= sum(_bytes(variable.aval) for variable in done)
    return peak


def _results(jaxpr: Any) -> int:
    return sum(_bytes(variable.aval) for variable in jaxpr.outvars)


def _variables(items: Sequence[Any]) -> list[Any]:
    return [item for item in items if not hasattr(item, "val")]  # literals have a value


def _inner(params: dict[str, Any]) -> Iterator[Any]:
    """The jaxprs that an equation holds: the bodies of loops, branches and calls."""
    for value in params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            item = getattr(item, "jaxpr", item)
            if hasattr(item, "eqns"):
                yield item


def _bytes(leaf: Any) -> int:
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return 8 * leaf.size
    return leaf.size * leaf.dtype.itemsize


def _size(count: int) -> str:
    return f"{count / _GB:.1f} GB" if count >= _GB / 10 else f"{count / 1e6:.0f} MB"
