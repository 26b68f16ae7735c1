r"""One fit for every job: what is estimated, measured and believed in, out comes a model with its uncertainty.

Least $\tfrac12 |r(\theta)|^2 + \tfrac12 \sum_k (\theta_k / \sigma_k)^2$ over the numbers that `free` names; r are the
rows of the data (`data`). `hostfit` solves it on the CPU; under a transformation, and with a solver of one's own,
optimistix does, and differentiates it through the condition of the minimum.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jaxtyping import Array, Float

from ..compiled.batching import DRAFT_OPTIONS, FEW, filtered_program, on_host, staged, traced
from ..compiled.precision import in_float64
from ..effects.extended import ExtendedModel, extend
from ..errors import InputError, check_count, check_real
from ..rigid.chain import chain_between
from ..rigid.model import Leaf, RobotModel
from . import posefit
from .blockwise import BlockLevenbergMarquardt, normal_of
from .data import Data, PoseData, as_data
from .free import Free, apply, chosen_of
from .hostfit import descend
from .posesolver import NormalEquations, cut_weights, normal_equations
from .priors import rigid_prior
from .solution import Fit

__all__ = ["Fit", "fit"]

_SOLVERS = (optimistix.AbstractLeastSquaresSolver, optimistix.AbstractMinimiser)
NULL = 1e-12  # of the largest eigenvalue of the information: below it a direction is not determined
STATIONARY = 1e-5  # share of the gradient at the start that may be left where a fit within limits has converged
SEVERAL = 8  # devices or sets of recordings in a small problem


class _Closed(eqx.Module):
    """Rows of postures in closed form, a block at a time."""

    parts: tuple[posefit.Part, ...]
    weights: Any


class _Problem(eqx.Module):
    """What a solver works on: `y` are the numbers in their sizes."""

    model: ExtendedModel
    data: tuple[Data, ...]
    precision: Float[Leaf, " numbers"]  # of the prior on y
    closed: _Closed | None
    free: Free = eqx.field(static=True)

    def at(self, y: Float[Array, " numbers"]) -> tuple[ExtendedModel, tuple[Data, ...]]:
        return apply(self.free, self.model, self.data, y * self.free.sizes)

    def rows(self, y: Float[Array, " numbers"]) -> Float[Array, " rows"]:
        model, data = self.at(y)
        return jnp.concatenate([one.residual(model) for one in data])

    def normal(self, y: Float[Array, " numbers"]) -> NormalEquations:
        if self.closed is None:
            return normal_of(lambda x: _rows(x, self), y)
        ones = jnp.ones_like(y)
        return normal_equations(self.closed.parts, self.closed.weights, jnp.asarray(self.precision), ones, y)


def _rows(y: Float[Array, " numbers"], problem: _Problem) -> tuple[Array, Array]:
    return problem.rows(y), jnp.sqrt(jnp.asarray(problem.precision)) * y


def fit(
    model: RobotModel | ExtendedModel,
    data: Any,
    free: Any,
    *,
    prior: Mapping[str, Any] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    solver: Any = None,
    max_steps: int = 256,
) -> Fit:
    """The model that fits the data best in what is `free`, with covariance and the solver's verdict; pure.

    `free`: one or several of `inertia`, `friction`, `effects`, `joint_offset`, `link_geometry`, `frames` (what the
    measuring devices leave open), `tool_frame`, `base`, `gravity`, and of rollouts `start` and `drives`; or a mapping
    from these to places, `{"joint_offset": ["elbow"], "frames": True}`. `data` as for `residual`. `prior`: one sigma
    about the given model by the same names (SI units; for `inertia` relative, as `robot.trust`). `bounds`: limits of a
    number's change, by its name or how that begins: L-BFGS-B of jaxopt then searches. `solver`: any least-squares
    solver or minimiser of optimistix; by default `BlockLevenbergMarquardt` for postures alone, else SciPy's
    `least_squares`, for which the rows are compiled once; under a transformation, and on other devices than the CPU,
    `optimistix.LevenbergMarquardt`.

    A solver that fails says so in `result` (`reason` in words); `InputError` is wrong input. Differentiable by model
    and data through the condition of the minimum, and mapped by `jax.vmap`; bounded fits are not differentiable.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q = np.random.default_rng(0).uniform(-1, 1, (30, 4))
    >>> hand = robot.link_names[-1]
    >>> seen = np.asarray(fj.frame_placement(robot, q + [0, 0.02, 0, 0], hand))[:, :3, 3]
    >>> run = fj.postures(q=q, position=seen, base_frame="base", tool_frame=hand, unknown=[])
    >>> found = fj.fit(robot, run, {"joint_offset": ["elbow", robot.joint_names[1]]})
    >>> round(found.parameters["joint_offset " + robot.joint_names[1]].value, 6)
    0.02
    """
    whole = model if isinstance(model, ExtendedModel) else extend(model)
    for name, given in (("prior", prior or {}), ("bounds", bounds or {})):
        if not isinstance(given, Mapping):
            raise InputError(f"{name} is {given!r}; a mapping from names is expected, {{'effects': ...}}")
    if solver is not None and not isinstance(solver, _SOLVERS):
        raise InputError(
            f"solver is {solver!r}; one of optimistix is expected: optimistix.LevenbergMarquardt(1e-8, 1e-8)"
        )
    check_count("max_steps", max_steps)
    parts = as_data(whole, data)
    chosen = chosen_of(whole, parts, free)
    precision = _precision(chosen, whole, prior or {}) * chosen.sizes**2
    closed = None if traced(whole, parts) else _closed_form(chosen, whole, parts)
    problem = _Problem(whole, parts, precision, closed, chosen)
    if bounds is not None:
        return _bounded(problem, *_limits(chosen, bounds), max_steps)
    if solver is None and closed is None and on_host(problem) and not staged():
        return _descended(problem, max_steps)
    if solver is None:
        solver = BlockLevenbergMarquardt() if closed else optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    return _solved(problem, solver, max_steps)


@in_float64
def _solved(problem: _Problem, solver: Any, max_steps: int) -> Fit:
    solve = _solve_quick if _brief(problem) else _solve
    return replace(solve(replace(problem, free=problem.free.unnamed()), solver, max_steps), free=problem.free)


@in_float64
def _descended(problem: _Problem, max_steps: int) -> Fit:
    """The fit with its steps on the host: the programs are the rows with their Jacobian and what the numbers change."""
    bare = replace(problem, free=problem.free.unnamed())
    bare = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, bare)  # handed over once
    linear = _linear_quick if _brief(problem) else _linear

    def rows_at(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jacobian, rows = linear(jnp.asarray(y), bare)
        return np.asarray(rows), np.asarray(jacobian)

    found = descend(rows_at, np.asarray(problem.precision, float), max_steps)
    square, precision = float(found.rows @ found.rows), np.asarray(problem.precision)
    model, data = _placed(jnp.asarray(found.at), bare)
    results = optimistix.RESULTS
    failed = results.nonlinear_divergence if found.stuck else results.nonlinear_max_steps_reached
    whole = _put_together(
        replace(problem, model=model, data=data),
        found.at,
        _told(found.jacobian, found.rows, square, precision, np),
        np.float64(0.5 * (square + np.sum(precision * found.at**2))),
        found.rows,
        results.successful if found.converged else failed,
        {"max_steps": max_steps, "num_steps": np.int64(found.steps)},
    )
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, (np.ndarray, np.generic)) else x, whole)


def _linearised(y: Array, problem: _Problem) -> tuple[Array, Array]:
    """Jacobian of the rows (rows, numbers), and the rows."""

    def both(y: Array) -> tuple[Array, Array]:
        rows = problem.rows(y)
        return rows, rows

    return jax.jacfwd(both, has_aux=True)(y)


def _brief(problem: _Problem) -> bool:
    """Whether so few rows are fitted that a program costs more to optimise than it then saves."""
    if not on_host(problem):
        return False  # the compiler's options are those of the caller's program
    arrays = (x for x in jax.tree.leaves(problem.data) if eqx.is_array(x))
    return max((prod(x.shape[:-1]) for x in arrays), default=0) <= FEW and len(problem.data) <= SEVERAL


def _least_squares(problem: _Problem, solver: Any, max_steps: int) -> Fit:
    adjoint = optimistix.ImplicitAdjoint(linear_solver=lineax.AutoLinearSolver(well_posed=False))
    start = jnp.zeros(len(problem.free.names))
    found = optimistix.least_squares(
        _rows, solver, start, args=problem, adjoint=adjoint, max_steps=max_steps, throw=False
    )
    return _fit_at(problem, found.value, found.result, found.stats)


_solve, _linear = filtered_program(_least_squares), filtered_program(_linearised)
_solve_quick, _linear_quick, _placed = (
    filtered_program(function, DRAFT_OPTIONS)
    for function in (_least_squares, _linearised, lambda y, problem: problem.at(y))
)


def _fit_at(problem: _Problem, y: Array, result: Any, stats: dict[str, Any]) -> Fit:
    model, data = problem.at(y)
    rows = problem.rows(y)
    still = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, (problem, y))
    told = _covariance(*still)
    cost = 0.5 * (jnp.sum(rows**2) + jnp.sum(problem.precision * y**2))
    return _put_together(replace(problem, model=model, data=data), y, told, cost, rows, result, stats)


def _put_together(
    fitted: _Problem, y: Any, told: Sequence[Any], cost: Any, rows: Any, result: Any, stats: dict[str, Any]
) -> Fit:
    """The fit with numbers, covariance and share in SI units; `fitted` holds the model and the data with them."""
    scale = fitted.free.sizes
    covariance, hidden, rank = told
    return Fit(
        fitted.model,
        fitted.data,
        y * scale,
        covariance * scale[:, None] * scale,
        hidden,
        cost,
        rows,
        rank,
        result,
        {key: value for key, value in stats.items() if value is not None},
        fitted.free,
    )


def _covariance(problem: _Problem, y: Array) -> tuple[Array, Array, Array]:
    """Covariance of y for rows of one variance, share of each number in undetermined directions, and rank."""
    if problem.closed is None:
        J, rows = _linearised(y, problem)
        return _told(J, rows, jnp.sum(rows**2), jnp.asarray(problem.precision), jnp)
    normal = problem.normal(y)
    counted = sum(jnp.sum(jnp.asarray(w) > 0) for w in jax.tree.leaves(problem.closed.weights))
    square = 2.0 * normal.cost - jnp.sum(problem.precision * y**2)
    return _spread(normal.matrix, counted, square, jnp)


def _told(J: Any, rows: Any, square: Any, precision: Any, lib: Any) -> tuple[Any, Any, Any]:
    """`_covariance` of rows with their Jacobian; `lib` is NumPy or JAX."""
    highest = {"precision": jax.lax.Precision.HIGHEST} if lib is jnp else {}
    information = lib.matmul(J.T, J, **highest) + lib.diag(precision)
    counted = lib.sum((rows != 0) | lib.any(J != 0, axis=1))
    return _spread(information, counted, square, lib)


def _spread(information: Any, counted: Any, square: Any, lib: Any) -> tuple[Any, Any, Any]:
    size = lib.sqrt(lib.maximum(lib.diagonal(information), 1e-300))
    values, vectors = lib.linalg.eigh(information / size[:, None] / size)
    kept = values > NULL * values[-1]
    inverse = (vectors * lib.where(kept, 1.0 / lib.where(kept, values, 1.0), 0.0)) @ vectors.T / size[:, None] / size
    rank = lib.sum(kept)
    variance = square / lib.maximum(counted - rank, 1)
    return variance * inverse, lib.sum(lib.where(kept, 0.0, vectors**2), axis=1), rank


def _precision(free: Free, model: ExtendedModel, prior: Mapping[str, Any]) -> Float[np.ndarray, " numbers"]:
    """Inverse variance of each number's prior, zero where there is none."""
    known = {"effect": "effects"}
    unused, out = set(prior), []
    for part in free.parts:
        kind = known.get(part.kind, part.kind)
        sigma = prior.get(kind, prior.get("friction") if kind == "effects" else None)
        unused -= {kind} | ({"friction"} if kind == "effects" else set())
        if sigma is not None:
            check_real(f"prior: sigma of '{kind}'", sigma)
            if not traced(sigma) and not (np.asarray(sigma, float) > 0).all():
                raise InputError(f"prior: sigma of '{kind}' is {sigma}; expected numbers above zero")
        if sigma is None:
            out.append(np.zeros(len(part.index)))
        elif kind == "inertia" and np.ndim(sigma) == 0:
            if traced(model.robot.inertia):
                raise InputError(
                    "prior: a relative sigma of `inertia` needs a model that is not traced by jit, grad or vmap"
                )
            out.append(rigid_prior(model.robot, float(sigma))[1][np.array(part.index)])
        else:
            whole = np.broadcast_to(np.asarray(sigma, float), part.shape).reshape(-1)
            out.append(whole[np.array(part.index)] ** -2.0)
    if unused:
        kinds = sorted({known.get(part.kind, part.kind) for part in free.parts})
        raise InputError(f"prior: '{sorted(unused)[0]}' is not free; free are {', '.join(kinds)}")
    return np.concatenate(out)


