"""Say how each subtask of the kitchen is done: generators of targets, one for each control step, that watch as they go.

Every skill ends by itself, done or not, with the hand away from things.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from envs.manipulation.hand_frame import HANDLES
from envs.manipulation.kitchen_rig import GOALS, SUBTASKS
from qdos_brax.collection.scripted.kitchen_arm import HandTarget, Poses, frame

FORWARD = frame([0, 1, 0], [1, 0, 0])
DOWN = frame([0, 0.6, -0.8], [1, 0, 0])
_ASKEW = frame([0.5, 0.86, 0], [0.86, -0.5, 0])

Targets = Iterator[HandTarget]
Place = np.ndarray | Callable[[], np.ndarray]


@dataclass(frozen=True)
class Look:
    """Look at one simulation of ``poses``, and remember how its episode is played.

    Attributes:
        poses: of all simulations.
        index: which of them.
        rng: the episode's own random numbers.
        pace: factor on every speed.
        hesitation: probability of a pause before a move.
    """

    poses: Poses
    index: int
    rng: np.random.Generator
    pace: float
    hesitation: float

    @property
    def tip(self) -> np.ndarray:
        """Return float64[3], between the finger tips."""
        return self.poses.tips[self.index]

    @property
    def hand(self) -> np.ndarray:
        """Return float64[3, 3], the rotation of link 7."""
        return self.poses.hands[self.index]

    def qpos(self, number: int) -> float:
        """Return one number of qpos."""
        return float(self.poses.qpos[self.index, number])

    def site(self, name: str) -> np.ndarray:
        """Return float64[3], where a site is now."""
        return self.poses.sites[self.index, self.poses.model.site(name).id].copy()

    def handle(self, subtask: str) -> np.ndarray:
        """Return float64[3], where the hand moves the thing of a subtask."""
        return self.site(HANDLES[subtask])

    def is_complete(self, subtask: str) -> bool:
        """Return whether a subtask was completed so far."""
        return bool(self.poses.extra[self.index, SUBTASKS.index(subtask)])

    def gap(self, subtask: str) -> float:
        """Return how far a subtask is from its goal."""
        numbers = self.poses.qpos[self.index, list(GOALS[subtask])]
        return float(np.linalg.norm(numbers - list(GOALS[subtask].values())))


def move(
    look: Look,
    place: Place,
    *,
    within: float = 0.015,
    steps: int = 25,
    speed: float = 0.05,
    rotation: np.ndarray | Callable[[], np.ndarray] = FORWARD,
    grip: bool = True,
    until: Callable[[], bool] = lambda: False,
) -> Targets:
    """Yield targets at ``place`` until the tips are there.

    Args:
        look: the simulation.
        place: float64[3], or what gives it anew for every step.
        within: m, how near ends the move; 0: only ``steps`` and ``until`` do.
        steps: the most it lasts.
        speed: m per control step.
        rotation: of the hand, or what gives it anew.
        grip: whether the fingers are shut.
        until: ends the move as well.
    """
    if look.rng.uniform() < look.hesitation:
        yield from pause(look, int(look.rng.integers(3, 12)), grip)
    for _ in range(round(steps / min(look.pace, 1.0))):
        position = place() if callable(place) else place
        if until() or (within and np.linalg.norm(position - look.tip) < within):
            return
        yield HandTarget(position, rotation() if callable(rotation) else rotation, grip, speed * look.pace)


def beside(place: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    """Return ``place[3]`` moved by (x, y, z)."""
    return place + np.array([x, y, z])


def pause(look: Look, steps: int, grip: bool) -> Targets:
    """Yield the hand's own place for ``steps``."""
    target = HandTarget(look.tip.copy(), look.hand.copy(), grip, 0.02)
    for _ in range(steps):
        yield target


def kettle(look: Look) -> Targets:
    """Move the kettle to the back, pushed low and in its middle."""
    x, y, z = look.qpos(23), look.qpos(24), 1.69
    yield from move(look, np.array([x, y - 0.20, z + 0.17]), grip=False, within=0.03, steps=40, rotation=DOWN)
    yield from move(look, np.array([x, y - 0.18, z]), grip=False, rotation=DOWN)
    pushed = np.array([x + 0.02, 0.58, z])
    far_enough = lambda: look.qpos(24) > 0.50  # noqa: E731
    yield from move(look, pushed, grip=False, within=0.02, steps=40, speed=0.03, rotation=DOWN, until=far_enough)
    yield from move(look, np.array([x, 0.30, z + 0.08]), grip=False, within=0.05, steps=10, rotation=DOWN)
    yield from move(look, np.array([x, 0.22, z + 0.25]), within=0.06, steps=10)


