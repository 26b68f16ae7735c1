r"""Least squares on poses: rows of all devices, their exact Jacobian, and one compiled Levenberg-Marquardt solve.

The unknowns stand in one vector of scaled numbers: the coefficients of the twist columns, common to all groups, then
what each device leaves open. A row is predicted minus measured (m or rad) times its weight; the prior adds a row
$\sqrt{\lambda_k}\, y_k$ for each unknown. `free` is 0 for unknowns that are held at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import lie
from ..model import Leaf
from ..spatial import matmul
from .chain import Chain, ChainPose, chain_pose, chain_twists, column_motion
from .devices import Device

__all__ = [
    "Group",
    "Problem",
    "Rows",
    "Solution",
    "Weights",
    "linearise",
    "predict",
    "rows_of",
    "sizes",
    "solve",
    "solve_many",
]


class Group(eqx.Module):
    """Postures that one device measured."""

    chain: Chain
    device: Device
    position: Float[Leaf, "nv samples"]  # joint positions, rad or m
    fields: Float[Leaf, "pieces 6 samples"]  # twist of a unit of each piece of a column, at a joint of the chain
    at: Int[Leaf, " pieces"]  # which joint of the chain
    column: Int[Leaf, " pieces"]  # which column
    datum: Any  # what the device measured, the samples on the first axis
    measured: Bool[Leaf, "samples rows"]  # which rows it measured


class Problem(eqx.Module):
    """Everything measured, and the size of each unknown."""

    groups: tuple[Group, ...]
    scale: Float[Leaf, " unknowns"]
    columns: int = eqx.field(static=True)


class Rows(NamedTuple):
    """What each row of the residual is: its group, posture within the group (-1: a constraint) and channel."""

    group: Int[np.ndarray, " rows"]
    sample: Int[np.ndarray, " rows"]
    channel: Int[np.ndarray, " rows"]
    measured: Bool[np.ndarray, " rows"]


class Solution(NamedTuple):
    """Unknowns at the least cost, whether the solver converged, in how many steps, and half the sum of squares."""

    unknowns: Float[Array, " unknowns"]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    cost: Float[Array, ""]


def rows_of(problem: Problem) -> Rows:
    """The rows of `linearise`, in its order."""
    parts = []
    for g, group in enumerate(problem.groups):
        samples, count = np.shape(group.measured)
        channel = np.repeat(group.device.channels(), samples)
        sample = np.tile(np.arange(samples), count)
        parts.append((np.full(len(sample), g), sample, channel, np.asarray(group.measured).T.reshape(-1)))
        rows = np.zeros(len(_constraint(group.device)), int)
        parts.append((rows + g, rows - 1, rows, rows == 0))
    return Rows(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _constraint(device: Device) -> np.ndarray:
    with jax.ensure_compile_time_eval():
        return np.asarray(device.constraint(jnp.zeros(len(device.unknowns()))))


@eqx.filter_jit
def linearise(problem: Problem, unknowns: Float[Array, " unknowns"]) -> tuple[Array, Array]:
    """Residual (rows,) in m and rad at the scaled unknowns, and its exact Jacobian (rows, unknowns)."""
    return _linearise(problem, unknowns)


def _linearise(problem: Problem, unknowns: Array) -> tuple[Array, Array]:
    residuals, jacobians = [], []
    for group, coefficients, own, where in _split(problem, unknowns):
        residual, of_pose, of_own, pieces = _group(group, coefficients, own)
        moved = matmul(of_pose, pieces)  # rows pieces samples
        motion = jnp.zeros((len(moved), problem.columns, moved.shape[2])).at[:, jnp.asarray(group.column)].add(moved)
        residuals.append(residual)
        jacobians.append(_place(motion, of_own, where, len(unknowns)))
        tied, of_tied = group.device.constraint(own), jax.jacfwd(group.device.constraint)(own)
        residuals.append(tied)
        jacobians.append(jnp.zeros((len(tied), len(unknowns))).at[:, where : where + len(own)].set(of_tied))
    return jnp.concatenate(residuals), jnp.concatenate(jacobians) * problem.scale


def _split(problem: Problem, unknowns: Array) -> list[tuple[Group, Array, Array, int]]:
    """Each group with the coefficients of its columns, its device's unknowns and where those begin."""
    values = unknowns * problem.scale
    start = problem.columns
    coefficients, parts = values[:start], []
    for group in problem.groups:
        count = len(group.device.unknowns())
        parts.append((group, coefficients, values[start : start + count], start))
        start += count
    return parts


