"""Files: OGBench's npz equals OGBench's own reader, our HDF5 survives a round trip, bad files are one clear line."""

from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from ogbench.relabel_utils import relabel_dataset
from ogbench.utils import load_dataset

import envs
from qdos_brax.data import formats
from qdos_brax.errors import UserError

pytestmark = pytest.mark.quick

TASK = "antmaze-medium-task1"


@pytest.fixture(scope="module")
def env() -> envs.Task:
    return envs.make(TASK, physics="mujoco")


def ogbench_rows(env: envs.Task, lengths: tuple[int, ...] = (7, 5, 9), seed: int = 0) -> dict[str, np.ndarray]:
    """Rows as OGBench's generator stores them: T + 1 per trajectory, some at the task's goal."""
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    nq, nv, other = env.engine.nq, env.engine.nv, env.observation_size - env.engine.nq - env.engine.nv
    qpos, qvel = rng.normal(size=(n, nq)).astype(np.float32), rng.normal(size=(n, nv)).astype(np.float32)
    qpos[:, :2] = rng.uniform(-1.5, 1.5, (n, 2))  # inside a free cell, as everything at the goal
    at_goal = rng.random(n) < 0.3
    qpos[at_goal, :2] = env.goal_xy + rng.normal(size=(at_goal.sum(), 2)) * 0.3
    terminals = np.zeros(n, bool)
    terminals[np.cumsum(lengths) - 1] = True
    return {
        "observations": np.concatenate([qpos, qvel, rng.normal(size=(n, other)).astype(np.float32)], axis=1),
        "actions": rng.uniform(-1, 1, (n, env.action_size)).astype(np.float32),
        "terminals": terminals,
        "qpos": qpos,
        "qvel": qvel,
    }


def d4rl_rows(env: envs.Task) -> dict[str, np.ndarray]:
    """The same rows under D4RL's keys, with next observations."""
    rows = ogbench_rows(env)
    n = len(rows["terminals"])
    return {
        "observations": rows["observations"],
        "actions": rows["actions"],
        "next_observations": np.roll(rows["observations"], -1, axis=0),
        "rewards": np.zeros(n, np.float32),
        "terminals": np.zeros(n, bool),
        "timeouts": rows["terminals"],
        "infos/qpos": rows["qpos"],
        "infos/qvel": rows["qvel"],
        "infos/quality": np.arange(n, dtype=np.int8) % 4,
    }


@pytest.mark.parametrize("name", ["antmaze-medium", "antmaze-teleport", "humanoidmaze-medium"])
def test_npz_equals_ogbench_reader_and_relabelling(tmp_path: Path, name: str) -> None:
    env = envs.make(f"{name}-task1", physics="mujoco")
    path = tmp_path / "set.npz"
    np.savez(path, **ogbench_rows(env))
    reference = load_dataset(str(path), add_info=True)
    relabel_dataset(f"{name}-singletask", gymnasium.make(f"{name}-singletask-task1-v0"), reference)

    dataset = formats.read(path, env)

    for key in ("observations", "actions", "next_observations", "rewards", "masks", "qpos", "qvel"):
        np.testing.assert_array_equal(getattr(dataset, key), reference[key], err_msg=key)
    np.testing.assert_array_equal(dataset.ends, reference["terminals"].astype(bool))
    assert 0 < (dataset.masks == 0).sum() < dataset.size
    assert dataset.num_episodes == 3 and dataset.size == 18
    assert dataset.observations.dtype == np.float32 and dataset.observations.flags.c_contiguous


def test_npz_cut_inside_a_trajectory_loses_only_the_row_without_a_next_state(tmp_path: Path, env: envs.Task) -> None:
    path = tmp_path / "cut.npz"
    rows = ogbench_rows(env)
    np.savez(path, **{key: value[:-2] for key, value in rows.items()})
    dataset = formats.read(path, env)
    assert dataset.size == 6 + 4 + 6
    np.testing.assert_array_equal(dataset.next_observations[-1], rows["observations"][-3])


def test_hdf5_round_trip_keeps_everything(tmp_path: Path, env: envs.Task) -> None:
    path = tmp_path / "folder" / "set.hdf5"
    rows = d4rl_rows(env)
    formats.write_hdf5(path, rows, {"env": TASK, "seed": 3})
    dataset = formats.read(path, env)
    pairs = {
        "observations": "observations",
        "actions": "actions",
        "next_observations": "next_observations",
        "ends": "timeouts",
        "qpos": "infos/qpos",
        "qvel": "infos/qvel",
        "quality": "infos/quality",
    }
    for ours, theirs in pairs.items():
        np.testing.assert_array_equal(getattr(dataset, ours), rows[theirs], err_msg=ours)
    success = env.success(rows["infos/qpos"], env.goal_xy)
    np.testing.assert_array_equal(dataset.rewards, success - 1.0)
    np.testing.assert_array_equal(dataset.masks, 1.0 - success)
    assert formats.read_attrs(path)["seed"] == 3
    assert [p.name for p in path.parent.iterdir()] == ["set.hdf5"]


