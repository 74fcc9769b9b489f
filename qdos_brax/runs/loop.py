"""The loop over phases: chunks, log points, checkpoints. It knows no learner.

A run that is killed and continued ends as it would have ended without the kill: a checkpoint holds everything a chunk
reads, the phase's constants come again from ``init``, and metrics.csv is cut back to the checkpoint's rows.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.runs import checkpoint, signals
from qdos_brax.runs.checkpoint import Artifacts, CheckpointStore
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.live import MemberBoard
from qdos_brax.runs.metrics import MetricsTable, Observer
from qdos_brax.runs.progress import Progress

_WALL_PARTS = ("data", "pretrain", "label", "online", "eval")


class Phase(Protocol):
    """Define one part of a run, cut into chunks: jitted programs of many steps each.

    Attributes:
        name: the column ``phase`` of metrics.csv.
        part: "pretrain", "label" or "online", the key of ``wall_seconds``; phases may share one.
        num_chunks: chunks in it.
    """

    name: str
    part: str
    num_chunks: int

    def init(self, key: jax.Array, artifacts: Artifacts) -> tuple[Any, Any]:
        """Return the state before the first chunk, a pytree of arrays, and the constants that every chunk reads.

        It is called on resume too: the state is then replaced by the saved one, and the constants, which no checkpoint
        holds, are those that it makes.

        Args:
            key: typed keys[members], one per member, for this phase alone.
            artifacts: what ``finish`` of the phase before returned; empty for the first.
        """
        ...

    def chunk(self, state: Any, constants: Any) -> tuple[Any, dict[str, Any]]:
        """Return the state after one chunk, and its log point.

        The state may be donated. A metric is a scalar or one number per member: "env_steps" and "update" (counts so
        far), "eval/success", "eval/return", "eval/episodes", "first_goal_step" (nan until reached), "status_ok"
        (0 for a member that is frozen), and any other. "eval_seconds", a float, is the wall time that evaluation
        took of this chunk; it is booked apart and does not appear in metrics.csv.
        """
        ...

    def finish(self, state: Any, artifacts: Artifacts) -> Artifacts:
        """Return everything that the next phases need: nested dicts with text keys and arrays at the leaves."""
        ...


@dataclasses.dataclass
class _Place:
    """Hold where the loop is; ``state`` is None at the start of a phase, else (state, constants)."""

    phase: int
    chunk: int
    artifacts: Artifacts
    state: tuple[Any, Any] | None


def run_phases(
    phases: Sequence[Phase],
    folder: RunFolder,
    members: Sequence[Mapping[str, Any]],
    *,
    config: str,
    header: Mapping[str, Any],
    checkpoint_seconds: float = 30.0,
    data_seconds: float = 0.0,
    started: float | None = None,
    observers: Sequence[Observer] = (),
) -> tuple[dict[str, Any], Artifacts]:
    """Run the phases to their end, from the newest usable checkpoint if there is one.

    Args:
        phases: the phases in order.
        folder: the run's folder, held by the caller.
        members: the population: dicts with "seed", "alpha" and whatever else varies.
        config: hash of the configuration.
        header: first entries of summary.json: env, method, preset, physics.
        checkpoint_seconds: seconds of work between two checkpoints; 0 saves after every chunk.
        data_seconds: seconds that this process spent on the data.
        started: ``time.perf_counter()`` at this process's start; None for now.
        observers: receive every row of metrics.csv.

    Returns:
        The summary, as written to summary.json, and the artifacts of the last phase.

    Raises:
        UserError: the disk refuses, or no checkpoint can be used.
        SystemExit: SIGINT or SIGTERM arrived; the run was saved, and the code is 130 or 143.
    """
    store = CheckpointStore(folder.checkpoints, config)
    table = MetricsTable(folder.metrics, members)
    clock = _Clock(data_seconds, time.perf_counter() if started is None else started)
    keys = _member_keys(members)
    place = checkpoint.choose(store, lambda name: _restore(name, store, phases, keys, table, clock), signals.warn)
    if place is None:
        table.start()
        place = _Place(0, 0, {}, None)
    board = MemberBoard(members)
    with signals.collected() as caught, table.observed([board, *observers]):
        runner = _Runner(folder, store, table, clock, keys, checkpoint_seconds, board, caught)
        while place.phase < len(phases):
            place = runner.run(phases[place.phase], place)
    summary = {**header, "wall_seconds": clock.parts(), "members": table.summary()}
    write_text(folder.summary, json.dumps(summary, indent=2) + "\n")
    return summary, place.artifacts


@dataclasses.dataclass
class _Runner:
    """Run phases one by one; hold what they share."""

    folder: RunFolder
    store: CheckpointStore
    table: MetricsTable
    clock: _Clock
    keys: jax.Array
    checkpoint_seconds: float
    board: MemberBoard
    caught: list[int]

    def run(self, phase: Phase, place: _Place) -> _Place:
        """Runs the phase from ``place`` to its end; the place where the next one starts."""
        state, constants = place.state or phase.init(_phase_keys(self.keys, place.phase), place.artifacts)
        saved_at, pause = time.monotonic(), self.checkpoint_seconds
        with Progress(phase.name, phase.num_chunks, place.chunk, below=self.board) as progress:
            for chunk in range(place.chunk, phase.num_chunks):
                state = self._chunk(phase, state, constants, chunk, progress)
                stop = bool(self.caught)
                last = chunk + 1 == phase.num_chunks
                if stop or (not last and time.monotonic() - saved_at >= pause):
                    spent = self._save(place.phase, chunk + 1, state)
                    saved_at, pause = time.monotonic(), self._pause(spent)
                    self.clock.charge(phase.part)
                if stop:
                    self._stop()
        artifacts = checkpoint.as_device_arrays(phase.finish(state, place.artifacts))
        del state, constants
        self.clock.charge(phase.part)
        self.store.save_artifacts(place.phase + 1, artifacts)
        self._save(place.phase + 1, 0, None)
        if self.caught:
            self._stop()
        return _Place(place.phase + 1, 0, artifacts, None)

    def _chunk(self, phase: Phase, state: Any, constants: Any, chunk: int, progress: Progress) -> Any:
        before = {name: _mean(self.table.latest(name)) if chunk else 0.0 for name in ("env_steps", "update")}
        started = time.perf_counter()
        state, metrics = phase.chunk(state, constants)
        metrics = dict(metrics)
        eval_seconds = float(metrics.pop("eval_seconds", 0.0))
        self.clock.charge(phase.part, eval_seconds)
        seconds = max(time.perf_counter() - started - eval_seconds, 1e-9)
        done = {name: _mean(metrics[name]) - before[name] for name in before if name in metrics}
        unit = "env_steps" if done.get("env_steps") else "update"
        rate = done.get(unit, 0.0) / seconds
        self.table.append(phase.name, metrics, rate)
        success, episode_return = (_mean(self.table.latest(f"eval/{name}")) for name in ("success", "return"))
        progress.advance(rate, "env steps" if unit == "env_steps" else "updates", success, episode_return)
        return state

    def _save(self, phase: int, chunk: int, state: Any | None) -> float:
        """Save the run; return how many seconds that took."""
        started = time.monotonic()
        place = checkpoint.Position(phase, chunk, len(self.table.rows), tuple(self.table.columns), self.clock.parts())
        self.store.save(place, state)
        return time.monotonic() - started

    def _pause(self, save_seconds: float) -> float:
        """Return the seconds of work before the next save: where saving is slow, at least 20 times as long."""
        return max(self.checkpoint_seconds, 20 * save_seconds) if self.checkpoint_seconds else 0.0

    def _stop(self) -> None:
        signals.stop(self.caught[0], "stopped and saved", self.folder.path)


class _Clock:
    """Measure wall seconds by part of the run, added up over all processes that worked on it."""

    def __init__(self, data_seconds: float, started: float) -> None:
        self._parts = dict.fromkeys(_WALL_PARTS, 0.0)
        self._parts["data"] = data_seconds
        self._earlier = 0.0
        self._started = started
        self._mark = time.perf_counter()

    def add_earlier(self, parts: Mapping[str, float]) -> None:
        """Count what earlier processes spent."""
        self._earlier = parts["total"]
        for name, seconds in parts.items():
            if name != "total":
                self._parts[name] += seconds

    def charge(self, part: str, eval_seconds: float = 0.0) -> None:
        """Count the time since the last call for ``part``, except ``eval_seconds`` of it, which count for "eval"."""
        now = time.perf_counter()
        self._parts[part] += now - self._mark - eval_seconds
        self._parts["eval"] += eval_seconds
        self._mark = now

    def parts(self) -> dict[str, float]:
        """Return seconds by part, and in total (which counts imports and reading too)."""
        total = self._earlier + time.perf_counter() - self._started
        return {**{name: round(seconds, 3) for name, seconds in self._parts.items()}, "total": round(total, 3)}


def _restore(
    name: str,
    store: CheckpointStore,
    phases: Sequence[Phase],
    keys: jax.Array,
    table: MetricsTable,
    clock: _Clock,
) -> _Place:
    """The place of a checkpoint, with metrics.csv cut back to it."""
    saved = store.position(name)
    if saved.phase > len(phases):
        raise checkpoint.BrokenCheckpoint(f"it is in phase {saved.phase + 1} of {len(phases)}")
    artifacts = store.artifacts(saved.phase)
    state = None
    if not store.is_phase_start(name):
        like, constants = phases[saved.phase].init(_phase_keys(keys, saved.phase), artifacts)
        state = store.restore(name, like), constants
    try:
        table.cut_back(saved.rows, saved.columns)
    except UserError as error:
        raise checkpoint.BrokenCheckpoint(str(error)) from error
    clock.add_earlier(saved.wall_seconds)
    return _Place(saved.phase, saved.chunk, artifacts, state)


def _member_keys(members: Sequence[Mapping[str, Any]]) -> jax.Array:
    """Return typed keys[members] from the seeds; members that share a seed share the key."""
    return jax.vmap(jax.random.key)(np.asarray([member["seed"] for member in members], np.uint32))


def _phase_keys(keys: jax.Array, phase: int) -> jax.Array:
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, phase)


def _mean(values: Any) -> float:
    """Return the mean of the numbers that are not nan; nan if there is none."""
    numbers = np.asarray(values, np.float64)
    numbers = numbers[~np.isnan(numbers)]
    return float(numbers.mean()) if numbers.size else float("nan")
