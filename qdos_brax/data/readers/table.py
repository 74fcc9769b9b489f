"""Read files as named columns, block by block, so that no array is in memory twice."""

from __future__ import annotations

import contextlib
import math
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.files import parse_json

NUMERIC = "biuf"
"""Kinds of NumPy types that are read: booleans, integers, floating point."""

_BLOCK_BYTES = 8 << 20

CHECKSUMS = "checksums"
"""Attribute of files written here: JSON, CRC-32 of every column by name."""


class DataTable(ABC):
    """Read the columns of one file: ``shapes`` and ``dtypes`` by name, and the values in blocks of rows."""

    path: Path
    shapes: Mapping[str, tuple[int, ...]]
    dtypes: Mapping[str, np.dtype]

    def __contains__(self, key: str) -> bool:
        return key in self.shapes

    @abstractmethod
    def blocks(self, key: str) -> Iterator[np.ndarray]:
        """Yield the rows of a column in order, in its own type.

        Raises:
            OSError, ValueError and their like: the values are damaged (``rows.unreadable`` knows them).
        """

    @abstractmethod
    def __exit__(self, *error: Any) -> None: ...

    def __enter__(self) -> Self:
        return self

    def require(self, needed: Sequence[str], known: Sequence[str]) -> int:
        """Return the number of rows, after a look at the sizes.

        Args:
            needed: columns that must be there.
            known: columns that are read when they are there; all others may be anything.

        Raises:
            UserError: a column is missing, not numeric, or has another number of rows.
        """
        for key in needed:
            if key not in self:
                raise UserError(f"{self.path}: has no {key!r}; expected an OGBench .npz, a D4RL or a Minari .hdf5 file")
        num_rows = self.shapes[needed[0]][0] if self.shapes[needed[0]] else 0
        for key in filter(self.__contains__, (*needed, *known)):
            shape, dtype = self.shapes[key], self.dtypes[key]
            if dtype.kind not in NUMERIC:
                raise UserError(f"{self.path}: {key!r} is not numeric ({dtype})")
            if not shape or shape[0] != num_rows:
                rows = shape[0] if shape else 0
                raise UserError(
                    f"{self.path}: {key!r} has {rows} rows, {needed[0]!r} has {num_rows}: the file is damaged"
                )
        return num_rows

    def column(self, key: str) -> np.ndarray:
        """Return a column of one number per row, [N] or [N, 1], whole and in its own type.

        Raises:
            UserError: it has several numbers per row.
        """
        self._require_one(key)
        parts = [block.reshape(-1) for block in self.blocks(key)]
        return np.concatenate(parts) if parts else np.zeros(0, self.dtypes[key])

    def numbers(self, key: str, selection: np.ndarray | None) -> np.ndarray:
        """Return such a column as float32[n], its selected rows only; raises UserError likewise."""
        self._require_one(key)
        return self.floats(key, selection)[0].reshape(-1)

    def _require_one(self, key: str) -> None:
        if math.prod(self.shapes[key][1:]) != 1:
            size = "x".join(map(str, self.shapes[key][1:]))
            raise UserError(f"{self.path}: {key!r} has {size} numbers per row, one is expected")

    def floats(self, key: str, *selections: np.ndarray | None) -> list[np.ndarray]:
        """Return a column as float32 C-contiguous arrays, one per selection, in a single pass over the file.

        Args:
            key: the column.
            selections: bool[N], the rows to keep; None keeps all.
        """
        num_rows, *row_shape = self.shapes[key]
        sizes = [num_rows if rows is None else int(np.count_nonzero(rows)) for rows in selections]
        out = [np.empty((size, *row_shape), np.float32) for size in sizes]
        filled = [0] * len(out)
        start = 0
        for block in self.blocks(key):
            for index, rows in enumerate(selections):
                part = block if rows is None else block[rows[start : start + len(block)]]
                with np.errstate(over="ignore", invalid="ignore"):  # infinite then, and reported as such
                    out[index][filled[index] : filled[index] + len(part)] = part
                filled[index] += len(part)
            start += len(block)
        return out


