r"""How much of the kinematics to estimate: the level and the effects that predict held-out postures best.

Levels are nested: the frames of the device alone, the joints' offsets with them, then every link's geometry. Each is a
robust maximum a posteriori fit (`marginal`); each is judged by what it predicts for every posture without that one.
Effects join one by one, the one that gains most on postures left out (every fifth one) first, as long as the gain is
worth it; all widths and weights are chosen without those. `nested` repeats the whole choice inside each of five outer
folds, so that what it reports on the postures of a fold was chosen without them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..estimation import marginal, posefit
from ..estimation.marginal import FLAT, Linear, Posterior
from ..estimation.posegroups import Measured
from ..estimation.posesolver import solve
from . import thresholds
from .joining import Effects, Inner, joined, rms
from .kinematic_scores import Tested, row_noise, waves_shown

__all__ = [
    "EFFECT",
    "LEVELS",
    "Choice",
    "Effects",
    "Fold",
    "choose",
    "errors",
    "fit_level",
    "linearise",
    "nested",
    "pooled",
    "rms",
    "tolerances",
]

LEVELS = ("frames", "joint_offset", "full")
EFFECT, _EMPTY = 3, 4  # prior groups: 0 offsets, 1 translations, 2 rotations, 3 effects, 4 empty columns
_TOLERANCE = (5.0, 1.0, 1.0, 1.0, 1.0)  # stated widths in mrad or mm
_NO_WIDTH = 1e6  # of a prior that says nothing
_PATIENCE = 2000  # steps along the valleys of what the data hardly show

Array = np.ndarray


class Choice(NamedTuple):
    """A level with the effects (indices of blocks, in the order found) chosen on some rows, and its fit."""

    level: str
    effects: tuple[int, ...]
    fits: dict[str, tuple[Linear, Posterior]]  # every level's rows at its fit
    scores: dict[str, float]  # held-out error of each level, and of each effect that joined
    rivals: tuple[tuple[int, ...], ...] = ()  # effects that gain nearly as much as each of the chosen ones

    @property
    def linear(self) -> Linear:
        """The rows at the fit of the chosen level."""
        return self.fits[self.level][0]


class Fold(NamedTuple):
    """An outer fold: what was chosen without its postures, and the errors on them in m and rad."""

    choice: Choice
    levels: dict[str, tuple[Array, Array]]
    plain: tuple[Array, Array]  # the chosen level without effects
    chosen: tuple[Array, Array]


def tolerances(measured: Measured) -> tuple[Int[Array, " unknowns"], Float[Array, " groups"]]:
    """Prior group of every unknown (devices' own have none) and the stated width of each group."""
    known = {"joint_offset": 0, "link_geometry m": 1, "link_geometry rad": 2, "": _EMPTY}
    names = (f"{c.effect} {c.unit}" if c.effect == "link_geometry" else c.effect for c in measured.columns)
    groups = [known.get(name, EFFECT) for name in names]
    width = np.full(len(_TOLERANCE), _NO_WIDTH) if measured.plain else np.array(_TOLERANCE)
    return np.array([*groups, *(FLAT for _ in measured.own)], int), width


def free_at(level: str, prior: Int[Array, " unknowns"]) -> Bool[Array, " unknowns"]:
    """Which unknowns the level estimates; effects that stand among the columns always."""
    highest = {"frames": FLAT, "joint_offset": 0, "full": 2}[level]
    return (prior <= highest) | (prior == EFFECT)


def linearise(measured: Measured, at: Float[Array, " unknowns"]) -> Linear:
    """The problem's rows at a point."""
    residual, jacobian = posefit.linearise(measured.problem, at)
    prior, width = tolerances(measured)
    return Linear(residual, jacobian, at, measured.channel, measured.posture, prior, width)


def fit_level(
    measured: Measured, used: Bool[Array, " rows"], level: str, start: Float[Array, " unknowns"] | None = None
) -> tuple[Linear, Posterior]:
    """Fit of a level to the rows `used`, linearised anew until it stays; the frames alone by plain least squares."""
    prior, _ = tolerances(measured)
    at = np.zeros(len(prior)) if start is None else start
    if measured.plain and level != "frames":  # without priors undamped steps lead astray
        linear = linearise(measured, _least_squares(measured, used, level, at))
        return linear, marginal.fit(linear, used, free_at(level, prior))._replace(unknowns=linear.at)
    posterior = None
    linear = linearise(measured, at)
    for _ in range(8):
        posterior = marginal.fit(linear, used, free_at(level, prior), robust=level != "frames", start=posterior)
        step = np.abs(posterior.unknowns - linear.at).max()
        linear = linearise(measured, posterior.unknowns)
        if step < 1e-3:
            break
    assert posterior is not None
    return linear, posterior


def _least_squares(measured: Measured, used: Array, level: str, at: Array) -> Array:
    """Levenberg-Marquardt without priors, each channel in the size of its residual at the start."""
    linear = linearise(measured, at)
    free = free_at(level, linear.prior)
    size = [rms(linear.residual[used & (linear.channel == c)]) for c in (0, 1)]
    rows = np.where(used, 1.0 / np.array(size)[linear.channel], 0.0)
    precision = np.where(free & (linear.prior != FLAT), _NO_WIDTH**-2.0, np.where(free, 1e-10, 1.0))
    start = np.where(free, at, 0.0)
    return solve(measured.problem, rows, precision, free, start, max_steps=_PATIENCE).unknowns


def errors(measured: Measured, residual: Float[Array, " rows"], postures: Int[Array, " some"]) -> tuple[Array, Array]:
    """Error of every point (m) and every orientation (rad) measured in the given postures.

    What sits in a socket that no fitted posture shows is compared with the mean of its own.
    """
    found = []
    for channel in (0, 1):
        rows = (measured.channel == channel) & measured.measured & np.isin(measured.posture, postures)
        square = np.bincount(measured.item[rows], residual[rows] ** 2)
        found.append(np.sqrt(square[np.bincount(measured.item[rows]) > 0]) if rows.any() else np.zeros(0))
    return found[0], found[1]


def pooled(parts: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """RMS error of all folds together, m and rad."""
    a, b = (rms(np.concatenate([part[c] for part in parts])) for c in (0, 1))
    return a, b


def choose(measured: Measured, used: Bool[Array, " rows"], effects: Effects | None, asked: str | None = None) -> Choice:
    """Level and effects that predict best on postures left out of the rows `used`; the level `asked` for, if any."""
    fits, scores, best = {}, {}, asked
    start = None
    for level in LEVELS:
        linear, posterior = fit_level(measured, used, level, start)
        start = posterior.unknowns
        fits[level] = linear, posterior
        if asked is None:
            scores[level] = _held_out(measured, linear, used, posterior)
            better = best is None or scores[level] < (1.0 - thresholds.LEVEL_GAIN) * scores[best]
            if better and (best is None or _room(posterior, used) >= 0.0):
                best = level
    assert best is not None
    linear, posterior = fits[best]
    if effects is None:
        return Choice(best, (), fits, scores)
    chosen, rivals = _forward(measured, used, best, linear, posterior, effects, scores)
    while chosen and asked is None:  # a large effect hides what the links are off
        higher = _beside(measured, used, fits, best, effects, chosen)
        if higher == best:
            break
        best = higher
        chosen, rivals = _forward(measured, used, best, *fits[best], effects, scores)
    return Choice(best, chosen, fits, scores, rivals)


def widened(linear: Linear, columns: Float[Array, "rows some"]) -> Linear:
    """The rows with columns of effects behind the others."""
    return linear._replace(
        jacobian=np.hstack([linear.jacobian, columns]),
        at=np.r_[linear.at, np.zeros(columns.shape[1])],
        prior=np.r_[linear.prior, np.full(columns.shape[1], EFFECT)],
    )


def _beside(
    measured: Measured,
    used: Array,
    fits: Mapping[str, tuple[Linear, Posterior]],
    lowest: str,
    effects: Effects,
    chosen: Sequence[int],
) -> str:
    """The level that predicts best beside effects that were chosen at the `lowest`, to first order about its fit."""
    best, least = lowest, np.inf
    for level in LEVELS[LEVELS.index(lowest) :]:
        linear = fits[level][0]
        wide = widened(linear, effects.jacobian(linear.at, chosen))
        posterior = marginal.fit(wide, used, free_at(level, wide.prior), robust=True)
        score = _held_out(measured, wide, used, posterior)
        if score < (1.0 - thresholds.LEVEL_GAIN) * least and _room(posterior, used) >= 0.0:
            best, least = level, score
    return best


def _inner_folds(measured: Measured, used: Array) -> list[tuple[Array, Array]]:
    """Rows to fit, and postures left out, of each inner fold."""
    inside = np.unique(measured.posture[used & (measured.posture >= 0)])
    folds = [inside[k :: thresholds.FOLDS] for k in range(min(thresholds.FOLDS, len(inside)))]
    return [(used & ~np.isin(measured.posture, fold), fold) for fold in folds]


def _room(posterior: Posterior, used: Bool[Array, " rows"]) -> float:
    """How many more numbers the rows can tell than the fit takes from them; where it takes most, they are hardly held
    out from one another."""
    return thresholds.OF_ROWS * float(used.sum()) - posterior.freedom


def _held_out(measured: Measured, linear: Linear, used: Array, posterior: Posterior) -> float:
    """Typical error of a posture that was left out of the fit: the geometric mean, in which no single one counts much.

    A robust fit bears postures with a heavy tail; the root mean square of a few dozen would choose by them alone.
    """
    _, predicted = marginal.left_out(linear, posterior, used)
    parts = errors(measured, predicted, np.unique(linear.posture[used & (linear.posture >= 0)]))
    return float(np.exp(np.mean([np.mean(np.log(part + 1e-15)) for part in parts if len(part)])))


def _forward(
    measured: Measured,
    used: Array,
    level: str,
    linear: Linear,
    posterior: Posterior,
    effects: Effects,
    scores: dict[str, float],
) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Effects that join one by one, each the one that gains most on the inner folds.

    Gear errors of high order take part where the rows to fit show one, at first or beside what joined without them.
    """
    free = free_at(level, linear.prior)
    inner = [
        (marginal.fit(linear, rows, free, robust=True, start=posterior, iterations=15), rows, fold)
        for rows, fold in _inner_folds(measured, used)
    ]
    tested = Tested(linear, row_noise(linear, posterior), used, posterior.precision, free)

    def taken_in(which: Sequence[int]) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...], dict[str, float]]:
        Z = effects.jacobian(linear.at, which)
        folds = [Inner.make(measured, linear, *one, free, Z) for one in inner]
        return joined(folds, effects, which, level, _room(posterior, used))

    def shown(beside: Sequence[int]) -> list[int]:
        columns = effects.jacobian(linear.at, beside)
        waves, parts = effects.waves(linear.at), [rows for _, rows, _ in inner]
        return waves_shown(tested, waves, columns, parts)

    which = [*range(effects.grid), *shown(())]
    chosen, rivals, found = taken_in(which)
    more = sorted(set(shown(chosen)) - set(which)) if chosen else []
    if more:
        chosen, rivals, found = taken_in([*which, *more])
    scores.update(found)
    return chosen, rivals


def nested(
    measured: Measured,
    used: Bool[Array, " rows"],
    effects: Effects | None,
    extended: Callable[[Choice, Bool[Array, " rows"]], Float[Array, " rows"]],
    asked: str | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Fold]:
    """Five outer folds (every fifth posture): the whole choice without each, and the errors on it.

    `extended(choice, rows)` gives the residual of all rows for a choice with its effects fitted to `rows`.
    """
    inside = np.unique(measured.posture[used & (measured.posture >= 0)])
    folds = []
    for k in range(min(thresholds.FOLDS, len(inside))):
        fold = inside[k :: thresholds.FOLDS]
        rows = used & ~np.isin(measured.posture, fold)
        choice = choose(measured, rows, effects, asked)
        each = {level: errors(measured, fit[0].residual, fold) for level, fit in choice.fits.items()}
        plain = each[choice.level]
        chosen = errors(measured, extended(choice, rows), fold) if choice.effects else plain
        folds.append(Fold(choice, each, plain, chosen))
        progress((k + 1) / thresholds.FOLDS)
    return folds
