"""Our contact functions against MuJoCo C, and proof that MJX's own still need the mend."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from envs.physics.mjx.contacts import COLLIDERS, plane_capsule_frame

MARGIN = 0.02
PLANE_CAPSULE = (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE)
CAPSULE_BOX = (mjx.GeomType.CAPSULE, mjx.GeomType.BOX)
SPHERE_BOX = (mjx.GeomType.SPHERE, mjx.GeomType.BOX)
SPHERE_CAPSULE = (mjx.GeomType.SPHERE, mjx.GeomType.CAPSULE)
CAPSULES = (mjx.GeomType.CAPSULE, mjx.GeomType.CAPSULE)

BODY_AT_WALL = """
<mujoco><worldbody><geom type="box" size="2 2 1" margin=".01"/>
<body><freejoint/><geom type="{type}" size="{size}" margin=".01"/></body></worldbody></mujoco>"""

BODY_AT_LIMB = """
<mujoco><worldbody><geom type="capsule" size=".05 .1" quat=".8 .6 0 0" margin=".01"/>
<body><freejoint/><geom type="{type}" size="{size}" margin=".01"/></body></worldbody></mujoco>"""

CAPSULE_ON_FLOOR = """
<mujoco><worldbody><geom type="plane" size="1 1 1" margin=".01"/>
<body><freejoint/><geom type="capsule" size=".08 .28" margin=".01"/></body></worldbody></mujoco>"""


def contacts_in_c(model: mujoco.MjModel, pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Contacts float[n, 7] (distance, position, normal), sorted, in MuJoCo C."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([pos, quat])
    mujoco.mj_forward(model, data)
    rows = [np.concatenate([[c.dist], c.pos, c.frame[:3]]) for c in (data.contact[k] for k in range(data.ncon))]
    return np.array(sorted(map(tuple, rows))).reshape(-1, 7)


def our_contacts(
    model: mujoco.MjModel, kinds: tuple[Any, Any], body_first: bool = True, colliders: Any = COLLIDERS
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Likewise, as a function of the body's position[3] and quaternion[4]: the body is the model's second geom."""
    pair = np.array([[1, 0]] if body_first else [[0, 1]])
    mjx_model = mjx.put_model(model, impl="jax")
    start = mjx.make_data(model, impl="jax")

    @jax.jit
    def find(pos: jax.Array, quat: jax.Array) -> jax.Array:
        data = mjx.kinematics(mjx_model, start.replace(qpos=jnp.concatenate([pos, quat])))
        distance, position, frame = colliders[kinds](mjx_model, data, None, pair)
        return jnp.concatenate([distance[:, None], position, frame[:, 0]], axis=1)

    def within_margin(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
        rows = np.asarray(find(jnp.asarray(pos, jnp.float32), jnp.asarray(quat, jnp.float32)))
        # C lists the box first, so that its normals point the other way when the body is the first of the pair
        return np.array(sorted(map(tuple, rows[rows[:, 0] < MARGIN]))).reshape(-1, 7)

    return within_margin


def test_capsule_and_wall_equal_c() -> None:
    """Faces, seams and outer corners of a wall, the capsule's axis outside of it (deeper never happens)."""
    model = mujoco.MjModel.from_xml_string(BODY_AT_WALL.format(type="capsule", size=".08 .2828"))
    find = our_contacts(model, CAPSULE_BOX)
    rng = np.random.default_rng(0)
    seen = {0: 0, 1: 0, 2: 0}
    while sum(seen.values()) < 800:
        pos = np.array([2 + rng.uniform(0, 0.4), rng.uniform(-2.3, 2.3), rng.uniform(-0.7, 0.0)]).astype(np.float32)
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        expected = contacts_in_c(model, pos, quat)
        near_threshold = len(expected) and np.abs(expected[:, 0] - MARGIN).min() < 1e-5
        if near_threshold or (len(expected) and expected[0, 0] < -0.07):
            continue
        ours = find(pos, quat)
        assert len(ours) == len(expected), (pos, quat)
        np.testing.assert_allclose(ours, expected, atol=2e-4, err_msg=f"{pos} {quat}")
        seen[len(expected)] += 1
    assert min(seen.values()) > 30


def test_ball_and_wall_equal_c() -> None:
    model = mujoco.MjModel.from_xml_string(BODY_AT_WALL.format(type="sphere", size=".25"))
    find = our_contacts(model, SPHERE_BOX)
    upright = np.array([1.0, 0, 0, 0])
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(500):
        pos = np.array([2 + rng.uniform(-0.3, 0.4), rng.uniform(-2.3, 2.3), rng.uniform(-0.7, 0.0)]).astype(np.float32)
        expected = contacts_in_c(model, pos, upright)
        np.testing.assert_allclose(find(pos, upright), expected, atol=1e-5, err_msg=str(pos))
        found += len(expected)
    assert found > 100


@pytest.mark.parametrize(
    ("kind", "size", "kinds"), [("sphere", ".06", SPHERE_CAPSULE), ("capsule", ".04 .07", CAPSULES)]
)
def test_limbs_and_limbs_equal_c(kind: str, size: str, kinds: tuple[Any, Any]) -> None:
    """Sides and ends of both; MJX's own function is off by more than float32 is."""
    model = mujoco.MjModel.from_xml_string(BODY_AT_LIMB.format(type=kind, size=size))
    first = kind == "sphere"  # the kinds of a pair are in order
    ours, theirs = (our_contacts(model, kinds, first, c) for c in (COLLIDERS, collision_driver._COLLISION_FUNC))
    rng = np.random.default_rng(0)
    found, errors = 0, []
    while found < 150:
        pos = rng.uniform(-0.2, 0.2, 3).astype(np.float32)
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        expected = contacts_in_c(model, pos, quat)
        gap = expected[:, 0] if len(expected) else np.zeros(0)
        if len(gap) and (gap.max() > MARGIN - 1e-5 or gap.min() < -0.08):  # not: axes that cross
            continue
        at = ours(pos, quat)
        assert len(at) == len(expected), (pos, quat)
        np.testing.assert_allclose(at, expected, atol=5e-6, err_msg=f"{pos} {quat}")
        errors += list(np.abs(theirs(pos, quat) - expected).max(axis=1))
        found += len(expected)
    assert np.quantile(errors, 0.9) > 2e-5  # else MJX is mended upstream, and these two functions can go


def capsule_on_floor(angle: float) -> tuple[np.ndarray, SimpleNamespace, SimpleNamespace]:
    """C's contact frame of a capsule ``angle`` degrees off the normal, and what MJX's function reads of the scene."""
    model = mujoco.MjModel.from_xml_string(CAPSULE_ON_FLOOR)
    data = mujoco.MjData(model)
    turn = np.radians(angle) / 2
    data.qpos[:] = [0, 0, 0.05, np.cos(turn), np.sin(turn) * 0.6, np.sin(turn) * 0.8, 0]
    mujoco.mj_forward(model, data)
    scene = SimpleNamespace(
        geom_xpos=jnp.asarray(data.geom_xpos, jnp.float32),
        geom_xmat=jnp.asarray(data.geom_xmat, jnp.float32).reshape(-1, 3, 3),
    )
    sizes = SimpleNamespace(geom_size=jnp.asarray(model.geom_size, jnp.float32))
    return data.contact[0].frame.reshape(3, 3).copy(), sizes, scene


def test_floor_frame_equals_c_however_steep() -> None:
    for angle in (3, 20, 29, 31, 60, 90):
        expected, sizes, scene = capsule_on_floor(angle)
        frame = plane_capsule_frame(jnp.array([0.0, 0.0, 1.0]), scene.geom_xmat[1, :, 2])
        np.testing.assert_allclose(frame, expected, atol=1e-5)
        _, _, frames = COLLIDERS[PLANE_CAPSULE](sizes, scene, None, jnp.array([[0, 1]]))
        np.testing.assert_allclose(frames, [expected, expected], atol=1e-5)


def test_mjx_still_needs_the_mend() -> None:
    """Fails once MJX is mended upstream: then ``envs.physics.mjx.contacts`` can go."""
    expected, sizes, scene = capsule_on_floor(20)
    _, _, frames = collision_driver._COLLISION_FUNC[PLANE_CAPSULE](sizes, scene, None, jnp.array([[0, 1]]))
    assert np.abs(np.asarray(frames[0]) - expected).max() > 0.1

    model = mujoco.MjModel.from_xml_string(BODY_AT_WALL.format(type="sphere", size=".25"))
    data = mjx.make_data(model, impl="jax").replace(qpos=jnp.array([2.26, 0, 0, 1.0, 0, 0, 0]))

    @jax.jit
    def distance(data: mjx.Data) -> jax.Array:
        mjx_model = mjx.put_model(model, impl="jax")
        return mjx.collision(mjx_model, mjx.kinematics(mjx_model, data))._impl.contact.dist

    assert float(distance(data)[0]) > MARGIN  # C has a contact here, at distance 0.01
