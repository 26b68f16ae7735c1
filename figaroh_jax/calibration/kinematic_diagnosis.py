r"""Diagnosis at kinematic level: what is wrong with the robot, the device or the postures, named only where it holds.

Two routes to a name. Geometry (offsets, links) by its score against a stated tolerance, and by what postures that were
left out lose without it; effects by what they gain on postures left out of everything that chose them
(`levels.nested`). Both must beat the largest score that noise alone gives over the whole catalogue. Where the robot
that was found predicts held-out postures no better than the frames alone, nothing is named. Geometry that other
corrections, or links that are all a little off, explain as well is told as such (`kinematic_evidence`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from ..effects.kinematic import CATALOGUE
from ..estimation import marginal
from ..recordings.poses import PoseRecording, read_pose_recordings
from ..recordings.posture_checks import check_pose_recordings
from ..results import Cause, Estimate, Experiment, Gain, Name, Nearest, Rest, Selection, Verdict
from ..rigid.model import RobotModel
from . import levels, thresholds
from .calibrated import Calibration
from .calibration import Run
from .candidates import GEOMETRY, moved_rows, moves, twist_rows
from .changes import ZERO
from .kinematic_evidence import Evidence, weigh
from .kinematic_scores import EXACT, Scores, Tested, row_noise, score_blocks, score_jitter
from .outliers import playing_joints, still_outliers, variance_along

if TYPE_CHECKING:
    from ..formats.config import Task

__all__ = ["PoseDiagnosis", "diagnose_pose_task", "diagnose_poses"]

_CONTRADICTED = "the measured points do not follow the model's postures"
_WIDE, _HELD = 100.0, 1e-6  # of a block that was named: free; of one that is taken away


@dataclass(frozen=True, eq=False)
class PoseDiagnosis(Selection):
    """Verdict and causes, with the calibration that they stand on."""

    p_value: float
    before: tuple[float | None, float | None]  # RMS of the frames alone: mm, deg
    after: tuple[float | None, float | None]
    noise: tuple[float | None, float | None]
    experiment: Experiment | None
    calibration: Calibration
    rest: Rest = field(default_factory=lambda: Rest(np.zeros(0)))  # of position, orientation; over that of the frames


def diagnose_pose_task(task: Task, progress: Callable[[str, float], None] = lambda phase, share: None) -> PoseDiagnosis:
    """Diagnose the robot of a task from its recordings with a `measurement`."""
    from ..formats.robotfile import impossible_said, load_robot

    model = load_robot(task, kinematic=True)
    recordings = read_pose_recordings(task, model)
    notes = (*impossible_said(task.robot.model), *check_pose_recordings(task, model, recordings))
    stated = task.diagnose.tolerance
    widths = (stated.offset, stated.geometry)
    found = diagnose_poses(model, recordings, task.diagnose.forbid, task.diagnose.alpha, progress, tolerance=widths)
    notes = (*notes, *found.calibration.notes)
    return replace(found, calibration=replace(found.calibration, posture=dict(task.robot.posture), notes=notes))


def diagnose_poses(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    forbid: Sequence[str] = (),
    alpha: float = 0.05,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    tolerance: tuple[float, float] = thresholds.TOLERANCE,
) -> PoseDiagnosis:
    """Verdict, causes and calibration from postures and what a device measured at each.

    `tolerance`: offsets (rad, or m of a joint that slides) and shifts of links (m) that are good enough; a link may be
    turned by as many mrad as it may be shifted by half millimetres.
    """
    with jax.enable_x64(True):
        run = Run(model, recordings, forbid, progress, alpha=alpha)
        calibration = run.finish()
        progress("testing", 0.92)
        own = _geometry(run, calibration, alpha, tolerance)
        p_rest = run.p_value((run.fit[1], run.fit[2]), run.choice.level, run.named)
        effects = [c for c in calibration.causes if c.name.effect not in (*GEOMETRY, "outlier")]
        play = _play(run, alpha, tolerance[0])
        aside: list[tuple[Cause, str]] = []
        if play.found:  # a law that leaves its own joint erring at random is not the right one
            why = "its joint varies between postures beside it"
            aside += [(c, why) for c in effects if c.name.at in play.places]
            effects = [c for c in effects if c.name.at not in play.places]
        geometry = [replace(c, ambiguous_with=_allowed(c, forbid)) for c in own.causes if c.name.effect not in forbid]
        found = bool(geometry or effects)
        notes = [*calibration.notes, *own.notes]
        if found and not _better(calibration):
            note = "held-out postures are predicted no better than by the frames alone: nothing that was found is named"
            notes.append(note)
            aside += [(c, "held-out postures are predicted no better than by the frames alone") for c in effects]
            geometry, effects = [], []
        outliers = [c for c in calibration.causes if c.name.effect == "outlier"]
        if play.found and not _exact(run):  # the postures that a joint's play moves farthest are no errors of their own
            notes.append(play.note)
            still = [k in play.outliers for k in run.aside]
            within = [c for c, s in zip(outliers, still, strict=True) if not s]
            notes += [f"{c.note}, no farther than a joint that varies so may move it" for c in within]
            outliers = [c for c, s in zip(outliers, still, strict=True) if s]
        if run.unlike is not None:
            outliers = []  # what one recording has for itself is no error of its postures
            geometry, effects, dropped = _alike(run.unlike.name, geometry, effects)
            own = own._replace(nearest=[*own.nearest, *dropped])
        if calibration.contradicted:
            aside += [(c, _CONTRADICTED) for c in effects]
            own = own._replace(nearest=[*own.nearest, *(Nearest(c.name, 0.0, _CONTRADICTED) for c in geometry)])
            outliers, geometry, effects = [], [], []
        causes = tuple([*outliers, *geometry, *effects])
        p_value = min(1.0, 2.0 * min(own.p_value, run.p_effects))
        left_over = (
            run.history
            or play.found
            or bool(run.changes)
            or run.unlike is not None
            or p_rest < thresholds.OF_ALPHA * alpha
        )
        rest = own.rest or (left_over and not _exact(run))
        rest = rest or calibration.contradicted or _beyond_accuracy(recordings, calibration)
        rest = rest or (found and not (geometry or effects)) or len(own.causes) > len(geometry)
        nearest = [*own.nearest, *(Nearest(c.name, _share(c.gain), why) for c, why in aside)]
        nearest += run.unsure
        left = _left(calibration, run)
        return _answer(replace(calibration, notes=tuple(notes)), causes, p_value, rest, nearest, left)


def _alike(
    unlike: Name | None, geometry: list[Cause], effects: list[Cause]
) -> tuple[list[Cause], list[Cause], list[Nearest]]:
    """What is named, and what came near, where one recording errs in a way of its own, most like the effect `unlike`.

    An effect that all of them show is the one that they do not have alike, and has no one size; else nothing is named.
    """
    if unlike is not None and unlike not in [c.name for c in effects]:
        why = "the recordings differ in a way that has no name"
        near = [Nearest(unlike, 0.0, "most like what one of the recordings has for itself")]
        return [], [], near + [Nearest(c.name, _share(c.gain), why) for c in (*effects, *geometry)]
    note = "the recordings do not have it alike: it has no one size"
    return geometry, [replace(c, parameters={}, note=note) if c.name == unlike else c for c in effects], []


def _allowed(cause: Cause, forbid: Sequence[str]) -> tuple[Name, ...]:
    return tuple(name for name in cause.ambiguous_with if name.effect not in forbid)


def _share(gain: Gain) -> float:
    return max(1.0 - gain.after / gain.before, 0.0) if gain.before > 0.0 else 0.0


class _Named(NamedTuple):
    """Causes of the geometry, the p-value of the first, and what is beyond tolerance but has no place."""

    causes: list[Cause]
    p_value: float
    rest: bool
    notes: list[str]
    nearest: list[Nearest]


class _Geometry(NamedTuple):
    """Rows about the fit of full geometry, with columns of the named effects (free) and of a base said to be known."""

    linear: marginal.Linear
    names: list[Name]
    places: list[np.ndarray]  # columns of each name
    columns: list[tuple[str, str, float]]  # parameter, unit and size of each column
    width: np.ndarray  # stated tolerance of each unknown, in its size


def _geometry_of(run: Run, tolerance: tuple[float, float], about: np.ndarray | None = None) -> _Geometry:
    """The rows about the fit of full geometry, or `about` other unknowns of it."""
    measured = run.measured
    linear = run.choice.fits["full"][0] if about is None else levels.linearise(measured, about)
    known = [b for b in run.blocks if b.effect.name == "base_frame"] if run.effects else []
    extra = [*run.extension, *known]
    added = [column for block in extra for column in block.columns]
    sizes = np.array([size for block in extra for size in block.sizes])
    scale = np.asarray(measured.problem.scale)
    columns = [(c.parameter, c.unit, float(size)) for c, size in zip(measured.columns, scale, strict=False)]
    groups = _widths(tolerance)
    width = groups[np.maximum(linear.prior, 0)]
    names = [Name("joint_offset" if c.effect == ZERO else c.effect, c.at) for c in measured.columns]
    width[[k for k, c in enumerate(measured.columns) if c.effect == ZERO]] = groups[0]
    places = {name: np.array([k for k, n in enumerate(names) if n == name]) for name in names}
    if added:
        Z = moved_rows(measured, twist_rows(measured, linear.at), [moves(c, run.postures) for c in added])
        effects = sum(len(block.columns) for block in run.extension)
        group = np.where(np.arange(len(added)) < effects, marginal.FLAT, levels.EFFECT)
        first = len(linear.at)
        linear = linear._replace(
            jacobian=np.hstack([linear.jacobian, Z * sizes]),
            at=np.concatenate([linear.at, np.zeros(len(added))]),
            prior=np.concatenate([linear.prior, group]),
        )
        width = np.concatenate([width, [groups[1 if c.unit == "m" else 2] for c in added] * (1e-3 / sizes)])
        columns += [("", "", 1.0)] * (first - len(columns))
        columns += [(c.parameter, c.unit, float(size)) for c, size in zip(added, sizes, strict=True)]
        if known:
            places[known[0].name] = np.arange(first + effects, first + len(added))
    return _Geometry(linear, list(places), list(places.values()), columns, width)


def _geometry(run: Run, calibration: Calibration, alpha: float, tolerance: tuple[float, float]) -> _Named:
    """Offsets and links beyond their stated tolerance that postures tell from all others, the most evident first."""
    linear, names, places, columns, width = _geometry_of(run, tolerance)
    noise = row_noise(linear, run.fit[2])
    stated = width.copy()
    named: list[int] = []
    first = 1.0
    size = np.zeros(len(places), int)
    while len(named) < thresholds.MOST_GEOMETRY:
        scores = _beyond(linear, noise, run.used, width, places, named)
        if not named:
            first, size = scores.p_value, scores.size
        if scores.p_value > thresholds.OF_ALPHA * alpha:
            break
        named.append(_simplest(scores))
        width[places[named[-1]]] = _WIDE
    if not named:
        return _Named([], first, False, [], [])
    kept = _needed(linear, noise, run.used, places, named)
    told, same, dropped = weigh(Evidence(linear, noise, run.used, stated, places, kept), kept, size.tolist())
    at, covariance = _settled(run, tolerance, noise, told.width)
    gain, twins = _gain(calibration), _twins(run)
    causes = []
    for k in told.chosen:
        values, unknown = {}, []
        for i in places[k]:
            std = float(np.sqrt(covariance[i, i]))
            if std > thresholds.KNOWN * told.width[i]:
                unknown.append(columns[i][0])
            else:
                values[columns[i][0]] = Estimate(float(at[i]) * columns[i][2], std * columns[i][2], columns[i][1])
        others = [names[j] for j in same[k]]
        others += [name for twin in twins if names[k] in twin for name in twin if name != names[k]]
        note = f"{', '.join(unknown)}: not determined by these postures" if unknown else ""
        causes.append(
            Cause(names[k], values, 1.0 - first, gain, ambiguous_with=tuple(dict.fromkeys(others)), note=note)
        )
    beside = stated.copy()
    for k in told.chosen:
        beside[places[k]] = _WIDE
    scores = _beyond(linear, noise, run.used, beside, places, told.chosen)
    rest = scores.p_value <= thresholds.OF_ALPHA * alpha
    near = _not_told(linear, noise, run.used, told.width, places, names, dropped) if rest else []
    return _Named(causes, first, rest, [_grown(told.growth, tolerance)] if rest else [], near)


def _settled(
    run: Run, tolerance: tuple[float, float], noise: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The unknowns at prior widths, and their covariance, linearised anew until they stay.

    A fit with other widths shares what postures do not tell apart otherwise, by which products of errors change.
    """
    linear, count = _geometry_of(run, tolerance).linear, len(run.choice.fits["full"][0].at)
    at, covariance = _posterior_mode(linear, noise, run.used, width)
    for _ in range(thresholds.SETTLING):
        before = at
        at, covariance = _posterior_mode(_geometry_of(run, tolerance, at[:count]).linear, noise, run.used, width)
        if np.abs(at - before).max() < 1e-3:  # mrad and mm
            break
    return at, covariance