def microwave(look: Look) -> Targets:
    """Open the door by its handle, along its arc; grasp anew wherever the tips slide off."""
    joint = look.poses.model.joint("microwave")
    hinge = look.poses.anchors[look.index, joint.id].copy()
    handle, first = look.handle("microwave"), look.qpos(22)
    arm = handle - hinge

    def on_arc(angle: float) -> np.ndarray:
        c, s = np.cos(angle - first), np.sin(angle - first)
        return np.array([hinge[0] + c * arm[0] - s * arm[1], hinge[1] + s * arm[0] + c * arm[1], handle[2]])

    ahead = FORWARD[:, 2]
    here = lambda: on_arc(look.qpos(22))  # noqa: E731
    grasp = lambda: here() + 0.036 * ahead  # noqa: E731
    away = lambda: here() - 0.10 * ahead  # noqa: E731
    pull = lambda: on_arc(look.qpos(22) - 0.1) + 0.036 * ahead  # noqa: E731
    is_open = lambda: look.qpos(22) < -0.57  # noqa: E731
    slipped = lambda: is_open() or (look.tip - here()) @ look.hand[:, 2] < 0.006  # noqa: E731
    yield from move(look, away, grip=False, within=0.025, steps=45)
    for _ in range(5):
        yield from move(look, grasp, grip=False, within=0.010, steps=12, speed=0.03, until=is_open)
        yield from move(look, grasp, within=0.0, steps=3, until=is_open)
        yield from move(look, pull, within=0.0, steps=14, speed=0.06, until=slipped)
    yield from move(look, away, grip=False, within=0.03, steps=8)


def hinge_cabinet(look: Look) -> Targets:
    """Open the right door: fingers behind its handle, from between the two handles, and a sweep."""
    handle = look.handle("hinge cabinet")
    door = _door_panel(look)

    def edge(off: float) -> np.ndarray:
        panel = look.poses.geom_frames[look.index, door]
        return look.poses.geoms[look.index, door] + panel @ np.array([-0.113, off, 0.0])

    wide = lambda: look.qpos(21) > 1.3  # noqa: E731
    yield from move(look, np.array([-0.42, 0.42, 2.45]), within=0.06, steps=30)
    yield from move(look, beside(handle, -0.075, -0.12, 0.0), within=0.03, steps=15)
    yield from move(look, beside(handle, -0.075, 0.04, -0.04), within=0.02, steps=12)
    yield from move(look, lambda: edge(0.05), within=0.02, steps=9, rotation=_ASKEW)
    yield from move(look, lambda: edge(-0.10), within=0.005, steps=45, speed=0.06, rotation=_ASKEW, until=wide)
    yield from move(look, lambda: beside(look.site("end_effector"), -0.1, -0.15, 0.0), within=0.03, steps=6)


def light_switch(look: Look) -> Targets:
    """Move the switch to the left."""
    at = look.handle("light switch")
    on = lambda: look.qpos(17) < -0.66  # noqa: E731
    yield from move(look, beside(at, 0.10, -0.10, 0.0), within=0.02, steps=40)
    yield from move(look, beside(at, 0.07, 0.005, 0.0), within=0.012, steps=15)
    yield from move(look, beside(at, -0.09, 0.02, 0.0), steps=20, speed=0.03, until=on)
    yield from move(look, beside(at, -0.04, -0.10, 0.0), within=0.03, steps=10)


def slide_cabinet(look: Look) -> Targets:
    """Move the handle to the right."""
    at = look.handle("slide cabinet")
    is_open = lambda: look.qpos(19) > 0.2  # noqa: E731
    yield from move(look, beside(at, -0.09, -0.10, -0.05), within=0.02, steps=40)
    yield from move(look, beside(at, -0.07, 0.02, -0.05), steps=15)
    yield from move(look, beside(at, 0.25, 0.02, -0.05), within=0.02, steps=35, speed=0.03, until=is_open)
    yield from move(look, beside(at, 0.10, -0.12, -0.05), within=0.03, steps=10)


def bottom_burner(look: Look) -> Targets:
    """Turn the left knob of the lower row."""
    return _turn_knob(look, "bottom burner", 11, rise=0.3)


def top_burner(look: Look) -> Targets:
    """Turn the left knob of the upper row."""
    return _turn_knob(look, "top burner", 15, rise=0.5)


def _turn_knob(look: Look, subtask: str, number: int, rise: float) -> Targets:
    """Push the top of the knob's bar to the right, the fingers tilted so that the wrist has room."""
    side, depth = 0.3, 0.012
    rotation = frame([side, np.sqrt(1 - rise * rise - side * side), rise], [1, 0, 0])
    top, back = beside(look.handle(subtask), 0.0, 0.0, 0.035), 0.1 * rotation[:, 2]
    turned = lambda: look.qpos(number) < -0.80  # noqa: E731
    yield from move(look, beside(top, -0.055, 0.0, 0.0) - back, within=0.02, steps=35, rotation=rotation)
    yield from move(look, beside(top, -0.045, depth, 0.0), within=0.012, steps=15, rotation=rotation)
    along = beside(top, 0.10, depth, -0.02)
    yield from move(look, along, within=0.012, steps=35, speed=0.08, rotation=rotation, until=turned)
    yield from move(look, top - back, within=0.03, steps=10, rotation=rotation)


def _door_panel(look: Look) -> int:
    """Return the geom that is the right door itself."""
    model = look.poses.model
    boxes = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX.value
    return int(np.flatnonzero((model.geom_bodyid == model.body("hingerightdoor").id) & boxes)[0])


SKILLS: Mapping[str, Callable[[Look], Targets]] = {
    "bottom burner": bottom_burner,
    "top burner": top_burner,
    "light switch": light_switch,
    "slide cabinet": slide_cabinet,
    "hinge cabinet": hinge_cabinet,
    "microwave": microwave,
    "kettle": kettle,
}
