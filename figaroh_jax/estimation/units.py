r"""One parameter of several robots of a type, or of one robot on several days: a common mean and what differs.

Random effects: the estimate of run j of unit i, with standard deviation $s_{ij}$, is
$x_{ij} = \mu + u_i + d_{ij} + e_{ij}$ with spreads $\tau_u$ between units and $\tau_d$ between the days of one unit.
Spreads are by Paule and Mandel (1982): the weighted squares about the weighted mean are their degrees of freedom. That
a spread is there at all is tested by those squares with the spread zero (Cochran 1954), the p values over all
parameters, of units and of days together, by Holm's method. Standard deviations that are too small everywhere would
make everything differ: they are widened by what the median parameter shows (an empirical null, Efron 2004), for most
parameters are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import InputError

__all__ = ["Spread", "spreads"]


class Spread(NamedTuple):
    """One parameter over units and days."""

    name: str
    mean: float
    std: float  # of the mean
    units: float  # spread between units, one sigma
    days: float  # spread between the days of a unit, one sigma
    p_units: float  # of no spread between units, over all parameters and days too (Holm); 1 where there is one unit
    p_days: float  # of no spread between days; 1 where no unit has two
    shrunk: dict[str, float]  # each unit's value, drawn towards the mean by what its own data leave open
    widened: float  # factor of the given standard deviations

    def differs(self, alpha: float = 0.05) -> str:
        """`units`, `days`, `units, days`, or nothing."""
        return ", ".join(word for word, p in (("units", self.p_units), ("days", self.p_days)) if p < alpha)


def spreads(
    names: Sequence[str],
    values: Float[np.ndarray, "runs parameters"],
    std: Float[np.ndarray, "runs parameters"],
    units: Sequence[str] | None = None,
) -> tuple[Spread, ...]:
    """Mean and spreads of each parameter; `units` labels the runs (default: each run is a unit of its own).

    Runs with one label are days of one unit. NaN where a run does not tell a parameter. Raises `InputError` for fewer
    than two runs, wrong shapes, and standard deviations that are not above zero.

    >>> import numpy as np, figaroh_jax as fj
    >>> found = fj.units.spreads(["a"], np.array([[1.0], [1.2], [3.0]]), np.full((3, 1), 0.1))
    >>> found[0].differs()
    'units'
    """
    values, std = np.asarray(values, float), np.asarray(std, float)
    labels = list(map(str, range(len(values)))) if units is None else list(units)
    if values.ndim != 2 or len(values) < 2 or values.shape[1] != len(names):
        raise InputError(f"spreads: values have shape {values.shape}; two runs or more of {len(names)} parameters")
    if std.shape != values.shape or len(labels) != len(values):
        raise InputError(f"spreads: std has shape {std.shape} and {len(labels)} labels; values have {values.shape}")
    told = np.isfinite(values) & np.isfinite(std)
    if (std[told] <= 0).any():
        raise InputError(f"spreads: parameter '{names[int(np.argwhere(told & ~(std > 0))[0][1])]}' has a std of zero")
    widened = _widening(values, std, told, labels)
    rows = [
        _one(values[t, k], widened * std[t, k], [labels[i] for i in np.flatnonzero(t)]) for k, t in enumerate(told.T)
    ]
    p_units, p_days = _holm(np.array([[row[index] for row in rows] for index in (4, 5)]))
    return tuple(
        Spread(name, row[0], row[1], row[2], row[3], float(u), float(d), row[6], widened)
        for name, row, u, d in zip(names, rows, p_units, p_days, strict=True)
    )


def _one(x: np.ndarray, s: np.ndarray, labels: list[str]) -> tuple:
    """Mean, its std, both spreads, both p values and shrunk values of one parameter."""
    from scipy.special import chdtrc, fdtrc

    groups = _numbered(labels)
    freedom = len(x) - int(groups.max()) - 1
    days = _paule_mandel(x, s, groups, freedom)
    p_days = float(chdtrc(freedom, _within(x, s, groups, 0.0))) if freedom else 1.0
    weights = 1 / (s**2 + days**2)
    total = np.bincount(groups, weights)
    means, noise, whole = np.bincount(groups, weights * x) / total, total**-0.5, np.zeros(len(total), int)
    p_units = 1.0
    if len(means) > 1:
        squares = _within(means, noise, whole, 0.0)
        count = len(means) - 1
        # a spread between days is known from few days: their degrees of freedom count
        p_units = float(fdtrc(count, freedom, squares / count) if days > 0 else chdtrc(count, squares))
    units = _paule_mandel(means, noise, whole, len(means) - 1)
    weight = 1 / (noise**2 + units**2)
    mean = float(weight @ means / weight.sum())
    shrunk = mean + units**2 * weight * (means - mean)
    return mean, float(weight.sum() ** -0.5), units, days, p_units, p_days, dict(
        zip(dict.fromkeys(labels), map(float, shrunk), strict=True)
    )  # fmt: skip


def _within(x: np.ndarray, s: np.ndarray, groups: Int[np.ndarray, " n"], spread: float) -> float:
    """Weighted squares about the weighted mean of each group."""
    w = 1 / (s**2 + spread**2)
    means = np.bincount(groups, w * x) / np.bincount(groups, w)
    return float(w @ (x - means[groups]) ** 2)


def _paule_mandel(x: np.ndarray, s: np.ndarray, groups: Int[np.ndarray, " n"], freedom: int) -> float:
    """Spread at which the squares are their degrees of freedom; zero where they are fewer without one."""
    from scipy.optimize import brentq

    if freedom < 1 or _within(x, s, groups, 0.0) <= freedom:
        return 0.0
    top = 10 * float(np.ptp(x)) + float(s.max())
    return float(brentq(lambda t: _within(x, s, groups, t) - freedom, 0.0, top))  # pyright: ignore[reportArgumentType]


def _widening(values: np.ndarray, std: np.ndarray, told: np.ndarray, labels: list[str]) -> float:
    """Factor of the standard deviations by which the median parameter does not differ; at least one.

    Above one it takes one standard error of that median with it: too small a factor names what does not differ.
    """
    from scipy.special import chdtri

    ratios = []
    for x, s, t in zip(values.T, std.T, told.T, strict=True):
        own = [labels[i] for i in np.flatnonzero(t)]
        if len(own) < 2:
            continue
        groups = _numbered(own)
        freedom = len(own) - int(groups.max()) - 1
        if freedom < 1:  # one day of each unit: the units themselves
            groups, freedom = np.zeros(len(own), int), len(own) - 1
        if freedom > 0:
            ratios.append(_within(x[t], s[t], groups, 0.0) / chdtri(freedom, 0.5))
    if len(ratios) < 8:
        return 1.0
    low, middle, high = np.percentile(ratios, (25, 50, 75))
    error = 1.2533 * (high - low) / 1.349 / np.sqrt(len(ratios))  # of the median of normal numbers
    return float(np.sqrt(middle + error)) if middle > 1.0 else 1.0


def _numbered(labels: Sequence[str]) -> Int[np.ndarray, " n"]:
    known = list(dict.fromkeys(labels))
    return np.array([known.index(label) for label in labels], int)


def _holm(p: Float[np.ndarray, "kinds n"]) -> Float[np.ndarray, "kinds n"]:
    """Holm's adjusted p values, of units and days together; what was not tested (p = 1) does not count."""
    flat = p.ravel()
    order, count = np.argsort(flat), int((flat < 1.0).sum())
    adjusted = np.minimum(1.0, np.maximum.accumulate(np.maximum(1, count - np.arange(len(flat))) * flat[order]))
    out = np.empty_like(adjusted)
    out[order] = adjusted
    return out.reshape(p.shape)
