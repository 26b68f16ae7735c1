"""The noise floor: what is left of the torque rows that no repeatable model can explain, as a spectrum per joint."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..estimation import noise
from ..estimation.joint_rows import JointRows
from ..estimation.noise import Spectrum
from ..estimation.rows import Prior, Rows, fit
from ..results import Name
from .bank import Columns
from .comparison import ground, judge_grown, t_value
from .evidence import Score
from .flexible import rich_families
from .problem import Problem
from .screening import catalogue, exact_columns, screen
from .state import State, plain_rows, solved, whitened
from .step import stand
from .thresholds import LOWEST_FREQUENCY, LOWEST_RESOLVED, T_REST

__all__ = [
    "foretold",
    "kept_columns",
    "noise_floor",
    "noise_rms",
    "short",
    "sober_spectrum",
    "undecided",
    "whitening_of",
]

MOST_LEAKED = 4.0  # times the power, that what leaks through rows left out is told of a band at once
ROUNDS = 2  # of the fit and the spectrum of repeats' differences in turn
RICHNESS = 10  # groups of columns in the rich model
RICH_CUT = 1e-9  # of the unit-diagonal Gram of the rich model
COLUMN_CUT = 1e-8  # of the longest column: below, a column of the rigid body is what rounding leaves of zero
FEWEST = 20  # rows of a recording whose spectrum is taken
ENOUGH = 1500  # rows a joint without which misfit takes spectra and smooth families: then the noise is white


def noise_floor(
    problem: Problem, state: State, forbid: Collection[str] = ()
) -> tuple[Spectrum, Float[np.ndarray, "F nv"]]:
    """Spectrum of the noise, and the whitening response that follows from it.

    From the differences of repeats where there are some; the baseline is fitted in between, so that its weights are
    right. Else from the residual of a rich model, white where the data are short.
    """
    _, scale, count = _alike(problem, state)
    if not problem.layout.repeats:
        spectrum = _from_rich_model(problem, state, scale, forbid, count)
        return spectrum, whitening_of(problem, spectrum)
    response = np.ones((len(np.asarray(problem.records.omega)), 1)) / scale
    for _ in range(ROUNDS):
        rows = whitened(problem, state, response)
        state = solved(state, fit(rows, state.prior).theta)
        spectrum = _from_repeats(problem, rows, state, response)
        response = whitening_of(problem, spectrum)
    return spectrum, response  # pyright: ignore[reportPossiblyUnboundVariable]  # the loop runs at least once


def sober_spectrum(problem: Problem, state: State, forbid: Collection[str] = ()) -> Spectrum:
    """Spectrum of what the state and the one best candidate leave: of the catalogue, or a function of few columns.

    A rich model takes noise in at the frequencies of the motion, the more the less of the data is independent: slow
    noise in the band of a slow motion looks smaller than it is. One candidate takes little, and all of its own misfit.
    """
    rows, scale, count = _alike(problem, state)
    return _from_rich_model(problem, state, scale, forbid, count, richness=1)


def short(problem: Problem, state: State) -> bool:
    """Whether the data have no repeats and too few rows to tell slow noise by its spectrum from a misfit."""
    return not problem.layout.repeats and _rows_a_joint(plain_rows(problem, state)) < ENOUGH


def undecided(problem: Problem, state: State) -> tuple[str, str]:
    """Why these data cannot tell what is left from noise, and which would, both in words.

    Rows are asked for as seconds of motion, `ENOUGH` rows at twice the cutoff: what more rows of the same seconds say
    is not independent.
    """
    if problem.layout.repeats:
        return "what repeats of it is not surely more than chance", "more repeats of the same motion"
    rows, records = _rows_a_joint(plain_rows(problem, state)), problem.records
    if rows >= ENOUGH:
        return "without repeats the level of the noise is an estimate, which may be too low", "the same motion repeated"
    fitted = np.any(records.fitted, axis=2)
    spans = [at.rows for at in records.spans if fitted[at.slot, at.row : at.row + at.rows].any()]
    seconds = sum(spans) / float(records.rate)
    enough = max(0.5 * float(records.rate) / float(records.cutoff), 1.0) * ENOUGH / rows * seconds
    now, wanted = (f"{float(f'{x:.2g}'):g} s" for x in (seconds, enough))
    return (
        f"{now} of motion without repeats ({rows} rows a joint) are not enough to tell that from slow noise",
        f"the same motion repeated, or about {wanted} of such motion in all",
    )


def foretold(problem: Problem, state: State, forbid: Collection[str] = ()) -> Bool[np.ndarray, " nv"]:
    """Whether what the rich model takes of each joint's residual predicts parts that it was not fitted to.

    A misfit is there in all parts; noise that a rich model has taken in is in none but its own.
    """
    _, scale, count = _alike(problem, state)
    response = np.ones((len(np.asarray(problem.records.omega)), 1)) / scale
    rich = _rich(problem, state, response, forbid, count >= ENOUGH, RICHNESS)
    step, out = stand(problem, state, response), np.zeros(len(scale), bool)
    base = ground(step.verdicts, step.state.prior, step.folded)
    for joint in range(len(scale)):
        columns = rich.columns(joint)
        columns = columns[columns.any(1)]
        if len(columns):
            own = judge_grown(step.rows, base, (joint,), columns[:, None])
            worse, better = (v.own(step.rows, (joint,)) for v in (step.verdicts, own))
            out[joint] = t_value(worse, better) > T_REST
    return out


def _resolved(problem: Problem) -> bool:
    """Whether any recording has rows enough for a spectrum."""
    fitted = np.any(problem.records.fitted, axis=2)
    return any(fitted[at.slot, at.row : at.row + at.rows].sum() >= FEWEST for at in problem.records.spans)


def _alike(problem: Problem, state: State) -> tuple[Rows, Float[np.ndarray, " nv"], int]:
    """Rows as they are, the RMS of what a fit with the joints weighted alike leaves of them, and rows a joint."""
    rows = plain_rows(problem, state)
    count = _rows_a_joint(rows)
    rough = rows.y - rows.X @ _weighted(rows, state.prior, np.sqrt((rows.y**2).mean(1)))
    return rows, np.sqrt((rough**2).sum(1) / count), count


def _rows_a_joint(rows: Rows) -> int:
    return max(1, rows.size // len(rows.y))


def noise_rms(problem: Problem, spectrum: Spectrum) -> Float[np.ndarray, " nv"]:
    """RMS of noise with the spectrum in the rows of each joint, N m or N."""
    frequency = np.linspace(0.05, float(problem.records.rate) / 2, 400)
    gain = np.interp(frequency, np.asarray(problem.records.omega) / (2 * np.pi), problem.gain)
    return np.sqrt((gain[:, None] * spectrum.power(frequency)).mean(0))


def _weighted(rows: Rows, prior: Prior, scale: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " P"]:
    """Coefficients with the joints weighted by `scale` (N m or N)."""
    G, b = rows.X.squares(scale**-2.0), rows.X.pulled(rows.y / scale[:, None] ** 2)
    return np.linalg.solve(G + np.diag(prior.precision + 1e-12), b + prior.precision * prior.mean)


def whitening_of(problem: Problem, spectrum: Spectrum) -> Float[np.ndarray, "F nv"]:
    """The response that makes noise with the spectrum white, joint by joint."""
    frequency = np.asarray(problem.records.omega) / (2 * np.pi)
    return noise.whitening(spectrum, frequency, problem.gain, float(problem.records.cutoff))


def _from_repeats(problem: Problem, rows: Rows, state: State, response: Float[np.ndarray, "F nv"]) -> Spectrum:
    residual = rows.y - rows.X @ state.theta
    other = _mean_of_partners(rows, residual)
    partners = np.maximum((rows.partner >= 0).sum(0), 1)
    difference = (residual - other) / np.sqrt(1 + 1 / partners)
    # the differences of one excitation's repeats sum to zero: one of them is no news
    news = 1 - 1 / (1 + partners[partners > 0].mean())
    return _fit(problem, np.where(rows.paired > 0, difference, 0.0), response, news=news)


def _mean_of_partners(rows: Rows, residual: Float[np.ndarray, "nv T"]) -> Float[np.ndarray, "nv T"]:
    return np.stack([rows.instrument(residual[j], j) for j in range(len(residual))])


def _from_rich_model(
    problem: Problem,
    state: State,
    scale: Float[np.ndarray, " nv"],
    forbid: Collection[str],
    count: int,
    richness: int = RICHNESS,
) -> Spectrum:
    """Residual of the baseline with the groups of the catalogue, and smooth families, that a forward selection takes.

    Families stand in for what the catalogue does not hold, those of many columns where the data are long alone: what
    the model misses of a misfit passes for noise.
    """
    response = np.ones((len(np.asarray(problem.records.omega)), 1)) / scale
    long, smooth = count >= ENOUGH or (richness == 1 and _resolved(problem)), count >= ENOUGH and richness > 1
    rich = _rich(problem, state, response, forbid, smooth, richness)
    basis = _basis(rich.rows)
    if not long:
        independent, residual = count * problem.passed, basis.residual
        degrees = independent - np.array([(basis.of(joint) ** 2).sum() for joint in range(len(scale))])
        degrees = np.maximum(degrees, independent / 4)
        squares = ((residual * scale[:, None]) ** 2).sum(1)
        return noise.white(squares / degrees, float(problem.records.rate) / 2, degrees)
    # what the same model leaves of whitened rows: slow noise there carries little through rows that are left out
    response = whitening_of(problem, _fit(problem, basis.residual, response, basis))
    basis = _basis(_behind(problem, rich, response))
    return _fit(problem, basis.residual, response, basis)


class _Taken(NamedTuple):
    """A group that the rich model took, at a grid point: its `effect` there (None of a family), and what is kept of its
    columns."""

    name: Name
    effect: Effect | None
    kept: Float[np.ndarray, "k directions"]


class _Rich(NamedTuple):
    """The rich model: its rows, the state that its columns are evaluated at, and each group that it took."""

    rows: Rows
    state: State
    taken: list[_Taken]

    def columns(self, joint: int) -> Float[np.ndarray, "k T"]:
        """The columns of the groups that one joint has."""
        own = self.rows.X.after(self.rows.X.width - sum(one.kept.shape[1] for one in self.taken)).own[joint]
        return own.columns.T


def _behind(problem: Problem, rich: _Rich, response: Float[np.ndarray, "F nv"]) -> Rows:
    """The rows of the rich model behind another response."""
    state, rows = rich.state, whitened(problem, rich.state, response)
    titles = {one.name.effect for one in rich.taken if one.effect is None}
    families = rich_families(problem, state, response, few=False, titles=titles) if titles else []
    found = {group.name: group.columns for group in families}
    each = [
        found[one.name] if one.effect is None else exact_columns(problem, state, rows, response, one.effect)
        for one in rich.taken
    ]
    more = [_kept_of(rows, columns, 0, one.kept) for columns, one in zip(each, rich.taken, strict=True)]
    return rows._replace(X=rows.X.beside(*more))


def _rich(
    problem: Problem,
    state: State,
    response: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    smooth: bool,
    richness: int,
) -> _Rich:
    """Rows of the state with the columns that a forward selection takes; `smooth` families among them."""
    rows = whitened(problem, state, response)
    state = solved(state, fit(rows, state.prior).theta)
    groups = catalogue(problem, state, rows, response, forbid)
    groups += rich_families(problem, state, response, few=not smooth)
    taken, prior, found, gram = [], state.prior, None, rows.X.squares()
    for _ in range(richness):
        found = screen(rows, fit(rows, prior, gram), groups, found)
        scores = found.scores
        if not scores:
            break
        # families have many columns: only z weighs them fairly
        best = int(np.argmax([(result.z if smooth else result.Q).max() for result in scores]))
        if scores[best].z.max() < _largest_by_chance(scores):
            break  # the best of so many that noise alone would have: without it, the residual would be less than noise
        point = int(np.argmax(scores[best].Q))
        kept = kept_columns(scores[best].root[point])
        more = _kept_of(rows, groups[best].columns, point, kept)
        X = rows.X.beside(more)
        gram = _grown_gram(gram, X, more)
        rows, prior = rows._replace(X=X, Xi=X), prior.extended(more.width)
        effect = jax.tree.map(lambda x, p=point: x[p], groups[best].effect)  # None stays what it is
        taken.append(_Taken(groups[best].name, effect, kept))
    return _Rich(rows, state, taken)


def _grown_gram(gram: Float[np.ndarray, "P0 P0"], X: JointRows, more: JointRows) -> Float[np.ndarray, "P P"]:
    """X'X, of which that of the columns before the last, `more`, is known."""
    cross, before = X.products(more), len(gram)
    return np.block([[gram, cross[:before]], [cross[:before].T, cross[before:]]])


