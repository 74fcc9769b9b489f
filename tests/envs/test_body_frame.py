"""The body's own frame: what is seen does not depend on where the world's axes lie."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.body_frame import BodyFrame

ANT, SOCCER = "antmaze-medium", "antsoccer-arena"


def moved(qpos: np.ndarray, qvel: np.ndarray, bodies: list[tuple[int, int]], angle: float, shift: np.ndarray):
    """The state after a turn of the world about the vertical and a shift, by complex numbers and by the half angle."""
    qpos, qvel = qpos.copy(), qvel.copy()
    for q, v in bodies:
        x, y = qpos[q : q + 2]
        place = (x + 1j * y) * np.exp(1j * angle)
        qpos[q : q + 2] = np.array([place.real, place.imag]) + shift
        w, i, j, k = qpos[q + 3 : q + 7]
        half = np.exp(0.5j * angle)
        wk, ij = (w + 1j * k) * half, (i + 1j * j) * half
        qpos[q + 3 : q + 7] = [wk.real, ij.real, ij.imag, wk.imag]
        speed = (qvel[v] + 1j * qvel[v + 1]) * np.exp(1j * angle)
        qvel[v : v + 2] = [speed.real, speed.imag]
    return qpos, qvel


@pytest.mark.quick
@pytest.mark.parametrize(("task", "bodies"), [(ANT, [(0, 0)]), (SOCCER, [(0, 0), (15, 14)])])
def test_what_is_seen_is_the_same_wherever_the_body_stands_and_faces(task, bodies):
    env = envs.make(task, physics="mujoco")
    frame, rng = env.body_frame, np.random.default_rng(0)
    qpos, qvel = rng.normal(size=env.engine.nq), rng.normal(size=env.engine.nv)
    for q, _ in bodies:
        qpos[q + 3 : q + 7] /= np.linalg.norm(qpos[q + 3 : q + 7])
    later_qpos, later_qvel = qpos + 0.01, qvel + 0.1
    for q, _ in bodies:
        later_qpos[q + 3 : q + 7] /= np.linalg.norm(later_qpos[q + 3 : q + 7])

    def see(turn):
        states = [turn(qpos, qvel), turn(later_qpos, later_qvel)]
        first, later = (jnp.asarray(np.concatenate(state), jnp.float32) for state in states)
        return frame.see(later, frame.pose(first))

    here = see(lambda *state: state)
    there = see(lambda *state: moved(*state, bodies, 2.1, np.array([3.0, -7.0])))
    assert here.shape == (env.observation_size + 2 * (len(bodies) - 1),)
    np.testing.assert_allclose(here, there, atol=2e-5)


@pytest.mark.quick
def test_a_pose_and_a_place_by_hand():
    """At (1, 2), facing +y: what lies at (1, 5) is 3 ahead; a velocity along +x goes to the right, that is -y."""
    frame = BodyFrame(heading=2, points=(6,), vectors=(8,))
    observation = jnp.array([1.0, 2.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5), 1.0, 5.0, 0.5, 0.0])
    pose = frame.pose(observation)
    np.testing.assert_allclose(pose, [1.0, 2.0, 0.0, 1.0], atol=1e-6)
    seen = frame.see(observation, pose)
    np.testing.assert_allclose(seen, [0, 0, 1, 0, 0, 0, 3, 0, 0, -0.5, 3, 0], atol=1e-6)


@pytest.mark.quick
def test_a_humanoid_is_seen_from_where_it_moves():
    """Its state's turn about the vertical changes nothing of what is seen; its course is the x axis."""
    env = envs.make("humanoidmaze-medium", physics="mujoco")
    frame, rng = env.body_frame, np.random.default_rng(1)
    qpos = np.concatenate([[0.5, 0.2, 1.3, 1.0, 0.1, 0.0, 0.2], rng.uniform(-0.1, 0.1, 21)])
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    qvel = rng.normal(size=27)

    def see(angle, shift):
        state = env.reset_to(*moved(qpos, qvel, [(0, 0)], angle, shift))
        return np.asarray(frame.see(state.obs, frame.pose(state.obs))), np.asarray(state.obs)

    (here, observed), (there, _) = see(0.0, np.zeros(2)), see(2.1, np.array([0.4, -0.3]))
    np.testing.assert_allclose(here, there, atol=2e-4)
    np.testing.assert_allclose(here[[0, 1, 40]], 0.0, atol=1e-6)
    np.testing.assert_allclose(here[39], np.linalg.norm(observed[39:41]), rtol=1e-5)
    others = np.setdiff1d(np.arange(69), [0, 1, 39, 40, 42, 43])
    np.testing.assert_array_equal(here[others], observed[others])


@pytest.mark.quick
def test_without_a_heading_places_are_relative_and_nothing_turns():
    frame = BodyFrame(vectors=(2,))
    pose = frame.pose(jnp.array([4.0, 5.0, 1.0, 2.0]))
    np.testing.assert_allclose(frame.see(jnp.array([5.0, 5.0, 1.0, 2.0]), pose), [1.0, 0.0, 1.0, 2.0])
