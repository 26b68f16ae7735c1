"""Every way to fit parameters that enter linearly: one function, one result, one object for each method.

All methods but the robust one and the instrumental variables see the data only through triangular factors
(`regression.Condensed`), whose size is that of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import InputError
from .conic import Constraints, constrained
from .regression import Condensed, Piece, Rows, condense

__all__ = [
    "Constrained",
    "ElasticNet",
    "InstrumentalVariables",
    "Method",
    "OrdinaryLeastSquares",
    "Prior",
    "Ridge",
    "Robust",
    "Solution",
    "TotalLeastSquares",
    "WeightedByJoint",
    "joint_weights",
    "solve",
    "with_prior",
]

LEAST = 1e-12  # of the torque: a residual below it is rounding


@dataclass(frozen=True)
class OrdinaryLeastSquares:
    """Every row counts alike."""


@dataclass(frozen=True)
class WeightedByJoint:
    """Rows of a joint weigh by the inverse of its own mean squared residual, found in turns."""

    iterations: int = 10
    tolerance: float = 1e-3  # relative change of the weights at which they stay


@dataclass(frozen=True)
class Robust:
    """Outlying rows weigh less: Huber's weights min(1, c/|e|) or Student's (n + 1)/(n + e^2), e in robust sigmas."""

    loss: Literal["huber", "student"] = "huber"
    cut: float = 1.345  # Huber's c: 95 % of the efficiency of least squares for normal errors
    freedom: float = 4.0  # of Student's distribution
    iterations: int = 30


@dataclass(frozen=True)
class Ridge:
    """Squares plus `strength` times the squared parameters, each in units of its column's length."""

    strength: float


@dataclass(frozen=True)
class Prior:
    """Tikhonov's method: squares plus `precision` times the squared difference to `mean` (see `with_prior`)."""

    mean: Float[np.ndarray, " columns"]
    precision: Float[np.ndarray, " columns"]


@dataclass(frozen=True)
class ElasticNet:
    """Few parameters: `strength` (0 to 1, of the one that leaves none) of the sum of sizes; `lasso` 1 is the lasso."""

    strength: float
    lasso: float = 1.0


@dataclass(frozen=True)
class Constrained:
    """Least squares under bounds, equalities, inequalities or bodies, by Clarabel."""

    constraints: Constraints


@dataclass(frozen=True)
class TotalLeastSquares:
    """Columns with errors too: `noise` is one sigma of the errors of each column and, last, of the torque.

    Columns without errors (0) are projected out first (Golub and Van Loan; Van Huffel and Vandewalle, 1991).
    """

    noise: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class InstrumentalVariables:
    """Z' (y - X theta) = 0 with the regressor Z of a motion that carries no noise of the encoders.

    `instruments` are the rows of the same recordings on a simulated motion (Janot, Vandanjon, Gautier 2014).
    """

    instruments: Rows


Method = (
    OrdinaryLeastSquares
    | WeightedByJoint
    | Robust
    | Ridge
    | Prior
    | ElasticNet
    | Constrained
    | TotalLeastSquares
    | InstrumentalVariables
)


@dataclass(frozen=True)
class Solution:
    """Parameters, and what stands behind them."""

    parameters: Float[np.ndarray, " columns"]
    weight: Float[np.ndarray, " nv"]  # of each joint's rows
    rms: Float[np.ndarray, " nv"]  # residual of each joint, N m or N; NaN without rows
    iterations: int = 1
    converged: bool = True
    method: Method = field(default_factory=OrdinaryLeastSquares)


def solve(
    data: Condensed,
    method: Method | None = None,
    *,
    weight: Float[np.ndarray, " nv"] | None = None,
    regression: Rows | None = None,
    used: Bool[np.ndarray, "nv columns"] | None = None,
    kept: Sequence[int] | Int[np.ndarray, " kept"] | None = None,
) -> Solution:
    """Fit the parameters of a condensed regression by `method` (default: ordinary least squares).

    `kept` are the columns that are fitted, normally the base parameters (default: all); the others stay zero. `weight`
    are the joints' weights. `regression` and `used` are needed by the methods that look at single rows. Where columns
    are dependent the parameters are the smallest, in units of the columns' lengths.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 300)
    >>> states = fj.states.States(robot, lambda: [(q, v, a, np.asarray(fj.inverse_dynamics(robot, q, v, a)))], ())
    >>> data = fj.regression.condense(states, states.used)
    >>> found = fj.least_squares.solve(data, kept=states.structural.independent)
    >>> bool(found.rms.max() < 1e-6)  # N m
    True
    """
    method = method or OrdinaryLeastSquares()
    columns = np.arange(len(data.names)) if kept is None else np.asarray(kept, int)
    weight = np.ones(len(data.columns)) if weight is None else np.asarray(weight, float)
    if isinstance(method, (Robust, InstrumentalVariables)) and (regression is None or used is None):
        raise InputError(f"{type(method).__name__} looks at single rows: give the regression and its used columns")
    if isinstance(method, WeightedByJoint):
        theta, weight, turns, done = _by_joint(data, columns, method)
    elif isinstance(method, Robust):
        theta, weight, turns, done = _robust(data, columns, method, regression, used)
    elif isinstance(method, InstrumentalVariables):
        theta, turns, done = _instrumental(method, columns, weight, regression), 1, True
    else:
        theta, turns, done = _placed(len(data.names), columns, _once(method, data.factor(weight), columns)), 1, True
    if not np.isfinite(theta).all():
        raise InputError(f"{type(method).__name__} gives no finite parameters: the data may hold no motion")
    return Solution(theta, weight, data.rms(theta), turns, done, method)