def _group(group: Group, coefficients: Array, own: Array) -> tuple[Array, Array, Array, Array]:
    """Residual (rows * samples,), its derivatives by the tool's motion (rows 6 samples) and by the device's unknowns
    (rows k samples), and the motion of the tool for each piece (6 pieces samples)."""
    pose = _pose(group, coefficients)

    def one(R: Array, p: Array, datum: Array) -> tuple[Array, ...]:
        def residual(motion: Array, own: Array) -> Array:
            moved = lie.pose(R + lie.skew(motion[3:]) @ R, p + motion[:3])  # to first order, which is all that is asked
            return group.device.residual(moved, own, datum)

        zero = jnp.zeros(6)
        return residual(zero, own), *jax.jacfwd(residual, argnums=(0, 1))(zero, own)

    over = jax.vmap(one, in_axes=(-1, -1, 0), out_axes=-1)
    residual, of_pose, of_own = over(pose.R, pose.p, jax.tree.map(jnp.asarray, group.datum))
    return residual.reshape(-1), of_pose, of_own, column_motion(pose, jnp.asarray(group.at), jnp.asarray(group.fields))


def _pose(group: Group, coefficients: Array) -> ChainPose:
    column, at, fields = (jnp.asarray(x) for x in (group.column, group.at, group.fields))
    twists = chain_twists(coefficients, column, at, fields, len(group.chain.joints))
    return chain_pose(group.chain, jnp.asarray(group.position), twists)


def _place(motion: Array, of_own: Array, where: int, unknowns: int) -> Array:
    """Jacobian of a group (rows * samples, unknowns): columns first, then the device's own among those of others."""
    rows, columns, samples = motion.shape
    before, after = where - columns, unknowns - where - of_own.shape[1]
    own = jnp.pad(of_own, ((0, 0), (before, after), (0, 0)))
    whole = jnp.concatenate([motion, own], axis=1)
    return jnp.moveaxis(whole, 1, 2).reshape(rows * samples, unknowns)


@eqx.filter_jit
def predict(problem: Problem, unknowns: Float[Array, " unknowns"]) -> Float[Array, " rows"]:
    """Residual (rows,) in m and rad at the scaled unknowns."""
    return _residual(problem, unknowns)


def _residual(problem: Problem, unknowns: Array) -> Array:
    parts = []
    for group, coefficients, own, _ in _split(problem, unknowns):
        pose = _pose(group, coefficients)

        def one(R: Array, p: Array, datum: Array, own: Array = own, device: Device = group.device) -> Array:
            return device.residual(lie.pose(R, p), own, datum)

        over = jax.vmap(one, in_axes=(-1, -1, 0), out_axes=-1)
        parts += [
            over(pose.R, pose.p, jax.tree.map(jnp.asarray, group.datum)).reshape(-1),
            group.device.constraint(own),
        ]
    return jnp.concatenate(parts)


class Weights(NamedTuple):
    """Weight of each row, precision of each unknown's prior, and 1 for the unknowns that are free, else 0."""

    row: Float[Array, " rows"]
    precision: Float[Array, " unknowns"]
    free: Float[Array, " unknowns"]


@jax.custom_jvp
def _weighted(unknowns: Array, problem: Problem, weights: Weights) -> Array:
    rows = weights.row * _residual(problem, unknowns * weights.free)
    return jnp.concatenate([rows, jnp.sqrt(weights.precision) * unknowns])


@_weighted.defjvp
def _weighted_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    unknowns, problem, weights = primals
    residual, jacobian = _linearise(problem, unknowns * weights.free)
    whole = jnp.concatenate([weights.row[:, None] * jacobian * weights.free, jnp.diag(jnp.sqrt(weights.precision))])
    value = jnp.concatenate([weights.row * residual, jnp.sqrt(weights.precision) * unknowns])
    return value, whole @ tangents[0]


def solve(
    problem: Problem,
    row_weights: Float[Array, " rows"],
    precision: Float[Array, " unknowns"],
    free: Float[Array, " unknowns"],
    start: Float[Array, " unknowns"],
    max_steps: int = 200,
) -> Solution:
    """Unknowns with the least sum of squared weighted rows and prior rows, by Levenberg-Marquardt from `start`."""
    weights = Weights(row_weights, precision, free)
    return jax.tree.map(
        lambda x: x[0], solve_many(problem, jax.tree.map(lambda x: x[None], weights), start[None], max_steps)
    )


@eqx.filter_jit
def solve_many(
    problem: Problem, weights: Weights, start: Float[Array, "lanes unknowns"], max_steps: int = 200
) -> Solution:
    """`solve` for several weights, priors, sets of free unknowns or starts at once."""
    import optimistix as optx

    def lane(weights: Weights, start: Array) -> Solution:
        solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
        found = optx.least_squares(
            lambda y, args: _weighted(y, *args), solver, start, (problem, weights), max_steps=max_steps, throw=False
        )
        cost = 0.5 * jnp.sum(found.state.f_info.residual**2)
        converged = found.result == optx.RESULTS.successful
        return Solution(found.value * weights.free, converged, found.stats["num_steps"], cost)

    return jax.vmap(lane)(weights, start)


def sizes(groups: Sequence[Group], columns: Sequence[float]) -> Float[np.ndarray, " unknowns"]:
    """Typical size of every unknown: of the columns' coefficients, then of the devices' own unknowns."""
    return np.array([*columns, *(size for group in groups for _, _, size in group.device.unknowns())])
