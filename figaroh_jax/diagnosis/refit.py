"""Exact refit of what enters nonlinearly: the profile likelihood of an effect's shape, minimised in its box.

For a shape p the linear unknowns are solved for, so the profile is J(p) = -s'G^-1 s for columns Z(p), s = Z'r and
G = Z'Z - Z'X A^-1 X'Z, with its gradient from those of the columns; for a position sensor, whose size is its
parameter, J(p) = D'D - 2 D'r - D'X A^-1 X'D with the exact change D(p) of the torque.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float

from ..effects.base import Effect, Motion
from ..recordings.stacked import Records
from .design import Units, local, shapes, unit_rows, units_and_slopes, with_shape
from .shifts import links_torque, torque_change

__all__ = ["Whitened", "bounded_minimum", "profile", "refit", "refit_shift", "shift_profile"]

STEPS = 12
RIDGE = 1e-9
CLOSE = 1e-2  # of its bracket: how exactly the size of a shift is searched


class Whitened(NamedTuple):
    """Residual and regressor of the current model as whitened rows, `A^-1`, and the whitening response."""

    residual: Float[np.ndarray, "nv n M"]
    X: Float[np.ndarray, "nv n M P"]
    inverse: Float[np.ndarray, "P P"]
    whitening: Complex[np.ndarray, "F nv"] | Float[np.ndarray, "F nv"]


def bounded_minimum(
    function: Callable[[Any], tuple[Any, Any]], start: Any, lower: Any, upper: Any, *, native: bool = False
) -> Any:
    """Minimiser in a box of a smooth function that answers its value and its gradient, by L-BFGS-B.

    The only place that knows the minimisers. SciPy's runs on the host around one compiled function. `native` takes
    jaxopt's, which works inside `jit` and `vmap` but compiles its own loop around every function (6 CPU s around a
    trivial one, 13 to 38 s around a refit), and is no longer maintained.
    """
    if native:
        from jaxopt import LBFGSB

        solver = LBFGSB(function, value_and_grad=True, maxiter=STEPS, tol=1e-6, implicit_diff=False)
        return solver.run(start, bounds=(lower, upper)).params
    from scipy.optimize import minimize  # slow to import

    options = {"maxiter": STEPS, "ftol": 1e-7, "gtol": 1e-6}
    return minimize(function, start, jac=True, bounds=list(zip(lower, upper, strict=True)), options=options).x


def profile(
    Z: Float[np.ndarray, "*starts k rows n M"],
    slope: Float[np.ndarray, "*starts p k rows n M"],
    joints: list[int],
    whitened: Whitened,
) -> tuple[Float[np.ndarray, " *starts"], Float[np.ndarray, "*starts p"]]:
    """J of the columns `Z` at the `joints`, the change of the penalised squares that they bring, and its gradient.

    With x = G^-1 s: dJ = x' dG x - 2 ds'x.
    """
    residual, X = (x[joints[0]] if len(joints) == 1 else x[joints] for x in (whitened.residual, whitened.X))
    residual, X = residual.reshape(-1), X.reshape(-1, whitened.X.shape[-1])
    flat, changes = (x.reshape(*x.shape[:-3], -1) for x in (Z, slope))
    s, C, gram = flat @ residual, flat @ X, flat @ np.swapaxes(flat, -1, -2)
    taken = C @ whitened.inverse
    scale = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1) + 1e-300)
    unit = (gram - taken @ np.swapaxes(C, -1, -2)) / (scale[..., None] * scale[..., None, :])
    x = np.linalg.solve(unit + RIDGE * np.eye(flat.shape[-2]), (s / scale)[..., None])[..., 0] / scale
    # what G x is a product with: the columns less what the model takes up
    left = (x[..., None, :] @ flat)[..., 0, :] - (x[..., None, :] @ taken)[..., 0, :] @ X.T
    pull = (changes @ (left - residual)[..., None, :, None])[..., 0]
    return -(s * x).sum(-1), 2 * (pull @ x[..., None])[..., 0]


def refit(
    effects: Effect, motion: Motion, records: Records, whitened: Whitened, grid: Effect | None = None
) -> tuple[Effect, Float[np.ndarray, "k rows n M"]]:
    """Best shape over the starts (leading axis of `effects`), each between its neighbours on the grid; its columns.

    The `grid` is that of the place where it is not the parameters' own.
    All starts are one box problem: the sum of their profiles, whose gradient is that of each.
    """
    names = shapes(type(effects))
    start = np.stack([np.asarray(getattr(effects, name)) for name in names], axis=-1)
    points = {n: p.grid if grid is None else np.unique(getattr(grid, n)) for n, p in effects.parameters().items()}
    box = np.stack([_box(effects.parameters()[n], x, points[n]) for n, x in zip(names, start.T, strict=True)], axis=-1)
    low, width = box[:, 0], box[:, 1] - box[:, 0]
    # a start that stands there more than once (the grid is short) is followed once
    fields = np.concatenate([np.reshape(x, (len(start), -1)) for x in jax.tree.leaves(effects)], axis=1)
    _, once, copies = np.unique(fields, axis=0, return_index=True, return_inverse=True)
    device_effects, device_motion = jax.device_put((jax.tree.map(lambda x: np.asarray(x)[once], effects), motion))
    scale, known = 1.0, {}

    def profiles(values: Float[np.ndarray, "starts p"]) -> dict[str, Any]:
        found = _profiles(device_effects, device_motion, values[once], records, whitened)
        return {name: x[copies.reshape(-1)] for name, x in found.items() if name != "Z"} | {"Z": found["Z"]}

    def function(u: Float[np.ndarray, " startsp"]) -> tuple[float, Float[np.ndarray, " startsp"]]:
        values = low + u.reshape(low.shape) * width
        known.update(profiles(values), at=values)
        return float(known["value"].sum()) / scale, (known["slope"] * width).reshape(-1) / scale

    first = ((start - low) / width).reshape(-1)
    scale = abs(function(first)[0]) + 1e-9
    values = (
        low + bounded_minimum(function, first, np.zeros_like(first), np.ones_like(first)).reshape(low.shape) * width
    )
    if not np.array_equal(known["at"], values):
        known = profiles(values)
    best = int(np.argmin(np.where(np.isfinite(known["value"]), known["value"], np.inf)))
    one = jax.tree.map(lambda x: np.asarray(x)[best], effects)
    return with_shape(one, names, list(values[best])), known["Z"][copies.reshape(-1)[best]]


def shift_profile(change: Float[np.ndarray, "sizes nv T"], whitened: Whitened) -> Float[np.ndarray, " sizes"]:
    """J of whitened rows of exact changes of the torque."""
    D = change.reshape(len(change), -1)
    C = D @ whitened.X.reshape(D.shape[1], -1)
    return (D * (D - 2 * whitened.residual.reshape(-1))).sum(1) - ((C @ whitened.inverse) * C).sum(1)


def refit_shift(
    effects: Effect, Z: Float[np.ndarray, "grid nv T"], motion: Motion, records: Records, whitened: Whitened
) -> Effect:
    """The effect of a position sensor with the size that fits best, between the neighbours of the best grid point.

    `effects` are the grid of its size, `Z` their columns. The profile of a shift has one valley. It is searched
    without its gradient: that of the inverse dynamics takes longer to compile than all the values that a search in
    one number needs. The load is that of the motion as read: right to first order, and near enough to begin with.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    ((name, parameter),) = effects.parameters().items()
    sizes, one = np.asarray(getattr(effects, name)), jax.tree.map(lambda x: np.asarray(x)[:1], effects)
    best = sizes[np.argmin(shift_profile(Z * sizes[:, None, None], whitened))]
    edges = np.array([parameter.lower, *np.sort(sizes), parameter.upper])
    low, high = edges[edges < best].max(initial=parameter.lower), edges[edges > best].min(initial=parameter.upper)
    as_read = links_torque(motion.model, motion.position, motion.velocity, motion.acceleration, records)
    joints = np.arange(as_read.shape[1])[None]

    def value(size: float) -> float:
        change = torque_change(with_shape(one, [name], [np.array([size])]), motion, records, as_read, turns=0)
        rows = unit_rows(Units(np.swapaxes(change, 1, 2)[:, None], joints), records, whitened.whitening)
        return float(shift_profile(rows, whitened)[0])

    options = {"xatol": CLOSE * (high - low), "maxiter": 2 * STEPS}
    found: Any = minimize_scalar(value, bounds=(low, high), method="bounded", options=options)
    return with_shape(jax.tree.map(lambda x: x[0], one), [name], [np.float64(found.x)])


