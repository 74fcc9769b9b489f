"""Films of episodes that a finished run's agents play."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

import envs
from envs.render import NoOpenGL, Renderer, steps_per_second
from qdos_brax.analysis.finished import TrainedRun, evaluation_key, load_run
from qdos_brax.errors import UserError
from qdos_brax.report.video import mp4


def film_run(run: Path, out: Path, height: int = 480) -> dict[str, float]:
    """Film the first episode of the first member of a finished run, in real time.

    It starts as the first episode of ``evaluate_run`` does. The two may differ later: a program for one environment
    rounds differently from one for many.

    Args:
        run: the run folder.
        out: the film, ending in .mp4.
        height: height of its frames in pixels; the width follows from the maze.

    Returns:
        The episode's success (0 or 1), return and length.

    Raises:
        UserError: the run has not finished, this machine cannot draw or film, or the film cannot be written.
    """
    trained = load_run(run)
    env, episode_return, length = trained.env, 0.0, -1
    try:
        renderer = Renderer(env, height)
    except NoOpenGL as error:
        raise UserError(str(error)) from error
    with renderer, mp4(out, renderer.height, renderer.width, steps_per_second(env)) as write:
        for state, _ in EpisodeRunner(trained).episode(0):
            write(renderer.frame(state.pipeline_state.qpos, state.info["goal"]))
            length += 1
            episode_return += float(state.reward) if length else 0.0
    return {"success": float(state.metrics["success"]), "return": episode_return, "length": length}


class EpisodeRunner:
    """Run the episodes that evaluation begins with, compiled once for all members of a run.

    Args:
        trained: the run.
    """

    def __init__(self, trained: TrainedRun) -> None:
        self._trained = trained
        self._reset = jax.jit(trained.env.reset)
        self._choose = jax.jit(lambda artifacts, hyper, obs: trained.agent(artifacts, hyper).choose(obs))
        self._step = jax.jit(self._step_once)

    def episode(self, member: int) -> Iterator[tuple[Any, jax.Array | None]]:
        """Yield the states of a member's first episode, each with the decision that led to it (None for the start)."""
        learned = of_member(self._trained, member)
        state = self._reset(jax.random.split(evaluation_key(), 1)[0])
        yield state, None
        length = 0
        while not state.done:
            if length % self._trained.config.skills.horizon == 0:
                decision = self._choose(*learned, state.obs)
            state = self._step(*learned, state, decision, length % self._trained.config.skills.horizon)
            length += 1
            yield state, decision

    def _step_once(self, artifacts: Any, hyper: Any, state: Any, decision: jax.Array, step: jax.Array) -> Any:
        action = self._trained.agent(artifacts, hyper).play(state.obs, decision, step)
        return self._trained.env.step(state, action)


def on_mujoco_c(trained: TrainedRun) -> TrainedRun:
    """Return the run with its task on MuJoCo C: a few episodes are not worth MJX's compilation."""
    return trained._replace(env=envs.make(trained.config.env, physics="mujoco"))


def of_member(trained: TrainedRun, member: int) -> tuple[Any, Any]:
    """Return (artifacts, hyper) of one member, as ``trained.agent`` takes them."""
    return _of_index((trained.artifacts, trained.hyper), member)


@jax.jit
def _of_index(trees: tuple[Any, Any], index: int) -> tuple[Any, Any]:
    """Return the entries at an index of the first axis, by one program."""
    artifacts, hyper = jax.tree.map(lambda leaf: leaf[index], trees)
    return artifacts, hyper
