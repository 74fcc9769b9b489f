"""Reading and writing dataset files: which reader takes a file, the task's labels, our own ``.hdf5``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from envs.mazes.maze_task import LARGEST_MOVE
from envs.task import Task
from qdos_brax.data import checks
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.labelling import label
from qdos_brax.data.readers import d4rl, minari, ogbench
from qdos_brax.data.readers.rows import Rows, unreadable
from qdos_brax.data.readers.table import CHECKSUMS, HDF5Table, NpzTable, checksum
from qdos_brax.data.requirements import refuse
from qdos_brax.errors import UserError
from qdos_brax.files import replacing, user_errors

_CHUNK_BYTES = 1 << 19


def read(path: str | os.PathLike[str], env: Task) -> Dataset:
    """Return the transitions of ``path``, labelled for the task of ``env``.

    Args:
        path: an OGBench ``.npz``, a D4RL-flat ``.hdf5`` (also ``.h5``), a Minari folder or its ``main_data.hdf5``.
        env: the task, for its sizes, checks and labels.

    Raises:
        UserError: unreadable, incomplete, not finite, or made for another task or action space.
    """
    rows = load(path, env.jump)
    refuse(str(path), checks.prepare(rows, env))
    return label(rows, env, str(path))


def load(path: str | os.PathLike[str], jump: float | None = LARGEST_MOVE) -> Rows:
    """Return the rows of ``path``, not yet checked or labelled.

    Args:
        path: as for ``read``.
        jump: the task's ``jump``, which D4RL's files need; where the task is not known that of the mazes.

    Raises:
        UserError: unreadable or incomplete.
    """
    path = data_file(path)
    if not _is_hdf5(path):
        with unreadable(path), NpzTable(path) as archive:
            return d4rl.load(archive, jump) if d4rl.is_d4rl(archive) else ogbench.load(archive)
    with unreadable(path), h5py.File(path, "r") as file:
        by_episode = minari.is_minari(file)
    if by_episode:
        return minari.load(path)
    with unreadable(path), HDF5Table(path) as table:
        return d4rl.load(table, jump)


def data_file(path: str | os.PathLike[str]) -> Path:
    """Return the one file that ``path`` stands for: itself, or what holds the episodes of a Minari folder.

    Raises:
        UserError: there is none.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return minari.main_file(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; give --dataset an OGBench .npz, a D4RL .hdf5 or a Minari folder")
    return path


def write_hdf5(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any]) -> None:
    """Write ``arrays`` (keys as in the file, ``infos/qpos`` for a group) whole or not at all, with checksums.

    Args:
        path: the ``.hdf5`` file; folders are made.
        arrays: D4RL's flat keys; ``next_observations`` is ours (D4RL's readers ignore it).
        attrs: file attributes: numbers and strings.

    Raises:
        UserError: the folder or the disk does not take the file.
    """
    path = Path(path).expanduser()
    with user_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    # From version 1.10 of the format on, HDF5 guards its own structures by checksums.
    with replacing(path) as partial, h5py.File(partial, "w", libver=("v110", "v110")) as file:
        for key, array in arrays.items():
            row_bytes = max(1, math.prod(array.shape[1:]) * array.dtype.itemsize)
            chunk = (max(1, min(len(array), _CHUNK_BYTES // row_bytes)), *array.shape[1:])
            file.create_dataset(key, data=array, compression="lzf", chunks=chunk)
        for name, value in attrs.items():
            file.attrs[name] = value
        file.attrs[CHECKSUMS] = json.dumps({key: checksum(array) for key, array in arrays.items()})


def read_attrs(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the attributes of an ``.hdf5`` file without the checksums; empty for other files."""
    path = data_file(path)
    if not _is_hdf5(path):
        return {}
    with unreadable(path), h5py.File(path, "r") as file:
        return {name: value for name, value in file.attrs.items() if name != CHECKSUMS}


def _is_hdf5(path: Path) -> bool:
    return path.suffix in (".hdf5", ".h5") or h5py.is_hdf5(path)
