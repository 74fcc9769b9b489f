"""Define what all tasks share: success, reward, termination and cap, as OGBench's single-task mode has them."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.body_frame import Frame
from envs.brax_base import Env, State
from envs.families import TaskSpec
from envs.physics.base import Engine, PipelineState
from envs.scene import Scene, free_view
from envs.things import Thing

# fold_in(key, i) is split(key, n)[i] (findings/jax-fold-in-gives-the-keys-of-split.sh): a number that no split reaches.
_NEXT_EPISODE = 0x5EED0


class SimulatorStates(Protocol):
    """Hold simulator states: a ``PipelineState``, or the rows of a data set."""

    @property
    def qpos(self) -> Any:
        """Return [..., nq]."""

    @property
    def qvel(self) -> Any:
        """Return [..., nv]."""

    @property
    def extra(self) -> Any:
        """Return int[..., e], or None for tasks without discrete state."""


class StateRows(SimulatorStates, Protocol):
    """Hold rows of a data set, one transition each; ``qpos`` and ``qvel`` may be None."""

    @property
    def observations(self) -> np.ndarray:
        """Return float32[N, obs]."""
        ...

    @property
    def next_observations(self) -> np.ndarray:
        """Return float32[N, obs], the true next ones."""
        ...


class FloorMap(NamedTuple):
    """Describe the plane in which positions lie, as a map shows it.

    Attributes:
        grid: int[I, J], 1 where a cell is a wall; row by row from the lowest y, each from the lowest x.
        corner: float[2], x and y of the lowest corner of cell (0, 0).
        cell: side of a cell.
        goal: float[2].
    """

    grid: np.ndarray
    corner: np.ndarray
    cell: float
    goal: np.ndarray

    @property
    def walls(self) -> np.ndarray:
        """Return float[W, 2], the centres of the cells that are walls."""
        return self.corner + (np.argwhere(self.grid == 1)[:, ::-1] + 0.5) * self.cell


class Resting(NamedTuple):
    """Hold how high something lies and where it rests, which shows the MuJoCo that recorded it.

    Up to MuJoCo 3.4 two geoms met at the larger of their margins, since 3.5 at the sum: the same thing rests higher.

    Attributes:
        heights: float64[N], of the states asked about, in m.
        today: the height at rest with the installed MuJoCo.
        before: that with MuJoCo before 3.5.
    """

    heights: np.ndarray
    today: float
    before: float


class Task(Env, ABC):
    """Simulate one task; subclasses say where episodes start, what success is and what is observed.

    Success is read on the state before the action (OGBench's ``success_timing="pre"``), success ends the episode, and
    ``step`` never resets: see ``envs.AutoReset``.

    What not every task can do has a member all the same, which is None where the task cannot: ``position``,
    ``floor_map``, ``distance_left``, ``parts``, ``resting``, ``body_frame``. Maps, paths, reports and checks leave out
    what is None, and ``things`` is empty.

    Args:
        spec: which task.
        engine: the physics.
        goal: the task's goal, as ``reset_to`` takes it; of size 0 for tasks whose goal never varies.

    Attributes:
        distance_margin: change of ``distance_left`` that counts as progress or as a setback.
        jump: distance that the first two numbers of an observation, a position then, never move in one control step;
            None where they are no position. Readers of data files find unmarked ends of episodes by it.
        body_frame: how the body sees its observations from where it is.
        things: what rests in the scene until it is touched, independent of one another.
        metric_names: what ``state.metrics`` holds: "success", and "score" (the share of the task that is done) for a
            task that has parts.
        unfit: why known files of the same scene cannot be used, by their numbers per observation.
    """

    distance_margin = 0.0
    jump: float | None = None
    body_frame: Frame | None = None
    things: tuple[Thing, ...] = ()
    metric_names: tuple[str, ...] = ("success",)
    unfit: Mapping[int, str] = MappingProxyType({})

    def __init__(self, spec: TaskSpec, engine: Engine, goal: Any = ()) -> None:
        self.spec = spec
        self.engine = engine
        self._goal = np.asarray(goal, np.float32)

    @property
    def observation_size(self) -> int:
        """Return the numbers per observation."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def action_size(self) -> int:
        """Return the numbers per action, each in [-1, 1]."""
        return self.engine.action_size

    @property
    def extra_size(self) -> int:
        """Return the numbers of the discrete state."""
        return self.engine.extra_size

    @property
    def backend(self) -> str:
        """Return the engine's name."""
        return self.engine.name

    @property
    def episode_length(self) -> int:
        """Return the cap in control steps."""
        return self.spec.episode_length

    @abstractmethod
    def reset(self, rng: jax.Array) -> State:
        """Return a start of the task, drawn from ``rng``, a typed key; subclasses may add options."""

    @abstractmethod
    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[...], whether ``goal`` is reached at ``qpos[..., nq]``, ``extra[..., e]``; NumPy or jax."""

    def reset_to(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        goal: Any = None,
        key: jax.Array | None = None,
        extra: jax.Array | None = None,
    ) -> State:
        """Return any simulator state as the first of an episode.

        Args:
            qpos: float[nq].
            qvel: float[nv].
            goal: what has to be reached; None takes the task's goal.
            key: what the physics' chances are drawn from, and the key of the next episode under ``AutoReset``, so that
                the one that a start was drawn from will do; None takes a fixed one.
            extra: int[e], the discrete state; None takes zeros.
        """
        pipeline_state = self.start_physics(qpos, qvel, extra, key)
        obs = self.observe(pipeline_state)
        info = {
            "goal": jnp.asarray(self._goal if goal is None else goal, jnp.float32),
            "truncation": jnp.zeros(()),
            "final_obs": obs,
            "reset_key": jax.random.fold_in(jax.random.key(0) if key is None else key, _NEXT_EPISODE),
        }
        metrics = {name: jnp.zeros(()) for name in self.metric_names}
        return State(pipeline_state, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

    def start_physics(
        self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None, key: jax.Array | None
    ) -> PipelineState:
        """Return the physics of ``reset_to``; tasks whose sensors err draw the errors from ``key``."""
        return self.engine.init(qpos, qvel, extra)

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step under ``action[act]`` in [-1, 1]."""
        before, goal = state.pipeline_state, state.info["goal"]
        success = self.success(before.qpos, goal, before.extra).astype(jnp.float32)
        reward, mask = self.labels(before, goal)
        pipeline_state = self.engine.step(before, action)
        obs = self.observe(pipeline_state)
        capped = (pipeline_state.steps >= self.episode_length).astype(jnp.float32)
        return state.replace(
            pipeline_state=pipeline_state,
            obs=obs,
            reward=reward,
            done=jnp.maximum(1.0 - mask, capped),
            metrics=state.metrics | {"success": success},
            info=state.info | {"truncation": capped * mask, "final_obs": obs},
        )

    def idle(self, state: State, over: jax.Array) -> State:
        """Return what to step in place of ``state`` if nobody reads the result where ``over`` (bool) is True.

        With MuJoCo C an episode that is over then costs no physics while those beside it go on.
        """
        return state.replace(pipeline_state=self.engine.idle(state.pipeline_state, over))

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        """Return float32[obs], what is seen of a state; qpos and qvel unless a task overrides it."""
        return jnp.concatenate([pipeline_state.qpos, pipeline_state.qvel])

    def labels(self, states: SimulatorStates, goal: Any = None) -> tuple[Any, Any]:
        """Return (reward[...], mask[...]) of states before the action, online and for data alike; NumPy or jax.

        The reward is success - 1, the mask 1 - success, unless a task overrides it.

        Args:
            states: where the action was taken.
            goal: [..., g]; None takes the task's goal.
        """
        success = self.success(states.qpos, self._goal if goal is None else goal, states.extra).astype(np.float32)
        return success - 1.0, 1.0 - success

    def file_rewards(self, rewards: np.ndarray) -> np.ndarray:
        """Return a file's own rewards float32[N] on the task's scale; as they are unless a task overrides it."""
        return rewards

    def check_rows(self, rows: StateRows) -> list[str]:
        """Return one line per cheap sign that ``rows`` are of another task; every training asks."""
        return []

    def check_steps(self, rows: StateRows) -> list[str]:
        """Return one line per sign that ``rows`` do not follow from one another; ``data check`` asks."""
        return []

    def scene(self) -> Scene:
        """Return how the task is drawn; the engine's model from MuJoCo's own camera unless a task overrides it."""
        return Scene(copy.deepcopy(self.engine.model), {"free": free_view})

    def position(self, qpos: Any) -> dict[str, Any] | None:
        """Return [..., 2] by the name of everything that moves in a plane, first what acts; NumPy or jax."""
        return None

    def floor_map(self) -> FloorMap | None:
        """Return the plane in which ``position`` lies."""
        return None

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray | None:
        """Return float64[...], how far ``qpos[..., nq]``, ``extra[..., e]`` are from success; for measuring only.

        A way in units of length, or a count of what is still to be done; inf where there is no way.
        """
        return None

    def parts(self, states: SimulatorStates) -> Mapping[str, Any] | None:
        """Return bool[...] by name, which parts of the task are done in ``states``; None for tasks without parts."""
        return None

    def resting(self, qpos: np.ndarray) -> Resting | None:
        """Return how high things lie at ``qpos[N, nq]``, and where they rest, of a task whose contacts have margins."""
        return None


def count_rows(bad: np.ndarray) -> str:
    """Return as words how many of ``bad`` (bool[N]) are True and which is the first, as "3 rows (first 17)"."""
    count = int(bad.sum())
    return f"{count:,} row{'s' if count > 1 else ''} (first {bad.argmax()})"
