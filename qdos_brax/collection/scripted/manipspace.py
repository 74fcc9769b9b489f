"""Demonstrate OGBench's cubes and scene: its own oracles, one per simulation, and what is worse than they are."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from envs.manipulation.manipspace import SHIFT, ManipSpaceTask, TableState
from envs.manipulation.manipspace_rig import ROBOT_JOINTS
from qdos_brax.collection.scripted.demonstrator import SimStates
from qdos_brax.collection.scripted.oracles import MOVE, Oracle
from qdos_brax.collection.scripted.table import Table, TableReader
from qdos_brax.collection.scripted.targets import LYING, GoalSeeker, any_target

AIMED_SHARE = 0.75
"""Share of the good episodes that go for the goals of the variant's tasks, one after another; the others play."""
_WRONG_SHARE = 0.5  # of what failing episodes do: anything, with things that are in place; else it is let go half way
_LET_GO = (0.4, 0.8)  # of a plan
_RETREAT = 12  # control steps
_WAYPOINT_STEPS = 30
_APART = 0.06  # m, between cubes at a start
_RANGES = np.array([[0.0, 0.0, -0.16, 0.0], [0.0, 0.0, 0.0, 0.2]])  # of the scene's buttons, drawer and window


class CubeDemonstrator:
    """Demonstrate the cubes.

    Good episodes (``navigate``) follow OGBench's plan oracles with smooth noise. A share of them, ``AIMED_SHARE``,
    starts where one of the tasks starts and does what the tasks' goals ask for; the others take random targets, as
    OGBench's play data. ``noisy``: the Markov oracles under heavy noise, to random targets. ``wander``: the hand goes
    anywhere, among the things too, and grips at random. ``fail``: all is in place at first; then something is moved
    away, or is taken towards a goal and let go half way.

    Args:
        env: a task of the variant.
        n: simulations.
        noise: of the plans, in units of the action.
    """

    version: ClassVar[int] = 1
    heavy_noise: ClassVar[float] = 0.5

    def __init__(self, env: ManipSpaceTask, n: int, noise: float) -> None:
        self._env, self._noise, self._n = env, noise, n
        self._reader = TableReader(env)
        self._players: list[_Player] = []
        self._kinds = np.zeros(n, np.int8)

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        """Start an episode in every simulation; see ``Demonstrator``."""
        self._kinds = np.array(kinds, np.int8)
        self._players = [_PLAYERS[int(kind)](self._env, self._noise, rng) for kind in kinds]
        tables = [player.start(rng) for player in self._players]
        qpos = np.zeros((self._n, self._env.engine.nq))
        qpos[:, :6] = self._env.rig.arm_start(
            rng.uniform(*self._env.space.arm_bounds, (self._n, 3)), rng.uniform(-np.pi, np.pi, self._n)
        )
        qpos[:, ROBOT_JOINTS:] = [_table_qpos(table, rng) for table in tables]
        extra = np.array([table.extra for table in tables], np.int32)
        return SimStates(qpos, np.zeros((self._n, self._env.engine.nv)), extra, np.zeros((self._n, 0), np.float32))

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return (actions, quality); see ``Demonstrator``."""
        tables = self._reader.read(states)
        actions = np.array([player.act(table, rng) for player, table in zip(self._players, tables, strict=True)])
        noise = np.array([player.action_noise for player in self._players])
        actions += noise[:, None] * rng.standard_normal(actions.shape)
        return np.clip(actions, -1.0, 1.0).astype(np.float32), self._kinds


class SceneDemonstrator(CubeDemonstrator):
    """Demonstrate the scene, in the same ways."""


class _Player:
    """Play one episode; this one takes random targets.

    Attributes:
        action_noise: standard deviation of the noise on its actions.
    """

    style = "plan"
    action_noise = 0.0

    def __init__(self, env: ManipSpaceTask, noise: float, rng: np.random.Generator) -> None:
        self._env = env
        self._oracle = Oracle(env, self.style, noise)

    def start(self, rng: np.random.Generator) -> TableState:
        """Return where things are at first."""
        return _random_table(self._env, rng)

    def act(self, table: Table, rng: np.random.Generator) -> np.ndarray:
        """Return the action float64[5]."""
        if self._oracle.done:
            self._aim(table, rng)
        return self._oracle.act(table)

    def _aim(self, table: Table, rng: np.random.Generator) -> None:
        """Set the next target."""
        self._oracle.set_target(table, any_target(self._env, table, rng), rng)


class _Noisy(_Player):
    style = "markov"
    action_noise = CubeDemonstrator.heavy_noise


class _Good(_Player):
    """Go for the goals of the tasks, or play."""

    def __init__(self, env: ManipSpaceTask, noise: float, rng: np.random.Generator) -> None:
        super().__init__(env, noise, rng)
        self._seekers = [GoalSeeker(env, description) for description in env.descriptions]
        self._task = int(rng.integers(len(self._seekers)))
        self._aimed = rng.uniform() < AIMED_SHARE

    def start(self, rng: np.random.Generator) -> TableState:
        if not self._aimed:
            return super().start(rng)
        state = self._env.start_of(self._env.descriptions[self._task])
        cubes = state.cubes.copy()
        cubes[:, :2] += rng.uniform(-SHIFT, SHIFT, (len(cubes), 2))
        fixtures = state.fixtures
        if len(fixtures):
            fixtures = np.clip(fixtures + [0, 0, *rng.uniform(-SHIFT, SHIFT, 2)], *_RANGES)
        return TableState(cubes, fixtures, state.extra)

    def _aim(self, table: Table, rng: np.random.Generator) -> None:
        if not self._aimed:
            return super()._aim(table, rng)
        target = self._seekers[self._task].next_target(table, rng)
        if target is None or not self._seekers[self._task].feasible(table):
            options = [i for i, seeker in enumerate(self._seekers) if i != self._task and seeker.feasible(table)]
            self._task = int(rng.choice(options)) if options else self._task
            target = self._seekers[self._task].next_target(table, rng)
        self._oracle.set_target(table, target or any_target(self._env, table, rng), rng)


class _Failing(_Good):
    """Take things away from where they belong, or let go of them half way."""

    def __init__(self, env: ManipSpaceTask, noise: float, rng: np.random.Generator) -> None:
        super().__init__(env, noise, rng)
        self._let_go, self._retreat = 1.0, 0

    def start(self, rng: np.random.Generator) -> TableState:
        return self._env.goal_state(self._env.descriptions[self._task])

    def act(self, table: Table, rng: np.random.Generator) -> np.ndarray:
        if self._retreat == 0 and (self._oracle.done or self._oracle.progress() < self._let_go):
            return super().act(table, rng)
        self._retreat = self._retreat or _RETREAT
        self._retreat -= 1
        if self._retreat == 0:
            self._aim(table, rng)
        return np.array([0.0, 0.0, 1.0, 0.0, -1.0])

    def _aim(self, table: Table, rng: np.random.Generator) -> None:
        target = self._seekers[self._task].next_target(table, rng)
        if target is None or rng.uniform() < _WRONG_SHARE:
            self._let_go, target = 1.1, any_target(self._env, table, rng)
        else:
            self._let_go = rng.uniform(*_LET_GO)
        self._oracle.set_target(table, target, rng)


class _Wandering(_Player):
    """Send the hand anywhere."""

    def __init__(self, env: ManipSpaceTask, noise: float, rng: np.random.Generator) -> None:
        super().__init__(env, noise, rng)
        self.action_noise = noise
        self._left, self._place, self._yaw, self._grip = 0, np.zeros(3), 0.0, 0.0

    def act(self, table: Table, rng: np.random.Generator) -> np.ndarray:
        if self._left == 0 or np.linalg.norm(self._place - table.hand) < 0.03:
            low, high = self._env.space.arm_bounds
            self._left = _WAYPOINT_STEPS
            self._place = rng.uniform([*low[:2], LYING], high)
            self._yaw, self._grip = rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0])
        self._left -= 1
        return np.clip([*((self._place - table.hand) / MOVE[:3]), self._yaw, self._grip], -1.0, 1.0)


_PLAYERS: dict[int, type[_Player]] = {0: _Good, 1: _Noisy, 2: _Wandering, 3: _Failing}
"""By the code of ``QUALITY``."""


def _random_table(env: ManipSpaceTask, rng: np.random.Generator) -> TableState:
    """Return cubes anywhere on the table, apart from one another, and everything else anyhow."""
    places: list[np.ndarray] = []
    while len(places) < env.cubes:
        place = rng.uniform(*env.space.object_bounds)
        if all(np.linalg.norm(place - other) > _APART for other in places):
            places.append(place)
    cubes = np.array([[*place, LYING] for place in places])
    fixtures = rng.uniform(*_RANGES) if env.extra_size else np.zeros(0)
    return TableState(cubes, fixtures, rng.integers(2, size=env.extra_size).astype(np.int32))


def _table_qpos(table: TableState, rng: np.random.Generator) -> np.ndarray:
    """Return qpos from the first cube on, each cube turned at random."""
    half = rng.uniform(0, np.pi, len(table.cubes))
    zero = np.zeros_like(half)
    turns = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    return np.concatenate([np.concatenate([table.cubes, turns], axis=1).ravel(), table.fixtures])
