"""A finished run: its agent, and how well it plays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax.errors import FlaxError

from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.config.task import make_task
from qdos_brax.data.device import Normaliser
from qdos_brax.errors import UserError
from qdos_brax.high_level.agent import Agent, Policy
from qdos_brax.high_level.evaluation import evaluate, summary
from qdos_brax.methods.actor_critics import make_actor_critic
from qdos_brax.methods.build import make_policy
from qdos_brax.methods.learners_view import learners_env
from qdos_brax.methods.low_level_kinds import make_low_level
from qdos_brax.offline.flat_policy import FlatPolicy
from qdos_brax.population.members import Population
from qdos_brax.runs.checkpoint import final_artifacts
from qdos_brax.runs.export import read_export
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_command
from qdos_brax.runs.metrics import PART_DONE


class TrainedRun(NamedTuple):
    """Hold what a finished run has learned.

    Attributes:
        config: the run's configuration.
        env: its task, as its learners see it.
        artifacts: parameters with a leading member axis.
        hyper: what a scan may vary, by dotted key, with a leading member axis.
        agent: (artifacts, hyper) of one member -> what plays.
    """

    config: Config
    env: Any
    artifacts: Any
    hyper: dict[str, jax.Array]
    agent: Callable[[Any, Any], Policy]


def load_run(run: Path) -> TrainedRun:
    """Read the agents of a finished run from its folder, or from the file that it was exported to.

    Args:
        run: the run folder or the file.

    Raises:
        UserError: it is neither, the run has not finished, the file cannot be trusted, or this machine does not have
            the task or its engine.
    """
    if run.is_file():
        return _exported_run(run)
    folder = RunFolder.open(str(run))
    config = configs.from_yaml(folder.config)
    if folder.read_summary() is None:
        raise UserError(f"the run in {run} has not finished; continue it with: {resume_command(run)}")
    env = _task_of(run, config)
    return trained_run(config, env, final_artifacts(folder.checkpoints, configs.config_hash(config)))


def _task_of(run: Path, config: Config) -> Any:
    try:
        return make_task(config.env, config.physics)
    except UserError as error:  # one of several runs, perhaps, that were made elsewhere
        raise UserError(f"{run}: {error}") from error


def _exported_run(path: Path) -> TrainedRun:
    config, found = read_export(path)
    env = _task_of(path, config)
    trained = trained_run(config, env, found.arrays)
    try:
        jax.eval_shape(lambda: _decide(trained))
    except (FlaxError, LookupError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its arrays do not fit its configuration") from error
    return trained


def _decide(trained: TrainedRun) -> jax.Array:
    """Return the first member's action at a blank observation."""
    artifacts, hyper = jax.tree.map(lambda leaf: leaf[0], (trained.artifacts, trained.hyper))
    agent, observation = trained.agent(artifacts, hyper), jnp.zeros(trained.env.observation_size)
    return agent.play(observation, agent.choose(observation), 0)


def trained_run(config: Config, env: Any, artifacts: Any) -> TrainedRun:
    """Return the agents of a run.

    Args:
        config: the run's configuration.
        env: its task.
        artifacts: what its phases learned, with a leading member axis; copied to one device from however many.
    """
    env = learners_env(config, env)
    return TrainedRun(
        config,
        env,
        jax.device_put(artifacts, jax.local_devices()[0]),
        {key: jnp.asarray(value) for key, value in configs.population_hyper(config).items()},
        _policy(config, env),
    )


def _policy(config: Config, env: Any) -> Callable[[Any, Any], Policy]:
    """(artifacts, hyper) of one member -> what plays."""
    low_level, policy = make_low_level(config, env), METHODS[config.method].policy
    if policy is not None:
        act = make_policy(config, env, policy).act
        return lambda artifacts, hyper: FlatPolicy(Normaliser(**artifacts["normaliser"]), act, artifacts["policy"])
    high_level = make_actor_critic(config, env)
    return lambda artifacts, hyper: Agent(
        normaliser=Normaliser(**artifacts["normaliser"]),
        low_level=low_level,
        high_level=high_level,
        box=hyper["skills.latent_box"],
        skills=artifacts.get("skills", {}),
        actor=artifacts["actor"],
    )


def evaluation_key() -> jax.Array:
    """Return the key for starts that no training or evaluation of a run has seen, the same for every member."""
    return jax.random.key(2**32 - 1)


def evaluate_run(run: Path, episodes: int) -> list[dict[str, float]]:
    """Play whole episodes with the agents of a finished run.

    Args:
        run: the run folder, or the file that it was exported to.
        episodes: episodes per member.

    Returns:
        One dict per member: seed, alpha, and whatever else varies, success (0..1), return, length, episodes, and
        score (0..1) where a task has one, and for each part of a task the share of episodes at whose end it is done.

    Raises:
        UserError: it is no run folder, or the run has not finished.
    """
    trained = load_run(run)
    members = configs.members(trained.config)

    def play(artifacts: Any, hyper: Any, key: jax.Array) -> Any:
        agent = trained.agent(artifacts, hyper)
        return evaluate(trained.env, agent.choose, agent.play, key, episodes, trained.config.skills.horizon)

    program = Population(trained.hyper, trained.config.members_per_program).program(play)
    result = program(trained.artifacts, trained.hyper, evaluation_key())
    columns, names = summary(result), ("success", "return", "length", "score")
    means = {name: columns[f"eval/{name}"] for name in names if f"eval/{name}" in columns}
    means |= {f"{part} done": columns[f"{PART_DONE}{part}"] for part in result.parts or {}}
    return [
        {**member, **{name: float(value[index]) for name, value in means.items()}, "episodes": episodes}
        for index, member in enumerate(members)
    ]
