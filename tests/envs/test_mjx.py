"""MJX against MuJoCo C on states that rollouts visit: one control step (20 evaluations of the dynamics).

Error: the largest difference of any coordinate of qpos, per state. Measured (200 states each, float32):

    antmaze-large    free space  median 1e-7, p99 2e-6, max 5e-6    touching walls          median 1e-7, max 2e-6
    antmaze-medium   free space  median 1e-7, p99 2e-6, max 3e-6    touching walls          median 1e-7, max 2e-6
    antsoccer-arena  free space  median 1e-7, p99 2e-6, max 2e-6    touching walls or ball  median 1e-7, max 2e-6

With other seeds about one state in 250 is off by 1e-3: a contact begins at the margin, with a jump in force, and
float32 sees it one Runge-Kutta stage earlier or later. In float64 all states agree to 4e-8. Not covered: a leg whose
axis is inside a wall (8 cm deep), where C has odd contacts of its own.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.physics.mjx_engine import MjxEngine

STATES = 200
TOLERANCE = (1e-6, 1e-5)  # median and p90, over states
RARE = 0.02  # share of states that may be off by more than 1e-4


def one_step(engine: Any) -> Any:
    """Batched: qpos[N], qvel[N], actions[N] -> the state one control step later."""
    return jax.jit(jax.vmap(lambda q, v, a: engine.step(engine.init(q, v), a)))


def visited_states(env: envs.TaskEnv, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(qpos, qvel, actions) along random rollouts in C, most of which run at a wall; the ball near the ant."""
    rng = np.random.default_rng(seed)
    rollouts, steps, every = 80, 16, 4
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(seed), rollouts)).pipeline_state
    qpos, qvel = np.array(start.qpos), np.array(start.qvel)
    cells = env.layout.free_cells[rng.integers(len(env.layout.free_cells), size=rollouts)]
    at_wall = (np.arange(rollouts) % 4 > 0)[:, None]
    off_centre = np.where(at_wall, rng.choice([-1.0, 1.0], (rollouts, 2)), rng.uniform(-1, 1, (rollouts, 2)))
    qpos[:, :2] = env.layout.ij_to_xy(cells) + off_centre
    qvel[:, :2] += np.where(at_wall, 2 * off_centre, 0)
    if env.spec.family == "antsoccer":
        angle = rng.uniform(0, 2 * np.pi, rollouts)
        near = qpos[:, :2] + 0.9 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        qpos[:, 15:17] = np.clip(near, -1.7, 21.7)  # the arena's walls are at -2 and 22
        qvel[:, 14:17] = rng.normal(size=(rollouts, 3))
    actions = rng.uniform(-1, 1, (steps, rollouts, 8)).astype(np.float32)
    held = np.repeat(actions[::4], 4, axis=0)

    def body(state: Any, action: jax.Array) -> tuple[Any, Any]:
        after = jax.vmap(env.engine.step)(state, action)
        return after, (after.qpos, after.qvel)

    _, (qs, vs) = jax.jit(lambda s, a: jax.lax.scan(body, s, a))(jax.vmap(env.engine.init)(qpos, qvel), held)
    qs = np.asarray(qs)[every - 1 :: every].reshape(-1, env.engine.nq)
    vs = np.asarray(vs)[every - 1 :: every].reshape(-1, env.engine.nv)
    chosen = rng.permutation(len(qs))[:count]
    return qs[chosen], vs[chosen], rng.uniform(-1, 1, (count, 8)).astype(np.float32)


def touches(env: envs.TaskEnv, qpos: np.ndarray, qvel: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """bool[N]: in the control step something touches a wall, or the ant the ball (MuJoCo C)."""
    model = env.engine.model
    data = mujoco.MjData(model)
    hard = [g for g in range(model.ngeom) if model.geom(g).name.startswith("block_") or model.geom(g).name == "ball"]
    found = np.zeros(len(qpos), bool)
    for n in range(len(qpos)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[n], qvel[n], actions[n]
        for _ in range(5):
            mujoco.mj_step(model, data)
            pairs = data.contact.geom[: data.ncon]
            found[n] |= (np.isin(pairs, hard).any(axis=1) & (pairs != 0).all(axis=1)).any()  # geom 0 is the floor
    return found


def compare(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    qpos, qvel, actions = visited_states(env, STATES)
    exact = one_step(env.engine)(qpos, qvel, actions)
    engine = MjxEngine(env.layout, ball=env.spec.family == "antsoccer")
    ours = one_step(engine)(qpos, qvel, actions)
    error = np.abs(np.asarray(ours.qpos) - np.asarray(exact.qpos)).max(axis=1)
    touching = touches(env, qpos, qvel, actions)
    for kind, chosen in (("free", ~touching), ("touching", touching)):
        assert chosen.sum() >= 15, kind
        median, p90, p99 = np.quantile(error[chosen], [0.5, 0.9, 0.99])
        print(
            f"{name} {kind}: {chosen.sum()} states, median {median:.1e}, p90 {p90:.1e}, p99 {p99:.1e}, "
            f"max {error[chosen].max():.1e}"
        )
        assert median <= TOLERANCE[0] and p90 <= TOLERANCE[1], kind
    assert (error > 1e-4).mean() <= RARE


def test_one_step_equals_c_in_a_maze() -> None:
    compare("antmaze-large")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["antmaze-medium", "antsoccer-arena"])
def test_one_step_equals_c_elsewhere(name: str) -> None:
    compare(name)


@pytest.mark.slow
def test_mjx_task_runs_and_resets_in_jit() -> None:
    env = envs.AutoReset(envs.make("antmaze-medium", physics="mjx"))
    assert env.backend == "mjx"
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    state.info["steps"] = jnp.array([0, 0, 997, 999])

    def body(state: Any, key: jax.Array) -> tuple[Any, Any]:
        after = jax.vmap(env.step)(state, jax.random.uniform(key, (4, 8), minval=-1, maxval=1))
        return after, after.done

    last, done = jax.jit(lambda s, k: jax.lax.scan(body, s, k))(state, jax.random.split(jax.random.key(1), 5))
    assert jax.tree.structure(last) == jax.tree.structure(state)
    np.testing.assert_array_equal(last.info["steps"], [5, 5, 2, 4])
    np.testing.assert_array_equal(done.sum(axis=0), [0, 0, 1, 1])
    assert bool(jnp.isfinite(last.obs).all()) and float(last.metrics["nan"].sum()) == 0