def _beyond(
    linear: marginal.Linear,
    noise: np.ndarray,
    used: np.ndarray,
    width: np.ndarray,
    places: Sequence[np.ndarray],
    named: Sequence[int],
) -> Scores:
    """Scores of all corrections that are not `named` beside a robot within the widths."""
    at, _ = _posterior_mode(linear, noise, used, width)
    here = linear._replace(residual=linear.residual + linear.jacobian @ (at - linear.at), at=at)
    blocks = [linear.jacobian[:, p] if k not in named else np.zeros((len(noise), 0)) for k, p in enumerate(places)]
    return score_blocks(Tested(here, noise, used, width**-2.0, np.ones(len(width), bool)), blocks, len(named))


def _widths(tolerance: tuple[float, float]) -> np.ndarray:
    """How far offsets, shifts and turns of links, and what belongs to a device may be off, in mrad and mm."""
    offset, shift = np.maximum(tolerance, 1e-9)
    default = thresholds.TOLERANCE
    return np.array([1e3 * offset, 1e3 * shift, 1e3 * thresholds.TURN * shift / default[1], 1.0, 1.0])


def _grown(growth: tuple[float, float], tolerance: tuple[float, float]) -> str:
    """A note on geometry that is off in a way that no single correction tells."""
    stated = _widths(tolerance)[1:3]
    sizes = [size * scale for size, scale in zip(stated, growth, strict=True)]
    what = "the geometry is off beyond its tolerance in a way that these postures do not place"
    if max(growth) < 1.4:
        return what
    return (
        f"{what}: all links off by some {sizes[0]:.1f} mm and {sizes[1]:.1f} mrad explain it"
        f" (tolerance {stated[0]:g} mm and {stated[1]:g} mrad)"
    )


