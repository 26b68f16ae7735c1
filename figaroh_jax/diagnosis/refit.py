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
from jaxtyping import Complex, Float, Int

from ..effects.base import Effect, Motion
from ..estimation.joint_rows import JointRows
from ..recordings.stacked import Records
from .design import Units, local, shapes, unit_rows, units_and_slopes, with_shape
from .shifts import links_torque, torque_change

__all__ = ["Whitened", "box_minima", "profile", "refit", "refit_shift", "shift_profile"]

STEPS = 12  # evaluations of a search at the most for each number of the shape, beside the first
SETTLED = 1e-7  # of the first value: a step that promises less is not taken
CLOSE = 1e-4  # the same for the size of a shift, which is fitted exactly later
STEP = 1e-5  # of its bracket: over which the profile of a shift is differentiated
FAR = 10.0  # times what its next step promises: what a start may lie above the best to be followed
RIDGE = 1e-9  # of normal equations with a unit diagonal


class Whitened(NamedTuple):
    """Residual and regressor of the current model as whitened rows, `A^-1`, and the whitening response."""

    residual: Float[np.ndarray, "nv n M"]
    X: JointRows
    inverse: Float[np.ndarray, "P P"]
    whitening: Complex[np.ndarray, "F nv"] | Float[np.ndarray, "F nv"]


def box_minima(
    function: Callable[[Float[np.ndarray, "starts p"], Int[np.ndarray, " some"]], tuple[np.ndarray, np.ndarray]],
    start: Float[np.ndarray, "starts p"],
    close: float = SETTLED,
) -> tuple[Float[np.ndarray, "starts p"], Float[np.ndarray, " starts"]]:
    """Minimisers in the unit box of one smooth function a start, evaluated together, and the minima.

    `function` answers the values of some of the starts and their gradients. Each start goes its own way by projected
    quasi-Newton steps (BFGS), which are shortened until the value falls; it is left where a step promises less than
    `close` of its first value, and where it promises by far too little to become the best.
    """
    x = np.clip(start, 0.0, 1.0)
    value, slope = function(x, np.arange(len(x)))
    scale = np.abs(value) + 1e-9
    # a first step of a quarter of the box
    bend = np.eye(x.shape[1]) * (4 * np.abs(slope).max(1) + 1e-300)[:, None, None]
    length, seen = np.ones(len(x)), np.zeros(len(x), bool)  # `seen`: the curvature
    for _ in range(STEPS * x.shape[1]):
        free = ((x > 0) | (slope < 0)) & ((x < 1) | (slope > 0))
        pull = np.where(free, slope, 0.0)
        apart = free[:, :, None] & free[:, None]
        step = -np.linalg.solve(np.where(apart, bend, np.eye(x.shape[1])), pull[..., None])[..., 0]
        promised = -(step * pull).sum(1) / 2
        hopeless = seen & (value - FAR * promised > value.min())
        going = (promised > close * scale) & ~hopeless & (length > 1e-3)
        some = np.flatnonzero(going)
        if not len(some):
            break
        tried = np.where(going[:, None], np.clip(x + length[:, None] * step, 0.0, 1.0), x)
        new, turned = value.copy(), slope.copy()
        new[some], turned[some] = function(tried, some)
        better = going & (new <= value + 1e-4 * (pull * (tried - x)).sum(1))
        for one in some:
            bend[one], seen[one] = _bent(bend[one], tried[one] - x[one], turned[one] - slope[one], seen[one])
        length = np.where(better, 1.0, np.where(going, length / 3, length))
        x, slope = (np.where(better[:, None], after, before) for after, before in ((tried, x), (turned, slope)))
        value = np.where(better, new, value)
    return x, value


def _bent(
    bend: Float[np.ndarray, "p p"], moved: Float[np.ndarray, " p"], turned: Float[np.ndarray, " p"], seen: bool
) -> tuple[Float[np.ndarray, "p p"], bool]:
    """The curvature after a move that has turned the gradient (BFGS); one that bends down says nothing."""
    rise = float(moved @ turned)
    if not rise > 1e-12 * float(np.sqrt((moved @ moved) * (turned @ turned))):
        return bend, seen
    if not seen:
        bend = np.eye(len(moved)) * float(turned @ turned) / rise
    across = bend @ moved
    return bend + np.outer(turned, turned) / rise - np.outer(across, across) / float(moved @ across), True