def test_hdf5_without_positions_takes_its_own_rewards(tmp_path: Path, env: envs.Task) -> None:
    path = tmp_path / "plain.hdf5"
    rows = {key: value for key, value in d4rl_rows(env).items() if not key.startswith("infos/")}
    rows["rewards"] = np.linspace(0, 1, len(rows["rewards"]), dtype=np.float32)
    rows["terminals"] = rows["rewards"] == 1
    formats.write_hdf5(path, rows, {})
    dataset = formats.read(path, env)
    np.testing.assert_allclose(dataset.rewards, rows["rewards"] - 1)
    np.testing.assert_array_equal(dataset.masks, 1.0 - rows["terminals"])
    assert dataset.qpos is None and dataset.quality is None


def _spoil(rows: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    return {**rows, key: value}


def _with(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: _spoil(r, "observations", _with(r["observations"], (3, 1), np.nan)), "observations has NaN"),
        (lambda r: _spoil(r, "actions", r["actions"] * 30), "actions reach"),
        (lambda r: _spoil(r, "observations", r["observations"][:, :20]), "20 numbers per row, antmaze-medium has 29"),
        (lambda r: _spoil(r, "actions", r["actions"][:-1]), "damaged"),
        (lambda r: {k: v for k, v in r.items() if k != "actions"}, "no 'actions'"),
        (lambda r: {k: v for k, v in r.items() if k != "qpos"}, "neither qpos nor rewards"),
        (lambda r: _spoil(r, "actions", r["actions"].astype(object)), "not numeric"),
        (lambda r: _spoil(r, "actions", np.full(r["actions"].shape, "x")), "not numeric"),
        (lambda r: {k: v[:1] for k, v in r.items()}, "no transitions"),
        (lambda r: {k: v[:0] for k, v in r.items()}, "no transitions"),
    ],
)
def test_bad_rows_are_one_clear_line(tmp_path: Path, env: envs.Task, spoil: Any, says: str) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **spoil(ogbench_rows(env)))
    with pytest.raises(UserError, match=says) as error:
        formats.read(path, env)
    assert "\n" not in str(error.value)


def test_actions_over_by_rounding_are_clipped(tmp_path: Path, env: envs.Task) -> None:
    path = tmp_path / "set.npz"
    rows = ogbench_rows(env)
    np.savez(path, **_spoil(rows, "actions", _with(rows["actions"], (0, 0), 1.0005)))
    assert formats.read(path, env).actions.max() == 1.0


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_files_are_refused(tmp_path: Path, env: envs.Task, suffix: str, share: float) -> None:
    path = tmp_path / f"set{suffix}"
    if suffix == ".npz":
        np.savez(path, **ogbench_rows(env))
    else:
        formats.write_hdf5(path, d4rl_rows(env), {})
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError, match="cannot be read"):
        formats.read(path, env)


def test_other_files_are_refused(tmp_path: Path, env: envs.Task) -> None:
    text, array = tmp_path / "notes.txt", tmp_path / "array.npy"
    text.write_text("hello")
    np.save(array, np.zeros(3))
    for path in (text, array, tmp_path / "absent.npz", tmp_path):
        with pytest.raises(UserError):
            formats.read(path, env)
    group = tmp_path / "group.hdf5"
    with h5py.File(group, "w") as file:
        file.create_group("observations")
    with pytest.raises(UserError):
        formats.read(group, env)


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "set.hdf5"
    with pytest.raises(TypeError):
        formats.write_hdf5(path, {"observations": np.array([object()])}, {})
    assert list(tmp_path.iterdir()) == []


def test_files_written_here_notice_any_change_of_their_values(tmp_path: Path, env: envs.Task) -> None:
    path = tmp_path / "set.hdf5"
    formats.write_hdf5(path, d4rl_rows(env), {})
    with h5py.File(path, "r+") as file:
        file["actions"][3, 2] += 1e-3
    with pytest.raises(UserError, match="'actions' does not have the checksum"):
        formats.read(path, env)
    formats.write_hdf5(path, d4rl_rows(env), {})
    with h5py.File(path, "r+") as file:
        del file["infos/qvel"]
    with pytest.raises(UserError, match="'infos/qvel' was written and is gone"):
        formats.read(path, env)
