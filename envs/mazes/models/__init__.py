"""Build MuJoCo models: the ant alone, in a maze, and with a ball, and the humanoid, as OGBench 1.2.2 builds them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from envs.mazes.maze import TELEPORT_RADIUS, WALL_HALF_SIZE, Maze
from envs.mazes.walls import WALLS, WALLS_AROUND
from envs.physics.mujoco.pairs import list_pairs

_ANT = Path(__file__).with_name("ant.xml")
_HUMANOID = Path(__file__).with_name("humanoid.xml")

# Collision bits of the models for MJX: what ant or humanoid touch, the ant against the ball, what the ball touches.
_BODY_BIT, _KICK_BIT, _BALL_BIT = 1, 2, 4


def ant_model(maze: Maze | None = None, ball: bool = False) -> mujoco.MjModel:
    """Return the model with all walls.

    Order and attributes of geoms follow OGBench (walls row by row, teleporters, the target, the ball), since
    contacts are solved in that order and the results agree bit for bit.

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
    """Return the humanoid with all walls; geoms in OGBench's order, as ``ant_model``.

    Args:
        maze: its walls are added; None leaves an open floor, without target.
    """
    root = ET.parse(_HUMANOID).getroot()
    if maze is not None:
        _add_walls(_find(root, "worldbody"), maze)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def near_walls_ant(mocap: bool, ball: bool = False) -> mujoco.MjModel:
    """Return the ant on an open floor, and the walls in reach: ``WALLS`` boxes per free body, to be moved there.

    Args:
        mocap: the boxes are mocap bodies ("ant_wall_0", .., "ball_wall_0", ..), for MJX; else geoms of the world of
            these names, for MuJoCo C. See ``_compile_for_mjx`` and ``_compile_for_c``.
        ball: with the soccer ball.
    """
    root = ET.parse(_ANT).getroot()
    world = _find(root, "worldbody")
    add_walls = _add_mocap_walls if mocap else _add_world_walls
    for geom in _find(world, "body[@name='torso']").iter("geom"):
        geom.set("contype", str(_BODY_BIT | _KICK_BIT))
        geom.set("conaffinity", "0")
    add_walls(world, "ant", _BODY_BIT)
    if ball:
        add_walls(world, "ball", _BALL_BIT)
        geom = _add_ball(world)
        geom.set("contype", str(_BALL_BIT))
        geom.set("conaffinity", str(_KICK_BIT))
    floor_bits = _BODY_BIT | _BALL_BIT
    return _compile_for_mjx(root, floor_bits) if mocap else _compile_for_c(root, floor_bits)


def near_walls_humanoid(mocap: bool) -> mujoco.MjModel:
    """Return the humanoid, as ``near_walls_ant``; its parts touch each other as well."""
    root = ET.parse(_HUMANOID).getroot()
    world = _find(root, "worldbody")
    if not mocap:
        _add_world_walls(world, "humanoid", _BODY_BIT)
        return _compile_for_c(root, floor_bits=_BODY_BIT)
    _add_mocap_walls(world, "humanoid", _BODY_BIT)
    return _compile_for_mjx(root, floor_bits=_BODY_BIT)


def _compile_for_c(root: ET.Element, floor_bits: int) -> mujoco.MjModel:
    """Compile with a list of what can touch (see ``envs.physics.mujoco.pairs``), without cameras and lights.

    MuJoCo's own reset of states that blow up is off, so that the task sees them. So are islands where all
    joints hang together: there is only one, and looking for it costs time and changes nothing.
    """
    _find(_find(root, "worldbody"), "geom[@name='floor']").set("conaffinity", str(floor_bits))
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    for element in (*spec.cameras, *spec.lights):
        spec.delete(element)
    list_pairs(spec)
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if model.ntree == 1:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model


def _compile_for_mjx(root: ET.Element, floor_bits: int) -> mujoco.MjModel:
    """Compile with ``contype`` for moving geoms alone: MJX collides the floor with mocap boxes, C does not."""
    floor = _find(_find(root, "worldbody"), "geom[@name='floor']")
    floor.set("contype", "0")
    floor.set("conaffinity", str(floor_bits))
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _add_world_walls(world: ET.Element, owner: str, bit: int) -> None:
    """Add boxes of the world, as a whole maze has them, so that contacts are found in the same order, bit for bit."""
    for k in range(WALLS):
        box = {"name": f"{owner}_wall_{k}", "pos": "0 0 -100", "contype": "0", "conaffinity": str(bit)}
        _add_box(world, box)


def _add_mocap_walls(world: ET.Element, owner: str, bit: int) -> None:
    for k in range(WALLS_AROUND):
        box = ET.SubElement(world, "body", name=f"{owner}_wall_{k}", mocap="true", pos="0 0 -100")
        _add_box(box, {"contype": "0", "conaffinity": str(bit)})


def _add_box(parent: ET.Element, attributes: dict[str, str]) -> None:
    size = " ".join(map(str, WALL_HALF_SIZE))
    ET.SubElement(parent, "geom", {"type": "box", "size": size, "material": "wall"} | attributes)


def _add_ball(world: ET.Element) -> ET.Element:
    """Add the ball's body to ``world``; return its geom."""
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
    """Add discs on the floor, for show: the task moves the body, not the physics."""
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
