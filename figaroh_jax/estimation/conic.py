"""Least squares under convex constraints, by the interior-point solver Clarabel (Goulart and Chen, 2024).

The squares stand as the triangular factor of their rows, so the size of a problem is that of its parameters. A body is
physically consistent where its pseudo-inertia is positive semidefinite (Wensing, Kim, Slotine 2018): a convex set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.inertia import pseudo_inertia

__all__ = ["Body", "Constraints", "NotConverged", "constrained"]

MARGIN = 1e-7  # least eigenvalue of a scaled pseudo-inertia: a body on the very border could not be inverted
# Iterations and the share of the way to the border that a step takes. Most problems need 20 iterations; close to the
# border of a cone long steps may lead nowhere (500 iterations, with a gap of .01), where shorter ones need 16.
_STEPS = ((200, 0.99), (200, 0.95), (500, 0.8))
_SOLVED = ("Solved", "AlmostSolved")
_UPPER = [(i, j) for j in range(4) for i in range(j + 1)]  # Clarabel's order of a triangle


class NotConverged(InputError):
    """The solver gave up on a problem that may have a solution."""


@dataclass(frozen=True)
class Body:
    """Ten columns, in Pinocchio's order, that shall be those of a physically consistent body."""

    name: str
    columns: Sequence[int]
    mass: float  # kg, its scale
    length: float  # m, its scale
    least_mass: float = 0.0  # kg
    greatest_mass: float = np.inf
    box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None  # m: corners around the centre of mass


@dataclass(frozen=True)
class Constraints:
    """What parameters have to satisfy; each part may be missing. Matrices have a column for each parameter."""

    bodies: Sequence[Body] = ()
    lower: Float[np.ndarray, " columns"] | None = None
    upper: Float[np.ndarray, " columns"] | None = None
    equal: tuple[Float[np.ndarray, "n columns"], Float[np.ndarray, " n"]] | None = None  # A x = b
    at_most: tuple[Float[np.ndarray, "n columns"], Float[np.ndarray, " n"]] | None = None  # A x <= b


@dataclass
class _Rows:
    """Rows A x + s = b with s in one cone after another."""

    columns: int
    A: list[Any] = field(default_factory=list)
    b: list[Any] = field(default_factory=list)
    cones: list[Any] = field(default_factory=list)

    def add(self, A: Float[np.ndarray, "n columns"], b: Float[np.ndarray, " n"], cone: Any) -> None:
        if len(b):
            self.A.append(A)
            self.b.append(b)
            self.cones.append(cone)


def constrained(
    factor: Float[np.ndarray, "n k"], constraints: Constraints, scale: Float[np.ndarray, " columns"] | None = None
) -> Float[np.ndarray, " columns"]:
    """Parameters x with the least squares `|factor @ [x, -1]|^2` that satisfy the constraints.

    `scale` is the expected size of each parameter (default: from the columns). Raises `InputError` where no parameters
    satisfy the constraints, or the solver does not reach its tolerance.
    """
    import clarabel as _clarabel
    from scipy import sparse

    columns = factor.shape[1] - 1
    scale = _scale(factor) if scale is None else scale
    R = np.asarray(np.linalg.qr(factor, mode="r"))[: columns + 1]
    unit = max(float(np.linalg.norm(R[:, -1])), 1e-12)
    clarabel: Any = _clarabel  # its types are compiled: no checker sees them
    rows = _Rows(columns)
    _linear(rows, constraints, scale, clarabel)
    for body in constraints.bodies:
        _body(rows, body, scale, clarabel)
    # y = R x - z as variables of their own: the squared condition number of R'R never appears
    A = sparse.bmat(
        [
            [sparse.csc_matrix(R[:, :-1] * scale / unit), -sparse.identity(len(R))],
            *([sparse.csc_matrix(a * scale), sparse.csc_matrix((len(a), len(R)))] for a in rows.A),
        ],
        format="csc",
    )
    P = sparse.block_diag([sparse.csc_matrix((columns, columns)), sparse.identity(len(R))], format="csc")
    b = np.concatenate([R[:, -1] / unit, *rows.b])
    cones, status, found = [clarabel.ZeroConeT(len(R)), *rows.cones], "", None
    for most, fraction in _STEPS:
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.max_iter, settings.max_step_fraction = False, most, fraction
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
        found = clarabel.DefaultSolver(P, np.zeros(columns + len(R)), A, b, cones, settings).solve()
        status = str(found.status)
        if status in _SOLVED or "PrimalInfeasible" in status:
            break
    _check(status)
    assert found is not None
    return np.asarray(found.x)[:columns] * scale


