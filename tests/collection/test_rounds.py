"""Rounds of episodes that run at once: in their order whatever ends first, and none outlives another's failure."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import envs
from qdos_brax.collection import recipes
from qdos_brax.collection.collect import collect
from qdos_brax.collection.makers import maker_of
from qdos_brax.errors import UserError
from tests.collection.stand_ins import collector

LENGTH = 200


class Rounds:
    """Make rows that say which round they are of, after ``play`` has had its say."""

    version, expert_id, chunk_steps, at_once = 1, "nobody", 1, 2

    def __init__(self, play: Callable[[int, Callable[[int], None]], None]) -> None:
        real = collector("antmaze-medium", "mixed")
        self.env, self.recipe, self._play = real.env, replace(real.recipe, episode_steps=LENGTH), play
        self.begun: list[int] = []

    def episodes(
        self, kinds: np.ndarray, length: int, seed: int, turn: int, progress: Callable[[int], None] | None = None
    ) -> dict[str, np.ndarray]:
        assert progress is not None
        self.begun.append(turn)
        self._play(turn, progress)
        rows = len(kinds) * length
        return {
            "observations": np.full((rows, 1), turn),
            "timeouts": np.zeros(rows, bool),
            "infos/qpos": np.zeros((rows, self.env.engine.nq), np.float32),
            "infos/qvel": np.zeros((rows, self.env.engine.nv), np.float32),
        }


def run(rounds: Rounds, count: int, seen: list[tuple[int, int]]) -> dict[str, np.ndarray]:
    return collect(rounds, count * LENGTH, seed=0, num_envs=1, progress=lambda *at: seen.append(at))


def test_two_rounds_run_at_once_and_stay_in_order() -> None:
    second = threading.Event()

    def play(turn: int, progress: Callable[[int], None]) -> None:
        if turn == 0:
            progress(50)
            assert second.wait(30), "the second round did not run beside the first"
        progress(LENGTH)
        if turn == 1:
            second.set()

    seen: list[tuple[int, int]] = []
    rows = run(Rounds(play), 3, seen)
    np.testing.assert_array_equal(rows["observations"][:, 0], np.repeat([0, 1, 2], LENGTH))
    done = [rows for rows, _ in seen]
    assert len(seen) == 4 and done == sorted(done) and seen[-1] == (3 * LENGTH, 3 * LENGTH)
    assert 50 in np.diff([0, *done])


def test_a_failure_ends_the_rounds_beside_it() -> None:
    stopped: list[int] = []

    def play(turn: int, progress: Callable[[int], None]) -> None:
        if turn == 1:
            raise UserError("it broke")
        for step in range(3_000):  # half a minute at most
            try:
                progress(step % LENGTH)
            except InterruptedError:
                stopped.append(turn)
                raise
            threading.Event().wait(0.01)

    rounds = Rounds(play)
    with pytest.raises(UserError, match="it broke"):
        run(rounds, 9, [])
    assert 0 in stopped and len(rounds.begun) <= 3


def test_rounds_at_once_give_the_rows_of_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """OGBench's oracles draw from NumPy's one generator."""
    pytest.importorskip("ogbench")
    env: Any = envs.make("scene", physics="mujoco")
    maker = maker_of(env)
    found = []
    for at_once in (2, 1):
        made = maker.collector(recipes.degraded(0.5, maker, noise=0.1))
        assert made.at_once == 2
        monkeypatch.setattr(type(made), "at_once", at_once)
        found.append(collect(made, 16 * 200, seed=1, num_envs=4))
        monkeypatch.undo()
    assert set(found[0]) == set(found[1])
    for name, array in found[0].items():
        np.testing.assert_array_equal(array, found[1][name], err_msg=name)
