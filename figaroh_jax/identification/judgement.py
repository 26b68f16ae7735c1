"""What an identification is worth: spreads, verdicts on parameters, quality of the fit, predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, joint_unit
from ..effects.extended import ExtendedModel, extend
from ..estimation.base_parameters import TEN, BaseParameters
from ..estimation.consistency import inconsistencies
from ..estimation.free import Free, chosen_of
from ..estimation.priors import rigid_prior
from ..estimation.regression import Condensed, Piece, Regression
from ..estimation.solution import Fit
from ..formats.native import place_names
from ..recordings.groupmotion import coordinate_positions
from ..recordings.signals import Signals
from ..results import Estimate, Name, Trace
from ..rigid.model import RobotModel
from .result import BaseParameter, FittedEffect, Link, Parameter, Quality, Status

__all__ = [
    "Judged",
    "Solved",
    "correlations",
    "described_effects",
    "described_links",
    "dropped",
    "extended",
    "posterior_covariance",
    "predicted",
    "prior_sigma",
    "quality",
    "solution_of",
]

NOTABLE = 0.95  # correlation that is reported
FEW = 20  # correlations at most
ON_BOUND = 1e-6  # of what was believed before: nearer to a bound than any data could say
OUTLYING = 8.0  # robust standard deviations of its joint's residual
TOUCHED = 1e-9  # of a null direction: a smaller part in it is rounding


def quality(data: Condensed, squares: Float[np.ndarray, " nv"]) -> Quality:
    """Quality from each joint's sum of squared residuals; R2 is about the mean of the joint's torque."""
    rows = np.where(data.rows > 0, data.rows, np.nan)
    torque = data.squares(np.zeros(len(data.names)))
    return _quality(squares, torque, data.torque.sum(axis=0), rows)


def _quality(squares: np.ndarray, torque: np.ndarray, total: np.ndarray, rows: np.ndarray) -> Quality:
    spread = torque - total**2 / rows
    with np.errstate(divide="ignore", invalid="ignore"):
        r2 = np.where(spread > 0, 1 - squares / spread, np.nan)
        return Quality(np.sqrt(squares / rows), np.sqrt(np.where(torque > 0, squares / torque, np.nan)), r2)


def posterior_covariance(
    base: BaseParameters, covariance: Float[np.ndarray, "rank rank"], spread: Float[np.ndarray, "columns columns"]
) -> Float[np.ndarray, "columns columns"]:
    """Covariance of all parameters from that of the base parameters; `spread spread'` is that of what was believed."""
    B = base.matrix @ spread
    # (I + B' C^-1 B)^-1 = I - B' (C + B B')^-1 B: no inverse of C, which may be nearly singular
    inside = covariance + B @ B.T
    size = np.sqrt(np.diag(inside))
    gain = np.linalg.solve(inside / np.outer(size, size), B / size[:, None])
    whole = np.eye(len(spread)) - (B / size[:, None]).T @ gain
    return spread @ whole @ spread.T


def prior_sigma(data: Condensed, links: int, model: RobotModel, trust: float) -> Float[np.ndarray, " columns"]:
    """What was believed before: the links' `trust`; for a drive, that it makes all the torque."""
    factor = data.factor()
    torque = data.squares(np.zeros(len(data.names)))
    length = np.linalg.norm(factor[:, :-1], axis=0)
    felt = np.array([sum(torque[j] for j, own in enumerate(data.columns) if k in own) for k in range(len(length))])
    sigma = np.sqrt(felt) / np.where(length > 0, length, np.inf)
    sigma[:links] = 1 / np.sqrt(rigid_prior(model, trust)[1])
    return np.where(sigma > 0, sigma, 1.0)