def _check(status: str) -> None:
    if status in _SOLVED:
        return
    if "PrimalInfeasible" in status:
        raise InputError(
            "no parameters satisfy all constraints together: bounds, equalities and consistency contradict"
        )
    raise NotConverged(
        f"the constrained fit did not converge (Clarabel: {status}); the recordings may contain hardly any motion"
    )


def _scale(factor: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " columns"]:
    length = np.linalg.norm(factor[:, :-1], axis=0)
    return np.linalg.norm(factor[:, -1]) / np.where(length > 1e-9 * length.max(initial=0.0), length, 1.0) + 1e-12


def _linear(rows: _Rows, constraints: Constraints, scale: Float[np.ndarray, " columns"], clarabel: Any) -> None:
    """Rows of the linear constraints, each divided by its own size."""
    identity = np.eye(rows.columns)
    if constraints.equal is not None:
        A, b = _even(*constraints.equal, scale)
        rows.add(A, b, clarabel.ZeroConeT(len(b)))
    for bound, sign in ((constraints.upper, 1.0), (constraints.lower, -1.0)):
        if bound is not None:
            kept = np.isfinite(bound)
            A, b = _even(sign * identity[kept], sign * bound[kept], scale)
            rows.add(A, b, clarabel.NonnegativeConeT(len(b)))
    if constraints.at_most is not None:
        A, b = _even(*constraints.at_most, scale)
        rows.add(A, b, clarabel.NonnegativeConeT(len(b)))


def _even(A: np.ndarray, b: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size = np.maximum(np.linalg.norm(np.asarray(A) * scale, axis=1), 1e-300)
    return np.asarray(A) / size[:, None], np.asarray(b) / size


def _body(rows: _Rows, body: Body, scale: Float[np.ndarray, " columns"], clarabel: Any) -> None:
    """The pseudo-inertia in units of the body's own mass and length, and its mass and centre of mass."""
    turn = np.diag([1 / body.length] * 3 + [1.0]) / np.sqrt(body.mass)
    matrices = [turn @ pseudo_inertia(e) @ turn for e in np.eye(10)]
    weight = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in _UPPER])
    A = np.zeros((10, rows.columns))
    A[:, list(body.columns)] = -np.array([[m[i, j] for m in matrices] for i, j in _UPPER]) * weight[:, None]
    diagonal = np.array([float(i == j) for i, j in _UPPER])
    rows.add(A, -MARGIN * diagonal, clarabel.PSDTriangleConeT(4))
    A, b = _cad(body, rows.columns)
    A, b = _even(A, b, scale)
    rows.add(A, b, clarabel.NonnegativeConeT(len(b)))


def _cad(body: Body, columns: int) -> tuple[np.ndarray, np.ndarray]:
    A, b = [], []

    def at_most(coefficients: dict[int, float], value: float) -> None:
        row = np.zeros(columns)
        for k, c in coefficients.items():
            row[body.columns[k]] = c
        A.append(row)
        b.append(value)

    if body.least_mass > 0:
        at_most({0: -1.0}, -body.least_mass)
    if np.isfinite(body.greatest_mass):
        at_most({0: 1.0}, body.greatest_mass)
    if body.box is not None:
        for axis, (low, high) in enumerate(zip(*body.box, strict=True), 1):
            at_most({axis: 1.0, 0: -float(high)}, 0.0)
            at_most({axis: -1.0, 0: float(low)}, 0.0)
    return np.array(A).reshape(-1, columns), np.array(b)
