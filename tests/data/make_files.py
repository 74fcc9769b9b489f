"""Writes tests/data/files: small data sets made by the real environment of OGBench and by the real Minari.

    python tests/data/make_files.py ogbench    # needs ogbench (1.2.2 made what is here): antmaze-medium, random actions
    python tests/data/make_files.py minari     # needs minari[create,hdf5] (0.5.4 made what is here): the same steps

Minari is no dependency of the tests; run the second line in an environment of its own.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np

FILES = Path(__file__).parent / "files"
OGBENCH_FILE = FILES / "ogbench-antmaze-medium.npz"
ROWS = 12  # per trajectory, the last one only a next state
TRAJECTORIES = 2


def make_ogbench() -> None:
    """As OGBench's ``generate_locomaze.py``: prev_qpos and prev_qvel, done in the last row, float32 and bool."""
    import gymnasium
    import ogbench  # noqa: F401  (registers the environments)

    env = gymnasium.make("antmaze-medium-v0", terminate_at_goal=False, max_episode_steps=ROWS)
    env.action_space.seed(0)
    np.random.seed(0)  # OGBench's noise of starts and goals
    rows: dict[str, list] = {key: [] for key in ("observations", "actions", "terminals", "qpos", "qvel")}
    for trajectory in range(TRAJECTORIES):
        observation, _ = env.reset(seed=trajectory, options={"task_id": 1 + trajectory})
        done = False
        while not done:
            action = env.action_space.sample()
            following, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            for key, value in zip(rows, (observation, action, done, info["prev_qpos"], info["prev_qvel"]), strict=True):
                rows[key].append(value)
            observation = following
    arrays = {key: np.array(value, bool if key == "terminals" else np.float32) for key, value in rows.items()}
    np.savez_compressed(OGBENCH_FILE, **arrays)


def make_minari() -> None:
    """The steps of the OGBench file through ``minari.DataCollector``, as a Box and as a goal-conditioned Dict."""
    os.environ["MINARI_DATASETS_PATH"] = str(FILES / "collected")
    import gymnasium
    import minari
    from gymnasium import spaces

    source = np.load(OGBENCH_FILE)
    starts = np.flatnonzero(np.roll(source["terminals"], 1))

    class Replay(gymnasium.Env):
        """Shows what is in the file, whatever is done; the first trajectory is cut off, the second terminates."""

        action_space = spaces.Box(-1, 1, (8,), np.float32)

        def __init__(self, as_dict: bool) -> None:
            self._as_dict, self._trajectory = as_dict, -1
            box = lambda n: spaces.Box(-np.inf, np.inf, (n,), np.float64)  # noqa: E731
            goal = {"achieved_goal": box(2), "desired_goal": box(2), "observation": box(27)}
            self.observation_space = spaces.Dict(goal) if as_dict else box(29)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self._trajectory += 1
            self._row = starts[self._trajectory]
            return self._seen()

        def step(self, action):
            self._row += 1
            last = bool(source["terminals"][self._row])
            terminated = last and self._trajectory == 1
            return *self._seen()[:1], float(self._row), terminated, last and not terminated, self._seen()[1]

        def _seen(self):
            observation = source["observations"][self._row].astype(np.float64)
            info = {"qpos": source["qpos"][self._row], "qvel": source["qvel"][self._row]}
            if not self._as_dict:
                return observation, info
            goal = {"achieved_goal": observation[:2], "desired_goal": np.ones(2), "observation": observation[2:]}
            return goal, info

    for name, as_dict in (("flat", False), ("dict", True)):
        env = minari.DataCollector(Replay(as_dict), record_infos=True)
        for start in starts:
            env.reset(seed=int(start))
            done, row = False, start
            while not done:
                _, _, terminated, truncated, _ = env.step(source["actions"][row])
                done, row = terminated or truncated, row + 1
        env.create_dataset(f"test/{name}-v0", algorithm_name="replay", author="tests")
        shutil.rmtree(FILES / f"minari-{name}", ignore_errors=True)
        shutil.move(FILES / "collected" / "test" / f"{name}-v0", FILES / f"minari-{name}")
    shutil.rmtree(FILES / "collected")


if __name__ == "__main__":
    {"ogbench": make_ogbench, "minari": make_minari}[sys.argv[1]]()
