"""Films of episodes that a finished run's agents play."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.render import NoOpenGL, Renderer, steps_per_second
from qdos_brax.analysis.finished import TrainedRun, evaluation_key, load_run
from qdos_brax.config.task import make_task
from qdos_brax.errors import UserError
from qdos_brax.methods.learners_view import learners_env
from qdos_brax.report.video import mp4

_STEPS = 50  # of an episode that are played by one call, at least one decision's


def film_run(run: Path, out: Path, height: int = 480) -> dict[str, float]:
    """Film the first episode of the first member of a finished run, in real time.

    It starts as the first episode of ``evaluate_run`` does. The two may differ later: a program for one environment
    rounds differently from one for many.

    Args:
        run: the run folder.
        out: the film, ending in .mp4.
        height: height of its frames in pixels; the width follows from the maze.

    Returns:
        The episode's success (0 or 1), return and length, and of a task with parts the share that was done at its end.

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
        for moment in EpisodeRunner(trained).episode(0):
            write(renderer.frame(moment.qpos, moment.goal, moment.extra))
            length += 1
            episode_return += float(moment.reward) if length else 0.0
    score = {} if moment.score is None else {"score": float(moment.score)}
    return {"success": float(moment.success), "return": episode_return, "length": length, **score}


class Moment(NamedTuple):
    """Hold what is seen of a state of an episode.

    Attributes:
        qpos, qvel, extra: the simulator's state.
        goal: of the task.
        reward, success: of the step that led to it.
        score: the share of the task that is done; None of a task without parts.
        decision: what was decided before that step; None for the start.
    """

    qpos: Any
    qvel: Any
    extra: Any
    goal: Any
    reward: Any
    success: Any
    score: Any
    decision: Any


class EpisodeRunner:
    """Run the episodes that evaluation begins with, compiled once for all members of a run.

    Args:
        trained: the run.
    """

    def __init__(self, trained: TrainedRun) -> None:
        self._trained = trained
        self._reset = jax.jit(trained.env.reset)
        self._play = jax.jit(self._play_on)

    def episode(self, member: int) -> Iterator[Moment]:
        """Yield the start of a member's first episode and what followed, arrays of NumPy."""
        learned = of_member(self._trained, member)
        state = self._reset(jax.random.split(evaluation_key(), 1)[0])
        yield jax.device_get(_seen(state, None))
        while not state.done:
            state, live, moments = self._play(*learned, state)
            moments = jax.device_get(moments)
            for index in range(np.count_nonzero(live)):
                yield jax.tree.map(lambda leaf, index=index: leaf[index], moments)

    def _play_on(self, artifacts: Any, hyper: Any, state: Any) -> tuple[Any, jax.Array, Moment]:
        """Play some decisions by one program, for a call per step is slow: (state after, bool[T], moments[T]).

        The episode goes on in the steps that are true; beyond its end nothing happens.
        """
        env, agent = self._trained.env, self._trained.agent(artifacts, hyper)
        horizon = self._trained.config.skills.horizon

        def decide(state: Any, _: None) -> tuple[Any, tuple[jax.Array, Moment]]:
            decision = agent.choose(state.obs)

            def step(state: Any, index: jax.Array) -> tuple[Any, tuple[jax.Array, Moment]]:
                live = state.done < 0.5
                action = agent.play(state.obs, decision, index)
                after = jax.lax.cond(live, lambda: env.step(state, action), lambda: state)
                return after, (live, _seen(after, decision))

            return jax.lax.scan(step, state, jnp.arange(horizon))

        state, played = jax.lax.scan(decide, state, None, length=max(1, _STEPS // horizon))
        return state, *jax.tree.map(lambda leaf: jax.lax.collapse(leaf, 0, 2), played)


def _seen(state: Any, decision: jax.Array | None) -> Moment:
    physics = state.pipeline_state
    return Moment(
        qpos=physics.qpos,
        qvel=physics.qvel,
        extra=physics.extra,
        goal=state.info["goal"],
        reward=state.reward,
        success=state.metrics["success"],
        score=state.metrics.get("score"),
        decision=decision,
    )


def on_mujoco_c(trained: TrainedRun) -> TrainedRun:
    """Return the run with its task on MuJoCo C: a few episodes are not worth MJX's compilation."""
    return trained._replace(env=learners_env(trained.config, make_task(trained.config.env, "mujoco")))


def of_member(trained: TrainedRun, member: int) -> tuple[Any, Any]:
    """Return (artifacts, hyper) of one member, as ``trained.agent`` takes them."""
    return _of_index((trained.artifacts, trained.hyper), member)


@jax.jit
def _of_index(trees: tuple[Any, Any], index: int) -> tuple[Any, Any]:
    """Return the entries at an index of the first axis, by one program."""
    artifacts, hyper = jax.tree.map(lambda leaf: leaf[index], trees)
    return artifacts, hyper