def _closed_form(free: Free, model: ExtendedModel, data: tuple[Data, ...]) -> _Closed | None:
    """Rows and derivatives of postures by the twists of their chains, where nothing else is free."""
    kinds = {part.kind for part in free.parts}
    plain = not any(effect.has("position_error") or effect.has("change") for effect in model.effects)
    if not (plain and kinds <= {"joint_offset", "link_geometry", "frames"}):
        return None
    if not all(isinstance(one, PoseData) for one in data):
        return None
    columns, order, count = [], [], sum(len(p.index) for p in free.parts if p.kind != "frames")
    first = np.cumsum([count, *(len(one.device.unknowns()) for one in data if isinstance(one, PoseData))])
    for part in free.parts:
        if part.kind == "frames":
            order += [int(first[part.key[0]]) + i for i in part.index]
        else:
            order += range(len(columns), len(columns) + len(part.index))
            columns += [_unit_twist(model.robot, part.kind, i) for i in part.index]
    groups = tuple(_group(model.robot, one, columns) for one in data if isinstance(one, PoseData))
    problem = posefit.Problem(groups, np.ones(int(first[-1])), count)
    parts = posefit.parts_of(problem)
    weights = [np.asarray(one.weight, float).T.reshape(-1) for one in data if isinstance(one, PoseData)]
    tied = [np.full(posefit.ties(g.device), float(one.tied)) for g, one in zip(groups, data, strict=True)]  # pyright: ignore[reportAttributeAccessIssue]
    cut = cut_weights(problem, parts, np.concatenate([x for pair in zip(weights, tied, strict=True) for x in pair]))
    local = [eqx.tree_at(lambda p: p.local, part, part.local[:, order] * free.sizes) for part in parts]
    return _Closed(tuple(local), cut)


