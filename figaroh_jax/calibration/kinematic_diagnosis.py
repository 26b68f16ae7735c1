r"""Diagnosis at kinematic level: what is wrong with the robot, the device or the postures, named only where it holds.

Two routes to a name. Geometry (offsets, links) by its score against a stated tolerance, and by what postures that were
left out lose without it; effects by what they gain on postures left out of everything that chose them
(`levels.nested`). Both must beat the largest score that noise alone gives over the whole catalogue. Where the robot
that was found predicts held-out postures no better than the frames alone, nothing is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from ..effects.kinematic import CATALOGUE, HISTORY
from ..estimation import marginal
from ..recordings.poses import PoseRecording, read_pose_recordings
from ..recordings.posture_checks import check_pose_recordings
from ..results import Cause, Estimate, Experiment, Gain, Name, Selection, Verdict
from ..rigid.model import RobotModel
from . import levels, thresholds
from .calibrated import Calibration
from .calibration import Run
from .candidates import GEOMETRY, moved_rows, moves, twist_rows
from .kinematic_scores import Scores, row_noise, score_blocks, score_jitter, score_waves

if TYPE_CHECKING:
    from ..formats.config import Task

__all__ = ["PoseDiagnosis", "diagnose_pose_task", "diagnose_poses"]

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


def diagnose_pose_task(task: Task, progress: Callable[[str, float], None] = lambda phase, share: None) -> PoseDiagnosis:
    """Diagnose the robot of a task from its recordings with a `measurement`."""
    from ..formats.robotfile import load_robot

    model = load_robot(task)
    recordings = read_pose_recordings(task, model)
    notes = check_pose_recordings(task, model, recordings)
    found = diagnose_poses(model, recordings, task.diagnose.forbid, task.diagnose.alpha, progress)
    notes = (*notes, *found.calibration.notes)
    return replace(found, calibration=replace(found.calibration, posture=dict(task.robot.posture), notes=notes))


def diagnose_poses(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    forbid: Sequence[str] = (),
    alpha: float = 0.05,
    progress: Callable[[str, float], None] = lambda phase, share: None,
) -> PoseDiagnosis:
    """Verdict, causes and calibration from postures and what a device measured at each."""
    with jax.enable_x64(True):
        run = Run(model, recordings, forbid, progress)
        calibration = run.finish()
        progress("testing", 0.92)
        geometry, p_geometry = _geometry(run, calibration, alpha)
        p_effects, p_rest = _effect_scores(run)
        effects = [c for c in calibration.causes if c.name.effect not in (*GEOMETRY, "outlier")]
        p_play, joint = _play(run)
        plays = p_play < thresholds.OF_ALPHA * alpha
        if p_effects > alpha:
            effects = []
        elif plays:  # a law that leaves its own joint erring at random is not the right one
            effects = [cause for cause in effects if cause.name.at != (joint,)]
        effects = [cause for cause in effects if _has_size(cause)]
        geometry = [c for c in geometry if c.name.effect not in forbid]
        found = bool(geometry or effects)
        if found and not _better(calibration):
            geometry, effects = [], []
            note = "held-out postures are predicted no better than by the frames alone: nothing that was found is named"
            calibration = replace(calibration, notes=(*calibration.notes, note))
        outliers = [c for c in calibration.causes if c.name.effect == "outlier"]
        if plays:  # the postures that a joint's play moves farthest are no errors of their own
            outliers = []
        causes = tuple([*outliers, *geometry, *_with_rivals(effects, run)])
        p_value = min(1.0, 2.0 * min(p_geometry, p_effects))
        if plays:
            what = "backlash, or poor repeatability"
            note = f"the true position of {joint} varies about its reading between postures: {what}"
            aside = [f"{c.note}, not named beside {what}" for c in calibration.causes if c.name.effect == "outlier"]
            calibration = replace(calibration, notes=(*calibration.notes, note, *aside))
        rest = run.history or plays or p_rest < thresholds.OF_ALPHA * alpha or _beyond_accuracy(recordings, calibration)
        rest = rest or (found and not (geometry or effects))
        return _answer(calibration, causes, p_value, rest)


class _Geometry(NamedTuple):
    """Rows about the fit of full geometry, with columns of the named effects (free) and of a base said to be known."""

    linear: marginal.Linear
    names: list[Name]
    places: list[np.ndarray]  # columns of each name
    columns: list[tuple[str, str, float]]  # parameter, unit and size of each column
    width: np.ndarray  # stated tolerance of each unknown, in its size


def _geometry_of(run: Run) -> _Geometry:
    linear, _ = run.choice.fits["full"]
    measured = run.measured
    known = [b for b in run.blocks if b.effect.name == "base_frame"] if run.effects else []
    extra = [*run.extension, *known]
    added = [column for block in extra for column in block.columns]
    sizes = np.array([size for block in extra for size in block.sizes])
    scale = np.asarray(measured.problem.scale)
    columns = [(c.parameter, c.unit, float(size)) for c, size in zip(measured.columns, scale, strict=False)]
    width = np.array(thresholds.TOLERANCE)[np.maximum(linear.prior, 0)]
    names = [Name(c.effect, c.at) for c in measured.columns]
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
        width = np.concatenate(
            [width, [thresholds.TOLERANCE[1 if c.unit == "m" else 2] for c in added] * (1e-3 / sizes)]
        )
        columns += [("", "", 1.0)] * (first - len(columns))
        columns += [(c.parameter, c.unit, float(size)) for c, size in zip(added, sizes, strict=True)]
        if known:
            places[known[0].name] = np.arange(first + effects, first + len(added))
    return _Geometry(linear, list(places), list(places.values()), columns, width)


def _geometry(run: Run, calibration: Calibration, alpha: float) -> tuple[list[Cause], float]:
    """Offsets and links beyond their stated tolerance, the most evident first, and the p-value of the first one."""
    linear, names, places, columns, width = _geometry_of(run)
    noise = row_noise(linear, run.fit[2])
    named: list[int] = []
    first = 1.0
    free = np.ones(len(width), bool)
    at, covariance = linear.at, np.zeros((len(width),) * 2)
    while len(named) < thresholds.MOST_GEOMETRY:
        at, covariance = _posterior_mode(linear, noise, run.used, width)
        here = linear._replace(residual=linear.residual + linear.jacobian @ (at - linear.at), at=at)
        blocks = [linear.jacobian[:, p] if k not in named else np.zeros((len(noise), 0)) for k, p in enumerate(places)]
        scores = score_blocks(here, noise, run.used, width**-2.0, blocks, free, seed=len(named))
        first = scores.p_value if not named else first
        if scores.p_value > thresholds.OF_ALPHA * alpha:
            break
        named.append(_simplest(scores))
        width[places[named[-1]]] = _WIDE
    gain, twins = _gain(calibration), _twins(run)
    named = _needed(linear, noise, run.used, places, named)
    causes = []
    for k in named:
        values = {
            columns[i][0]: Estimate(
                float(at[i] * columns[i][2]), float(np.sqrt(covariance[i, i]) * columns[i][2]), columns[i][1]
            )
            for i in places[k]
        }
        same = tuple(name for twin in twins if names[k] in twin for name in twin if name != names[k])
        causes.append(Cause(names[k], values, 1.0 - first, gain, ambiguous_with=same))
    return causes, first


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
    normal = G.T @ G + np.diag(precision)
    covariance = np.linalg.inv(normal)
    pull = G.T @ (linear.residual[rows] / noise[rows]) + precision * linear.at
    return linear.at - covariance @ pull, covariance


def _simplest(scores: Scores) -> int:
    """Block that explains most for its number of columns."""
    merit = np.where(scores.size > 0, scores.q - scores.size * 5.0, -np.inf)
    return int(np.argmax(merit))


def _effect_scores(run: Run) -> tuple[float, float]:
    """p-value of the largest score of an effect beside the level alone, and beside the level with its effects."""
    if run.effects is None:
        return 1.0, 1.0
    grid = range(run.effects.grid)
    slices = run.effects.slices(grid)
    linear, posterior = run.choice.fits[run.choice.level]
    found = []
    for fit in ((linear, posterior), (run.fit[1], run.fit[2])):
        at = _without_effects(fit[0], run)
        Z = run.effects.jacobian(at, grid)
        blocks = [Z[:, s] for k, s in slices.items() if k not in (run.named if fit[0] is run.fit[1] else ())]
        free = levels.free_at(run.choice.level, fit[0].prior)
        beside = fit[0], row_noise(*fit), run.used, fit[1].precision
        p_grid = score_blocks(*beside, blocks, free).p_value
        p_high = score_waves(*beside, run.effects.waves(at), free)
        found.append(min(p_grid, p_high) if p_high == 1.0 else min(1.0, 2.0 * min(p_grid, p_high)))
    return found[0], found[1]


def _play(run: Run) -> tuple[float, str]:
    """p-value of the joint that looks most as if it moved at random from posture to posture, and its name."""
    final, linear, posterior, _ = run.fit
    joints = [(c.at[0], k) for k, c in enumerate(final.columns) if c.effect == "joint_offset"]
    free = levels.free_at(run.choice.level, linear.prior)
    ways = linear.jacobian[:, [k for _, k in joints]]
    p_value, worst = score_jitter(linear, row_noise(linear, posterior), run.used, posterior.precision, ways, free)
    return p_value, joints[worst][0]


def _has_size(cause: Cause) -> bool:
    """Whether some amplitude of an effect is surely not zero: a cause may have come in for what another explains."""
    entry = CATALOGUE.get(cause.name.effect)
    linear = {n for n, p in entry.parameters().items() if p.linear} if entry else set()
    sizes = [value for name, value in cause.parameters.items() if name in linear]
    return not sizes or any(abs(one.value) > thresholds.SIZE_SIGMAS * one.std for one in sizes)


def _without_effects(linear: marginal.Linear, run: Run) -> np.ndarray:
    """Unknowns of the columns of geometry and of the devices alone."""
    columns = len(run.measured.columns)
    extra = len(linear.at) - columns - len(run.measured.own)
    return np.concatenate([linear.at[:columns], linear.at[columns + extra :]])


def _with_rivals(effects: Sequence[Cause], run: Run) -> list[Cause]:
    """The causes with what gained nearly as much in their place."""
    rivals: dict[Name, tuple[Name, ...]] = {}
    for k, others in zip(run.choice.effects, run.choice.rivals, strict=True):
        own = Name(run.blocks[k].effect.name, run.blocks[k].columns[0].at)
        named = (run.blocks[j] for j in others if run.blocks[j].effect is not HISTORY)
        names = (Name(block.effect.name, block.columns[0].at) for block in named)
        rivals[own] = tuple(dict.fromkeys(name for name in names if name != own))
    return [replace(cause, ambiguous_with=rivals.get(cause.name, ())) for cause in effects]


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


def _answer(calibration: Calibration, causes: tuple[Cause, ...], p_value: float, rest: bool) -> PoseDiagnosis:
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
    )
