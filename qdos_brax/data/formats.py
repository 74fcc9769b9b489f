"""Dataset files: OGBench ``.npz`` and D4RL's flat ``.hdf5`` in, our ``.hdf5`` (D4RL's layout) out.

Rewards and masks are the task's own wherever the file has the simulator's positions: the reward of a row is
``success - 1`` of the state before the action, its mask ``1 - success`` (OGBench 1.2 single-task, timing "pre").
"""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from qdos_brax.data.dataset import Dataset, episode_bounds
from qdos_brax.errors import UserError

_ACTION_SLACK = 1e-3  # rounding of files stored in half precision; more than that is another action space
_JUMP = 1.5  # no ant or humanoid gets that far in one control step; the first D4RL files have resets without a mark

_HDF5_OPTIONAL = ("next_observations", "rewards", "timeouts", "infos/qpos", "infos/qvel", "infos/quality")


def read(path: str | os.PathLike[str], env: Any) -> Dataset:
    """The transitions of ``path``, labelled for the task of ``env``.

    Args:
        path: an OGBench ``.npz`` or a D4RL-flat ``.hdf5`` (also ``.h5``).
        env: the task, for its sizes and its ``success``.

    Raises:
        UserError: unreadable, incomplete, not finite, or made for another task or action space.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise UserError(f"{path}: no such file; give --dataset an OGBench .npz or a D4RL .hdf5 file")
    arrays = _load_hdf5(path) if _is_hdf5(path) else _load_npz(path)
    lines = validate(arrays, env)
    if lines:
        more = f" (and {len(lines) - 1} more, see: data check)" if len(lines) > 1 else ""
        raise UserError(f"{path}: {lines[0]}{more}")
    return _label(arrays, env, str(path))


def validate(arrays: Mapping[str, np.ndarray], env: Any) -> list[str]:
    """What makes ``arrays`` unusable for ``env``: one line each with cause and mend; empty when all is well.

    Args:
        arrays: rows in the regular layout (``observations``, ``actions``, ``next_observations``, ``ends``, maybe
            ``qpos``, ``qvel``, ``rewards``, ``quality``), as the readers of this module make them.
        env: the task.
    """
    lines: list[str] = []
    n = len(arrays["observations"])
    if n == 0:
        return ["no transitions; every episode needs at least two rows, the last is only a next state"]
    nq, nv = env.engine.nq, env.engine.nv
    obs, act = env.observation_size, env.action_size
    widths = {"observations": obs, "next_observations": obs, "actions": act, "qpos": nq, "qvel": nv}
    for key, width in widths.items():
        if key in arrays and arrays[key].shape != (n, width):
            shape = "x".join(map(str, arrays[key].shape[1:])) or "1"
            lines.append(f"{key} has {shape} numbers per row, {env.spec.name} has {width}: made for another task?")
    for key in ("observations", "actions", "next_observations", "rewards", "qpos", "qvel"):
        if key in arrays:
            bad = ~np.isfinite(arrays[key]).reshape(n, -1).all(axis=1)
            if bad.any():
                lines.append(f"{key} has NaN or infinity in {bad.sum()} rows, first row {bad.argmax()}: remove them")
    over = float(np.abs(arrays["actions"]).max())
    if over > 1.0 + _ACTION_SLACK:
        lines.append(f"actions reach {over:.3g}, the task takes [-1, 1]: scale them")
    if "qpos" not in arrays and "rewards" not in arrays:
        lines.append("neither qpos nor rewards: the task's rewards cannot be told; OGBench sets need add_info's qpos")
    return lines


def horizon_lines(ends: np.ndarray, horizon: int) -> tuple[list[str], list[str]]:
    """(errors, notes) on how the episodes fit windows of ``horizon`` steps."""
    bounds = episode_bounds(ends)
    lengths = bounds[:, 1] - bounds[:, 0]
    short = int((lengths < horizon).sum())
    if short == len(lengths):
        return [f"no episode has {horizon} steps (longest {lengths.max()}): use a shorter segment horizon"], []
    note = f"{short} of {len(lengths)} episodes are shorter than {horizon} steps and give no segment"
    return [], [note] if short else []


def write_hdf5(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any]) -> None:
    """Writes ``arrays`` (keys as in the file, ``infos/qpos`` for a group) whole or not at all.

    Args:
        path: the ``.hdf5`` file; folders are made.
        arrays: D4RL's flat keys; ``next_observations`` is ours (D4RL's readers ignore it).
        attrs: file attributes: numbers and strings.

    Raises:
        UserError: the folder or the disk does not take the file.
    """
    path = Path(path).expanduser()
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(partial, "w") as file:
            for key, array in arrays.items():
                file.create_dataset(key, data=array, compression="lzf", chunks=True)
            for name, value in attrs.items():
                file.attrs[name] = value
        os.replace(partial, path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The rows of ``path`` in the regular layout, not yet checked or labelled; raises UserError when unreadable."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    return _load_hdf5(path) if _is_hdf5(path) else _load_npz(path)


def read_attrs(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The attributes of an ``.hdf5`` file; empty for other files."""
    path = Path(path).expanduser()
    if not _is_hdf5(path):
        return {}
    with h5py.File(path, "r") as file:
        return dict(file.attrs)