def _largest_by_chance(scores: Sequence[Score]) -> float:
    """About the largest z that noise alone gives of as many candidates and grid points, were they independent."""
    return float(np.sqrt(2 * np.log(max(sum(len(result.z) for result in scores), 1))))


def _kept_of(rows: Rows, columns: Columns, point: int, kept: Float[np.ndarray, "k directions"]) -> JointRows:
    """What is kept of a group's columns at a grid point."""
    return JointRows.at(columns.joints, np.tensordot(kept.T, columns.Z[point], 1), len(rows.y))


def kept_columns(root: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k directions"]:
    """What makes a group's columns those that the model before has not absorbed (`evidence.CUT`), with unit variance.

    A family holds the friction of the baseline once more: with both, nothing tells the one from the other, the residual
    of their fit is orthogonal to neither by as much as the noise, and a candidate of which little is left beside them
    scores what is rounding.
    """
    return root[np.abs(root).max(1) > 0].T


class _Basis(NamedTuple):
    """An orthonormal basis of what the columns of rows span, X times `directions`, and what it leaves of the torque."""

    X: JointRows
    directions: Float[np.ndarray, "P basis"]
    residual: Float[np.ndarray, "nv T"]

    def of(self, joint: int, rows: slice = slice(None)) -> Float[np.ndarray, "rows basis"]:
        """Its rows of one joint: those of all joints would be the largest thing in memory."""
        own = self.X.own[joint]
        return own.columns[rows] @ self.directions[own.place]


def _basis(rows: Rows) -> _Basis:
    """What the rows' columns span, without the directions that rounding leaves."""
    gram = rows.X.squares()
    scale = np.sqrt(np.diag(gram))
    seen = np.flatnonzero(scale > COLUMN_CUT * scale.max())
    values, vectors = np.linalg.eigh(gram[np.ix_(seen, seen)] / np.outer(scale[seen], scale[seen]))
    keep = values > RICH_CUT
    directions = np.zeros((len(scale), int(keep.sum())))
    directions[seen] = vectors[:, keep] / np.sqrt(values[keep]) / scale[seen, None]
    theta = directions @ (directions.T @ rows.X.pulled(rows.y))
    return _Basis(rows.X, directions, rows.y - rows.X @ theta)


def _fit(
    problem: Problem,
    rows: Float[np.ndarray, "nv T"],
    response: Float[np.ndarray, "F nv"],
    taken: _Basis | None = None,
    news: float = 1.0,
) -> Spectrum:
    """Spectrum of unwhitened noise rows, of which a share `news` is independent.

    `taken` is what a model has removed from them.
    """
    records = problem.records
    n, _, count, nv = records.shape
    rate = float(records.rate)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    power, left, kept = np.zeros((3, len(frequency), nv))
    masks: list[Bool[np.ndarray, "rows nv"]] = []
    for at in records.spans:
        here = slice(at.row, at.row + at.rows)
        series = rows.reshape(nv, n, count)[:, at.slot, here].T
        used = np.flatnonzero(np.abs(series).max(1) > 0)
        if len(used) < FEWEST:
            continue
        inside = slice(used[0], used[-1] + 1)
        own, p = noise.periodogram(series[inside], rate, level=True)
        power += len(used) * _onto(frequency, own, p)
        masks.append(series[inside] != 0)
        kept += len(used) * masks[-1].mean(0)
        if taken is not None:
            first = at.slot * count + at.row
            rows_here = slice(first + inside.start, first + inside.stop)
            shares = [noise.leverage(taken.of(joint, rows_here)) for joint in range(nv)]
            left -= len(used) * _onto(frequency, own, np.stack(shares, axis=1))
    sizes = [int(mask.any(1).sum()) for mask in masks]
    weights = sum(sizes)
    power, left, kept = power / weights, np.maximum((left + kept) / weights, 0.1), kept / weights
    known = np.asarray(records.omega) / (2 * np.pi)
    gain = np.interp(frequency, known, problem.gain)
    white = _onto(frequency, known, response) ** 2
    degrees = np.full(len(frequency), max(1.0, weights / count)) * left.mean(1) * news
    degrees[0] /= 2  # one real number
    lowest = min(max(LOWEST_RESOLVED * rate / count, LOWEST_FREQUENCY), rate / 8)
    told = frequency >= (lowest if taken is not None else 0.0)  # what a model misses at low frequency is no noise

    def fitted(leaked: Float[np.ndarray, "freqs nv"] | float) -> Spectrum:
        shown = (power / white / left / leaked)[told]
        return noise.fit_spectrum(frequency[told], shown, gain[told], degrees[told], rate / 2, lowest)

    spectrum = fitted(1.0)
    through = white * gain[:, None] * spectrum.power(frequency)
    through = np.where((told & (gain > noise.PASSED))[:, None], through * left, power) / kept
    seen = [_onto(frequency, *noise.seen_through(mask, rate, frequency, through)) for mask in masks]
    leaked = sum(size * one for size, one in zip(sizes, seen, strict=True)) / weights / (kept * through)
    return fitted(np.clip(leaked, 1 / MOST_LEAKED, MOST_LEAKED))


def _onto(wanted: np.ndarray, own: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(wanted, own, column) for column in values.T], axis=1)
