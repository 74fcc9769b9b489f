"""A film of what a run has learned."""

from __future__ import annotations

from pathlib import Path

import jax

from envs.render import NoOpenGL, Renderer, steps_per_second
from qdos_brax.errors import UserError
from qdos_brax.methods.build import evaluation_key, load_run
from qdos_brax.report.video import mp4


def film_run(run: Path, out: Path, height: int = 480) -> dict[str, float]:
    """Films the first episode of the first member of a finished run, in real time.

    It starts where the first episode of ``evaluate_run`` starts. The two may part later: a program for one environment
    rounds differently from one for many.

    Args:
        run: the run folder.
        out: the film, ending in .mp4.
        height: of its frames, in pixels; the width follows from the maze.

    Returns:
        The episode's success (0 or 1), return and length.

    Raises:
        UserError: the run has not ended, this machine cannot draw or film, or the film cannot be written.
    """
    trained = load_run(run)
    env, horizon = trained.env, trained.config.skills.horizon
    agent = trained.agent(*jax.tree.map(lambda x: x[0], (trained.artifacts, trained.hyper)))
    choose = jax.jit(agent.choose)
    step = jax.jit(lambda state, latent: env.step(state, agent.play(state.obs, latent)))
    state = jax.jit(env.reset)(jax.random.split(evaluation_key(), 1)[0])
    episode_return, length = 0.0, 0
    try:
        renderer = Renderer(env, height)
    except NoOpenGL as error:
        raise UserError(str(error)) from error
    with renderer, mp4(out, renderer.height, renderer.width, steps_per_second(env)) as write:
        write(renderer.frame(state.pipeline_state.qpos, state.info["goal_xy"]))
        while not state.done:
            if length % horizon == 0:
                latent = choose(state.obs)
            state = step(state, latent)
            write(renderer.frame(state.pipeline_state.qpos, state.info["goal_xy"]))
            episode_return += float(state.reward)
            length += 1
    return {"success": float(state.metrics["success"]), "return": episode_return, "length": length}
