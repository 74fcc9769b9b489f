"""What the stepper leaves out or keeps from one step to the next changes no bit."""

import mujoco
import numpy as np
import pytest

import envs
from envs.mazes.walls import MazeRig
from envs.physics.mujoco import stepper as steppers
from envs.physics.mujoco.stepper import BatchStep, BatchStepper

N, STEPS = 6, 60
NOTHING = np.zeros((N, 0), np.float32)


def stepper_of(task: str) -> BatchStepper:
    stepper: BatchStepper = envs.make(task, physics="mujoco").engine._stepper
    return stepper


def starts(stepper: BatchStepper, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Places around the first cells' seams, so that walls come and go."""
    rng, model = np.random.default_rng(1), stepper._model
    qpos = np.tile(mujoco.MjData(model).qpos, (N, 1))
    qpos[:, :2] += rng.uniform(-spread, spread, (N, 2))
    qvel = np.zeros((N, model.nv))
    qvel[:, :2] = rng.uniform(-6.0, 6.0, (N, 2))
    return qpos.astype(np.float32), qvel.astype(np.float32)


def step(stepper: BatchStepper, before: BatchStep | None, places: tuple[np.ndarray, np.ndarray], k: int) -> BatchStep:
    """Step on; now and then a simulation is put elsewhere by hand, and another one begins anew."""
    action = np.random.default_rng(k).uniform(-1.0, 1.0, (N, stepper._model.nu)).astype(np.float32)
    extra = np.zeros((N, 0), np.int32)
    if before is None:
        exact = np.zeros((N, stepper.nstate))
        return stepper.step(exact, np.ones(N, bool), *places, extra, action, NOTHING)
    qpos, qvel = (values.astype(np.float32) for values in stepper.positions(before.exact))
    fresh = np.zeros(N, bool)
    if k % 9 == 0:
        qpos[k % N, :2] += 0.25
    if k % 13 == 0:
        fresh[k % N] = True
        qpos[k % N], qvel[k % N] = places[0][k % N], places[1][k % N]
    return stepper.step(before.exact, fresh, qpos, qvel, extra, action, NOTHING)


@pytest.mark.parametrize("task", ["humanoidmaze-medium", "antsoccer-arena"])
def test_what_is_kept_changes_no_bit(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sets of simulations take turns on one batch; the reference puts every wall anew and keeps no MjData."""
    kept = stepper_of(task)
    monkeypatch.setattr(steppers, "_MOST_KEPT", 0)
    plain = stepper_of(task)
    before_plain = plain._rig.before

    def placed_anew(batch: steppers.Batch, extra: np.ndarray) -> None:
        assert isinstance(plain._rig, MazeRig)
        plain._rig._placed.clear()
        before_plain(batch, extra)

    monkeypatch.setattr(plain._rig, "before", placed_anew)
    monkeypatch.setattr(steppers, "_rounds_to", lambda exact, values: False)
    expected = rollouts(plain)
    monkeypatch.undo()
    found = rollouts(kept)
    assert next(iter(kept._idle.values()))[0].persistent == (task == "humanoidmaze-medium")
    assert len({step.tobytes() for step in found}) == len(found)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def rollouts(stepper: BatchStepper) -> list[np.ndarray]:
    """Return everything that steps returned of two sets of simulations that take turns."""
    sets = [starts(stepper, 3.0), starts(stepper, 1.5)]
    states: list[BatchStep | None] = [None, None]
    found = []
    for k in range(STEPS):
        which = 0 if k < STEPS // 2 else k % 2  # one set alone first, which goes on from its own forward pass
        states[which] = step(stepper, states[which], sets[which], k)
        found.append(np.concatenate([states[which].exact, states[which].sensed], axis=1))
    return found


def test_quarters_are_the_nearest_ones_of_any_place() -> None:
    """By floor and clip, which the rig computes in fewer calls; NaN may be anywhere, infinity is at the edge."""
    stepper = stepper_of("antsoccer-medium")
    rig = stepper._rig
    assert isinstance(rig, MazeRig)
    rng = np.random.default_rng(0)
    qpos = np.zeros((500, stepper._model.nq))
    qpos[:, rig._columns] = rng.uniform(-60.0, 60.0, (500, 4))
    qpos[0, 0], qpos[1, 1] = np.inf, -np.inf
    columns, rows = int(rig._last[0]) + 1, int(rig._last[1]) + 1
    for body, first in enumerate((0, 15)):
        where = np.floor((qpos[:, first : first + 2] - rig._corner[:2]) / 2.0)
        expected = np.clip(where[:, 1], 0, rows - 1) * columns + np.clip(where[:, 0], 0, columns - 1)
        np.testing.assert_array_equal(rig._quarters_of(qpos)[:, body], expected)
    qpos[2, 0] = np.nan
    assert 0 <= rig._quarters_of(qpos)[2, 0] < rows * columns


def test_calls_at_once_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call that finds another one at work takes half of the threads; the numbers are the same."""
    stepper = stepper_of("antsoccer-arena")
    monkeypatch.setattr(stepper, "_threads", 2)
    places = starts(stepper, 3.0)
    alone = step(stepper, None, places, 0)
    with steppers._calls.one_more() as calls:
        assert calls == 1
        beside = step(stepper, None, places, 0)
    assert [key for key, idle in stepper._idle.items() if idle] == [(N, 2), (N, 1)]
    np.testing.assert_array_equal(beside.exact, alone.exact)
    with pytest.raises(ZeroDivisionError), steppers._calls.one_more():
        _ = 1 // 0
    with steppers._calls.one_more() as calls:
        assert calls == 1


def test_sensors_of_the_last_sub_step_alone_change_no_bit() -> None:
    """An arm's force on its pad is seen after the last of 25; the reference computes all sensors in each of them."""
    pytest.importorskip("ogbench")
    stepper = stepper_of("cube-double")
    model, engine = stepper._model, envs.make("cube-double", physics="mujoco").engine
    assert model.nsensor == 1 and not model.opt.disableflags & steppers._NO_SENSORS
    plain = BatchStepper(model, engine._rig, 25)
    plain._sub_steps = lambda batch, ids: batch.step(ids=ids, nstep=25)  # type: ignore[method-assign]
    qpos, qvel = np.tile(mujoco.MjData(model).qpos, (N, 1)).astype(np.float32), np.zeros((N, model.nv), np.float32)
    qpos[:, :6] = engine._rig.arm_start(np.tile([0.42, 0.0, 0.045], (N, 1)), np.zeros(N))  # just above the table
    qpos[:, 14:17], qpos[:, 21:24] = [0.42, 0.0, 0.02], [0.42, 0.2, 0.02]
    extra, states = np.zeros((N, 0), np.int32), []
    for one in (stepper, plain):
        exact = np.zeros((N, one.nstate + engine._rig.memory_size))
        exact[:, one.nstate :], _ = one.start(qpos, qvel, extra, NOTHING)
        after = BatchStep(exact, extra, np.zeros(0))
        for k in range(12):
            action = np.random.default_rng(k).uniform(-0.3, 0.3, (N, 5)).astype(np.float32)
            action[:, 4] = 1.0  # grip the cube
            places = [values.astype(np.float32) for values in one.positions(after.exact)] if k else [qpos, qvel]
            after = one.step(after.exact, np.full(N, k == 0), *places, extra, action, NOTHING)
            states.append(np.concatenate([after.exact, after.sensed], axis=1))
    np.testing.assert_array_equal(states[:12], states[12:])
    contact = np.array(states)[:, :, stepper.nstate + engine._rig.memory_size + 18]
    assert contact.max() > 0.1, "no pad was touched, so that the force was not put to the test"