def profile(
    Z: Float[np.ndarray, "*starts k rows n M"],
    slope: Float[np.ndarray, "*starts p k rows n M"],
    joints: list[int],
    whitened: Whitened,
) -> tuple[Float[np.ndarray, " *starts"], Float[np.ndarray, "*starts p"]]:
    """J of the columns `Z` at the `joints`, the change of the penalised squares that they bring, and its gradient.

    With x = G^-1 s: dJ = x' dG x - 2 ds'x.
    """
    residual, (X, place) = whitened.residual[joints].reshape(-1), whitened.X.tall(joints)
    flat, changes = (x.reshape(*x.shape[:-3], -1) for x in (Z, slope))
    s, C, gram = flat @ residual, flat @ X, flat @ np.swapaxes(flat, -1, -2)
    taken = C @ whitened.inverse[np.ix_(place, place)]
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
    """
    names = shapes(type(effects))
    start = np.stack([np.asarray(getattr(effects, name)) for name in names], axis=-1)
    points = {n: p.grid if grid is None else np.unique(getattr(grid, n)) for n, p in effects.parameters().items()}
    box = np.stack([_box(effects.parameters()[n], x, points[n]) for n, x in zip(names, start.T, strict=True)], axis=-1)
    low, width = box[:, 0], box[:, 1] - box[:, 0]
    # a start that stands there more than once (the grid is short) is followed once
    fields = np.concatenate([np.reshape(x, (len(start), -1)) for x in jax.tree.leaves(effects)], axis=1)
    once = np.unique(fields, axis=0, return_index=True)[1]
    few, low, width = jax.tree.map(lambda x: np.asarray(x)[once], effects), low[once], width[once]
    device_effects, device_motion = jax.device_put(few), _on_device(motion)
    known: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # shape and columns of each start as last evaluated

    def function(u: Float[np.ndarray, "starts p"], some: Int[np.ndarray, " some"]) -> tuple[np.ndarray, np.ndarray]:
        values = low + u * width
        value, slope, Z = _profiles(device_effects, device_motion, values, some, records, whitened)
        known.update({one: (values[one], own) for one, own in zip(some.tolist(), Z, strict=True)})
        return value, slope * width[some]

    shares, least = box_minima(function, (start[once] - low) / width)
    values, best = low + shares * width, int(np.argmin(np.where(np.isfinite(least), least, np.inf)))
    if not np.array_equal(known[best][0], values[best]):
        function(shares, np.array([best]))
    one = jax.tree.map(lambda x: np.asarray(x)[best], few)
    return with_shape(one, names, list(values[best])), known[best][1]


_ON_DEVICE: list[tuple[Motion, Any]] = []  # the last one: all refits of a step share their motion


def _on_device(motion: Motion) -> Any:
    if not any(known is motion for known, _ in _ON_DEVICE):
        _ON_DEVICE[:] = [(motion, jax.device_put(motion))]
    return _ON_DEVICE[0][1]


def shift_profile(change: Float[np.ndarray, "sizes nv T"], whitened: Whitened) -> Float[np.ndarray, " sizes"]:
    """J of whitened rows of exact changes of the torque."""
    D = change.reshape(len(change), -1)
    C = whitened.X.pulled(change.reshape(len(change), len(whitened.residual), -1))
    return (D * (D - 2 * whitened.residual.reshape(-1))).sum(1) - ((C @ whitened.inverse) * C).sum(1)


def refit_shift(
    effects: Effect, Z: Float[np.ndarray, "grid nv T"], motion: Motion, records: Records, whitened: Whitened
) -> Effect:
    """The effect of a position sensor with the size that fits best, between the neighbours of the best grid point.

    `effects` are the grid of its size, `Z` their columns. The profile of a shift has one valley. It is searched
    with a difference for its gradient: that of the inverse dynamics takes longer to compile than all the values that a
    search in one number needs. One step of Newton's method gives the true motion: near enough to begin with, also where
    the link swings on the gear in the band of the motion, which no first order shows.
    """
    ((name, parameter),) = effects.parameters().items()
    sizes, one = np.asarray(getattr(effects, name)), jax.tree.map(lambda x: np.asarray(x)[:1], effects)
    best = sizes[np.argmin(shift_profile(Z * sizes[:, None, None], whitened))]
    edges = np.array([parameter.lower, *np.sort(sizes), parameter.upper])
    low, high = edges[edges < best].max(initial=parameter.lower), edges[edges > best].min(initial=parameter.upper)
    as_read = links_torque(motion.model, motion.position, motion.velocity, motion.acceleration, records)
    joints = np.tile(np.arange(as_read.shape[1]), (2, 1))

    def function(u: Float[np.ndarray, "1 1"], _: Int[np.ndarray, " 1"]) -> tuple[np.ndarray, np.ndarray]:
        size = low + u[0] * (high - low)
        both = jax.tree.map(lambda x: np.repeat(x, 2, axis=0), one)
        both = with_shape(both, [name], [np.append(size, size + STEP * (high - low))])
        change = torque_change(both, motion, records, as_read, turns=1)
        rows = unit_rows(Units(np.swapaxes(change, 1, 2)[:, None], joints), records, whitened.whitening)
        value, beside = shift_profile(rows, whitened)
        return np.array([value]), np.array([[(beside - value) / STEP]])

    share = float(box_minima(function, np.array([[(best - low) / (high - low)]]), CLOSE)[0][0, 0])
    return with_shape(jax.tree.map(lambda x: x[0], one), [name], [np.float64(low + share * (high - low))])


def _profiles(
    effects: Effect,
    motion: Motion,
    values: Float[np.ndarray, "starts p"],
    some: Int[np.ndarray, " some"],
    records: Records,
    whitened: Whitened,
) -> tuple[Float[np.ndarray, " some"], Float[np.ndarray, "some p"], Float[np.ndarray, "some k rows n M"]]:
    """Profile, gradient and columns of some of the starts at one place, each its own effect with its own shape."""
    torque, slope = (x[some] for x in units_and_slopes(effects, values, motion))
    count, p, k = slope.shape[:3]
    joints = np.asarray(effects.at)[some] if local(effects) else np.tile(np.arange(len(whitened.residual)), (count, 1))
    both = np.concatenate([torque[:, None], slope], axis=1).reshape(count, (1 + p) * k, *torque.shape[2:])
    rows = unit_rows(Units(both, joints), records, whitened.whitening)
    rows = rows.reshape(count, 1 + p, k, *rows.shape[2:])
    value, gradient = profile(rows[:, 0], rows[:, 1:], joints[0].tolist(), whitened)
    return value, gradient, rows[:, 0]


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