def _not_told(
    linear: marginal.Linear, noise, used, width, places, names: Sequence[Name], dropped: Sequence[int]
) -> list[Nearest]:
    """Corrections found and not named, and the share of the error on postures left out that each takes."""
    now, found = np.sqrt(_left_out_squares(linear, noise, used, width).mean()), []
    for k in dropped:
        wide = width.copy()
        wide[places[k]] = _WIDE
        share = 1.0 - np.sqrt(_left_out_squares(linear, noise, used, wide).mean()) / now
        why = "links that are all a little off explain the postures as well"
        found.append(Nearest(names[k], max(float(share), 0.0), why))
    return found


def _needed(
    linear: marginal.Linear,
    noise: np.ndarray,
    used: np.ndarray,
    places: Sequence[np.ndarray],
    named: Sequence[int],
) -> list[int]:
    """Those of the blocks `named` that postures left out are worse without, by more than chance.

    All other geometry is held at the nominal one: what a joint's offset does, the next link can do as well.
    """
    kept, width = list(named), np.full(len(linear.at), _HELD)
    for k in kept:
        width[places[k]] = _WIDE
    while kept:
        free = _left_out_squares(linear, noise, used, width)
        worth = []
        for k in kept:
            held = width.copy()
            held[places[k]] = _HELD
            loss = _left_out_squares(linear, noise, used, held) - free
            worth.append(loss.mean() / (loss.std(ddof=1) / np.sqrt(len(loss)) + 1e-300))
        least = int(np.argmin(worth))
        if worth[least] > thresholds.LOSS_SIGMAS:
            break
        width[places[kept.pop(least)]] = _HELD
    return kept


