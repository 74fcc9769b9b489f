"""Read Minari: a data set's folder or its ``main_data.hdf5``, without Minari."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from qdos_brax.data.readers.rows import Rows, after_action, unreadable
from qdos_brax.data.readers.table import NUMERIC
from qdos_brax.errors import UserError
from qdos_brax.files import parse_json

_MAIN_FILE = "main_data.hdf5"
_REQUIRED = ("observations", "actions", "rewards", "terminations", "truncations")
_STATES = {"infos/qpos", "infos/qvel"}
# What is read of an episode's infos where all episodes have it, by the rows' field.
_INFOS = {"qpos": "infos/qpos", "qvel": "infos/qvel", "extra": "infos/extra", "quality": "infos/quality"}
_INTEGERS = {"extra": np.int32, "quality": np.int8}
_OURS = {"infos/extra": 2, "infos/quality": 1}  # with their axes: infos of these names may be anything elsewhere
_GOAL_KEYS = {"observation", "achieved_goal", "desired_goal"}


def main_file(folder: Path) -> Path:
    """Return the file in a data set's folder that holds its episodes.

    Raises:
        UserError: the folder is no Minari data set stored as HDF5.
    """
    for path in (folder / "data" / _MAIN_FILE, folder / _MAIN_FILE):
        if path.is_file():
            return path
    raise UserError(f"{folder}: has no data/{_MAIN_FILE}; a folder must be a Minari data set stored as hdf5")


def is_minari(file: h5py.File) -> bool:
    """Return whether the file holds groups named by episode."""
    return any(key.startswith("episode_") for key in file)


def load(path: Path) -> Rows:
    """Return the transitions of a Minari ``main_data.hdf5``; episodes have one observation more than actions.

    Observations that are a dictionary (groups within the episode) become one vector. Of a goal-conditioned one it is
    ``observation``, preceded by ``achieved_goal`` where that is a position that ``observation`` leaves out (ant
    mazes); the desired goal is the data's, not the task's, and left out. Any other dictionary is flattened as
    ``gymnasium.spaces.flatten`` does: leaf after leaf, by name.

    Raises:
        UserError: unreadable, an episode missing or incomplete, or sizes that do not fit.
    """
    with unreadable(path), h5py.File(path, "r") as file:
        names = _episode_names(path, file)
        stops = np.cumsum([_set(_item(file, f"{name}/actions")).shape[0] for name in names])
        total = int(stops[-1]) if names else 0
        if not total:
            raise UserError(f"{path}: no transitions")
        first = _open(path, file, names[0])
        width = _observations(first["observations"]).shape[1]
        rows = Rows(
            observations=np.empty((total, width), np.float32),
            actions=np.empty((total, *first["actions"].shape[1:]), np.float32),
            next_observations=np.empty((total, width), np.float32),
            ends=np.zeros(total, bool),
            terminals=np.empty(total, np.float32),
            rewards=np.empty(total, np.float32),
        )
        for field in _fields(first):
            shape = (total, *first[_INFOS[field]].shape[1:])
            setattr(rows, field, np.empty(shape, _INTEGERS.get(field, np.float32)))
        rows.ends[stops - 1] = True
        for name, start, stop in zip(names, [0, *stops], stops, strict=False):
            # One episode's data sets are open at a time, for each has a cache of its own.
            _fill(path, name, _open(path, file, name), rows, slice(int(start), int(stop)))
        after_action(path, rows)
        return rows


def _episode_names(path: Path, file: h5py.File) -> list[str]:
    """Return the names of all episodes in order; checks them against the metadata."""
    numbers = sorted(int(match[1]) for key in file if (match := re.fullmatch(r"episode_(\d+)", key)))
    expected = len(numbers)
    metadata_path = path.with_name("metadata.json")
    attributes = dict(file.attrs)  # older versions keep the metadata here
    if metadata_path.is_file():
        attributes |= parse_json(metadata_path.read_text(encoding="utf-8"))
    if "total_episodes" in attributes:
        expected = int(attributes["total_episodes"])
    missing = sorted(set(range(max(expected, numbers[-1] + 1 if numbers else 0))) - set(numbers))
    if missing:
        raise UserError(f"{path}: episode_{missing[0]} is missing ({len(numbers)} of {expected} are there)")
    return [f"episode_{number}" for number in numbers]


def _fields(items: Mapping[str, Any]) -> list[str]:
    """Return the rows' fields that an episode's infos hold; simulator states count if they are whole."""
    whole = set(items) >= _STATES
    return [field for field, key in _INFOS.items() if key in items and (whole or key not in _STATES)]


def _open(path: Path, file: h5py.File, name: str) -> dict[str, Any]:
    """Return what an episode holds; ``observations`` may be a group."""
    group, items = file[name], {}
    for key in (*_REQUIRED, *_INFOS.values()):
        try:
            item = _item(group, key)
        except KeyError:
            if key in _REQUIRED:
                raise UserError(f"{path}: {name} has no {key!r}: damaged, or of another version") from None
            continue
        if key not in _OURS or _is_ours(item, _OURS[key]):
            items[key] = item
    steps = group.attrs.get("total_steps")
    if steps is not None and steps != (length := _set(items["actions"]).shape[0]):
        raise UserError(f"{path}: {name} has {length} of its {steps} steps: the file is damaged")
    return items


def _is_ours(item: Any, axes: int) -> bool:
    """Return whether an info is what ``data export`` writes under its name: whole numbers, of so many axes."""
    return isinstance(item, h5py.h5d.DatasetID) and item.dtype.kind in "biu" and len(item.shape or ()) == axes


def _fill(path: Path, name: str, items: Mapping[str, Any], rows: Rows, part: slice) -> None:
    """Read an episode into its ``part`` of ``rows``, after a look at the sizes."""
    length = part.stop - part.start
    for key in ("rewards", "terminations", "truncations"):
        shape = _set(items[key]).shape
        if shape not in ((length,), (length, 1)):
            raise UserError(f"{path}: {name} has {length} actions and {key} of shape {shape}: the file is damaged")
    fields = _fields(items)
    for field, key in _INFOS.items():
        if (field in fields) != (getattr(rows, field) is not None):
            raise UserError(f"{path}: {name} and the first episode differ in having {key}")
    observations, expected = _observations(items["observations"]), (length + 1, rows.observations.shape[1])
    if observations.shape != expected:
        raise UserError(
            f"{path}: {name} has observations {observations.shape} where {expected} are expected: the file is damaged"
        )
    rows.observations[part], rows.next_observations[part] = observations[:-1], observations[1:]
    rows.actions[part] = _numbers(items["actions"])
    assert rows.rewards is not None and rows.terminals is not None
    rows.rewards[part] = _numbers(items["rewards"]).reshape(-1)
    rows.terminals[part] = _numbers(items["terminations"]).reshape(-1) != 0
    for field in fields:
        values = _numbers(items[_INFOS[field]])
        if len(values) not in (length, length + 1):
            raise UserError(f"{path}: {name} has {len(values)} rows of {_INFOS[field]}: the file is damaged")
        values = values[:length]  # one more in today's files, where reset's info comes first
        getattr(rows, field)[part] = values


def _observations(item: Any) -> np.ndarray:
    """Return [T + 1, obs] of an episode, from its ``observations``."""
    if not isinstance(item, h5py.h5g.GroupID):
        return _flat(item)
    group = h5py.Group(item)
    if not set(group) >= _GOAL_KEYS:
        return np.concatenate([_flat(leaf) for leaf in _leaves(group)], axis=1)
    observation, achieved = _flat(_item(group, "observation")), _item(group, "achieved_goal")
    if isinstance(achieved, h5py.h5g.GroupID):
        return observation  # the kitchen's: parts of the observation again
    position = _flat(achieved)
    if np.array_equal(observation[:, : position.shape[1]], position):
        return observation
    return np.concatenate([position, observation], axis=1)


def _leaves(group: h5py.Group) -> Iterator[Any]:
    """Yield all that is no group below ``group``, by name; parts of a tuple by number."""
    for key in sorted(group, key=lambda key: (int(key[7:]), "") if re.fullmatch(r"_index_\d+", key) else (0, key)):
        item = _item(group, key)
        if isinstance(item, h5py.h5g.GroupID):
            yield from _leaves(h5py.Group(item))
        else:
            yield item


def _item(group: h5py.Group, key: str) -> Any:
    """Return HDF5's own handle of ``key``: h5py's objects take twice the time, and there are thousands."""
    return h5py.h5o.open(group.id, key.encode())


def _flat(item: Any) -> np.ndarray:
    """Return [T, numbers per row]."""
    array = _numbers(item)
    return array.reshape(len(array), -1)


def _numbers(item: Any) -> np.ndarray:
    """Return a data set as float32."""
    values = _set(item)
    if values.dtype.kind not in NUMERIC:
        raise TypeError(f"{_name(item)} is not numeric ({values.dtype})")
    out = np.empty(values.shape, bool if values.dtype.kind == "b" else np.float32)
    values.read(h5py.h5s.ALL, h5py.h5s.ALL, out)
    return out.astype(np.float32, copy=False)


def _set(item: Any) -> h5py.h5d.DatasetID:
    if not isinstance(item, h5py.h5d.DatasetID) or not item.shape:
        raise TypeError(f"{_name(item)} holds no rows")
    return item


def _name(item: Any) -> str:
    return repr(h5py.h5i.get_name(item).decode(errors="replace"))