def _unit_twist(robot: RobotModel, kind: str, index: int) -> tuple[int, Float[np.ndarray, "6"]]:
    """Joint and twist of a unit of one number."""
    if kind == "link_geometry":
        return index // 6, np.eye(6)[index % 6]
    turns = robot.joints[index].kind == "revolute"
    axis = np.asarray(robot.axis)[index]
    return index, np.concatenate([np.zeros(3), axis] if turns else [axis, np.zeros(3)])


def _group(robot: RobotModel, one: PoseData, columns: list[tuple[int, np.ndarray]]) -> posefit.Group:
    chain = chain_between(robot, one.base_frame, one.tool_frame)
    samples = len(one.position)
    pieces = (
        (k, chain.joints.index(joint), np.repeat(twist[:, None], samples, axis=1))
        for k, (joint, twist) in enumerate(columns)
        if joint in chain.joints
    )
    measured = np.asarray(one.weight) > 0
    return posefit.group_of(chain, one.device, np.asarray(one.position).T, len(columns), pieces, one.datum, measured)


def _limits(free: Free, bounds: Mapping[str, tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limit of each number in its size."""
    lower, upper = np.full((2, len(free.names)), np.inf) * [[-1.0], [1.0]]
    for key, pair in bounds.items():
        if np.shape(pair) != (2,):
            raise InputError(f"bounds: '{key}' has {pair!r}; a pair is expected, lower and upper")
        low, high = pair
        mine = np.array([name == key or name.startswith(f"{key} ") for name in free.names])
        if not mine.any():
            raise InputError(f"bounds: nothing free is called '{key}'; free are {', '.join(free.names[:12])}")
        if not low <= 0.0 <= high:
            raise InputError(f"bounds: '{key}' {low, high} excludes 0, the given model")
        lower[mine], upper[mine] = low, high
    return lower / free.sizes, upper / free.sizes


@in_float64
def _bounded(problem: _Problem, lower: np.ndarray, upper: np.ndarray, max_steps: int) -> Fit:
    if traced(problem):
        raise InputError("a fit with bounds runs on the host, not under jit, grad or vmap; see `fit_linear`")
    with warnings.catch_warnings():  # that jaxopt is no longer maintained is known, and said where it is required
        warnings.simplefilter("ignore", DeprecationWarning)
        from jaxopt import ScipyBoundedMinimize

    start = jnp.zeros(len(problem.free.names))
    scale = float(_cost(start, problem)) or 1.0
    search = ScipyBoundedMinimize(
        method="L-BFGS-B",
        fun=lambda y: _cost(y, problem) / scale,
        tol=1e-12,
        maxiter=max(max_steps, 1000),
        options={"ftol": 1e-15, "gtol": 1e-9, "maxcor": 30},
    )
    found = search.run(start, bounds=(lower, upper))
    # judged by the gradient that the limits leave: a line search that rounding ends says nothing of the point
    slopes = [np.asarray(jax.grad(_cost)(y, problem)) for y in (start, jnp.asarray(found.params))]
    left = np.asarray(found.params) - np.clip(found.params - slopes[1], lower, upper)
    good = bool(found.state.success) or np.abs(left).max() <= STATIONARY * np.abs(slopes[0]).max()
    result = optimistix.RESULTS.successful if good else optimistix.RESULTS.nonlinear_max_steps_reached
    return _finished(problem, jnp.asarray(found.params), result, {"num_steps": jnp.asarray(found.state.iter_num)})


@eqx.filter_jit
def _cost(y: Array, problem: _Problem) -> Array:
    return jnp.asarray(0.5 * sum(jnp.sum(x**2) for x in _rows(y, problem)))


_finished = eqx.filter_jit(_fit_at)
