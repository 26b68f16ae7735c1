r"""Levenberg-Marquardt on the rows of `posefit`, one compiled program that never holds the Jacobian of all postures.

Least $\tfrac12 |W r(y)|^2 + \tfrac12 \sum_k \lambda_k y_k^2$. Each step adds up the normal matrix of $\ell = T y$
block by block, takes it to y, and solves it with $\mu$ times its diagonal (Marquardt 1963); $\mu$ follows the ratio
of gained to predicted decrease (Nielsen 1999). Squaring the condition number bends steps, not the point where they
end: that is where the exact gradient vanishes. Measured against optimistix with its QR: a twentieth of its time, and
less to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from ..compiled.batching import program
from .posefit import Part, Problem, block_rows, host_parts, linearise, on_host, parts_of, ties

__all__ = [
    "NormalEquations",
    "Solution",
    "State",
    "attempt",
    "beginning",
    "cut_weights",
    "normal_equations",
    "solve",
    "stuck",
]

_DAMPING = 1e-6  # at the start, of the normal matrix's diagonal: a closed-form start is near
_STEP = 1e-9  # of the scaled unknowns
_DECREASE = 1e-14  # predicted, of the cost
_STUCK = 1e12  # damping at which no step helps


class Solution(NamedTuple):
    """Unknowns at the least cost, whether the solver converged, in how many steps, and half the sum of squares."""

    unknowns: Float[np.ndarray, " unknowns"]
    converged: bool
    steps: int
    cost: float


class NormalEquations(NamedTuple):
    """J'J, J'r and half of r'r of weighted rows."""

    matrix: Float[Any, "unknowns unknowns"]
    gradient: Float[Any, " unknowns"]
    cost: Float[Any, ""]


class State(NamedTuple):
    """Where a search stands."""

    at: Float[Any, " unknowns"]
    step: Float[Any, " unknowns"]  # to be tried
    normal: NormalEquations
    damping: Float[Any, ""]
    growth: Float[Any, ""]
    decrease: Float[Any, ""]  # that the step promises
    steps: Int[Any, ""]
    converged: Bool[Any, ""]


def solve(
    problem: Problem,
    row_weights: Float[Any, " rows"],
    precision: Float[Any, " unknowns"],
    free: Shaped[Any, " unknowns"],
    start: Float[Any, " unknowns"],
    max_steps: int = 500,
) -> Solution:
    """Unknowns with the least sum of squared weighted rows and prior rows, by Levenberg-Marquardt from `start`.

    Where `free` is 0 an unknown is held at zero. To be called where 64-bit JAX is on.
    """
    weights, precision, free = (np.asarray(x, float) for x in (row_weights, precision, free))
    start = np.asarray(start, float) * free
    if on_host(problem):  # by the rows that `linearise` takes too
        given = problem, host_parts(problem), weights, precision, free
        normal_at, found = partial(_normal_on_host, *given), beginning(start)
        while _going(found, max_steps):
            found = attempt(normal_at, found)
        ended = _ended(found)
    else:
        parts = parts_of(problem)
        ended = _minimise(parts, cut_weights(problem, parts, weights), precision, free, start, max_steps)
    at, converged, steps, cost = ended
    return Solution(np.asarray(at), bool(converged), int(steps), float(cost))