def joint_weights(data: Condensed, theta: Float[np.ndarray, " columns"]) -> Float[np.ndarray, " nv"]:
    """Inverse of the mean squared residual of each joint; a joint without rows weighs nothing.

    A joint whose torque is zero throughout, because nothing drives it, weighs as little as any other: parameters of
    zero would leave nothing of it, so that by its own residual it would take them there.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 300)
    >>> states = fj.states.States(robot, lambda: [(q, v, a, np.asarray(fj.inverse_dynamics(robot, q, v, a)))], ())
    >>> data = fj.regression.condense(states, states.used)
    >>> fj.least_squares.joint_weights(data, np.zeros(40)).shape
    (4,)
    """
    squares, rows = data.squares(theta), data.rows
    torque = data.squares(np.zeros_like(theta))
    floor = LEAST**2 * torque + np.finfo(float).tiny
    weight = np.where(rows > 0, rows / np.maximum(squares, floor), 0.0)
    driven = (rows > 0) & (torque > 0)
    return np.where((rows > 0) & ~driven, weight[driven].min(), weight) if driven.any() else weight


def with_prior(
    factor: Float[np.ndarray, "n k"], mean: Float[np.ndarray, " columns"], precision: Float[np.ndarray, " columns"]
) -> Float[np.ndarray, "n k"]:
    """Factor of the squares plus `precision` times the squared difference to `mean`.

    >>> import numpy as np, figaroh_jax as fj
    >>> factor = np.array([[2.0, 6.0], [0.0, 0.0]])  # 2 x = 6
    >>> both = fj.least_squares.with_prior(factor, np.array([1.0]), np.array([4.0]))
    >>> round(float(both[0, 1] / both[0, 0]), 3)  # halfway between 3 and 1
    2.0
    """
    root = np.sqrt(np.asarray(precision))
    rows = np.column_stack([np.diag(root), root * np.asarray(mean)])
    return np.asarray(np.linalg.qr(np.concatenate([factor, rows]), mode="r"))


def _once(method: Any, factor: Float[np.ndarray, "n k"], kept: np.ndarray) -> Float[np.ndarray, " kept"]:
    """One solve from the factor of the kept columns."""
    if isinstance(method, Constrained):
        if len(kept) != factor.shape[1] - 1:
            raise InputError("Constrained fits all columns: leave `kept` out")
        return constrained(factor, method.constraints)
    if isinstance(method, Prior):
        factor = with_prior(factor, method.mean, method.precision)
    own = factor[:, [*kept, -1]]
    if isinstance(method, Ridge):
        length = np.linalg.norm(own[:, :-1], axis=0)
        own = with_prior(own, np.zeros(len(kept)), method.strength * length**2)
    if isinstance(method, ElasticNet):
        return _sparse(own, method)
    if isinstance(method, TotalLeastSquares):
        return _total(own, np.asarray(method.noise, float)[[*kept, -1]])
    return _least(own)


def _least(factor: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " columns"]:
    length = np.linalg.norm(factor[:, :-1], axis=0)
    length = np.where(length > 0, length, 1.0)
    return np.linalg.lstsq(factor[:, :-1] / length, factor[:, -1], rcond=1e-10)[0] / length


def _placed(columns: int, kept: np.ndarray, values: np.ndarray) -> Float[np.ndarray, " columns"]:
    theta = np.zeros(columns)
    theta[kept] = values
    return theta