def _label(arrays: Mapping[str, np.ndarray], env: Any, source: str) -> Dataset:
    if "qpos" in arrays:
        success = np.asarray(env.success(arrays["qpos"], env.goal_xy)).astype(np.float32)
        rewards, masks = success - 1.0, 1.0 - success
    else:
        # D4RL's sparse rewards are 0 and 1; ours are one less.
        rewards = arrays["rewards"] - (1.0 if arrays["rewards"].min() >= 0 else 0.0)
        masks = 1.0 - arrays["terminals"]
    return Dataset(
        observations=_float32(arrays["observations"]),
        actions=np.clip(_float32(arrays["actions"]), -1.0, 1.0),
        rewards=_float32(rewards),
        masks=_float32(masks),
        ends=np.asarray(arrays["ends"], bool),
        next_observations=_float32(arrays["next_observations"]),
        qpos=_float32(arrays["qpos"]) if "qpos" in arrays else None,
        qvel=_float32(arrays["qvel"]) if "qvel" in arrays else None,
        quality=np.asarray(arrays["quality"], np.int8) if "quality" in arrays else None,
        source=source,
    )


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)


def _is_hdf5(path: Path) -> bool:
    return path.suffix in (".hdf5", ".h5") or h5py.is_hdf5(path)


# --- OGBench npz ---


def _load_npz(path: Path) -> dict[str, np.ndarray]:
    """Regular layout from OGBench's T + 1 rows per trajectory, whose last row is only a next state."""
    try:
        file = np.load(path, allow_pickle=False)
        if isinstance(file, np.ndarray):
            raise ValueError("a single array, not an archive")
        with file:
            rows = {key: file[key] for key in ("observations", "actions", "terminals", "qpos", "qvel") if key in file}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        raise UserError(f"{path}: cannot be read as .npz or .hdf5 (truncated or another format): {error}") from None
    _require(path, rows, ("observations", "actions", "terminals"))
    is_last = np.asarray(rows["terminals"], bool)
    if len(is_last):
        is_last[-1] = True  # a file cut inside a trajectory: its last row has no next state either
    keep = ~is_last
    arrays = {key: value[keep] for key, value in rows.items() if key != "terminals"}
    arrays["next_observations"] = rows["observations"][np.flatnonzero(keep) + 1]
    arrays["ends"] = np.roll(is_last, -1)[keep]
    return arrays


# --- D4RL flat HDF5 ---


def _load_hdf5(path: Path) -> dict[str, np.ndarray]:
    """Regular layout from D4RL's flat one; without next observations the last row of each episode is only one."""
    try:
        with h5py.File(path, "r") as file:
            rows = {
                key.removeprefix("infos/"): np.asarray(file[key])
                for key in ("observations", "actions", "terminals", *_HDF5_OPTIONAL)
                if key in file
            }
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as HDF5 (truncated or another format): {error}") from None
    _require(path, rows, ("observations", "actions", "terminals"))
    terminals = np.asarray(rows.pop("terminals"), bool).reshape(-1)
    ends = terminals | np.asarray(rows.pop("timeouts", terminals), bool).reshape(-1)
    arrays: dict[str, np.ndarray] = {**rows, "terminals": terminals.astype(np.float32)}
    if len(ends):
        ends[-1] = True
    if "next_observations" in arrays:
        return {**arrays, "ends": ends}
    if "qpos" in arrays and arrays["qpos"].ndim == 2:
        steps = np.linalg.norm(np.diff(arrays["qpos"][:, :2], axis=0), axis=1)
        ends[:-1] |= steps > _JUMP
    keep = ~ends
    arrays = {key: value[keep] for key, value in arrays.items()}
    arrays["next_observations"] = rows["observations"][np.flatnonzero(keep) + 1]
    arrays["ends"] = np.roll(ends, -1)[keep]
    return arrays


def _require(path: Path, rows: Mapping[str, np.ndarray], keys: tuple[str, ...]) -> None:
    """Raises UserError unless all ``keys`` are there, numeric, and all arrays have as many rows as the first."""
    for key in keys:
        if key not in rows:
            raise UserError(f"{path}: has no {key!r}; expected an OGBench .npz or a D4RL .hdf5 file")
    n = np.shape(rows["observations"])[0] if np.ndim(rows["observations"]) else 0
    for key, value in rows.items():
        if not (np.issubdtype(value.dtype, np.number) or value.dtype == bool):
            raise UserError(f"{path}: {key!r} is not numeric ({value.dtype})")
        if np.ndim(value) == 0 or len(value) != n:
            raise UserError(f"{path}: {key!r} has {np.shape(value)} rows, observations have {n}: the file is damaged")
