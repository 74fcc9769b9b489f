"""Collection on real physics with a stand-in expert: sizes, codes, true next states, one seed repeats, two differ."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax.collection import bodies, collect, default_set, recipes
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.poses import STANDING, humanoid_is_up
from qdos_brax.commands.data import add_parser
from qdos_brax.data import formats
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

ROWS = 650  # three episodes of 200 steps and one that is cut


class StandIn:
    """Acts on everything a walker sees, without knowing how to walk."""

    params = np.ones(3, np.float32)

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return jnp.sin(jnp.concatenate([3 * direction, qvel[:3], qpos[2:3], qpos[7:9]]))


class StandInDribbler(StandIn):
    """The same with a ball: turns the other way."""

    walker = StandIn()

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return -super().act(qpos, qvel, direction)


def expert(env: envs.Task) -> StandIn:
    return StandInDribbler() if env.spec.family == "antsoccer" else StandIn()


DEFAULT = recipes.degraded(0.5, bodies.ANT)


@pytest.fixture(scope="module", params=["antmaze-medium", "antsoccer-arena"])
def env(request: Any) -> envs.Task:
    return envs.make(request.param, physics="mujoco")


@pytest.fixture(scope="module")
def rows(env: envs.Task) -> dict[str, np.ndarray]:
    seen: list[tuple[int, int]] = []
    rows = collect.collect(
        env, ROWS, DEFAULT, seed=0, num_envs=2, progress=lambda *at: seen.append(at), policy=expert(env)
    )
    assert seen[-1] == (ROWS, ROWS) and seen == sorted(seen)
    return rows


def test_rows_fit_the_task(env: envs.Task, rows: dict[str, np.ndarray]) -> None:
    assert {len(value) for value in rows.values()} == {ROWS}
    assert rows["observations"].shape[1] == env.observation_size
    assert np.abs(rows["actions"]).max() <= 1.0
    assert np.flatnonzero(rows["timeouts"]).tolist() == [299, 599, 649]
    assert not rows["terminals"].any()
    success = env.success(rows["infos/qpos"], env.goal_xy)
    np.testing.assert_array_equal(rows["rewards"], success - 1.0)
    for first in (0, 300, 600):
        assert len(np.unique(rows["infos/quality"][first : first + 50])) == 1  # one kind per episode


def test_next_observations_are_what_the_engine_makes_of_the_row(env: envs.Task, rows: dict[str, np.ndarray]) -> None:
    inside = ~rows["timeouts"]
    inside[-1] = False
    shifted = np.roll(rows["observations"], -1, axis=0)
    np.testing.assert_array_equal(rows["next_observations"][inside], shifted[inside])
    np.testing.assert_array_equal(rows["observations"][:, : env.engine.nq], rows["infos/qpos"])
    for end in np.flatnonzero(rows["timeouts"]):
        state = env.engine.init(rows["infos/qpos"][end], rows["infos/qvel"][end])
        after = env.engine.step(state, rows["actions"][end])
        # Only the solver's warm start and the float32 rounding of the start tell the two apart.
        np.testing.assert_allclose(rows["next_observations"][end, : env.engine.nq], after.qpos, atol=2e-2)


# Soccer alone: it does all that a maze does, and a second collection takes time.
@pytest.mark.parametrize("env", ["antsoccer-arena"], indirect=True)
def test_one_seed_repeats_and_two_differ(env: envs.Task, rows: dict[str, np.ndarray]) -> None:
    again = collect.collect(env, ROWS, DEFAULT, seed=0, num_envs=2, policy=expert(env))
    for key, value in rows.items():
        np.testing.assert_array_equal(again[key], value, err_msg=key)
    other = collect.collect(env, ROWS, DEFAULT, seed=1, num_envs=2, policy=expert(env))
    assert not np.array_equal(other["actions"], rows["actions"])
    assert not np.array_equal(other["infos/qpos"][0], rows["infos/qpos"][0])


def test_teleporters_work_while_collecting() -> None:
    env = envs.make("antmaze-teleport", physics="mujoco")
    exits = env.layout.ij_to_xy(np.array(env.layout.teleporters.exits))

    class AtEntrances(collect.Collector):
        """Every lane starts at an entrance, so that the first step goes through it."""

        def _start_xy(self, key: jax.Array) -> jax.Array:
            entrances = self.env.layout.ij_to_xy(np.array(self.env.layout.teleporters.entrances))
            return jax.random.choice(key, jnp.asarray(entrances, jnp.float32))

    kinds = np.full(12, QUALITY["wander"], np.int8)
    rows = AtEntrances(env, StandIn(), DEFAULT).episodes(jax.random.key(0), kinds, collect.CHUNK_STEPS)
    first = np.arange(12) * collect.CHUNK_STEPS
    came_out = rows["infos/qpos"][first + 1, :2]
    assert {tuple(xy) for xy in came_out} == {tuple(xy) for xy in exits}
    # as online: the observation shows the entrance once more, the one after it the exit
    np.testing.assert_array_equal(rows["next_observations"][first], rows["observations"][first + 1])
    assert (np.linalg.norm(rows["observations"][first + 1, :2] - rows["observations"][first, :2], axis=1) < 1).all()
    assert (np.linalg.norm(rows["observations"][first + 2, :2] - came_out, axis=1) < 1).all()


class Limp(StandIn):
    """Lets a humanoid fall, within a second or so."""

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        return jnp.zeros(21)


def test_a_humanoid_that_fell_begins_anew_on_its_feet() -> None:
    env = envs.make("humanoidmaze-medium", physics="mujoco")
    rows = collect.collect(env, 400, recipes.degraded(0.5, bodies.HUMANOID), seed=0, num_envs=2, policy=Limp())
    fell = rows["infos/fell"]
    assert fell.sum() >= 4
    lane_ends = np.isin(np.arange(400), [199, 399])
    np.testing.assert_array_equal(rows["timeouts"], fell | lane_ends)
    assert not rows["terminals"].any()
    assert np.asarray(humanoid_is_up(rows["infos/qpos"])).all()  # what lies is the state behind the last row

    first = np.flatnonzero(fell[:-1]) + 1
    np.testing.assert_allclose(rows["infos/qpos"][first, 2], STANDING)
    inside = ~rows["timeouts"]
    shifted = np.roll(rows["observations"], -1, axis=0)
    np.testing.assert_array_equal(rows["next_observations"][inside], shifted[inside])
    for end in np.flatnonzero(fell)[:3]:
        state = env.engine.init(rows["infos/qpos"][end], rows["infos/qvel"][end])
        after = env.engine.step(state, rows["actions"][end])
        assert not humanoid_is_up(after.qpos)
        np.testing.assert_allclose(rows["next_observations"][end], env.observe(after), atol=2e-2)
        assert np.abs(rows["next_observations"][end] - shifted[end]).max() > 0.1


def test_a_body_without_an_expert_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = envs.make("humanoidmaze", physics="mujoco")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path))
    monkeypatch.delitem(bodies.CONDUCTS, "humanoidmaze")
    refused = pytest.raises(UserError, match=r"no expert .* humanoidmaze.*--dataset FILE.*humanoidmaze-medium-navigate")
    with refused:
        collect.collect(env, 400, DEFAULT, seed=0)
    with refused:
        default_set.default_dataset(env, transitions=400, degraded_share=0.5, noise=0.2, seed=0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_share_of_degraded_episodes_is_as_stated(share: float) -> None:
    kinds = recipes.episode_kinds(recipes.degraded(share, bodies.ANT).mix, 100, seed=0)
    assert (kinds != QUALITY["navigate"]).sum() == round(100 * share)
    counts = [int((kinds == code).sum()) for code in QUALITY.values() if code != QUALITY["navigate"]]
    assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize(
    ("transitions", "num_envs", "length"),
    [(200, 64, 200), (4_000, 16, 250), (64_000, 64, 1000), (1_000_000, 64, 1000)],
)
def test_small_sets_have_shorter_episodes(transitions: int, num_envs: int, length: int) -> None:
    assert collect._episode_length(transitions, num_envs, 1000) == length


@pytest.mark.parametrize("wrong", [{"transitions": 10}, {"num_envs": 0}, {"seed": -1}])
def test_arguments_out_of_range_are_refused(env: envs.Task, wrong: dict[str, Any]) -> None:
    right = {"transitions": 200, "recipe": DEFAULT, "seed": 0, "num_envs": 2, "policy": expert(env)}
    with pytest.raises(UserError):
        collect.collect(env, **(right | wrong))


def test_a_mix_is_exact_to_the_episode_and_comes_from_the_seed() -> None:
    mix = recipes.parse_mix("expert=0.3,noisy=0.3,wander=0.2,fail=0.2")
    kinds = recipes.episode_kinds(mix, 50, seed=3)
    assert np.bincount(kinds).tolist() == [15, 15, 10, 10]
    np.testing.assert_array_equal(kinds, recipes.episode_kinds(mix, 50, seed=3))
    assert not np.array_equal(kinds, recipes.episode_kinds(mix, 50, seed=4))
    # 7 episodes: 2.1, 2.1, 1.4, 1.4; five are bad, of which 2.14, 1.43, 1.43: the first of the largest remainders gains
    assert np.bincount(recipes.episode_kinds(mix, 7, seed=0)).tolist() == [2, 2, 2, 1]
    assert set(recipes.episode_kinds({"wander": 1.0}, 9, seed=0).tolist()) == {QUALITY["wander"]}
    assert recipes.parse_mix(recipes.mix_text(mix)) == mix


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("expert=0.5,noisy=0.4", "sum to 0.9"),
        ("expert=1.5,noisy=-0.5", r"must lie in \[0, 1\]"),
        ("expert=0.5,noisey=0.5", "no behaviour 'noisey'"),
        ("expert=0.5,expert=0.5", "expert is there twice"),
        ("expert", "'expert' is no share"),
        ("expert=nan", "must lie in"),
    ],
)
def test_a_mix_that_makes_no_sense_is_refused(text: str, line: str) -> None:
    with pytest.raises(UserError, match=line):
        recipes.mixed(recipes.parse_mix(text), bodies.ANT)


@pytest.mark.parametrize(
    "make", [lambda: recipes.degraded(1.5, bodies.ANT), lambda: recipes.named("explore", bodies.ANT, noise=-1.0)]
)
def test_a_recipe_out_of_range_is_refused(make: Any) -> None:
    with pytest.raises(UserError):
        make()


def test_stitch_keeps_its_goal_and_explore_its_heading() -> None:
    env = envs.make("antsoccer-arena", physics="mujoco")
    stitch = collect.Collector(env, expert(env), recipes.named("stitch", bodies.ANT))
    lanes = stitch._reset(jax.random.split(jax.random.key(0), 32))
    cargo = np.where(lanes.has_ball[:, None], lanes.pipeline.qpos[:, 15:17], lanes.pipeline.qpos[:, :2])
    steps = np.abs(env.layout.xy_to_ij(cargo) - env.layout.xy_to_ij(np.asarray(lanes.goal_xy))).sum(axis=1)
    assert (steps == 4).all()  # an open field: cells to go are those of rows and columns
    assert 4 < int(lanes.has_ball.sum()) < 28
    kinds = jnp.zeros(32, jnp.int8)
    draw = jax.vmap(stitch._draw)  # the same of every recipe
    plan = jax.jit(jax.vmap(stitch._plan))
    at_goal = lanes.replace(has_ball=jnp.zeros(32, bool), goal_xy=lanes.pipeline.qpos[:, :2])
    draws = draw(jax.random.split(jax.random.key(1), 32))
    after = plan(at_goal, kinds, draws)
    np.testing.assert_array_equal(after.goal_xy, at_goal.goal_xy)
    navigate = collect.Collector(env, expert(env), recipes.named("navigate", bodies.ANT))
    after = jax.jit(jax.vmap(navigate._plan))(at_goal, kinds, draws)
    assert after.arrivals.tolist() == [1] * 32 and not np.array_equal(after.goal_xy, at_goal.goal_xy)

    explore = jax.jit(jax.vmap(collect.Collector(env, expert(env), recipes.named("explore", bodies.ANT))._plan))
    draws = draw(jax.random.split(jax.random.key(2), 32))
    for clock, changes in ((10, True), (11, False), (19, False), (20, True)):
        turned = explore(lanes.replace(clock=jnp.full(32, clock)), kinds + QUALITY["wander"], draws).heading
        assert bool((turned != lanes.heading).any(axis=1).all()) == changes == bool((turned != lanes.heading).any())


def test_the_default_set_is_collected_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    env = envs.make("antmaze-medium", physics="mujoco")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "data"))
    monkeypatch.setitem(bodies.CONDUCTS, "antmaze", replace(bodies.ANT, expert=StandIn))
    parameters: dict[str, Any] = {"transitions": 400, "degraded_share": 0.5, "noise": 0.2, "num_envs": 2}
    path = default_set.default_dataset(env, seed=0, **parameters)
    assert path.parent == tmp_path / "data" and str(path) in capsys.readouterr().out
    made = path.stat().st_mtime_ns
    assert default_set.default_dataset(env, seed=0, **parameters) == path and path.stat().st_mtime_ns == made
    assert default_set.default_dataset(env, seed=1, **parameters) != path
    dataset = formats.read(path, env)
    assert dataset.size == 400 and dataset.quality is not None
    attributes = formats.read_attrs(path)
    assert "wander=" in attributes["composition"] and attributes["recipe"] == "mixed"
    assert recipes.parse_mix(attributes["mix"]).keys() == recipes.BEHAVIOURS.keys()
    assert attributes["expert"] == policies.digest(StandIn())

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QDOS_DATA", str(tmp_path / "file"))
    with pytest.raises(UserError, match="QDOS_DATA"):
        default_set.default_dataset(env, seed=0, **parameters)


def test_commands_make_info_and_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import argparse

    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(required=True))

    def run(*words: str) -> tuple[int, str]:
        args = parser.parse_args(["data", *words])
        return args.run(args), capsys.readouterr().out

    monkeypatch.setitem(bodies.CONDUCTS, "antmaze", replace(bodies.ANT, expert=StandIn))
    path = str(tmp_path / "set.hdf5")
    assert run("make", "antmaze-medium", "--out", path, "--transitions", "400", "--num-envs", "2") == (0, f"{path}\n")
    code, text = run("info", path)
    assert code == 0 and "400" in text and "navigate 50.0%" in text
    assert run("check", path, "--env", "antmaze-medium")[0] == 0
    code, text = run("check", path, "--env", "antsoccer-arena")
    assert code == 2 and "observations has 29 numbers per row, antsoccer-arena has 42" in text
    code, text = run("check", path, "--env", "antmaze-medium", "--horizon", "500")
    assert code == 2 and "no episode has 500 steps" in text
    with pytest.raises(UserError, match="did you mean"):
        run("check", path, "--env", "antmaze-medum")
    with pytest.raises(UserError, match=r"\.hdf5"):
        run("make", "antmaze-medium", "--out", str(tmp_path / "set.npz"))
    with pytest.raises(UserError, match="takes neither"):
        run("make", "antmaze-medium", "--out", path, "--recipe", "stitch", "--mix", "expert=1")
    with pytest.raises(UserError, match="give one of them"):
        run("make", "antmaze-medium", "--out", path, "--degraded-share", "0.1", "--mix", "expert=1")
