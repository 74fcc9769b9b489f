"""Write a data set as a Minari set, with the ``minari`` package itself (extra: minari)."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from qdos_brax.data.dataset import Dataset
from qdos_brax.errors import UserError
from qdos_brax.files import replacing_folder

_NAME = re.compile(r"[\w-]+-v\d+")


def export_minari(dataset: Dataset, out: Path, task: str) -> None:
    """Write ``dataset`` as a Minari set: an episode per group, with one observation more than actions.

    Rewards are the task's, and a step terminates where its mask is 0, even if the episode goes on in the data; the
    last step of every other episode truncates. Simulator states are ``infos/qpos``, ``infos/qvel`` and, where a task
    has a discrete state, ``infos/extra``; ``infos/quality`` is that of the steps. With MINARI_DATASETS_PATH at the
    folder that ``out`` lies in, ``minari.load_dataset(out.name)`` reads it.

    Args:
        dataset: transitions, labelled for the task.
        out: the set's folder, whose name is the set's, such as antmaze-medium-v0; what it held is replaced.
        task: the task's full name, for the description.

    Raises:
        UserError: minari is not installed, ``out`` has no such name, next observations are not those of the rows that
            follow, or the folder cannot be written.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise UserError('minari is not installed; install it with: pip install -e ".[minari]"') from error
    if not _NAME.fullmatch(out.name):
        raise UserError(f"--out {out}: a Minari set's folder has a name and a version, such as antmaze-medium-v0")
    if out.exists() and not (out / "data").is_dir():
        raise UserError(f"--out {out} is there already and no Minari set; choose another folder")
    goes_on = ~dataset.ends[:-1]
    if not np.array_equal(dataset.next_observations[:-1][goes_on], dataset.observations[1:][goes_on]):
        raise UserError(
            f"{dataset.source}: next observations are not those of the rows that follow, which a Minari set cannot hold"
        )
    episodes = [EpisodeBuffer(id=i, **_episode(dataset, *bounds)) for i, bounds in enumerate(dataset.episode_bounds)]
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing_folder(out) as partial, warnings.catch_warnings():
        before = os.environ.get("MINARI_DATASETS_PATH")
        os.environ["MINARI_DATASETS_PATH"] = str(partial)
        try:
            warnings.simplefilter("ignore")  # that no environment is named: the set's own readers need none
            minari.create_dataset_from_buffers(
                dataset_id=out.name,
                buffer=episodes,
                action_space=spaces.Box(-1.0, 1.0, dataset.actions.shape[1:], np.float32),
                observation_space=spaces.Box(-np.inf, np.inf, dataset.observations.shape[1:], np.float32),
                algorithm_name="qdos-brax data export",
                author="qdos-brax",
                author_email="none",
                code_permalink="none",
                description=f"transitions of {task}, with its rewards",
            )
        finally:
            if before is None:
                del os.environ["MINARI_DATASETS_PATH"]
            else:
                os.environ["MINARI_DATASETS_PATH"] = before
        os.replace(partial / out.name / "data", partial / "data")
        (partial / out.name).rmdir()


def _episode(dataset: Dataset, first: int, stop: int) -> dict[str, Any]:
    part = slice(first, stop)
    terminations = dataset.masks[part] == 0
    truncations = np.zeros(stop - first, bool)
    truncations[-1] = not terminations[-1]
    infos = {name: getattr(dataset, name) for name in ("qpos", "qvel", "extra", "quality")}
    return {
        "observations": np.concatenate([dataset.observations[part], dataset.next_observations[stop - 1 : stop]]),
        "actions": dataset.actions[part],
        "rewards": dataset.rewards[part],
        "terminations": terminations,
        "truncations": truncations,
        "infos": {name: array[part] for name, array in infos.items() if array is not None},
    }