def _by_joint(data: Condensed, kept: np.ndarray, method: WeightedByJoint):
    weight, theta, own = np.ones(len(data.columns)), np.zeros(len(data.names)), data.merged(kept.tolist())
    for turn in range(1, method.iterations + 1):
        values = _least(own.factor(weight))
        theta, new = _placed(len(data.names), kept, values), joint_weights(own, values)
        done = bool(np.allclose(new, weight, rtol=method.tolerance, atol=0))
        weight = new
        if done:
            return theta, weight, turn, True
    return theta, weight, method.iterations, False


def _robust(data: Condensed, kept: np.ndarray, method: Robust, regression: Any, used: Any):
    weight = np.ones(len(data.columns))
    theta = _placed(len(data.names), kept, _least(data.factor()[:, [*kept, -1]]))
    scale = np.sqrt(1 / np.maximum(joint_weights(data, theta), 1e-300))
    for turn in range(1, method.iterations + 1):
        sizes: list[np.ndarray] = []

        def weighted(piece: Piece) -> np.ndarray:
            error = np.where(piece.weight > 0, piece.y - piece.X @ theta, np.nan)  # noqa: B023
            sizes.append(np.abs(error))  # noqa: B023
            return piece.weight * _row_weight(np.nan_to_num(error) / scale, method) / scale**2  # noqa: B023

        new = condense(regression, used, weighted)
        last, theta = theta, _placed(len(data.names), kept, _least(new.factor()[:, [*kept, -1]]))
        weight = 1 / scale**2
        scale = np.maximum(np.nanmedian(np.concatenate(sizes), axis=0) / 0.6745, 1e-12)  # of a normal distribution
        if np.linalg.norm(theta - last) <= 1e-6 * np.linalg.norm(theta):
            return theta, weight, turn, True
    return theta, weight, method.iterations, False


def _row_weight(error: np.ndarray, method: Robust) -> np.ndarray:
    if method.loss == "student":
        return (method.freedom + 1) / (method.freedom + error**2)
    return np.minimum(1.0, method.cut / np.maximum(np.abs(error), 1e-12))


def _sparse(factor: np.ndarray, method: ElasticNet) -> np.ndarray:
    try:
        from sklearn.linear_model import ElasticNet as Descent
    except ImportError:
        raise InputError("ElasticNet needs scikit-learn: pip install 'figaroh-jax[sparse]'") from None
    length = np.where(factor[:, :-1].any(axis=0), np.linalg.norm(factor[:, :-1], axis=0), 1.0)
    X, y = factor[:, :-1] / length, factor[:, -1]
    most = np.abs(X.T @ y).max() / len(y) / max(method.lasso, 1e-3)
    descent = Descent(alpha=method.strength * most, l1_ratio=method.lasso, fit_intercept=False, max_iter=100_000)
    return np.asarray(descent.fit(X, y).coef_) / length


def _total(factor: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Mixed least squares and total least squares, from the triangular factor."""
    if noise[-1] <= 0:
        raise InputError("TotalLeastSquares: the last number of `noise` is that of the torque and must be positive")
    noisy = np.flatnonzero(noise > 0)
    exact = np.flatnonzero(noise == 0)
    R = np.asarray(np.linalg.qr(factor[:, [*exact, *noisy]], mode="r"))
    n = len(exact)
    direction = np.linalg.svd(R[n:, n:] / noise[noisy])[2][-1] * (1 / noise[noisy])
    if abs(direction[-1]) < 1e-12 * np.abs(direction).max():
        raise InputError("TotalLeastSquares has no solution here: the columns alone are nearly dependent")
    out = np.zeros(factor.shape[1])
    out[noisy] = -direction / direction[-1]
    out[exact] = np.linalg.lstsq(R[:n, :n], -R[:n, n:] @ out[noisy], rcond=None)[0]
    return out[:-1]


def _instrumental(method: InstrumentalVariables, kept: np.ndarray, weight: np.ndarray, regression: Any):
    A, b = np.zeros((len(kept), len(kept))), np.zeros(len(kept))
    for piece, other in zip(regression.pieces(), method.instruments.pieces(), strict=True):
        if piece.X.shape != other.X.shape:
            raise InputError(f"instruments of shape {other.X.shape} for rows of shape {piece.X.shape}")
        Z = other.X[:, :, kept] * (piece.weight * weight)[:, :, None]
        A += np.einsum("tjk,tjl->kl", Z, piece.X[:, :, kept])
        b += np.einsum("tjk,tj->k", Z, piece.y)
    theta = np.zeros(len(regression.names))
    scale = np.sqrt(np.maximum(np.abs(np.diag(A)), 1e-300))
    theta[kept] = np.linalg.lstsq(A / np.outer(scale, scale), b / scale, rcond=1e-14)[0] / scale
    return theta