def _profiles(
    effects: Effect, motion: Motion, values: Float[np.ndarray, "starts p"], records: Records, whitened: Whitened
) -> dict[str, Any]:
    """Profile, gradient and columns of several starts at one place, each its own effect with its own shape."""
    torque, slope = units_and_slopes(effects, values, motion)
    starts, p, k = slope.shape[:3]
    joints = np.asarray(effects.at) if local(effects) else np.tile(np.arange(len(whitened.residual)), (starts, 1))
    both = np.concatenate([torque[:, None], slope], axis=1).reshape(starts, (1 + p) * k, *torque.shape[2:])
    rows = unit_rows(Units(both, joints), records, whitened.whitening)
    rows = rows.reshape(starts, 1 + p, k, *rows.shape[2:])
    value, gradient = profile(rows[:, 0], rows[:, 1:], joints[0].tolist(), whitened)
    return {"value": value, "slope": gradient, "Z": rows[:, 0]}


def _box(
    parameter: Any, starts: Float[np.ndarray, " starts"], points: Sequence[float] | Float[np.ndarray, " points"]
) -> Float[np.ndarray, "starts 2"]:
    """Neighbouring grid points of each start; the outermost reach to the parameter's bounds."""
    grid = np.array([parameter.lower, *sorted(points), parameter.upper])
    place = np.array([np.argmin(np.abs(grid[1:-1] - x)) + 1 for x in starts])
    low, high = grid[place - 1], grid[place + 1]
    if parameter.hole:
        low = np.where(starts >= parameter.hole[1], np.maximum(low, parameter.hole[1]), low)
        high = np.where(starts <= parameter.hole[0], np.minimum(high, parameter.hole[0]), high)
    return np.stack([low, high], axis=1)