@dataclass(frozen=True)
class Judged:
    """Fitted parameters with everything that says how far they can be trusted."""

    data: Condensed
    base: BaseParameters
    theta: Float[np.ndarray, " columns"]
    posterior: Float[np.ndarray, "columns columns"]
    covariance: Float[np.ndarray, "rank rank"]  # of the base parameters, by the data alone
    believed: Float[np.ndarray, " columns"]  # one sigma before the data
    bounded: Float[np.ndarray, " columns"]  # least values

    def base_parameters(self) -> tuple[BaseParameter, ...]:
        """Every base parameter: `identified` where the data say more than was believed before, else `prior only`."""
        B = self.base.matrix
        values = B @ self.theta
        sigma = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", B, self.posterior, B), 0.0))
        shown = np.sqrt(np.diag(self.covariance)) < np.sqrt((B**2) @ self.believed**2)
        return tuple(
            BaseParameter(text, float(value), float(spread), self._status(int(column), bool(ok)))
            for text, value, spread, ok, column in zip(
                self.base.expressions, values, sigma, shown, self.base.independent, strict=True
            )
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """Every single parameter: identified alone, known only through what was believed, or not at all."""
        sigma = np.sqrt(np.maximum(np.diag(self.posterior), 0.0))
        null = self.base.null
        size = np.abs(null).max(axis=0, initial=0.0)
        touched = np.abs(null) > TOUCHED * size
        alone, terms = ~touched.any(axis=1), touched.sum(axis=0)
        out = []
        for k, name in enumerate(self.base.names):
            known = bool(alone[k] and sigma[k] < self.believed[k])
            status = self._status(k, known)
            if not known and not _inertial(name):
                status = "not identifiable"
            mine = np.flatnonzero(touched[k])
            why = "" if alone[k] else self.base.null_directions[mine[np.argmin(terms[mine])]]
            found = name, float(self.theta[k]), float(sigma[k]), status, self.base.absorbed_in(name), why
            out.append(Parameter(*found))
        return tuple(out)

    def _status(self, column: int, shown: bool) -> Status:
        least = self.bounded[column]
        if np.isfinite(least) and self.theta[column] - least < ON_BOUND * self.believed[column]:
            return "on its bound"
        return "identified" if shown else "prior only"


def _inertial(name: str) -> bool:
    return name.rstrip("0123456789") in TEN


def correlations(
    base: BaseParameters, covariance: Float[np.ndarray, "rank rank"]
) -> tuple[tuple[str, str, float], ...]:
    """The pairs of base parameters whose errors go together most, strongest first."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    table = np.triu(covariance / np.outer(sigma, sigma), 1)
    pairs = [(int(i), int(j)) for i, j in np.argwhere(np.abs(table) > NOTABLE)]
    pairs.sort(key=lambda pair: -abs(table[pair]))
    return tuple((base.expressions[i], base.expressions[j], float(table[i, j])) for i, j in pairs[:FEW])


def described_links(ten: Float[np.ndarray, "links 10"], names: Sequence[str]) -> tuple[Link, ...]:
    """The links with the verdict whether bodies can have their parameters."""
    wrong = {one.link: one.reason for one in inconsistencies(ten, names)}
    return tuple(Link(name, own, name not in wrong, wrong.get(name, "")) for name, own in zip(names, ten, strict=True))


def fitted_effects(terms: Sequence[Effect], values: Float[np.ndarray, " drives"]) -> list[Effect]:
    """The effects, one at each place, with their amplitudes."""
    out, start = [], 0
    for term in terms:
        names = term.amplitudes()
        for k in range(len(term.at)):
            amplitudes = [np.float64(x) for x in values[start : start + len(names)]]
            start += len(names)
            one = jax.tree.map(lambda x: np.asarray(x)[k], term)  # noqa: B023
            out.append(eqx.tree_at(lambda e: [getattr(e, name) for name in names], one, amplitudes))  # noqa: B023
    return out


def extended(regression: Regression, theta: Float[np.ndarray, " columns"]) -> ExtendedModel:
    """The robot with the fitted links and effects."""
    links = 10 * len(regression.model.joints)
    robot = eqx.tree_at(lambda m: m.inertia, regression.model, theta[:links].reshape(-1, 10))
    return extend(robot, *fitted_effects(regression.terms, theta[links:]), width=regression.width)


class Solved(NamedTuple):
    """All columns as a solver left them, and why it did not end well (empty where it did)."""

    theta: Float[np.ndarray, " columns"]
    failure: str = ""
    steps: int = 1


def solution_of(
    regression: Regression,
    found: Solved,
    posterior: Float[np.ndarray, "columns columns"],
    rank: int,
    rows: Float[np.ndarray, " rows"],
) -> Fit:
    """The identification as a fit of links and effects: changes from the given links, and from no effect at all."""
    model = extended(regression, found.theta)
    free = chosen_of(model, (), ("inertia", "effects") if model.effects else "inertia")
    linear = [p for p in free.parts if p.kind == "inertia" or model.effects[p.key[0]].parameters()[p.key[1]].linear]
    start = np.zeros(len(found.theta))
    start[: 10 * len(regression.model.joints)] = np.asarray(regression.model.inertia).reshape(-1)
    return Fit(
        model=model,
        data=(),
        values=found.theta - start,
        covariance=posterior,
        hidden=np.zeros(len(start)),
        cost=0.5 * float(np.nansum(rows**2)),
        rows=rows,
        rank=rank,
        outcome=None,
        stats={"num_steps": found.steps},
        free=Free(tuple(linear)),
        failure=found.failure,
    )


def described_effects(
    model: RobotModel,
    terms: Sequence[Effect],
    values: Float[np.ndarray, " drives"],
    sigma: Float[np.ndarray, " drives"],
) -> tuple[FittedEffect, ...]:
    """The effects with names, values, standard deviations and units."""
    out, start = [], 0
    for effect in fitted_effects(terms, values):
        linear = effect.amplitudes()
        spread = dict(zip(linear, sigma[start : start + len(linear)], strict=True))
        start += len(linear)
        slides = effect.acts_on == "joint" and bool(prismatic_columns(model)[int(effect.at[0])])
        units = effect.units()
        parameters = {
            name: Estimate(float(value), float(spread.get(name, 0.0)), joint_unit(units[name], slides))
            for name, value in effect.physical().items()
        }
        out.append(FittedEffect(Name(effect.name, place_names(model, effect)), parameters))
    return tuple(out)


def prismatic_columns(model: RobotModel) -> Float[np.ndarray, " nv"]:
    """1 where a coordinate slides."""
    out = np.zeros(model.nv)
    out[model.dofs.column[~model.dofs.turns]] = 1.0
    return out


def predicted(
    regression: Regression, theta: Float[np.ndarray, " columns"], nominal: Float[np.ndarray, " columns"]
) -> tuple[tuple[Trace, ...], dict[str, Quality], tuple[str, ...]]:
    """Each recording with the torques of the nominal and the fitted robot; the quality of held-out ones; outliers."""
    parts: dict[int, list[Piece]] = {}
    for piece in regression.pieces(fitted=False):
        slim = (piece.X @ nominal, piece.X @ theta)
        parts.setdefault(piece.recording, []).append(piece._replace(X=np.stack(slim, axis=-1)))
    traces, holdout, outlying = [], {}, []
    for k, one in enumerate(regression.signals):
        X, y, weight = (np.concatenate([getattr(p, name) for p in parts[k]]) for name in ("X", "y", "weight"))
        rows = one.rows.index
        measured = None if one.torque is None else y
        traces.append(
            Trace(
                one.name,
                one.role,
                one.time[rows],
                coordinate_positions(regression.model, one.position[rows]),
                one.velocity[rows],
                measured,
                X[..., 0],
                X[..., 1],
            )
        )
        kept = weight > 0
        if measured is not None:
            outlying += _outlying(one, np.where(kept, y - X[..., 1], np.nan), regression.model.dof_names)
        if one.role == "holdout" and measured is not None:
            error, torque = np.where(kept, y - X[..., 1], 0.0), np.where(kept, y, 0.0)
            counts = np.where(kept.any(axis=0), kept.sum(axis=0), np.nan)
            name = one.file.rsplit("/", 1)[-1]
            holdout[name] = _quality((error**2).sum(0), (torque**2).sum(0), torque.sum(0), counts)
    return tuple(traces), holdout, tuple(outlying)


def _outlying(one: Signals, error: Float[np.ndarray, "rows nv"], joints: Sequence[str]) -> list[str]:
    """Rows whose residual lies far beyond those of its joint, in words."""
    out = []
    for name, column in zip(joints, error.T, strict=True):
        own = column[np.isfinite(column)]
        if not own.size:
            continue
        sigma = np.median(np.abs(own - np.median(own))) / 0.6745  # of a normal distribution
        far = np.abs(np.nan_to_num(column - np.median(own))) > OUTLYING * max(float(sigma), np.finfo(float).tiny)
        if far.any() and far.mean() < 0.1:
            worst = float(one.rows.row_times[int(np.nanargmax(np.abs(column)))])
            out.append(
                f"{one.name}: {far.sum()} row{'s' * int(far.sum() > 1)} of {name} beyond {OUTLYING:g} robust standard"
                f" deviations of its residual, the largest at {worst:.4g} s"
            )
    return out


def dropped(signals: Sequence[Signals], model: RobotModel) -> tuple[str, ...]:
    """What of each recording became rows, and what was left out, in words."""
    out = []
    for one in signals:
        weight = np.asarray(one.rows.weight)
        lost = {name: int(n) for name, n in zip(model.dof_names, (weight == 0).sum(axis=0), strict=True) if n}
        text = f"{one.name}: {one.rows.kept} rows per joint at {1 / (one.dt * one.rows.step):.4g} Hz, low-passed at"
        text += f" {one.cutoff:.4g} Hz"
        if lost:
            text += "; excluded by gate, mask, gap or because the joint stands: " + ", ".join(
                f"{name} {n}" for name, n in lost.items()
            )
        out.append(text)
    return tuple(out)
