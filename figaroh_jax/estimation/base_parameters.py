"""Base parameters: the combinations of a robot's parameters that its torques can tell.

Columns that are linear combinations of others add nothing to a regressor. A fixed order decides which ones stay: a
column is kept if it is independent of those kept before it. What the others are made of says how their parameters are
absorbed, `base = independent + beta @ dependent`. All of it follows from the triangular factor of the regressor, whose
columns are scaled to length one before any decision, so neither units nor the number of samples matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ..errors import InputError
from ..rigid.model import RobotModel

__all__ = ["TOLERANCE", "BaseParameters", "base_parameters", "essential", "inertial_names"]

TOLERANCE = 1e-8  # of a column's length: what is left of a dependent column is rounding, some 1e-14 to 1e-11
SEEN = 1e-12  # of the longest column: a shorter one is zero but for rounding
TERM = 1e-6  # of the largest coefficient in a row: smaller ones are rounding, and left out of the text
TEN = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


@dataclass(frozen=True)
class BaseParameters:
    """Which of `names` are kept, and how the others are absorbed into them."""

    names: tuple[str, ...]
    independent: Int[np.ndarray, " rank"]  # columns kept
    dependent: Int[np.ndarray, " rest"]  # columns that the kept ones make up
    unseen: Int[np.ndarray, " zero"]  # columns that are zero: no motion shows their parameters
    beta: Float[np.ndarray, "rank rest"]  # dependent column = sum of independent columns times beta
    condition: float  # of the kept columns
    scaled_condition: float  # of the kept columns, each scaled to length one

    @property
    def rank(self) -> int:
        """Number of base parameters."""
        return len(self.independent)

    @cached_property
    def matrix(self) -> Float[np.ndarray, "rank columns"]:
        """B with `base = B @ parameters`."""
        out = np.zeros((self.rank, len(self.names)))
        out[np.arange(self.rank), self.independent] = 1.0
        out[:, self.dependent] = self.beta
        return out

    @cached_property
    def spread(self) -> Float[np.ndarray, "columns rank"]:
        """Parameters with the given base values and the smallest change of all: the pseudoinverse of `matrix`."""
        return np.linalg.pinv(self.matrix)

    @cached_property
    def null(self) -> Float[np.ndarray, "columns free"]:
        """Changes of the parameters that no torque shows: `matrix @ null = 0`, one for each dependent or unseen."""
        free = np.concatenate([self.dependent, self.unseen])
        out = np.zeros((len(self.names), len(free)))
        out[free, np.arange(len(free))] = 1.0
        out[self.independent, : len(self.dependent)] = -self.beta
        return out

    @cached_property
    def expressions(self) -> tuple[str, ...]:
        """Each base parameter in names, `mx2 + 0.425 m3`."""
        names = [self.names[k] for k in self.dependent]
        floor = TERM * np.maximum(1.0, np.abs(self.beta).max(axis=1, initial=0.0))
        kept = [[(1.0, self.names[k])] for k in self.independent]
        for terms, row, least in zip(kept, self.beta, floor, strict=True):
            terms += [(float(b), name) for b, name in zip(row, names, strict=True) if abs(b) > least]
        return tuple(_text(terms) for terms in kept)

    @cached_property
    def null_directions(self) -> tuple[str, ...]:
        """Each column of `null` in names: what may grow together without any torque to show it."""
        rows = [self.null[:, k] for k in range(self.null.shape[1])]
        return tuple(_text(_leading(row, self.names)) for row in rows)

    def absorbed_in(self, name: str) -> tuple[str, ...]:
        """The base parameters in which a parameter is contained; none if no motion shows it."""
        if name not in self.names:
            raise InputError(f"no parameter '{name}'; known: {', '.join(self.names)}")
        column = self.matrix[:, self.names.index(name)]
        return tuple(self.expressions[k] for k in np.flatnonzero(np.abs(column) > TERM * np.abs(column).max(initial=0)))


def base_parameters(
    factor: Float[np.ndarray, "rows columns"],
    names: Sequence[str],
    order: Sequence[int] | None = None,
    tolerance: float = TOLERANCE,
) -> BaseParameters:
    """Base parameters of the regressor whose triangular factor (or which itself) is `factor`.

    `order` lists the columns in the order in which they are preferred (default: as they stand), so that the choice does
    not hang on how the columns of a matrix are arranged. A column is dependent if less than `tolerance` of its length
    is left beside those kept before it (modified Gram-Schmidt, twice). Gautier (1991) with a fixed order of pivots.
    Raises `InputError` where names and columns do not fit, or a number is not finite.
    """
    factor = np.asarray(factor, float)
    if factor.ndim != 2 or factor.shape[1] != len(names):
        raise InputError(f"{len(names)} names for a factor of shape {factor.shape}: one column for each is needed")
    if not np.isfinite(factor).all():
        raise InputError(f"column '{names[int(np.argwhere(~np.isfinite(factor))[0, 1])]}' holds a number not finite")
    order = range(len(names)) if order is None else order
    if sorted(order) != list(range(len(names))):
        raise InputError(f"order must name each of the {len(names)} columns once")
    length = np.linalg.norm(factor, axis=0)
    seen = length > SEEN * length.max(initial=0.0)
    scaled = factor / np.where(seen, length, 1.0)
    kept = np.array(_independent(scaled, [k for k in order if seen[k]], tolerance), int)
    others = np.array([k for k in order if seen[k] and k not in set(kept.tolist())], int)
    beta = np.linalg.lstsq(scaled[:, kept], scaled[:, others], rcond=None)[0]
    return BaseParameters(
        names=tuple(names),
        independent=kept,
        dependent=others,
        unseen=np.array([k for k in order if not seen[k]], int),
        beta=beta * length[others] / length[kept][:, None],
        condition=_condition(factor[:, kept]),
        scaled_condition=_condition(scaled[:, kept]),
    )


def essential(factor: Float[np.ndarray, "n k"], ratio: float = 30.0) -> Int[np.ndarray, " kept"]:
    """The columns whose parameters matter, of independent columns with the torque as the last of `factor`.

    The parameter with the largest relative standard deviation is set to zero and the others are fitted again, until the
    largest is at most `ratio` times the smallest (Pham and Gautier, 1991). Raises `InputError` for dependent columns.
    """
    length = np.linalg.norm(factor[:, :-1], axis=0)
    columns = np.arange(len(length))
    R = np.asarray(np.linalg.qr(factor[:, :-1] / np.where(length > 0, length, 1.0), mode="r"))
    if len(R) < len(columns) or np.linalg.cond(R) > 1 / TOLERANCE:
        raise InputError("essential parameters are chosen among independent columns: give the base parameters alone")
    inverse = np.linalg.inv(R)
    covariance = inverse @ inverse.T
    theta = np.linalg.lstsq(factor[:, :-1] / length, factor[:, -1], rcond=None)[0]
    while len(columns) > 1:
        relative = np.sqrt(np.diag(covariance)) / np.maximum(np.abs(theta), np.finfo(float).tiny)
        if relative.max() <= ratio * relative.min():
            break
        # what fixing one parameter at zero does to the estimates of the others
        worst = int(np.argmax(relative))
        others = np.delete(np.arange(len(columns)), worst)
        gain = covariance[others, worst] / covariance[worst, worst]
        theta = theta[others] - gain * theta[worst]
        covariance = covariance[np.ix_(others, others)] - np.outer(gain, covariance[worst, others])
        columns = columns[others]
    return columns


def inertial_names(model: RobotModel) -> tuple[str, ...]:
    """Names of the columns of `joint_torque_regressor`: `m1` to `Izz1` for the first link of the tree, and so on."""
    return tuple(f"{name}{k}" for k in range(1, len(model.joints) + 1) for name in TEN)


def _independent(columns: Float[np.ndarray, "n k"], order: Sequence[int], tolerance: float) -> list[int]:
    whole = np.empty((len(columns), min(columns.shape)), order="F")
    kept: list[int] = []
    for k in order:
        rest, basis = columns[:, k], whole[:, : len(kept)]
        for _ in range(2):  # twice is enough (Kahan, Parlett)
            rest = rest - basis @ (basis.T @ rest)
        size = np.linalg.norm(rest)
        if size > tolerance and len(kept) < whole.shape[1]:
            whole[:, len(kept)] = rest / size
            kept.append(k)
    return kept


def _condition(columns: Float[np.ndarray, "n k"]) -> float:
    if not columns.size:
        return 1.0
    return float(np.linalg.cond(columns))


def _leading(row: Float[np.ndarray, " columns"], names: Sequence[str]) -> list[tuple[float, str]]:
    least = TERM * np.abs(row).max()
    return [(float(x), name) for x, name in zip(row, names, strict=True) if abs(x) > least]


def _text(terms: Sequence[tuple[float, str]]) -> str:
    """`mx2 + 0.425 m3 - Iyy1`."""
    words = []
    for k, (factor, name) in enumerate(terms):
        size = f"{abs(factor):.6g}"
        sign = ("-" if factor < 0 else "") if k == 0 else (" - " if factor < 0 else " + ")
        words.append(sign + (name if size == "1" else f"{size} {name}"))
    return "".join(words)
