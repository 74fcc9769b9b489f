"""Hold what every reader makes of a file: one transition per row, not yet labelled for a task."""

from __future__ import annotations

import contextlib
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from qdos_brax.errors import UserError

SAME = 1e-4  # what two copies of a position may differ by; they went through float32 and back


@dataclass
class Rows:
    """Hold N transitions in episode order, float32 and C-contiguous unless said otherwise.

    Attributes:
        observations: [N, obs].
        actions: [N, act].
        next_observations: [N, obs], the true next observation, at episode ends too.
        ends: bool[N], the last row of each episode.
        terminals: [N], 1 where the task ended by the file's own account; None when it does not say.
        rewards: [N], the file's own, or None.
        qpos: [N, nq] before the action, or None.
        qvel: [N, nv] before the action, or None.
        extra: int32[N, e], discrete state before the action, or None.
        unknown_next: bool[N], rows whose next observation is not in the file (their own is repeated), or None.
        quality: int8[N], what produced the step, or None.
        notes: what the reader had to correct or leave out, one line each.
        mismatch: how next observations miss the rows that follow, so that most rows count as ends of episodes, in one
            line; "" where they do not.
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    ends: np.ndarray
    terminals: np.ndarray | None = None
    rewards: np.ndarray | None = None
    qpos: np.ndarray | None = None
    qvel: np.ndarray | None = None
    extra: np.ndarray | None = None
    quality: np.ndarray | None = None
    unknown_next: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    mismatch: str = ""

    @property
    def size(self) -> int:
        """Return the number of transitions."""
        return len(self.observations)

    def drop(self, rows: np.ndarray) -> None:
        """Drop the rows of a mask bool[N], in place; an episode that loses its last row ends one row earlier."""
        self.ends[:-1] |= self.ends[1:] & rows[1:]
        for name, value in self.arrays().items():
            setattr(self, name, np.ascontiguousarray(value[~rows]))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that are there, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}


@contextlib.contextmanager
def unreadable(path: Path) -> Iterator[None]:
    """Turn whatever a damaged or foreign file makes the libraries raise into one clear line."""
    try:
        yield
    except (
        OSError,
        EOFError,
        ValueError,
        TypeError,
        LookupError,
        ArithmeticError,
        RuntimeError,  # h5py's word for most kinds of damage, zipfile's for an encrypted member
        MemoryError,  # a damaged size
        struct.error,
        zlib.error,
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
    ) as error:
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise UserError(f"{path}: cannot be read as .npz or .hdf5 (truncated or another format): {reason}") from None


def discrete(path: Path, key: str, values: np.ndarray) -> np.ndarray:
    """Return a discrete state as int32, of the shape of ``values``.

    Raises:
        UserError: it holds numbers that are not whole: rewards are counted from it.
    """
    whole = np.round(values)
    if not np.array_equal(whole, values):  # nan equals nothing
        row = int(np.flatnonzero((whole != values).reshape(len(values), -1).any(axis=1))[0])
        raise UserError(f"{path}: {key!r} holds a number that is not whole, in row {row}: no discrete state")
    return whole.astype(np.int32)


def breaks_of(observations: np.ndarray, following: np.ndarray) -> np.ndarray:
    """Return bool[N]: the next observation is not the next row's."""
    breaks = np.zeros(len(observations), bool)
    if len(breaks) > 1 and observations.shape == following.shape:  # else the sizes are reported by the checks
        breaks[:-1] = np.abs(observations[1:] - following[:-1]).reshape(len(breaks) - 1, -1).max(axis=1) > 1e-6
    return breaks


def mismatch_of(observations: np.ndarray, following: np.ndarray, breaks: np.ndarray) -> str:
    """Return a line where most next observations are nearly, not exactly, the next row's: they were rounded."""
    if len(breaks) < 2 or breaks.mean() <= 0.5:
        return ""
    apart = np.abs(observations[1:] - following[:-1])[breaks[:-1]]
    limit = 2.0**-10 * np.abs(observations[1:])[breaks[:-1]] + 1e-6  # float16 rounds to within half of it
    if (apart <= limit).reshape(len(apart), -1).all(axis=1).mean() <= 0.5:
        return ""
    return (
        f"next_observations do not match the next row's observations in {breaks.sum()} of {len(breaks)} rows, by up "
        f"to {np.median(apart.reshape(len(apart), -1).max(axis=1)):.2g} in a typical one, so that each of these rows "
        "ends an episode: rounded to another precision? store both alike, or leave next_observations out"
    )


def note_breaks(notes: list[str], marked: np.ndarray, breaks: np.ndarray) -> None:
    """Add a line to ``notes`` if episodes end in rows that the file does not mark."""
    unmarked = breaks & ~marked
    unmarked[-1] = False
    if unmarked.any():
        notes.append(
            f"{unmarked.sum()} episode ends are not marked, the first at row {unmarked.argmax()}: "
            "timeouts out of step; ends are taken where the state jumps as well"
        )


def after_action(path: Path, rows: Rows) -> None:
    """Replace simulator states that were stored after the action, as D4RL's ant mazes have them, in place.

    D4RL's generator steps first and stores ``infos/qpos`` then, next to the observation from before. It shows where
    observations begin with the same two numbers as qpos: then nearly all of these numbers are those of the next
    observation. If the observation is qpos and qvel, they are taken from there.

    Raises:
        UserError: the states are from after the action and the observation does not hold those from before.
    """
    qpos, qvel, observations = rows.qpos, rows.qvel, rows.observations
    if qpos is None or qpos.ndim != 2 or observations.ndim != 2 or not rows.size:
        return
    if min(qpos.shape[1], observations.shape[1]) < 2 or _agree(qpos, observations).mean() > 0.5:
        return
    known = np.ones(rows.size, bool) if rows.unknown_next is None else ~rows.unknown_next
    if not known.any() or _agree(qpos, rows.next_observations)[known].mean() < 0.99:
        return
    nq = qpos.shape[1]
    if qvel is None or qvel.ndim != 2 or observations.shape[1] != nq + qvel.shape[1]:
        raise UserError(f"{path}: qpos is that after the action, and the observations do not hold that before it")
    qpos[:] = observations[:, :nq]
    qvel[:] = observations[:, nq:]
    rows.notes.append(
        "qpos and qvel are those after the action, as D4RL stores them: taken from the observations instead"
    )


def _agree(qpos: np.ndarray, observations: np.ndarray) -> np.ndarray:
    """Return bool[N]: states and observations begin with the same two numbers, in mazes the body's x and y."""
    return np.abs(qpos[:, :2] - observations[:, :2]).max(axis=1) <= SAME
