"""Minari: a data set's folder or its ``main_data.hdf5``, read without Minari."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from qdos_brax.data.readers.rows import Rows, after_action, unreadable
from qdos_brax.data.readers.table import NUMERIC
from qdos_brax.errors import UserError

_MAIN_FILE = "main_data.hdf5"
_GOAL_KEYS = {"observation", "achieved_goal", "desired_goal"}


def main_file(folder: Path) -> Path:
    """The file in a data set's folder that holds its episodes.

    Raises:
        UserError: the folder is no Minari data set stored as HDF5.
    """
    for path in (folder / "data" / _MAIN_FILE, folder / _MAIN_FILE):
        if path.is_file():
            return path
    raise UserError(f"{folder}: has no data/{_MAIN_FILE}; a folder must be a Minari data set stored as hdf5")


def is_minari(file: h5py.File) -> bool:
    """Whether the file holds groups named by episode."""
    return any(key.startswith("episode_") for key in file)


def load(path: Path) -> Rows:
    """The transitions of a Minari ``main_data.hdf5``; episodes have one observation more than actions.

    Observations that are a dictionary (groups within the episode) become one vector. Of a goal-conditioned one it is
    ``observation``, preceded by ``achieved_goal`` where that is a position that ``observation`` leaves out (ant
    mazes); the desired goal is the data's, not the task's, and left out. Any other dictionary is flattened as
    ``gymnasium.spaces.flatten`` does: leaf after leaf, by name.

    Raises:
        UserError: unreadable, an episode missing or incomplete, or sizes that do not fit.
    """
    with unreadable(path), h5py.File(path, "r") as file:
        episodes = _episodes(path, file)
        lengths = [_length(path, group) for group in episodes]
        stops = np.cumsum(lengths)
        total = int(stops[-1]) if lengths else 0
        if not total:
            raise UserError(f"{path}: no transitions")
        first = _observations(episodes[0])
        rows = Rows(
            observations=np.empty((total, first.shape[1]), np.float32),
            actions=np.empty((total, *_set(episodes[0], "actions").shape[1:]), np.float32),
            next_observations=np.empty((total, first.shape[1]), np.float32),
            ends=np.zeros(total, bool),
            terminals=np.empty(total, np.float32),
            rewards=np.empty(total, np.float32),
        )
        with_states = sum("infos/qpos" in group and "infos/qvel" in group for group in episodes)
        if with_states not in (0, len(episodes)):
            raise UserError(f"{path}: only {with_states} of {len(episodes)} episodes have infos/qpos and infos/qvel")
        if with_states:
            rows.qpos, rows.qvel = (
                np.empty((total, *_set(episodes[0], f"infos/{key}").shape[1:]), np.float32) for key in ("qpos", "qvel")
            )
        rows.ends[stops - 1] = True
        for group, length, stop in zip(episodes, lengths, stops, strict=True):
            _fill(path, group, rows, slice(int(stop) - length, int(stop)))
        after_action(path, rows)
        return rows


def _episodes(path: Path, file: h5py.File) -> list[h5py.Group]:
    """The groups of all episodes in order; checks them against the metadata."""
    numbers = sorted(int(match[1]) for key in file if (match := re.fullmatch(r"episode_(\d+)", key)))
    expected = len(numbers)
    metadata_path = path.with_name("metadata.json")
    attributes = dict(file.attrs)  # older versions keep the metadata here
    if metadata_path.is_file():
        attributes |= json.loads(metadata_path.read_text(encoding="utf-8"))
    if "total_episodes" in attributes:
        expected = int(attributes["total_episodes"])
    missing = sorted(set(range(max(expected, numbers[-1] + 1 if numbers else 0))) - set(numbers))
    if missing:
        raise UserError(f"{path}: episode_{missing[0]} is missing ({len(numbers)} of {expected} are there)")
    return [file[f"episode_{number}"] for number in numbers]


def _length(path: Path, group: h5py.Group) -> int:
    """Transitions in an episode, after a look at the sizes of everything in it."""
    for key in ("observations", "actions", "rewards", "terminations", "truncations"):
        if key not in group:
            raise UserError(f"{path}: {group.name[1:]} has no {key!r}; the file is damaged or of another version")
    length = _set(group, "actions").shape[0]
    for key in ("rewards", "terminations", "truncations"):
        shape = _set(group, key).shape
        if shape not in ((length,), (length, 1)):
            raise UserError(f"{path}: {group.name[1:]} has {length} actions and {key} of shape {shape}: it is damaged")
    if group.attrs.get("total_steps", length) != length:
        steps = group.attrs["total_steps"]
        raise UserError(f"{path}: {group.name[1:]} has {length} of its {steps} steps: the file is damaged")
    return int(length)


def _fill(path: Path, group: h5py.Group, rows: Rows, part: slice) -> None:
    length = part.stop - part.start
    observations = _observations(group)
    if observations.shape != (length + 1, rows.observations.shape[1]):
        raise UserError(
            f"{path}: {group.name[1:]} has observations {observations.shape} where "
            f"{(length + 1, rows.observations.shape[1])} are expected: the file is damaged"
        )
    rows.observations[part], rows.next_observations[part] = observations[:-1], observations[1:]
    rows.actions[part] = _numbers(group, "actions")
    assert rows.rewards is not None and rows.terminals is not None
    rows.rewards[part] = _numbers(group, "rewards").reshape(-1)
    rows.terminals[part] = _numbers(group, "terminations").reshape(-1) != 0
    for key, target in (("qpos", rows.qpos), ("qvel", rows.qvel)):
        if target is not None:
            values = _numbers(group, f"infos/{key}")
            if len(values) not in (length, length + 1):
                raise UserError(f"{path}: {group.name[1:]} has {len(values)} rows of infos/{key}: the file is damaged")
            target[part] = values[:length]  # one more in today's files, where reset's info comes first


def _observations(group: h5py.Group) -> np.ndarray:
    """[T + 1, obs] of an episode."""
    item = group["observations"]
    if not isinstance(item, h5py.Group):
        return _flat(group, "observations")
    if not set(item) >= _GOAL_KEYS:
        return np.concatenate([_flat(parent, key) for parent, key in _leaves(item)], axis=1)
    observation = _flat(item, "observation")
    if isinstance(item["achieved_goal"], h5py.Group):
        return observation  # the kitchen's: parts of the observation again
    position = _flat(item, "achieved_goal")
    if np.array_equal(observation[:, : position.shape[1]], position):
        return observation
    return np.concatenate([position, observation], axis=1)


def _leaves(group: h5py.Group) -> Iterator[tuple[h5py.Group, str]]:
    """Group and name of all data sets below ``group``, by name; parts of a tuple by number."""
    for key in sorted(group, key=lambda key: (int(key[7:]), "") if re.fullmatch(r"_index_\d+", key) else (0, key)):
        if isinstance(group[key], h5py.Group):
            yield from _leaves(group[key])
        else:
            yield group, key


def _flat(group: h5py.Group, key: str) -> np.ndarray:
    """[T, numbers per row]."""
    array = _numbers(group, key)
    return array.reshape(len(array), -1)


def _numbers(group: h5py.Group, key: str) -> np.ndarray:
    """A data set as float32."""
    values = _set(group, key)
    if values.dtype.kind not in NUMERIC or not values.shape:
        raise TypeError(f"{values.name[1:]!r} is not numeric ({values.dtype})")
    with np.errstate(over="ignore", invalid="ignore"):  # infinite then, and reported as such
        return np.asarray(values[()]).astype(np.float32, copy=False)


def _set(group: h5py.Group, key: str) -> h5py.Dataset:
    item = group[key]
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        raise TypeError(f"{item.name[1:]!r} holds no values")
    return item
