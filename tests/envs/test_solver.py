"""The constraint solver against the dual problem: the forces that a non-negative least-squares routine finds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from envs.physics.mjx.solver import solve, solve_positive

NV, ROWS = 14, 56


def problem(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Inertia, smooth acceleration and constraints of an ant's size; a third of the rows are absent."""
    root = rng.normal(size=(NV, NV))
    present = rng.uniform(size=ROWS) < 2 / 3
    return {
        "mass": root @ root.T / NV + 0.1 * np.eye(NV),
        "smooth": 20 * rng.normal(size=NV),
        "jacobian": rng.normal(size=(ROWS, NV)) * present[:, None],
        "stiffness": np.where(present, 10.0 ** rng.uniform(-1, 2, ROWS), 1e15),  # MJX gives absent rows 1e15
        "reference": 10 * rng.normal(size=ROWS) * present,
    }


def solved(p: dict[str, jax.Array], guess: jax.Array) -> jax.Array:
    with jax.default_matmul_precision("highest"):  # as the engine calls it: a GPU would take TF32
        return solve(p["mass"], p["mass"] @ p["smooth"], p["jacobian"], p["stiffness"], p["reference"], guess)


def by_forces(p: dict[str, np.ndarray]) -> np.ndarray:
    """a + M^-1 J^T f with f >= 0 minimising f (J M^-1 J^T + 1 / D) f / 2 + f (J a - r)."""
    rows = p["jacobian"].any(axis=1)
    jacobian, reference = p["jacobian"][rows], p["reference"][rows]
    lift = np.linalg.solve(p["mass"], jacobian.T)
    root = np.linalg.cholesky(jacobian @ lift + np.diag(1 / p["stiffness"][rows]))
    target = scipy.linalg.solve_triangular(root, reference - jacobian @ p["smooth"], lower=True)
    forces, _ = scipy.optimize.nnls(root.T, target)
    assert (forces > 0).sum() >= 5
    return p["smooth"] + lift @ forces


def test_it_finds_what_the_dual_problem_has() -> None:
    rng = np.random.default_rng(0)
    problems = [problem(rng) for _ in range(50)]
    stacked = {key: jnp.asarray(np.stack([p[key] for p in problems]), jnp.float32) for key in problems[0]}
    for guess in (stacked["smooth"], 50.0 * jnp.ones_like(stacked["smooth"])):
        found = jax.jit(jax.vmap(solved))(stacked, guess)
        for p, x in zip(problems, np.asarray(found), strict=True):
            np.testing.assert_allclose(x, by_forces(p), atol=2e-4 * np.abs(x).max())


def test_without_a_constraint_in_force_nothing_changes() -> None:
    p = {key: jnp.asarray(value, jnp.float32) for key, value in problem(np.random.default_rng(1)).items()}
    p["reference"] = jnp.full(ROWS, -1e4)  # every constraint is satisfied with room to spare
    np.testing.assert_allclose(solved(p, jnp.zeros(NV)), p["smooth"], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("n", [1, 14, 27])
def test_linear_systems(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(8, n, n))
    matrix, vector = root @ root.swapaxes(1, 2) / n + 0.1 * np.eye(n), rng.normal(size=(8, n))
    found = jax.jit(jax.vmap(solve_positive))(jnp.asarray(matrix, jnp.float32), jnp.asarray(vector, jnp.float32))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, vector[..., None])[..., 0], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("active", [0, 3])
def test_one_constraint_by_hand(active: int) -> None:
    """Mass 2, one row along axis ``active`` with D = 6 that asks for 1: minimum at 6 / (2 + 6)."""
    row = np.zeros((1, 4), np.float32)
    row[0, active] = 1.0
    found = solve(2 * jnp.eye(4), jnp.zeros(4), jnp.asarray(row), jnp.array([6.0]), jnp.array([1.0]), jnp.full(4, 9.0))
    np.testing.assert_allclose(found, 0.75 * row[0], rtol=1e-6)
