"""MuJoCo's constraint problem, solved to the end in a few Newton steps.

The acceleration x minimises

    1/2 (x - a) M (x - a) + 1/2 sum_i D_i min(0, J_i x - r_i)^2

over limits and pyramidal contacts, all of them one-sided (MuJoCo documentation, "Computation", primal problem). The
cost is convex and piecewise quadratic, so that its minimum along a line can be written down: the derivative is
piecewise linear, and rises. MJX's own solver searches for it in a loop inside the Newton loop, which on a CPU takes
twice as long as all the rest of a forward pass.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_MAX_STEPS = 20  # states that an ant visits need 1 to 5
_FULL_STEP = 1e-3  # a line minimum this near to 1 is a full Newton step, but for rounding
_FAR = 1e6  # steps along a line beyond which a constraint cannot change sides
_ROUNDING = 1e-6  # relative change of an acceleration that float32 cannot better


def solve(
    mass: jax.Array,
    smooth: jax.Array,
    jacobian: jax.Array,
    stiffness: jax.Array,
    reference: jax.Array,
    guess: jax.Array,
) -> jax.Array:
    """The constrained acceleration float[nv].

    Args:
        mass: M, float[nv, nv], the joint-space inertia.
        smooth: a, float[nv], the acceleration without constraints.
        jacobian: J, float[n, nv], one row per constraint; rows of zeros stand for absent ones.
        stiffness: D, float[n], at least 0.
        reference: r, float[n], the acceleration that each constraint asks for.
        guess: float[nv], where to start: the solution of the step before (warm start).
    """

    def cost(x: jax.Array) -> jax.Array:
        gap = jnp.minimum(jacobian @ x - reference, 0.0)
        return 0.5 * (x - smooth) @ mass @ (x - smooth) + 0.5 * jnp.sum(stiffness * gap**2)

    def newton(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        x, _, steps = carry
        gap = jacobian @ x - reference
        weight = jnp.where(gap < 0, stiffness, 0.0)
        slope = mass @ (x - smooth) + jacobian.T @ (weight * gap)
        curvature = mass + (jacobian.T * weight) @ jacobian
        way = -jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(curvature), slope)
        along = jacobian @ way
        length = _line_minimum(way @ mass @ (x - smooth), way @ mass @ way, gap, along, stiffness)
        full = jnp.abs(length - 1.0) < _FULL_STEP
        length = jnp.where(full, 1.0, length)
        # A full step within one quadratic piece ends at the minimum of the whole; a step below rounding has been there.
        same_piece = ((gap + length * along < 0) == (gap < 0)).all()
        small = jnp.abs(length * way).max() < _ROUNDING * jnp.abs(x).max()
        return x + length * way, (same_piece & full) | small, steps + 1

    start = jnp.where(cost(guess) < cost(smooth), guess, smooth)
    going = lambda carry: ~carry[1] & (carry[2] < _MAX_STEPS)  # noqa: E731
    return jax.lax.while_loop(going, newton, (start, jnp.zeros((), bool), jnp.zeros((), jnp.int32)))[0]


def _line_minimum(
    slope: jax.Array, curvature: jax.Array, gap: jax.Array, along: jax.Array, stiffness: jax.Array
) -> jax.Array:
    """The t >= 0 where slope + t curvature + sum_i D_i along_i min(0, gap_i + t along_i) crosses zero.

    Args:
        slope: the derivative of the smooth part at 0.
        curvature: of the smooth part, above 0.
        gap: float[n], J x - r at t = 0.
        along: float[n], its rate.
        stiffness: D, float[n].
    """

    def derivative(t: jax.Array) -> jax.Array:
        return slope + t * curvature + jnp.sum(stiffness * along * jnp.minimum(gap + t[..., None] * along, 0.0), -1)

    moving = jnp.abs(along) > jnp.abs(gap) / _FAR
    kinks = jnp.where(moving, -gap / jnp.where(moving, along, 1.0), 0.0)
    kinks = jnp.maximum(kinks, 0.0)
    rising = derivative(kinks) > 0
    low = jnp.max(jnp.where(rising, 0.0, kinks))
    high = jnp.min(jnp.where(rising, kinks, low + 1.0))  # beyond the last kink any point of the piece will do
    weight = jnp.where(gap + 0.5 * (low + high) * along < 0, stiffness * along, 0.0)
    rise = curvature + weight @ along  # 0 at the minimum only, where there is no way left to go
    return jnp.maximum(-(slope + weight @ gap) / jnp.where(rise > 0, rise, 1.0), 0.0)
