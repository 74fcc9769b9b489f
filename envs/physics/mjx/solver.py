"""Solve MuJoCo's constraint problem to the end in a few Newton steps.

The acceleration x minimises

    1/2 x M x - f x + 1/2 sum_i D_i min(0, J_i x - r_i)^2

over limits and pyramidal contacts, all of them one-sided (MuJoCo documentation, "Computation", primal problem). The
cost is convex and piecewise quadratic, so that the derivative along a line is piecewise linear, and rises.

Linear systems are solved here too: on a CPU, jax 0.10's batched Cholesky factorisation waits for the very threads it
runs on, and two at a time in one program wait for each other for ever.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_MAX_STEPS = 20  # states that an ant visits need 1 to 5
_LINE_STEPS = 4  # Newton steps along the line; the next direction makes up for a minimum that they miss
_FULL_STEP = 1e-3  # a line minimum this near to 1 is a full Newton step, but for rounding
_ROUNDING = 1e-6  # relative change of an acceleration that float32 cannot better


def solve(
    mass: jax.Array,
    force: jax.Array,
    jacobian: jax.Array,
    stiffness: jax.Array,
    reference: jax.Array,
    guess: jax.Array,
) -> jax.Array:
    """Return the constrained acceleration float[nv].

    Args:
        mass: M, float[nv, nv], the joint-space inertia.
        force: f, float[nv], all forces but the constraints'.
        jacobian: J, float[n, nv], one row per constraint; rows of zeros stand for absent ones.
        stiffness: D, float[n], at least 0.
        reference: r, float[n], the acceleration that each constraint asks for.
        guess: float[nv], where to start: the solution of the step before (warm start).
    """
    transposed = jacobian.T  # once, and not in every step: a CPU multiplies J' W J three times as fast with it

    def newton(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        x, _, steps = carry
        gap = jacobian @ x - reference
        weight = jnp.where(gap < 0, stiffness, 0.0)
        slope = mass @ x - force + transposed @ (weight * gap)
        way = -solve_positive(mass + (transposed * weight) @ jacobian, slope)
        along = jacobian @ way
        pushed = mass @ way
        length = _line_minimum(pushed @ x - force @ way, pushed @ way, gap, along, stiffness)
        full = jnp.abs(length - 1.0) < _FULL_STEP
        length = jnp.where(full, 1.0, length)
        # A full step within one quadratic piece ends at the minimum of the whole; a step below rounding has been there.
        same_piece = ((gap + length * along < 0) == (gap < 0)).all()
        small = jnp.abs(length * way).max() < _ROUNDING * jnp.abs(x).max()
        return x + length * way, (same_piece & full) | small, steps + 1

    going = lambda carry: ~carry[1] & (carry[2] < _MAX_STEPS)  # noqa: E731
    return jax.lax.while_loop(going, newton, (guess, jnp.zeros((), bool), jnp.zeros((), jnp.int32)))[0]


def solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Return x[n] with ``matrix[n, n]`` x = ``vector[n]`` for a symmetric positive definite matrix (Cholesky, U' U)."""
    n = len(vector)
    augmented = jnp.concatenate([matrix, vector[:, None]], axis=1)  # its factor's last column is y with U' y = vector

    def factorise(k: jax.Array, upper: jax.Array) -> jax.Array:
        row = augmented[k] - upper[:, k] @ upper
        return upper.at[k].set(jnp.where(jnp.arange(n + 1) < k, 0.0, row) / jnp.sqrt(row[k]))

    upper = jax.lax.fori_loop(0, n, factorise, jnp.zeros_like(augmented))

    def substitute(i: jax.Array, x: jax.Array) -> jax.Array:
        k = n - 1 - i
        return x.at[k].set((upper[k, n] - upper[k, :n] @ x) / upper[k, k])

    return jax.lax.fori_loop(0, n, substitute, jnp.zeros_like(vector))


def _line_minimum(
    slope: jax.Array, curvature: jax.Array, gap: jax.Array, along: jax.Array, stiffness: jax.Array
) -> jax.Array:
    """Return about the t > 0 where slope + t curvature + sum_i D_i along_i min(0, gap_i + t along_i) crosses zero.

    Newton's method from t = 1 on, which is where a Newton step of the whole problem ends if no constraint changes
    sides; within the bracket that the signs seen so far leave.

    Args:
        slope: the derivative of the smooth part at 0.
        curvature: of the smooth part, above 0.
        gap: float[n], J x - r at t = 0.
        along: float[n], its rate.
        stiffness: D, float[n].
    """
    t, low, high = jnp.ones(()), jnp.zeros(()), jnp.full((), jnp.inf)
    for _ in range(_LINE_STEPS):
        pull = jnp.where(gap + t * along < 0, stiffness * along, 0.0)
        derivative = slope + t * curvature + pull @ (gap + t * along)
        rise = curvature + pull @ along  # 0 at the minimum only, where there is no way left to go
        low, high = jnp.where(derivative < 0, t, low), jnp.where(derivative > 0, t, high)
        newton = t - derivative / jnp.where(rise > 0, rise, 1.0)
        halfway = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2 * t)
        t = jnp.where((newton >= low) & (newton <= high), newton, halfway)
    return t