def cut_weights(
    problem: Problem, parts: tuple[Part, ...], weights: Float[np.ndarray, " rows"]
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """For each group the weights of its rows (blocks rows block), zero where a block is filled up, and of its ties."""
    found, first = [], 0
    for group, part in zip(problem.groups, parts, strict=True):
        (samples, count), (blocks, _, size) = np.shape(group.measured), part.position.shape
        whole = np.zeros((count, blocks * size))
        whole[:, :samples] = weights[first : first + samples * count].reshape(count, samples)
        first += samples * count
        tied = ties(group.device)
        found.append((np.swapaxes(whole.reshape(count, blocks, size), 0, 1), weights[first : first + tied]))
        first += tied
    return tuple(found)


def normal_equations(
    parts: tuple[Part, ...], weights: Any, precision: Array, free: Array, at: Float[Array, " unknowns"]
) -> NormalEquations:
    """Normal matrix, gradient and cost at `at`; of what is held, a row of the unit matrix."""
    total = jnp.diag(precision), precision * at, 0.5 * jnp.sum(precision * at**2)
    for part, (weight, tied_weight) in zip(parts, weights, strict=True):
        local = part.local @ at

        def add(sums: Array, block: Any, part: Part = part, local: Array = local) -> tuple[Array, None]:
            return sums + _square(_whole_rows(part, local, *block)), None

        blocks = (weight, part.position, part.fields, part.datum)
        own = local[len(local) - len(part.device.unknowns()) :]
        tied, by_own = part.device.constraint(own), jax.jacfwd(part.device.constraint)(own)
        by_local = jnp.pad(by_own, ((0, 0), (len(local) - len(own), 0)))
        ties = _square((tied_weight[:, None] * jnp.concatenate([by_local, tied[:, None]], axis=1)).T)
        sums = jax.lax.scan(add, ties, blocks)[0]
        here = part.local.T @ sums[:-1, :-1] @ part.local, part.local.T @ sums[:-1, -1], 0.5 * sums[-1, -1]
        total = jax.tree.map(jnp.add, total, here)
    matrix = free[:, None] * total[0] * free + jnp.diag(1.0 - free)
    return NormalEquations(matrix, free * total[1], total[2])


def _whole_rows(part: Part, local: Array, weight: Array, position: Array, fields: Array, datum: Any) -> Array:
    """Weighted derivatives of a block's rows by the numbers `local`, then the rows (local + 1, rows * block)."""
    joints, pieces = 6 * len(part.chain.axis), len(part.at)
    twists = local[:joints].reshape(-1, 6, 1)
    if pieces:
        place = (jnp.arange(joints // 6)[:, None] == jnp.asarray(part.at)).astype(fields.dtype)
        twists += jnp.tensordot(place, local[joints : joints + pieces, None, None] * fields, axes=1)
    residual, response, by_own = block_rows(part.chain, part.device, twists, local[joints + pieces :], position, datum)
    columns = [response, by_own, residual[None]]
    if pieces:
        each = response.reshape(-1, 6, *residual.shape)[jnp.asarray(part.at)]
        columns.insert(1, jnp.sum(each * fields[:, :, None], axis=1))
    return (weight * jnp.concatenate(columns)).reshape(-1, residual.size)


def _square(rows: Float[Array, "columns samples"]) -> Float[Array, "columns columns"]:
    return jnp.matmul(rows, rows.T, precision=jax.lax.Precision.HIGHEST)


def _normal_on_host(
    problem: Problem,
    parts: Any,
    weights: np.ndarray,
    precision: np.ndarray,
    free: np.ndarray,
    at: np.ndarray,
) -> NormalEquations:
    residual, jacobian = linearise(problem, at, parts)
    rows, columns = weights * residual, jacobian * free
    columns *= weights[:, None]
    matrix = columns.T @ columns + np.diag(free * precision + 1.0 - free)
    return NormalEquations(
        matrix, columns.T @ rows + free * precision * at, 0.5 * (rows @ rows + np.sum(precision * at**2))
    )


def _library(x: Any) -> Any:
    """NumPy for what lies on the host, JAX for what is traced."""
    return np if isinstance(x, (np.ndarray, np.generic)) else jnp


def attempt(normal_at: Callable[[Any], NormalEquations], state: State) -> State:
    """One trial step: taken where the cost falls, and the next one with the damping that follows."""
    at, lib = state.at + state.step, _library(state.at)
    normal = normal_at(at)
    gained = (state.normal.cost - normal.cost) / state.decrease
    better = gained > 0.0  # from the infinite cost at the beginning to the first one too
    if lib is np:
        at, normal = (at, normal) if better else (state.at, state.normal)
    else:
        at, normal = jax.tree.map(partial(jnp.where, better), (at, normal), (state.at, state.normal))
    shrink = lib.clip(1.0 - (2.0 * gained - 1.0) ** 3, 1.0 / 3.0, 1.0)
    damping = lib.where(state.steps == 0, state.damping, state.damping * lib.where(better, shrink, state.growth))
    step, decrease = _damped(normal, damping)
    growth = lib.where(better, 2.0, 2.0 * state.growth)
    small = lib.abs(step).max() <= _STEP * (1.0 + lib.abs(at).max())
    done = (damping < 1.0) & (small | (decrease <= _DECREASE * normal.cost))
    return State(at, step, normal, damping, growth, decrease, state.steps + 1, done)


def beginning(start: Float[Any, " unknowns"]) -> State:
    """The state before the first trial, which is the start itself."""
    lib = _library(start)
    zero, one = lib.zeros_like(start), lib.ones((), start.dtype)
    nowhere = NormalEquations(lib.eye(len(start), dtype=start.dtype), zero, lib.inf * one)
    return State(start, zero, nowhere, _DAMPING * one, 2.0 * one, one, lib.zeros((), int), lib.zeros((), bool))


def stuck(state: State) -> Bool[Any, ""]:
    """Whether no damping helps any more."""
    return state.damping >= _STUCK


def _search(
    parts: tuple[Part, ...], weights: Any, precision: Array, free: Array, start: Array, max_steps: Int[Array, ""]
) -> tuple[Any, Any, Any, Any]:
    normal_at = partial(normal_equations, parts, weights, precision, free)
    going = partial(_going, max_steps=max_steps)
    return _ended(jax.lax.while_loop(going, partial(attempt, normal_at), beginning(start)))


def _ended(state: State) -> tuple[Any, Any, Any, Any]:
    """What a solution takes of a state; a plain tuple, for only programs that give one are kept between processes."""
    return state.at, state.converged, state.steps, state.normal.cost


def _going(state: State, max_steps: Any) -> Any:
    return ~state.converged & (state.steps < max_steps) & ~stuck(state)


_minimise = program(_search, kept=True)


def _damped(normal: NormalEquations, damping: Any) -> tuple[Float[Any, " unknowns"], Float[Any, ""]]:
    """Step at a damping, and the decrease of the cost that it promises; by a Cholesky factor of unit diagonal."""
    lib = _library(normal.gradient)
    size = lib.sqrt(lib.diagonal(normal.matrix))
    size = lib.where(size > 0.0, size, 1.0)
    scaled = normal.matrix / lib.outer(size, size) + damping * lib.eye(len(size))
    step = -_solved(scaled, normal.gradient / size) / size
    return step, 0.5 * lib.sum(step * (damping * size**2 * step - normal.gradient))


def _solved(matrix: Float[Any, "n n"], right: Float[Any, " n"]) -> Float[Any, " n"]:
    """By Cholesky's factor; NaN where there is none."""
    if _library(right) is jnp:
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), right)
    try:
        np.linalg.cholesky(matrix)  # SciPy, whose factor could be used again, takes longer to import than a fit takes
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)
    return np.linalg.solve(matrix, right)
