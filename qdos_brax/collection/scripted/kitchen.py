"""Play the kitchen by script: subtasks in random orders and paces, and episodes that go wrong in four ways."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from envs.manipulation.kitchen import Kitchen
from envs.manipulation.kitchen_rig import JOINTS, START_QPOS, SUBTASKS
from qdos_brax.collection.scripted.demonstrator import SimStates
from qdos_brax.collection.scripted.kitchen_arm import Arm, HandTarget, Poses
from qdos_brax.collection.scripted.kitchen_skills import DOWN, FORWARD, SKILLS, Look, Targets, beside, move, pause
from qdos_brax.data.quality import QUALITY

SEQUENCE_SHARE = {"mixed": 0.0, "partial": 0.3, "complete": 1.0}
"""Share of the episodes, by variant, that do the task's four subtasks one after another."""

_PACES = (0.9, 1.3)  # range of the factor on every speed
_HESITATION = 0.04  # probability of a pause before a move
_TRIES = 3  # of a subtask
_WORKSPACE = np.array([[-0.75, 0.25, 1.75], [0.45, 0.72, 2.5]])  # m, where a wandering hand goes
_MISS = 0.13  # m by which a hand misses what it reaches for
_LET_GO = (0.2, 0.8)  # range of the share of a subtask's way at which it is let go


class KitchenDemonstrator:
    """Play the subtasks of the kitchen.

    An episode takes subtasks in turn, in random order. In ``mixed``, and in most of ``partial``, one of the task's four
    is left out, so that no episode shows all of them. ``fail`` lets each subtask go half way or reaches beside it,
    ``wander`` goes from place to place, ``noisy`` is good play under heavy noise.

    Args:
        env: the task.
        n: simulations played at once.
        noise: standard deviation of the action noise of all episodes but the noisy ones.
    """

    version = 2
    heavy_noise = 0.6

    def __init__(self, env: Kitchen, n: int, noise: float) -> None:
        self._env, self._noise = env, noise
        self._arm, self._poses = Arm(env), Poses(env, n)

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        """Return the task's start, n times, and plan an episode of ``kinds[n]`` for each."""
        n = len(kinds)
        self._kinds = kinds.astype(np.int8)
        looks = [
            Look(self._poses, index, own, pace=own.uniform(*_PACES), hesitation=_HESITATION)
            for index, own in enumerate(rng.spawn(n))
        ]
        self._plays = [self._play(look, int(kind)) for look, kind in zip(looks, kinds, strict=True)]
        nv, extra = self._env.engine.nv, np.zeros((n, self._env.extra_size), np.int32)
        return SimStates(np.tile(START_QPOS, (n, 1)), np.zeros((n, nv)), extra, np.zeros((n, 0), np.float32))

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return (actions float32[n, 9], quality int8[n]): an episode is of one quality."""
        self._poses.look(states.qpos, states.qvel, states.extra)
        actions = self._arm.actions(self._poses, [next(play) for play in self._plays])
        noise = np.where(self._kinds == QUALITY["noisy"], self.heavy_noise, self._noise)
        actions += noise[:, None] * rng.standard_normal((len(actions), JOINTS))
        return np.clip(actions, -1.0, 1.0).astype(np.float32), self._kinds.copy()

    def _play(self, look: Look, kind: int) -> Iterator[HandTarget]:
        """Return the targets of an episode, which never end."""
        if kind == QUALITY["wander"]:
            return _wander(look)
        plan = self._plan(look.rng)
        if kind == QUALITY["fail"]:
            return _fail(look, plan)
        return itertools.chain(_demonstrate(look, plan), _wait(look))

    def _plan(self, rng: np.random.Generator) -> list[str]:
        """Return the subtasks to do, in order."""
        own = list(self._env.subtasks)
        others = [str(name) for name in rng.permutation(SUBTASKS) if name not in own]
        if self._env.spec.variant == "complete":
            return own + others
        own = [str(name) for name in rng.permutation(own)]
        if rng.uniform() < SEQUENCE_SHARE[self._env.spec.variant]:
            return own + others
        return [str(name) for name in rng.permutation([*own[1:], others[0]])] + others[1:]


def _demonstrate(look: Look, plan: Sequence[str]) -> Targets:
    for subtask in plan:
        for _ in range(_TRIES):
            if not look.is_complete(subtask):
                yield from SKILLS[subtask](look)


def _wait(look: Look) -> Targets:
    """Yield the last place for ever."""
    while True:
        yield from pause(look, 20, grip=False)


def _wander(look: Look) -> Targets:
    """Yield targets at random places for ever."""
    while True:
        place = look.rng.uniform(*_WORKSPACE)
        rotation = (FORWARD, DOWN)[look.rng.integers(2)]
        yield from move(look, place, within=0.05, rotation=rotation, grip=bool(look.rng.integers(2)))


def _fail(look: Look, plan: Sequence[str]) -> Targets:
    """Yield targets of attempts at the subtasks of ``plan`` that come to nothing, for ever."""
    while True:
        subtask = str(look.rng.choice(plan))
        yield from _let_go(look, subtask) if look.rng.uniform() < 0.5 else _miss(look, subtask)


def _let_go(look: Look, subtask: str) -> Targets:
    """Yield an attempt that ends when the thing has begun to move, and the way back from it."""
    first, share = look.gap(subtask), look.rng.uniform(*_LET_GO)
    enough = first - share * max(first - 0.3, 0.0)
    for target in SKILLS[subtask](look):
        if look.gap(subtask) < enough:
            break
        yield target
    away = beside(look.tip, look.rng.uniform(-0.1, 0.1), -0.15, look.rng.uniform(0.0, 0.15))
    yield from move(look, away, within=0.03, steps=10, grip=False, rotation=look.hand.copy())


def _miss(look: Look, subtask: str) -> Targets:
    """Yield an attempt that reaches beside the thing."""
    angle = look.rng.uniform(0.0, 2 * np.pi)
    shift = _MISS * np.array([np.cos(angle), -0.3, np.sin(angle)])
    for target in SKILLS[subtask](look):
        yield target._replace(position=target.position + shift)
