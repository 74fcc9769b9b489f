"""A million transitions: seconds to load, and how much memory beyond the arrays themselves."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from qdos_brax.data import formats

ROWS = 1_000_000
LENGTH = 1_000
ROOT = Path(__file__).parents[2]

# In a process of its own, whose high-water mark is the loading's. A short file first, for what loads lazily.
LOAD = """
import contextlib, json, sys, time
from pathlib import Path
import envs
from qdos_brax.data import formats

def memory(key):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(key))

env = envs.make("antmaze-medium", physics="mujoco")
formats.read(sys.argv[1], env)
with contextlib.suppress(OSError):  # else the mark is at least that of the imports, which is the harder test
    Path("/proc/self/clear_refs").write_text("5")
before, started, cpu = memory("VmRSS"), time.perf_counter(), time.process_time()
dataset = formats.read(sys.argv[2], env)
seconds, cpu = time.perf_counter() - started, time.process_time() - cpu
arrays = [value for value in vars(dataset).values() if hasattr(value, "nbytes")]
size = sum(array.nbytes for array in arrays)
print(json.dumps({"rows": dataset.size, "seconds": seconds, "cpu": cpu, "memory": (memory("VmHWM") - before) / size}))
"""


def columns(num_rows: int, rows_per_episode: int) -> dict[str, np.ndarray]:
    """An ant that trembles within its cell; numbers that no compressor makes small."""
    rng = np.random.default_rng(0)
    observations = rng.uniform(-0.5, 0.5, (num_rows, 29)).astype(np.float32)
    return {
        "observations": observations,
        "actions": rng.uniform(-1, 1, (num_rows, 8)).astype(np.float32),
        "terminals": np.arange(num_rows) % rows_per_episode == rows_per_episode - 1,
        "qpos": observations[:, :15],
        "qvel": observations[:, 15:],
    }


def write_ogbench(path: Path, num_rows: int) -> Path:
    path = path.with_suffix(".npz")
    np.savez_compressed(path, **columns(num_rows, LENGTH + 1))
    return path


def d4rl_columns(num_rows: int) -> dict[str, np.ndarray]:
    rows = columns(num_rows, LENGTH)
    timeouts = {"timeouts": rows["terminals"], "terminals": np.zeros(num_rows, bool)}
    infos = {f"infos/{key}": rows.pop(key) for key in ("qpos", "qvel")}
    return rows | timeouts | infos | {"rewards": np.zeros(num_rows, np.float32)}


def write_d4rl(path: Path, num_rows: int) -> Path:
    path = path.with_suffix(".hdf5")
    with h5py.File(path, "w") as file:
        for key, value in d4rl_columns(num_rows).items():
            file.create_dataset(key, data=value, compression="gzip")
    return path


def write_ours(path: Path, num_rows: int) -> Path:
    path = path.with_suffix(".hdf5")
    rows = d4rl_columns(num_rows)
    formats.write_hdf5(path, rows | {"next_observations": np.roll(rows["observations"], -1, axis=0)}, {})
    return path


def write_minari(path: Path, num_rows: int) -> Path:
    path.mkdir()
    rows = columns(num_rows, LENGTH)
    with h5py.File(path / "main_data.hdf5", "w", track_order=True) as file:
        for episode, start in enumerate(range(0, num_rows, LENGTH)):
            part = slice(start, start + LENGTH)
            group = file.create_group(f"episode_{episode}")
            last = np.zeros((1, 29), np.float32)
            states = np.concatenate([rows["observations"][part], last])
            for key, value in (
                ("observations", states),
                ("actions", rows["actions"][part]),
                ("rewards", np.zeros(LENGTH)),
                ("terminations", np.zeros(LENGTH, bool)),
                ("truncations", rows["terminals"][part]),
                ("infos/qpos", states[:, :15]),
                ("infos/qvel", states[:, 15:]),
            ):
                group.create_dataset(key, data=value, chunks=True, maxshape=(None, *value.shape[1:]))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_ogbench, write_d4rl, write_ours, write_minari])
def test_a_million_transitions_load_in_5_seconds_and_twice_their_memory(
    tmp_path: Path, write: Callable[[Path, int], Path]
) -> None:
    short, long = write(tmp_path / "short", 5 * LENGTH), write(tmp_path / "long", ROWS)
    result = subprocess.run(
        [sys.executable, "-c", LOAD, str(short), str(long)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    found = json.loads(result.stdout.splitlines()[-1])
    print(write.__name__, found)
    assert found["rows"] >= 0.998 * ROWS
    assert 1.0 <= found["memory"] <= 2.0  # less than the arrays would mean that the measuring is wrong
    assert found["seconds"] <= 5.0
