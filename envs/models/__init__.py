"""MuJoCo models: the ant alone, in a maze, and with a ball, and the humanoid, built as OGBench 1.2.2 builds them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from envs.maze import TELEPORT_RADIUS, WALL_HALF_SIZE, Maze

_ANT = Path(__file__).with_name("ant.xml")
_HUMANOID = Path(__file__).with_name("humanoid.xml")

# Collision bits of ``near_walls_model``: what the ant touches, what the ball touches, the ant against the ball.
_ANT_BIT, _KICK_BIT, _BALL_BIT = 1, 2, 4


def ant_model(maze: Maze | None = None, ball: bool = False) -> mujoco.MjModel:
    """The exact model, for MuJoCo C.

    Order and attributes of geoms follow OGBench (walls row by row, teleporters, the target, the ball), for contacts are
    solved in that order and the results shall agree bit for bit.

    Args:
        maze: its walls are added; None leaves an open floor, without target.
        ball: add the soccer ball (a free body after the ant's).
    """
    root = ET.parse(_ANT).getroot()
    world = _find(root, "worldbody")
    if maze is not None:
        _add_walls(world, maze)
    if ball:
        _add_ball(world)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def humanoid_model(maze: Maze | None = None) -> mujoco.MjModel:
    """The exact humanoid, for MuJoCo C; geoms in OGBench's order, as ``ant_model``.

    Args:
        maze: its walls are added; None leaves an open floor, without target.
    """
    root = ET.parse(_HUMANOID).getroot()
    if maze is not None:
        _add_walls(_find(root, "worldbody"), maze)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def near_walls_model(ball: bool = False) -> mujoco.MjModel:
    """The model for MJX: open floor, and three mocap boxes per free body for the walls that can be in reach.

    Mocap bodies come in this order: the ant's three, the ball's three. Differences from ``ant_model``:

    - Only moving geoms have ``contype``: MJX collides the floor with mocap boxes, which C filters as static.
    - A body touches its own boxes only (collision bits below).
    - At most 12 contacts per dimension, the deepest; 8 solver and 12 line-search iterations. MJX finds a numeric's
      value by index, not by address, so that this one has to come before any longer one.
    """
    root = ET.parse(_ANT).getroot()
    custom = ET.SubElement(root, "custom")
    ET.SubElement(custom, "numeric", name="max_contact_points", data="12")
    option = _find(root, "option")
    option.set("iterations", "8")
    option.set("ls_iterations", "12")
    world = _find(root, "worldbody")
    for geom in _find(world, "body[@name='torso']").iter("geom"):
        geom.set("contype", str(_ANT_BIT | _KICK_BIT))
        geom.set("conaffinity", "0")
    floor = _find(world, "geom[@name='floor']")
    floor.set("contype", "0")
    floor.set("conaffinity", str(_ANT_BIT | _BALL_BIT))
    if ball:
        geom = _add_ball(world)
        geom.set("contype", str(_BALL_BIT))
        geom.set("conaffinity", str(_KICK_BIT))
    for owner, bit in (("ant", _ANT_BIT), ("ball", _BALL_BIT))[: 2 if ball else 1]:
        for k in range(3):
            box = ET.SubElement(world, "body", name=f"{owner}_wall_{k}", mocap="true", pos="0 0 -10")
            size = " ".join(map(str, WALL_HALF_SIZE))
            ET.SubElement(box, "geom", type="box", size=size, contype="0", conaffinity=str(bit), material="wall")
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _add_ball(world: ET.Element) -> ET.Element:
    """Adds the ball's body to ``world``; returns its geom."""
    body = ET.SubElement(world, "body", name="ball", pos="0 0 0.5")
    ET.SubElement(body, "freejoint", name="ball_root")
    return ET.SubElement(
        body, "geom", name="ball", size=".25", material="ball", priority="1", conaffinity="1", condim="6"
    )


def _add_walls(world: ET.Element, maze: Maze) -> None:
    half_x, half_y, half_z = WALL_HALF_SIZE
    rows, columns = maze.grid.shape
    for i in range(rows):
        for j in range(columns):
            if maze.grid[i, j] == 1:
                x, y = maze.ij_to_xy((i, j))
                ET.SubElement(
                    world,
                    "geom",
                    name=f"block_{i}_{j}",
                    type="box",
                    pos=f"{x} {y} {half_z}",
                    size=f"{half_x} {half_y} {half_z}",
                    contype="1",
                    conaffinity="1",
                    material="wall",
                )
    floor = _find(world, "geom[@name='floor']")
    floor.set("pos", f"{2 * (columns - 3)} {2 * (rows - 3)} 0")
    floor.set("size", f"{2 * columns} {2 * rows} 0.2")
    _add_teleporters(world, maze)
    target = {"name": "target", "type": "cylinder", "size": ".5 .05", "pos": "0 0 .05", "material": "target"}
    ET.SubElement(world, "geom", target, contype="0", conaffinity="0")


def _add_teleporters(world: ET.Element, maze: Maze) -> None:
    """Discs on the floor, for show: the task moves the body, not the physics."""
    if maze.teleporters is None:
        return
    for kind, cells in (("in", maze.teleporters.entrances), ("out", maze.teleporters.exits)):
        for k, cell in enumerate(cells):
            x, y = maze.ij_to_xy(cell)
            disc = {"name": f"teleport_{kind}_{k}", "type": "cylinder", "material": f"teleport_{kind}"}
            place = {"pos": f"{x} {y} .05", "size": f"{TELEPORT_RADIUS} .05"}
            ET.SubElement(world, "geom", disc | place, contype="0", conaffinity="0")


def _find(parent: ET.Element, path: str) -> ET.Element:
    element = parent.find(path)
    if element is None:
        raise ValueError(f"the model has no element {path}")
    return element
