"""Read the Franka kitchen's models and the arm's limits from the package gymnasium-robotics."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

_SCENE = "kitchen_assets/kitchen_env_model.xml"
_ARM = "franka_assets/franka_config.xml"


class ArmConfig(NamedTuple):
    """Hold the numbers of the arm's configuration file; v runs over the model's degrees of freedom.

    Attributes:
        position_bounds: float64[v, 2], of the position targets.
        velocity_bounds: float64[v, 2], of the velocity that an action asks for.
        position_noise: float64[v], amplitude of a sensor's error before it is scaled.
        velocity_noise: float64[v], likewise.
    """

    position_bounds: np.ndarray
    velocity_bounds: np.ndarray
    position_noise: np.ndarray
    velocity_noise: np.ndarray


def whole_model() -> mujoco.MjModel:
    """Return a fresh model of the kitchen with everything that is seen.

    Raises:
        ValueError: gymnasium-robotics is not installed.
    """
    return mujoco.MjModel.from_xml_path(str(_assets() / _SCENE))


def stepped_model() -> mujoco.MjModel:
    """Return a fresh model without what is only seen: the same bodies, masses and contacts, step by step the same bits.

    Raises:
        ValueError: gymnasium-robotics is not installed.
    """
    spec = mujoco.MjSpec.from_file(str(_assets() / _SCENE))
    spec.compiler.discardvisual = True
    return spec.compile()


def arm_config(nv: int) -> ArmConfig:
    """Return the limits and the sensors' errors of a model with ``nv`` degrees of freedom.

    Raises:
        ValueError: gymnasium-robotics is not installed.
    """
    root = ElementTree.parse(_assets() / _ARM).getroot()
    joints = [root.find(f"qpos{index}") for index in range(nv)]

    def column(name: str) -> np.ndarray:
        return np.array([joint.attrib[name].split() for joint in joints if joint is not None], np.float64)

    noise = (column("pos_noise_amp")[:, 0], column("vel_noise_amp")[:, 0])
    return ArmConfig(column("pos_bound"), column("vel_bound"), *noise)


def _assets() -> Path:
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise ValueError(
            "the kitchen's models are in the package gymnasium-robotics, which is not installed; "
            'run: pip install -c constraints.txt -e ".[manipulation]"'
        )
    return Path(found.origin).parent / "envs/assets/kitchen_franka"
