r"""Dry friction and joint limits as MuJoCo's soft constraints, solved exactly.

Each coordinate has a friction and two limits. With $a$ the acceleration, M the inertia and r the smooth torque,
$M a = r + f$, and each force is piecewise linear in the coordinate's own acceleration:
friction $f = \mathrm{clip}((p - a) / R, -F, F)$, a limit from below $f = \max(0, (p - a) / R)$, from above its mirror
image. p is the acceleration that the constraint asks for, R its softness (rollouts of MuJoCo: R = (1 - d)/d of the
inverse inertia, p = -b v for friction). That is the minimum of a convex piecewise quadratic function: Newton's method
on the set of forces that act, with an exact line search over its breakpoints (without one the set can cycle).
A torque that stops the joint within a step (Coulomb friction proper) is the same law with b = 1/dt and R towards 0.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

__all__ = ["Rows", "Solution", "corrected", "inverse", "product", "row_force", "solve_rows", "solved",
           "stiffened", "times"]  # fmt: skip

_MOST = 60  # Newton steps; 1 to 4 are used
_FAR = 1e300


class Rows(NamedTuple):
    """The constraints of each coordinate; arrays (nv, samples), with those of sums of coordinates behind them."""

    level: Array  # F >= 0
    pull: Array  # acceleration that friction asks for
    soft: Array
    low: Array  # acceleration that the lower limit asks for, -inf where it is far
    low_soft: Array
    high: Array  # the same of the upper limit, in the opposite direction
    high_soft: Array
    way: Array | None = None  # (rows, nv): behind the coordinates' own, rows of sums of them


class Solution(NamedTuple):
    """Accelerations and which forces act; arrays (nv, samples)."""

    a: Array
    slip: Array  # -1, 1: friction at its level; 0: it holds
    low: Array  # 1.0 where the lower limit pushes
    high: Array


def _apart(rows: Rows, a: Array) -> Array:
    """The acceleration of each row."""
    return a if rows.way is None else jnp.concatenate([a, times(rows.way[..., None], a)])


def _summed(rows: Rows, force: Array) -> Array:
    """Forces of the rows as those on the coordinates."""
    if rows.way is None:
        return force
    n = rows.way.shape[1]
    return force[:n] + times(rows.way.T[..., None], force[n:])


def _stiff(rows: Rows, slope: Array) -> Array:
    """Slopes of the rows as a matrix of the coordinates, (nv, nv, samples)."""
    if rows.way is None:
        return jnp.eye(len(slope))[..., None] * slope[:, None]
    n = rows.way.shape[1]
    pairs = rows.way[:, :, None, None] * rows.way[:, None, :, None]
    return jnp.eye(n)[..., None] * slope[:n, None] + (pairs * slope[n:, None, None]).sum(0)


def _acting(rows: Rows, a: Array) -> tuple[Array, Array, Array]:
    a = _apart(rows, a)
    raw = (rows.pull - a) / rows.soft
    slip = jnp.where(raw >= rows.level, 1.0, jnp.where(raw <= -rows.level, -1.0, 0.0))
    return slip, jnp.where(a < rows.low, 1.0, 0.0), jnp.where(-a < rows.high, 1.0, 0.0)


def row_force(rows: Rows, acting: Solution, a: Array) -> Array:
    """Force on each coordinate at the acceleration `a`, the acting ones given (linear in `a`)."""
    a = _apart(rows, a)
    friction = jnp.where(acting.slip == 0, (rows.pull - a) / rows.soft, acting.slip * rows.level)
    low = jnp.where(acting.low > 0, (jnp.where(acting.low > 0, rows.low, 0.0) - a) / rows.low_soft, 0.0)
    high = jnp.where(acting.high > 0, (jnp.where(acting.high > 0, rows.high, 0.0) + a) / rows.high_soft, 0.0)
    return _summed(rows, friction + low - high)


def _slope(rows: Rows, slip: Array, low: Array, high: Array) -> Array:
    return jnp.where(slip == 0, 1 / rows.soft, 0.0) + low / rows.low_soft + high / rows.high_soft


def times(matrix: Array, vector: Array) -> Array:
    """Matrices (n, m, samples) times vectors (m, samples): as a sum, which XLA fuses with what stands around it."""
    return jnp.sum(matrix * vector[None], 1)


def solved(matrix: Array, right: Array) -> Array:
    """Solution of symmetric positive systems with the samples on the last axis: (n, n, samples), (n, samples)."""
    if matrix.shape[0] == 1:
        return right / matrix[0]
    if matrix.shape[0] == 2:
        (a, b), (_, c) = matrix
        return jnp.stack([c * right[0] - b * right[1], a * right[1] - b * right[0]]) / (a * c - b * b)
    factor = jnp.linalg.cholesky(jnp.moveaxis(matrix, -1, 0))
    return jax.vmap(lambda f, b: jax.scipy.linalg.cho_solve((f, True), b))(factor, right.T).T


def inverse(matrix: Array) -> Array:
    """Inverses of symmetric positive matrices with the samples on the last axis, (n, n, samples).

    For derivatives: many directions then share what is done once, and each is a sum. Sweeps (Gauss and Jordan's
    elimination in place) need no pivots here and run over all samples at once.
    """
    places = jnp.arange(len(matrix))

    def sweep(k: Array, a: Array) -> Array:
        mine = places == k
        row = a[k] / a[k, k]
        after = a - a[:, k][:, None] * row[None]
        after = jnp.where(mine[:, None, None], row[None], jnp.where(mine[None, :, None], row[:, None], after))
        return jnp.where(mine[:, None, None] & mine[None, :, None], -1 / a[k, k], after)

    return -jax.lax.fori_loop(0, len(matrix), sweep, matrix)


def product(one: Array, two: Array) -> Array:
    """Products of matrices (n, n, samples), as sums."""
    return jnp.sum(one[:, :, None] * two[None], 1)


def stiffened(masses: Array, rows: Rows, found: Solution) -> Array:
    """Inverse of the masses with the stiffness of the constraints that act, (n, n, samples); a constant."""
    slope = _slope(rows, found.slip, found.low, found.high)
    return jax.lax.stop_gradient(inverse(masses + _stiff(rows, slope)))


def corrected(masses: Array, rows: Rows, found: Solution, gap: Array) -> Array:
    """The solution's acceleration after one Newton step: its value is the same, its derivatives are exact.

    `gap` is M a - r at the solution's `a` held fixed, differentiable in everything else.
    """
    return found.a - times(stiffened(masses, rows, found), gap - row_force(rows, found, found.a))


def solve_rows(masses: Array, right: Array, rows: Rows, warm: Array) -> Solution:
    """Solve M a = right + f(a); `masses` (nv, nv, samples), `right` (nv, samples). Not differentiable: `corrected`."""
    masses, right, rows, warm = jax.lax.stop_gradient((masses, right, rows, warm))
    if len(right) == 1:
        return _single(masses[0], right, rows)

    def unfinished(state: tuple[Solution, Array, Array]) -> Array:
        return ~state[1].all() & (state[2] < _MOST)

    def newton(state: tuple[Solution, Array, Array]) -> tuple[Solution, Array, Array]:
        found, done, count = state
        slope = _slope(rows, found.slip, found.low, found.high)
        gap = times(masses, found.a) - right - row_force(rows, found, found.a)
        way = -solved(masses + _stiff(rows, slope), gap)
        full = _acting(rows, found.a + way)
        same = jnp.stack([(x == y).all(0) for x, y in zip(full, found[1:], strict=True)]).all(0)
        step = jnp.where(same, 1.0, _line_search(masses, right, rows, found.a, way))
        a = found.a + jnp.where(done, 0.0, step) * way
        sets = (jnp.where(done | same, old, new) for old, new in zip(found[1:], _acting(rows, a), strict=True))
        return Solution(a, *sets), done | same, count + 1

    start = Solution(warm, *_acting(rows, warm))
    return jax.lax.while_loop(unfinished, newton, (start, jnp.zeros(right.shape[1], bool), jnp.asarray(0)))[0]


def _line_search(masses: Array, right: Array, rows: Rows, a: Array, way: Array) -> Array:
    """Step length at which the cost along `way` is least: its slope is piecewise linear and grows."""
    edges = (rows.pull - rows.soft * rows.level, rows.pull + rows.soft * rows.level, rows.low, -rows.high)
    now, apart = _apart(rows, a), _apart(rows, way)
    moving = jnp.where(apart == 0, 1.0, apart)
    at = jnp.concatenate([jnp.where(jnp.isfinite(x) & (apart != 0), (x - now) / moving, 0.0) for x in edges])
    at = jnp.concatenate([jnp.clip(at, 0.0, None), jnp.zeros((1, at.shape[1]))])
    at = jnp.concatenate([at, at.max(0, keepdims=True) + 1.0])
    start = jnp.sum(way * (times(masses, a) - right), 0)
    curve = jnp.sum(way * times(masses, way), 0)

    def slope(s: Array) -> Array:
        new = a + s * way
        return start + s * curve - jnp.sum(way * row_force(rows, Solution(new, *_acting(rows, new)), new), 0)

    values = jax.vmap(slope)(at)
    low = jnp.where(values <= 0, at, 0.0).max(0)
    high = jnp.where(values > 0, at, _FAR).min(0)
    high = jnp.where(high >= _FAR, low + 1.0, high)
    at_low, at_high = slope(low), slope(high)
    rise = at_high - at_low
    return jnp.where(rise > 0, low - at_low * (high - low) / jnp.where(rise > 0, rise, 1.0), low)


def _single(mass: Array, right: Array, rows: Rows) -> Solution:
    """One coordinate: the force falls with the acceleration, so trying the eight sets once would do; limits first."""
    best = _one(mass, right, rows, jnp.zeros_like(right), jnp.zeros_like(right))
    for low, high in ((1.0, 0.0), (0.0, 1.0)):
        other = _one(mass, right, rows, jnp.full_like(right, low), jnp.full_like(right, high))
        fits = (jnp.where(other.a < rows.low, 1.0, 0.0) == low) & (jnp.where(-other.a < rows.high, 1.0, 0.0) == high)
        best = jax.tree.map(lambda new, old, fits=fits: jnp.where(fits, new, old), other, best)
    return best


def _one(mass: Array, right: Array, rows: Rows, low: Array, high: Array) -> Solution:
    """The friction's closed form f = clip((p - a_s) / (R + 1/M), -F, F), with given limits acting."""
    slope = low / rows.low_soft + high / rows.high_soft
    push = jnp.where(low > 0, rows.low, 0.0) * low / rows.low_soft
    push = push - jnp.where(high > 0, rows.high, 0.0) * high / rows.high_soft
    mass, right = mass + slope, right + push
    raw = (rows.pull - right / mass) / (rows.soft + 1 / mass)
    slip = jnp.where(raw >= rows.level, 1.0, jnp.where(raw <= -rows.level, -1.0, 0.0))
    a = (right + jnp.clip(raw, -rows.level, rows.level)) / mass
    return Solution(a, slip, low, high)
