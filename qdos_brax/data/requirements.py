"""What a configuration's training needs of the data; ``data check`` and every training ask here, so that they agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from envs.task import Task
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.data.dataset import Dataset, longest_episode
from qdos_brax.data.readers.rows import Rows
from qdos_brax.data.segments import segment_starts
from qdos_brax.errors import UserError

_BLOCK = 1 << 14  # segments compared at once
_SAME = 1e-30  # observations that differ by less are equal on a device, which flushes smaller numbers to 0


def unmet(data: Rows | Dataset, env: Task, config: Config) -> list[str]:
    """Return one line for each need of ``config`` that ``data`` does not meet, with the setting that helps.

    Args:
        data: transitions of the task, of its sizes and finite.
        env: the task.
        config: the configuration to train with.
    """
    return [
        *unmet_by_task(env, config),
        *_segments(data, config),
        *_states(data, env, config),
        *_things(data, env, config),
        *_observations(data, config),
    ]


def unmet_by_task(env: Task, config: Config) -> list[str]:
    """Return a line if the task itself lacks what ``config`` needs, so that no data of it would do."""
    lacks = []
    if config.observation.view == "body" and env.body_frame is None:
        lacks.append(f"observation.view=body: {env.spec.family} offers no frame of a body: use observation.view=task")
    if config.exchange.share > 0 and not env.things:
        lacks.append(f"exchange.share: {env.spec.family} has no things that rest until they are touched: leave it at 0")
    return lacks


def remarks(data: Rows | Dataset, config: Config) -> list[str]:
    """Return one line for each thing that training says of ``data`` and does without."""
    return [*data.notes, *([data.mismatch] if data.mismatch and config.skills.horizon == 1 else [])]


def refuse(source: str, lines: Sequence[str]) -> None:
    """Raise UserError with the first of ``lines``, if there are any; ``source`` is where the data came from."""
    if lines:
        more = f" (and {len(lines) - 1} more, see: data check)" if len(lines) > 1 else ""
        raise UserError(f"{source}: {lines[0]}{more}")


def _segments(data: Rows | Dataset, config: Config) -> list[str]:
    """Return a line if no segment lies within one episode."""
    horizon = config.skills.horizon
    longest = longest_episode(data.ends)
    if data.mismatch and horizon > 1:
        return [data.mismatch]
    if longest >= horizon:
        return []
    order = ""
    if len(data.ends) > 1 and data.ends.mean() > 0.5 and data.observations.shape == data.next_observations.shape:
        apart = (data.next_observations[:-1] != data.observations[1:]).reshape(len(data.ends) - 1, -1).any(axis=1)
        order = f"; next_observations are not the next row's observations in {apart.sum()} of {len(data.ends)} rows"
    return [
        f"no episode has {horizon} steps, the length of a segment (longest {longest}){order}: use --set "
        "skills.horizon=N with a smaller N"
    ]


def _states(data: Rows | Dataset, env: Task, config: Config) -> list[str]:
    """Return a line if rollouts in the simulator have no states to start from."""
    skills = config.skills
    if not (METHODS[config.method].information and skills.has_information and skills.mi_rollout == "physics"):
        return []
    missing = _missing_states(data, env)
    if not missing:
        return []
    use = "--alpha 0" if skills.mi_encoder == "outcome" else "--set skills.mi_rollout=logged"
    return [f"no {missing}, the simulator states from which {config.method} rolls out its skills: use {use}"]


def _things(data: Rows | Dataset, env: Task, config: Config) -> list[str]:
    """Return a line if it is not known how the things stand that are exchanged between episodes."""
    missing = _missing_states(data, env) if config.exchange.share > 0 and env.things else ""
    if not missing:
        return []
    return [f"no {missing}, the simulator states in which things are exchanged: use --set exchange.share=0"]


def _missing_states(data: Rows | Dataset, env: Task) -> str:
    needed = {"qpos": data.qpos, "qvel": data.qvel} | ({"infos/extra": data.extra} if env.extra_size else {})
    return " and ".join(name for name, array in needed.items() if array is None)


def _observations(data: Rows | Dataset, config: Config) -> list[str]:
    """Return a line if the graph of states cannot tell one state from another."""
    if not METHODS[config.method].weighted or config.values.estimator != "graph" or not _constant(data, config):
        return []
    return [
        "observations are the same in every row, so that values.estimator=graph cannot tell states apart: use "
        "--set values.estimator=iql, or a file whose observations change"
    ]


def _constant(data: Rows | Dataset, config: Config) -> bool:
    """Return whether all segments begin and end with the same observation."""
    if data.observations.shape != data.next_observations.shape:  # another fault, which the checks name
        return False
    starts, last = segment_starts(data.ends, config.skills.horizon), config.skills.horizon - 1
    for begin in range(0, len(starts), _BLOCK):
        some = starts[begin : begin + _BLOCK]
        for part in (data.observations[some], data.next_observations[some + last]):
            if (np.abs(part - data.observations[starts[0]]) > _SAME).any():
                return False
    return len(starts) > 0