def _left_out_squares(linear: marginal.Linear, noise: np.ndarray, used: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Sum of the whitened squares of each posture, predicted without its fold."""
    postures = np.unique(linear.posture[used & (linear.posture >= 0)])
    found = np.zeros(len(postures))
    for k in range(min(thresholds.FOLDS, len(postures))):
        out = np.isin(linear.posture, postures[k :: thresholds.FOLDS])
        at, _ = _posterior_mode(linear, noise, used & ~out, width)
        rows = np.flatnonzero(out & used)
        square = ((linear.residual[rows] + linear.jacobian[rows] @ (at - linear.at)) / noise[rows]) ** 2
        found += np.bincount(np.searchsorted(postures, linear.posture[rows]), square, minlength=len(postures))
    return found


def _better(calibration: Calibration) -> bool:
    """Whether held-out postures are predicted better than by the frames alone, in position and orientation together."""
    both = [e for e in (calibration.position, calibration.orientation) if e is not None and e.validated_before > 0.0]
    return bool(np.mean([np.log(e.validated_after / e.validated_before) for e in both]) < 0.0) if both else False


def _twins(run: Run) -> list[tuple[Name, ...]]:
    """Names that nothing can tell apart: a base that is said to be known stands where the first joint stands."""
    place = (run.model.joints[run.chain[0]].name,)
    known = any(b.effect.name == "base_frame" for b in run.blocks)
    return [(Name("base_frame", ()), *(Name(effect, place) for effect in GEOMETRY))] if known else []


def _posterior_mode(linear: marginal.Linear, noise, used, width) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns at fixed noise and prior widths, and their covariance."""
    rows = np.flatnonzero(used)
    G = linear.jacobian[rows] / noise[rows, None]
    precision = np.where(linear.prior == marginal.FLAT, 1e-10, width**-2.0)
    tall = np.vstack([G, np.diag(np.sqrt(precision))])  # rows may be all but exact: squares would lose the prior
    root = np.linalg.inv(np.linalg.qr(tall, mode="r"))
    pull = G.T @ (linear.residual[rows] / noise[rows]) + precision * linear.at
    return linear.at - root @ (root.T @ pull), root @ root.T


def _simplest(scores: Scores) -> int:
    """Block that explains most for its number of columns."""
    merit = np.where(scores.size > 0, scores.q - scores.size * 5.0, -np.inf)
    return int(np.argmax(merit))


class _Play(NamedTuple):
    """Whether postures err beyond noise in all their rows together, which joints may do it, and the outliers beside."""

    found: bool
    places: tuple[tuple[str], ...]  # one of these joints; none: the device may err so as well
    outliers: tuple[int, ...]  # postures left out that are too far off for it
    note: str


def _play(run: Run, alpha: float, tolerance: float) -> _Play:
    """Errors at random from posture to posture as if a joint moved, by more than the rounding of good readings.

    `tolerance`: rad (or m), how well a good joint is zeroed.
    """
    final, linear, posterior, _ = run.fit
    joints = [(c.at[0], k) for k, c in enumerate(final.columns) if c.effect == "joint_offset"]
    free = levels.free_at(run.choice.level, linear.prior)
    tested = Tested(linear, row_noise(linear, posterior), run.used, posterior.precision, free)
    ways = linear.jacobian[:, [k for _, k in joints]]
    p_value, worst = score_jitter(tested, ways)
    if p_value >= thresholds.OF_ALPHA * alpha:
        return _Play(False, (), run.aside, "")
    first = len(final.columns)
    base = [first + k for k, (name, _) in enumerate(final.own) if name.split()[0] == "base_frame"]
    level = posterior.noise[linear.channel]  # a posture that varies much counts in full
    which = playing_joints(linear, level, run.used, ways, linear.jacobian[:, base])
    scale = np.asarray(final.problem.scale)[[k for _, k in joints]]
    sizes = [scale[k] ** 2 * variance_along(linear, posterior, run.used, ways[:, k]) for k in which or [worst]]
    if np.sqrt(max(sizes)) < thresholds.LEAST_PLAY * tolerance:
        return _Play(False, (), run.aside, "")
    outliers = still_outliers(linear, posterior, run.used, ways[:, which[0] if which else worst], run.aside)
    names = [joints[k][0] for k in which]
    one = f"{', '.join(names[:-1])} or {names[-1]}" if len(names) > 1 else "".join(names)
    note = (
        f"the true position of {one} varies about its reading between postures: backlash, or poor repeatability;"
        " or the device errs as if it did"
    )
    if not names:
        note = (
            "the rows of a posture err together, at random between postures: the device does, or a joint with backlash"
            f" or poor repeatability ({joints[worst][0]} would explain most)"
        )
    return _Play(True, tuple((name,) for name in names), tuple(outliers), note)


def _exact(run: Run) -> bool:
    """Whether no more is left than rounding, whose pattern is no cause's: postures of a simulation without noise."""
    linear, posterior = run.fit[1:3]
    return bool((posterior.noise[linear.channel[run.used]] <= EXACT).all())


def _beyond_accuracy(recordings: Sequence[PoseRecording], calibration: Calibration) -> bool:
    """Whether the noise that is left is more than the device is said to have."""
    for c in (0, 1):
        stated = [r.accuracy[c] for r in recordings if r.accuracy[c] is not None]
        if stated and calibration.noise[c] > thresholds.NOISY * max(s for s in stated if s is not None):
            return True
    return False


def _gain(calibration: Calibration) -> Gain:
    error = calibration.position or calibration.orientation
    assert error is not None
    return Gain(error.validated_before, error.validated_after, error.unit)


def _answer(
    calibration: Calibration, causes: tuple[Cause, ...], p_value: float, rest: bool, nearest: Sequence[Nearest], left
) -> PoseDiagnosis:
    verdict: Verdict = ("named+rest" if rest else "named") if causes else ("unknown" if rest else "nothing")
    errors = (calibration.position, calibration.orientation)
    scale = (1e3, 180.0 / np.pi)
    experiment = None
    doubted = next((c for c in causes if c.ambiguous_with), None)
    entry = CATALOGUE.get(doubted.name.effect) if doubted else None
    wording = entry.separated_by_postures or entry.separated_by if entry else ""
    if doubted is not None and wording:
        text = wording.format(at=" and ".join(doubted.name.at) or "all joints")
        pairs = tuple((doubted.name.effect, other.effect) for other in doubted.ambiguous_with)
        experiment = Experiment(text, tuple(dict.fromkeys(pairs)))
    return PoseDiagnosis(
        solution=calibration.solution,
        verdict=verdict,
        causes=causes,
        p_value=p_value,
        before=(errors[0] and errors[0].before, errors[1] and errors[1].before),
        after=(errors[0] and errors[0].after, errors[1] and errors[1].after),
        noise=(
            errors[0] and scale[0] * calibration.noise[0],
            errors[1] and scale[1] * calibration.noise[1],
        ),
        experiment=experiment,
        calibration=replace(calibration, verdict=verdict, causes=causes),
        rest=Rest(left, nearest=tuple(nearest)),
    )


def _left(calibration: Calibration, run: Run) -> np.ndarray:
    """What the causes leave beyond the noise, of position and orientation as far as measured, over the error before."""
    found, measured = [], run.measured
    sizes = zip((calibration.position, calibration.orientation), calibration.noise, (1e3, 180.0 / np.pi), strict=True)
    for c, (error, noise, scale) in enumerate(sizes):
        if error is not None:
            rows = measured.measured & (measured.channel == c)
            numbers = rows.sum() / len(np.unique(measured.item[rows]))  # of one point or one orientation
            beyond = error.after**2 - numbers * (scale * noise) ** 2
            found.append(np.sqrt(max(beyond, 0.0)) / max(error.before, 1e-300))
    return np.array(found)
