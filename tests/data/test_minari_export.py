"""Data as a Minari set: what Minari itself and our reader find in it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

import envs
from qdos_brax.commands.main import main
from qdos_brax.data import formats
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.minari_export import export_minari

SOURCE = Path(__file__).parent / "files" / "ogbench-antmaze-medium.npz"


def test_minari_and_our_reader_find_the_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    out = tmp_path / "sets" / "antmaze-medium-v0"
    command = ["data", "export", str(SOURCE), "--env", "antmaze-medium", "--out", str(out)]
    assert main(command) == 0 and main(command) == 0  # a second time: it is replaced
    env = envs.make("antmaze-medium", physics="mujoco")
    before, after = formats.read(SOURCE, env), formats.read(out, env)
    for name in ("observations", "actions", "rewards", "masks", "ends", "next_observations", "qpos", "qvel"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out.parent))
    found = minari.load_dataset("antmaze-medium-v0")
    assert (found.total_episodes, found.total_steps) == (before.num_episodes, before.size)
    for episode, (first, stop) in zip(found.iterate_episodes(), before.episode_bounds, strict=True):
        np.testing.assert_array_equal(episode.observations[:-1], before.observations[first:stop])
        np.testing.assert_array_equal(episode.observations[-1], before.next_observations[stop - 1])
        np.testing.assert_array_equal(episode.actions, before.actions[first:stop])
        np.testing.assert_array_equal(episode.rewards, before.rewards[first:stop])
        assert episode.truncations.tolist() == [False] * (stop - first - 1) + [True]
        assert not episode.terminations.any()
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_discrete_states_and_qualities_are_kept(tmp_path: Path) -> None:
    """A scene without the state of its buttons would be refused by training."""
    pytest.importorskip("minari")
    rng = np.random.default_rng(0)
    states = rng.normal(size=(12, 3)).astype(np.float32)
    before = Dataset(
        observations=states,
        next_observations=np.roll(states, -1, axis=0),
        actions=rng.uniform(-1, 1, (12, 2)).astype(np.float32),
        rewards=np.zeros(12, np.float32),
        masks=np.ones(12, np.float32),
        ends=np.isin(np.arange(12), [4, 11]),
        source="by hand",
        qpos=rng.normal(size=(12, 4)).astype(np.float32),
        qvel=rng.normal(size=(12, 4)).astype(np.float32),
        extra=rng.integers(0, 2, (12, 2)).astype(np.int32),
        quality=rng.integers(-1, 3, 12).astype(np.int8),
    )
    export_minari(before, tmp_path / "by-hand-v0", "a task by hand")
    after = formats.load(tmp_path / "by-hand-v0")
    for name in ("qpos", "qvel", "extra", "quality"):
        found, expected = getattr(after, name), getattr(before, name)
        np.testing.assert_array_equal(found, expected, err_msg=name)
        assert found.dtype == expected.dtype


@pytest.mark.parametrize("kind", ["groups", "floats", "whole numbers"])
def test_infos_of_other_makers_may_have_our_names(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("minari")
    out = tmp_path / "antmaze-medium-v0"
    assert main(["data", "export", str(SOURCE), "--env", "antmaze-medium", "--out", str(out)]) == 0
    with h5py.File(out / "data" / "main_data.hdf5", "a") as file:
        for episode in file.values():
            steps = len(episode["actions"])
            for name in ("infos/extra", "infos/quality"):
                if kind == "groups":
                    episode[f"{name}/step"] = np.arange(steps)
                else:
                    episode[name] = np.full((steps, 2), 0.5 if kind == "floats" else 1)
    found = formats.read(out, envs.make("antmaze-medium", physics="mujoco"))
    assert found.size == formats.load(SOURCE).size and found.extra is None and found.quality is None


@pytest.mark.parametrize("name", ["antmaze", "taken-v0"])
def test_a_folder_of_another_name_or_content_is_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken-v0").mkdir()
    assert main(["data", "export", str(SOURCE), "--env", "antmaze-medium", "--out", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert (len(error.splitlines()) == 1 and "antmaze-medium-v0" in error) or "no Minari set" in error
    assert [path.name for path in tmp_path.iterdir()] == ["taken-v0"] and not any((tmp_path / "taken-v0").iterdir())
