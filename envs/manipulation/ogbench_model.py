"""Read the models, bounds and tasks of OGBench's manipulation environments from the package ogbench."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from functools import cache
from typing import Any, NamedTuple

import mujoco
import numpy as np

PINCH = "ur5e/robotiq/pinch"
"""Name of the site between the fingers."""
FLANGE = "attachment_site"
"""Name of the site, in the model of the arm alone, that inverse kinematics places."""


class ManipSpace(NamedTuple):
    """Hold what OGBench says of one of its manipulation environments.

    Attributes:
        stepped: the model without what is only seen, with a sensor that makes contact forces known; step by step the
            same bits as the whole one.
        whole: the model with everything that is seen; not to be changed.
        arm: the model of the arm alone, for inverse kinematics.
        pinch_to_flange: float64[7], from the pose between the fingers to the flange's: quaternion (w, x, y, z), place.
        arm_home: float64[6], the arm's joints that inverse kinematics starts from in a reset.
        arm_bounds: float64[2, 3], lowest and highest place between the fingers at a start, in m.
        object_bounds: float64[2, 2], lowest and highest (x, y) where cubes are put on the table, in m.
        tasks: OGBench's description of each task.
    """

    stepped: mujoco.MjModel
    whole: mujoco.MjModel
    arm: mujoco.MjModel
    pinch_to_flange: np.ndarray
    arm_home: np.ndarray
    arm_bounds: np.ndarray
    object_bounds: np.ndarray
    tasks: list[dict[str, Any]]


@cache
def manip_space(name: str) -> ManipSpace:
    """Return what OGBench says of "cube-single", "cube-double" or "scene".

    Raises:
        ValueError: ogbench is not installed.
    """
    env = _environment(name)
    env._mjcf_model = env.build_mjcf_model()
    env.compile_model_and_data()
    for geoms, colour in zip(env._cube_geom_ids_list, env._cube_colors, strict=False):  # there are more colours
        env._model.geom_rgba[geoms] = colour
    return ManipSpace(
        stepped=_stepped(env),
        whole=env._model,
        arm=env._ik._model,
        pinch_to_flange=env._T_pa.wxyz_xyz.copy(),
        arm_home=env._home_qpos.copy(),
        arm_bounds=np.array(env._arm_sampling_bounds, np.float64),
        object_bounds=np.array(env._object_sampling_bounds, np.float64),
        tasks=env.task_infos,
    )


def _environment(name: str) -> Any:
    """Return OGBench's environment, with no model yet."""
    if importlib.util.find_spec("ogbench") is None:
        raise ValueError(
            "the models of cube and scene are in the package ogbench, which is not installed; "
            'run: pip install -c constraints.txt -e ".[manipulation]"'
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it looks for a window, and may find none
        importlib.import_module("ogbench.manipspace")
        gymnasium = importlib.import_module("gymnasium")
        return gymnasium.make(f"{name}-singletask-task1-v0", disable_env_checker=True).unwrapped


def _stepped(env: Any) -> mujoco.MjModel:
    utils = importlib.import_module("ogbench.manipspace.mjcf_utils")
    spec = mujoco.MjSpec.from_string(utils.to_string(env._mjcf_model), assets=utils.get_assets(env._mjcf_model))
    spec.compiler.discardvisual = True
    # Its value is not read: MuJoCo computes the contact forces on bodies only where a sensor asks for a force.
    spec.add_sensor(name="force", type=mujoco.mjtSensor.mjSENS_FORCE, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=PINCH)
    model = spec.compile()
    for field in ("actuator_gainprm", "actuator_biasprm"):
        getattr(model, field)[:] = getattr(env._model, field)
    model.opt.timestep = env._model.opt.timestep
    return model