class NpzTable(DataTable):
    """Read a ``.npz``; the archive's CRC-32 of every member is verified once its last block has been taken.

    Raises:
        OSError, ValueError, zipfile.BadZipFile: not an archive of arrays (``rows.unreadable`` knows them).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip = zipfile.ZipFile(path)
        self.shapes, self.dtypes = {}, {}
        for name in self._zip.namelist():
            key = name.removesuffix(".npy")
            with self._zip.open(name) as member:
                self.shapes[key], _, self.dtypes[key] = _npy_header(member)

    def __exit__(self, *error: Any) -> None:
        self._zip.close()

    def blocks(self, key: str) -> Iterator[np.ndarray]:
        """Yield the rows of a column in order, the whole of it where it is stored column by column."""
        with self._zip.open(f"{key}.npy") as member:
            shape, column_major, dtype = _npy_header(member)
            num_rows = shape[0]
            per_block = num_rows if column_major else _rows_per_block(shape, dtype)
            for start in range(0, num_rows, max(1, per_block)):
                size = (min(per_block, num_rows - start), *shape[1:])
                values = np.frombuffer(_exactly(member, math.prod(size) * dtype.itemsize), dtype)
                yield values.reshape(size, order="F" if column_major else "C")
            if member.read(1):
                raise ValueError(f"{key!r} is longer than its header says")


class HDF5Table(DataTable):
    """Read the data sets of an ``.hdf5``, by path within it; checksums are verified where the file has them.

    Raises:
        OSError and its like: not a whole HDF5 file (``rows.unreadable`` knows them).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = h5py.File(path, "r")
        try:
            self._sets: dict[str, h5py.Dataset] = {}
            self._file.visititems(self._add)
            self.shapes = {key: value.shape for key, value in self._sets.items()}
            self.dtypes = {key: value.dtype for key, value in self._sets.items()}
            self._checksums = stored_checksums(self._file)
            for key in self._checksums:
                if key not in self:
                    raise ValueError(f"{key!r} was written and is gone")
        except BaseException:
            self._file.close()
            raise

    def _add(self, key: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.shape is not None:
            self._sets[key] = item

    def __exit__(self, *error: Any) -> None:
        with contextlib.suppress(RuntimeError, OSError):  # of a damaged file, which has been reported
            self._file.close()

    def blocks(self, key: str) -> Iterator[np.ndarray]:
        """Yield the rows of a column in order, whole chunks at a time."""
        values = self._sets[key]
        crc = checksum_start(values.shape, values.dtype)
        per_block = _rows_per_block(values.shape, values.dtype)
        if values.chunks is not None:
            per_block = -(-per_block // values.chunks[0]) * values.chunks[0]  # no chunk is unpacked twice
        for start in range(0, values.shape[0], per_block):
            block = values[start : start + per_block]
            crc = zlib.crc32(np.ascontiguousarray(block).data, crc) if self._checksums else 0
            yield block
        if self._checksums.get(key, crc) != crc:
            raise ValueError(f"{key!r} does not have the checksum it was written with")


def checksum_start(shape: Sequence[int], dtype: np.dtype) -> int:
    """Return the CRC-32 of a column's shape and type, which that of its bytes goes on from."""
    return zlib.crc32(f"{dtype.str}{tuple(map(int, shape))}".encode())


def checksum(array: np.ndarray) -> int:
    """Return the CRC-32 of a column: its shape, type and bytes."""
    return zlib.crc32(np.ascontiguousarray(array).data, checksum_start(array.shape, array.dtype))


def stored_checksums(file: h5py.File) -> dict[str, int]:
    """Return the CRC-32 by column, of a file written here; empty for others.

    Raises:
        ValueError: they are there and damaged.
    """
    if CHECKSUMS not in file.attrs:
        return {}
    sums = parse_json(file.attrs[CHECKSUMS])
    if not isinstance(sums, dict):
        raise ValueError("the checksums are damaged")
    return sums


def _rows_per_block(shape: Sequence[int], dtype: np.dtype) -> int:
    return max(1, _BLOCK_BYTES // max(1, math.prod(shape[1:]) * dtype.itemsize))


def _npy_header(member: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return (shape, column-major, type) at the beginning of a ``.npy``."""
    version = np.lib.format.read_magic(member)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an array of .npy version {version}")
    return readers[version](member)


def _exactly(member: Any, size: int) -> bytearray:
    """Return the next ``size`` bytes."""
    buffer = bytearray(size)
    view, filled = memoryview(buffer), 0
    while filled < size:
        count = member.readinto(view[filled:])
        if not count:
            raise EOFError(f"{size - filled} bytes are missing")
        filled += count
    return buffer
