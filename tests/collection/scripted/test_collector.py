"""Scripted data: rows are what the task makes of their actions, one seed repeats, files and commands as for mazes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import envs
from envs.manipulation.kitchen_rig import START_QPOS
from qdos_brax.collection import default_set, recipes, scripted
from qdos_brax.collection.collect import collect
from qdos_brax.collection.makers import maker_of
from qdos_brax.collection.scripted.collector import ScriptedCollector
from qdos_brax.collection.scripted.demonstrator import SimStates
from qdos_brax.commands.main import main
from qdos_brax.data import formats
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError
from tests import reacher
from tests.collection.scripted.reaching import TURN, ReacherDemonstrator
from tests.envs.kitchen_reference import kitchen

LENGTH, ENVS, ROWS = 40, 5, 390  # two rounds of five episodes, the last of which is cut
NAME = "tests.collection.scripted.reaching:ReacherDemonstrator"


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    with reacher.registered():
        scripted.register_demonstrator("reacher", NAME)
        yield
        del scripted.DEMONSTRATORS["reacher"]


def collector(task: str = "reacher") -> ScriptedCollector:
    env = envs.make(task)
    maker = maker_of(env)
    made = maker.collector(recipes.degraded(0.5, maker, noise=0.1))
    assert isinstance(made, ScriptedCollector)
    return made


@pytest.fixture(scope="module")
def reaching() -> ScriptedCollector:
    return collector()


@pytest.fixture(scope="module")
def rows(reaching: ScriptedCollector) -> dict[str, np.ndarray]:
    seen: list[tuple[int, int]] = []
    rows = collect(reaching, ROWS, seed=0, num_envs=ENVS, progress=lambda *at: seen.append(at))
    assert seen == [(ENVS * LENGTH, ROWS), (ROWS, ROWS)]
    return rows


def episodes(array: np.ndarray) -> np.ndarray:
    """Rows by whole episode, [9, 40, ..]."""
    whole = ROWS // LENGTH
    return array[: whole * LENGTH].reshape(whole, LENGTH, *array.shape[1:])


def test_rows_replay_bit_for_bit_through_the_task(reaching: ScriptedCollector, rows: dict[str, np.ndarray]) -> None:
    def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
        after, physics = env.step(state, action), state.pipeline_state
        return after, (state.obs, after.obs, physics.qpos, physics.qvel, physics.extra, after.reward)

    env = reaching.env
    names = ("observations", "next_observations", "infos/qpos", "infos/qvel", "infos/extra", "rewards")
    starts = [episodes(rows[name])[:, 0] for name in ("infos/qpos", "infos/qvel", "infos/extra")]
    first = jax.vmap(lambda qpos, qvel, extra: env.reset_to(qpos, qvel, extra=extra))(*starts)
    actions = np.swapaxes(episodes(rows["actions"]), 0, 1)
    _, replayed = jax.jit(lambda state, actions: jax.lax.scan(jax.vmap(step), state, actions))(first, actions)
    for name, array in zip(names, replayed, strict=True):
        np.testing.assert_array_equal(episodes(rows[name]), np.swapaxes(array, 0, 1), err_msg=name)


def test_rows_are_as_those_of_mazes(reaching: ScriptedCollector, rows: dict[str, np.ndarray]) -> None:
    assert {name: (array.dtype.name, array.shape[1:]) for name, array in rows.items()} == {
        "observations": ("float32", (7,)),
        "actions": ("float32", (2,)),
        "next_observations": ("float32", (7,)),
        "timeouts": ("bool", ()),
        "rewards": ("float32", ()),
        "terminals": ("bool", ()),
        "infos/qpos": ("float32", (2,)),
        "infos/qvel": ("float32", (2,)),
        "infos/extra": ("int32", (1,)),
        "infos/quality": ("int8", ()),
    }
    assert {len(array) for array in rows.values()} == {ROWS}
    assert np.flatnonzero(rows["timeouts"]).tolist() == [*range(LENGTH - 1, ROWS, LENGTH), ROWS - 1]
    assert not rows["terminals"].any() and np.abs(rows["actions"]).max() <= 1
    # The tip by the row's own angles, the switch by the row's own state: -1 for each that is not there.
    away = np.linalg.norm(reacher.tip(rows["infos/qpos"]) - reacher.GOALS[0], axis=1) > reacher.TOLERANCE
    np.testing.assert_array_equal(rows["rewards"], -1.0 * away - (rows["infos/extra"][:, 0] == 0))
    np.testing.assert_array_equal(rows["observations"][:, 6], rows["infos/extra"][:, 0])


def test_the_mix_is_the_recipe_s_and_quality_the_step_s_own(rows: dict[str, np.ndarray]) -> None:
    quality = episodes(rows["infos/quality"])
    kinds = recipes.episode_kinds(recipes.degraded(0.5, ReacherDemonstrator).mix, 10, seed=0)[:9]
    np.testing.assert_array_equal(quality[:, -1], kinds)
    turned = quality != quality[:, -1:]
    np.testing.assert_array_equal(turned, (kinds == QUALITY["fail"])[:, None] & (np.arange(LENGTH) < TURN))
    assert (quality[turned] == QUALITY["navigate"]).all() and turned.any()
    success = episodes(rows["rewards"]) == 0
    assert success[kinds == QUALITY["navigate"]].any(axis=1).all()  # and none of these episodes ended by it
    assert not success[kinds == QUALITY["wander"]].all(axis=1).any()


def test_one_seed_repeats_and_two_differ(reaching: ScriptedCollector, rows: dict[str, np.ndarray]) -> None:
    for again in (collect(reaching, ROWS, 0, ENVS), collect(collector(), ROWS, 0, ENVS)):
        assert list(again) == list(rows)
        for name, array in rows.items():
            np.testing.assert_array_equal(again[name], array, err_msg=name)
    starts = episodes(rows["infos/qpos"])[:, 0]
    assert len(np.unique(starts, axis=0)) == 9  # the second round starts elsewhere than the first
    other = collect(reaching, ROWS, 1, ENVS)
    assert not np.isin(episodes(other["infos/qpos"])[:, 0, 0], starts[:, 0]).any()


class Resting:
    """Start where the kitchen does, and rest."""

    version, heavy_noise = 1, 0.0

    def __init__(self, env: envs.Task, n: int, noise: float) -> None:
        self.n = n

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        return SimStates(np.tile(START_QPOS, (self.n, 1)), np.zeros((self.n, 29)), *np.zeros((2, self.n, 7)))

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((self.n, 9), np.float32), np.zeros(self.n, np.int8)


def test_the_sensors_errors_come_from_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scripted.DEMONSTRATORS, "kitchen", Resting)
    resting = ScriptedCollector(kitchen("kitchen-mixed"), recipes.degraded(0.0, Resting))
    kinds = np.zeros(2, np.int8)
    rows, again, other, later = (resting.episodes(kinds, 6, *at) for at in ((0, 0), (0, 0), (1, 0), (0, 1)))
    seen = rows["observations"]
    np.testing.assert_array_equal(seen, again["observations"])
    for another in (other["observations"], later["observations"]):
        assert (seen[:, :18] != another[:, :18]).all()
    assert len(np.unique(seen[:, 0])) == 12  # drawn anew at every step, in every simulation
    np.testing.assert_array_equal(rows["next_observations"][~rows["timeouts"]], seen[1:][~rows["timeouts"][:-1]])
    assert 0 < np.abs(seen[:, :9] - rows["infos/qpos"][:, :9]).max() < 2e-3


@pytest.mark.parametrize("wrong", [{"transitions": 10}, {"num_envs": 0}, {"seed": -1}])
def test_arguments_out_of_range_are_refused(reaching: ScriptedCollector, wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError):
        collect(reaching, **({"transitions": 200, "seed": 0, "num_envs": 2} | wrong))


def test_who_plays_what() -> None:
    spec = envs.get_spec("reacher")
    assert scripted.demonstrator_class(spec) is ReacherDemonstrator
    made = scripted.make(envs.make("reacher-task2"), 3, 0.5)
    assert isinstance(made, ReacherDemonstrator) and (made.n, made.noise) == (3, 0.5)
    with pytest.raises(ValueError, match="already a demonstrator of 'reacher'"):
        scripted.register_demonstrator("reacher", ReacherDemonstrator)
    elsewhere: Any = SimpleNamespace(spec=spec, engine=object(), backend="mjx")
    with pytest.raises(UserError, match="demonstrated on MuJoCo C, not on mjx; use --physics mujoco"):
        ScriptedCollector(elsewhere, recipes.degraded(0.5, ReacherDemonstrator))


@pytest.mark.parametrize(
    ("start", "action", "message"),
    [
        (0.0, 1.01, "acts outside"),
        (0.0, np.nan, "acts outside"),
        (np.nan, 1.0, "simulation of reacher broke .* another --seed"),
    ],
)
def test_what_is_no_demonstration_is_no_data(
    start: float, action: float, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Broken(ReacherDemonstrator):
        def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
            return super().begin(kinds, rng)._replace(qpos=np.full((self.n, 2), start))

        def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
            return np.full((self.n, 2), action, np.float32), np.zeros(self.n, np.int8)

    monkeypatch.setitem(scripted.DEMONSTRATORS, "reacher", Broken)
    with pytest.raises(ValueError if start == 0 else UserError, match=message):
        default_set.make_file(tmp_path / "set.hdf5", collector(), 200, 0, 2)
    assert not list(tmp_path.iterdir())


def test_the_default_set_is_collected_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("QDOS_DATA", str(tmp_path))
    env = envs.make("reacher")
    path = default_set.default_dataset(env, 200, degraded_share=0.5, noise=0.1, seed=0, num_envs=2)
    assert path.name == "reacher-n200-bad0.5-noise0.1-seed0-envs2-mujoco-v1-ReacherDemonstrator-3.hdf5"
    assert "no data for reacher yet" in capsys.readouterr().out
    made = path.stat().st_mtime_ns
    assert default_set.default_dataset(env, 200, 0.5, 0.1, 0, 2) == path and path.stat().st_mtime_ns == made
    dataset = formats.read(path, env)
    assert dataset.size == 200 and dataset.extra is not None and dataset.quality is not None
    attributes = formats.read_attrs(path)
    assert attributes["expert"] == "ReacherDemonstrator-3" and attributes["recipe"] == "mixed"
    assert (attributes["noise"], attributes["heavy_noise"], attributes["version"]) == (0.1, 0.8, 1)


def test_commands_make_info_and_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "set.hdf5")
    sizes = ["--transitions", "400", "--num-envs", "5"]

    def run(*words: str) -> tuple[int, str]:
        code = main(["data", *words])
        output = capsys.readouterr()
        return code, output.out + output.err

    assert run("make", "reacher", "--out", path, *sizes, "--mix", "expert=0.5,noisy=0.5", "--noise", "0.1")[0] == 0
    code, text = run("info", path)
    assert code == 0 and "navigate=0.500 noisy=0.500" in text and "10 of 40 to 40 steps" in text
    code, text = run("check", path, "--env", "reacher-task2", "--horizon", "5")
    assert code == 0 and "fits reacher-task2: 400 transitions, 10 episodes" in text
    for words, message in (
        (["--recipe", "stitch"], "--recipe stitch is for mazes; reacher's demonstrations are mixed"),
        (["--mix", "expert=2"], r"the share of expert must lie in [0, 1]"),
        (["--noise", "-1"], "the action noise must be 0 or more"),
        (["--transitions", "10"], "transitions must be at least 200"),
        (["--physics", "mjx"], "does not run on 'mjx'"),
    ):
        code, text = run("make", "reacher", "--out", str(tmp_path / "other.hdf5"), *words)
        assert code == 2 and message in text and len(text.strip().splitlines()) == 1, text
    assert [file.name for file in tmp_path.iterdir()] == ["set.hdf5"]
