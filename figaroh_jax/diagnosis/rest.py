"""What is left when the causes are in: noise, or a misfit that has no name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import joint_unit
from ..estimation import noise
from ..estimation.noise import Spectrum
from ..estimation.rows import UNKNOWN, Linear, Rows
from ..recordings.stacked import filter_rows
from ..results import Dependence, Part, Verdict
from ..rigid.model import prismatic
from .comparison import ground, judge_grown, t_needed, t_value
from .flexible import Smooth, dependences, products, rough_functions, table_of_places
from .holdout import residual_rms
from .problem import Problem
from .screening import CHUNK, Group, draw_noise, noise_squares
from .state import State
from .step import Step, stand
from .thresholds import (
    FITTED,
    FITTED_SHARE,
    FOLLOWS,
    LEAST_BEYOND,
    LEAST_SHARE,
    LINE_P,
    OWN_SHARE,
    REPEATED,
    REPEATED_SHARE,
    REST_P,
    STANDSTILL,
    T_BETTER,
    T_REST,
    UNREPEATED,
)
from .weights import relative_speed

__all__ = [
    "Follows",
    "Significance",
    "beyond_noise",
    "excess",
    "follows_motion",
    "lines",
    "parts_of",
    "predictable",
    "relative_rest",
    "repeated_power",
    "repeating",
    "roughly_predictable",
    "rows_at",
    "significance",
    "taken_by_place",
    "tolerated",
    "verdict",
    "wrong_law",
]

POWER_DRAWS = 200  # of noise, whose power is compared with what is left

_Share = tuple[float, Dependence, tuple[float, float] | None, str | None]  # share, kind, band in Hz, file


class Significance(NamedTuple):
    """Whether what is left is more than noise, and where it is in words without a cause's name."""

    there: bool
    text: str


def relative_rest(problem: Problem, state: State, noise: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """RMS of what the state leaves beyond the noise (N m or N), relative to the RMS torque of each joint."""
    judged = np.asarray(problem.records.judged)
    torque = np.sqrt(((problem.torque * judged) ** 2).sum((0, 1)) / np.maximum(judged.sum((0, 1)), 1))
    left = np.sqrt(np.maximum(residual_rms(problem, state) ** 2 - noise**2, 0.0))
    return left / np.maximum(torque, 1e-9 * max(float(torque.max()), 1e-300))


def excess(
    problem: Problem, rows: Rows, residual: Float[np.ndarray, "nv T"], spectrum: Spectrum, whitening: np.ndarray
) -> tuple[float, float, Float[np.ndarray, " nv"]]:
    """Excess of the residual over the noise, its one-sided p-value, and the excess of each joint.

    With repeats the power that repeats; else the mean square less that of noise with the estimated spectrum (no p of
    its own: 1).
    """
    level = noise_squares(problem, spectrum, whitening)
    if not problem.layout.repeats:
        own = (residual**2).sum(1) - level
        return float(own.sum() / level.sum()), 1.0, own / level
    products, p = repeated_power(rows, residual)
    share = rows.paired.mean(1) * level
    return float(products.sum() / share.sum()), p, products / share


def repeated_power(rows: Rows, residual: Float[np.ndarray, "nv T"]) -> tuple[Float[np.ndarray, " nv"], float]:
    """Squares of each joint's residual that repeats have in common, and the one-sided p-value of as much, of all joints
    together or of the one that has most for its noise.

    By blocks of the motion: products of a row and its repeat are those of the repeat and the row, and tell it once.
    """
    products = residual * np.stack([rows.instrument(residual[j], j) for j in range(len(residual))])
    first = np.arange(len(rows.block))  # of all repeats of a row
    for partner in rows.partner:
        first = np.where(partner >= 0, np.minimum(first, partner), first)
    motion = np.where(rows.block >= 0, rows.block[first], -1)
    told = [*products, products.sum(0)]
    blocks = np.stack([np.bincount(motion[motion >= 0], one[motion >= 0]) for one in told])
    t, used = blocks.sum(1) / np.sqrt((blocks**2).sum(1) + 1e-300), np.count_nonzero(blocks, axis=1)
    from scipy.special import stdtr  # scipy is slow to import

    *own, together = stdtr(np.maximum(used - 1, 1), -t)
    p = together if len(own) == 1 else 2 * min(together, len(own) * min(own))
    return products.sum(1), float(min(1.0, p))


def beyond_noise(
    problem: Problem,
    residual: Float[np.ndarray, "nv T"],
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    generator: np.random.Generator,
    rows: Bool[np.ndarray, "nv T"] | None = None,
    fitted: tuple[Rows, Linear] | None = None,
) -> tuple[Float[np.ndarray, " nv"], Bool[np.ndarray, " nv"]]:
    """Squares that each joint's residual has beyond those of noise, where chance gives no joint so many, else zero; and
    whether it has fewer than chance gives any joint.

    Of some rows of each joint, or of all. With a `fitted` model, of what it leaves of the noise: of slow noise it takes
    much.

    Noise is drawn with all that its spectrum may be, and a joint's power counted in deviations of what noise has there:
    one draw in a hundred has a joint with as much. What no function of the motion predicts is a misfit too, if it is
    larger than the noise can be. Less power than the noise has is no noise either: its spectrum is estimated from what
    a rich model leaves, and what the motion's own frequencies leave passes for more noise than there is.
    """
    counted = np.ones(residual.shape, bool) if rows is None else rows
    parts = (draw_noise(problem, spectrum, whitening, CHUNK, generator) for _ in range(POWER_DRAWS // CHUNK))
    left = parts
    if fitted is not None:
        left = (_left_of(part, *fitted) for part in parts)
    noise = np.concatenate([(part**2 * counted).sum(2) for part in left]).astype(float)
    mean, deviation = noise.mean(0), np.maximum(noise.std(0), 1e-12 * noise.mean(0) + 1e-300)
    drawn, own = (noise - mean) / deviation, (residual**2 * counted).sum(1) - mean
    p, q = (
        (1 + np.sum(most[:, None] >= side * own / deviation, axis=0)) / (len(noise) + 1)
        for side, most in ((1, drawn.max(1)), (-1, -drawn.min(1)))
    )
    return np.where(p < REST_P, np.maximum(own, 0.0), 0.0), q < REST_P


def _left_of(noise: Float[np.ndarray, "draws nv T"], rows: Rows, linear: Linear) -> Float[np.ndarray, "draws nv T"]:
    """What a fit leaves of rows of noise."""
    theta = rows.Xi.pulled(noise * rows.paired) @ linear.inverse.T
    return noise - np.moveaxis(rows.X @ theta.T, 2, 0)


def repeating(
    problem: Problem, rows: Rows, residual: Float[np.ndarray, "nv T"], counted: Bool[np.ndarray, "nv T"]
) -> Float[np.ndarray, " nv"]:
    """Squares of each joint's residual, in some of its rows, that repeats of the motion have in common: no noise and
    no error of what a law is evaluated at. Infinite where no recording repeats another."""
    if not problem.layout.repeats:
        return np.full(len(residual), np.inf)
    other = np.stack([rows.instrument(residual[j], j) for j in range(len(residual))])
    paired = (rows.paired * counted).sum(1) / np.maximum(counted.sum(1), 1)
    return np.maximum((residual * other * counted).sum(1), 0.0) / np.maximum(paired, 1e-12)


def significance(
    now: tuple[float, float, Float[np.ndarray, " nv"]],
    first: float,
    p_catalogue: float,
    flexible: Smooth,
    line: tuple[float, float, int],
    joints: tuple[str, ...],
    predicted: bool,
    tolerable: bool,
) -> Significance:
    """Whether the rest is more than noise and more than what is `tolerable`.

    Power that repeats is no noise. Where no recording repeats another the noise is an estimate, and what is left above
    it counts only if smooth functions of the motion have `predicted` it on data that they were not fitted to. What is
    scored counts by the joint where it is largest: what is wrong at one of many is little of all.
    """
    size, p_repeat, own = now
    largest = float(np.max(own))
    repeated = p_repeat < 1
    repeats = p_repeat < REST_P and size > max(REPEATED, REPEATED_SHARE * first)
    p = min(flexible.p, p_catalogue) if repeated else flexible.p
    scored = p < REST_P and largest > max(FITTED if repeated else UNREPEATED, FITTED_SHARE * first)
    vibrates = line[0] < LINE_P and not tolerable
    worst, text = int(np.argmax(own)), ""
    there = bool((repeats or (scored and (repeated or predicted))) and not tolerable)
    if there:
        text = f"relative to the noise it is largest at {joints[worst]} ({own[worst]:.2g} times the noise power)"
        if flexible.p < REST_P:
            text += f"; strongest dependence: {flexible.strongest.effect} at {flexible.strongest.at[0]}"
    if vibrates:
        text += f"{'; ' if text else ''}a spectral line at {line[1]:.3g} Hz at {joints[line[2]]}"
    return Significance(there or vibrates, text)


def predictable(step: Step, groups: Sequence[Group]) -> bool:
    """Whether smooth `families` of the motion predict what is left at some joint on data they were not fitted to."""
    base = ground(step.verdicts, step.state.prior, step.folded)
    for group in groups:
        joints = group.columns.joints
        own = judge_grown(step.rows, base, joints, group.columns.Z[0])
        worse, better = (v.own(step.rows, joints) for v in (step.verdicts, own))
        if better.sum() < worse.sum() and t_value(worse, better) > T_REST:
            return True
    return False


def roughly_predictable(
    problem: Problem,
    step: Step,
    whitening: Float[np.ndarray, "F nv"],
    tolerance: float,
    moving: Bool[np.ndarray, "n M"] | None = None,
    at: Sequence[int] | None = None,
) -> Bool[np.ndarray, " nv"]:
    """Joints at which functions of the motion that no smooth one follows predict what is left, noise or not, on data
    they were not fitted to, where that is more than tolerable: a ripple and a coupling that the catalogue lacks pass
    for noise without repeats; repeats know the noise.

    What is needed counts the joints and not the functions of one: on data left out, columns that say nothing cost more
    than the best of them gains by chance. Only rows that are `moving` are asked: a joint that sticks holds whatever the
    others' motion brings, and one that breaks loose jerks them in a way that no filtered acceleration shows. Only
    joints `at` which it matters, or all.
    """
    found = np.zeros(problem.model.nv, bool)
    if problem.layout.repeats:
        return found
    large = relative_rest(problem, step.state, np.zeros(problem.model.nv)) > tolerance
    joints = np.flatnonzero(large & (True if at is None else np.isin(np.arange(len(large)), list(at))))
    base = ground(step.verdicts, step.state.prior, step.folded)
    for joint in joints.tolist():
        for columns in rough_functions(step.state.motion, joint):
            rows = rows_at(problem, step.state, columns, whitening, joint)
            if moving is not None:
                rows = rows * moving.reshape(-1)
            grown = judge_grown(step.rows, base, (joint,), rows[:, None])
            worse, better = (v.own(step.rows, (joint,)) for v in (step.verdicts, grown))
            if better.sum() < worse.sum() and t_value(worse, better) > t_needed(len(worse), T_REST, len(joints)):
                found[joint] = True
                break
    return found


class Follows(NamedTuple):
    """A joint whose residual surely follows the motion, in a way that no cause has."""

    text: str
    noise: Float[np.ndarray, " nv"]  # RMS of each joint's rows that may be noise, N m or N; infinite but at this joint


def follows_motion(
    problem: Problem, state: State, tolerance: float, moving: Bool[np.ndarray, "n M nv"]
) -> Follows | None:
    """What predicts half of what some joint leaves, on data that it was not fitted to; None without any.

    Asked are the products of two positions or velocities of the robot, and in the rows where the joint is `moving` a
    table of its position, one for each direction of motion. Without repeats a torque that follows either passes for
    slow noise. All rows of a joint count alike: the spectrum of the noise holds what is asked for.
    """
    size = residual_rms(problem, state)
    large = np.flatnonzero(relative_rest(problem, state, np.zeros_like(size)) > tolerance).tolist()
    if problem.layout.repeats or not large:
        return None
    white = np.ones((len(problem.records.omega), 1)) / np.maximum(size, 1e-12 * size.max())
    step, names = stand(problem, state, white), problem.model.dof_names
    base, (columns, places) = ground(step.verdicts, step.state.prior, step.folded), products(step.state.motion)

    def foretold(joint: int, rows: Float[np.ndarray, "k T"]) -> tuple[float, Float[np.ndarray, " k"]] | None:
        """Share of the held-out squares that functions leave, and their sizes; None where half is not surely taken."""
        grown = judge_grown(step.rows, base, (joint,), rows[:, None])
        worse, better = (v.own(step.rows, (joint,)) for v in (step.verdicts, grown))
        surely = t_value(worse, better) > t_needed(len(worse), T_REST, len(large))
        half = surely and better.sum() < (1 - FOLLOWS) * worse.sum()
        return (float(better.sum() / worse.sum()), grown.theta[-len(rows) :]) if half else None

    def told(joint: int, left: float, what: str) -> Follows:
        most = np.full(len(size), np.inf)
        most[joint] = size[joint] * np.sqrt(left)
        return Follows(f"{100 * (1 - left):.3g} % of what {names[joint]} leaves goes with {what}", most)

    for joint in large:
        rows = rows_at(problem, step.state, columns, white, joint)
        across, pull = step.rows.X.pulled_at((joint,), rows[:, None]).T, rows @ step.verdicts.residual[joint]
        gram = rows @ rows.T - across.T @ base.inverse[-1] @ across
        taken = [pull[at] @ np.linalg.lstsq(gram[np.ix_(at, at)], pull[at], rcond=None)[0] for at in map(list, places)]
        best = list(places[int(np.argmax(taken))])
        if found := foretold(joint, rows[best]):
            what = [f"the {('position', 'velocity')[k // len(names)]} of {names[k % len(names)]}" for k in best[:2]]
            return told(joint, found[0], " times ".join(what))
        table, at = table_of_places(step.state.motion, joint)
        rows = rows_at(problem, step.state, table, white, joint) * moving[:, :, joint].reshape(-1)
        # each number of a size of about that of what is left: a fold without data of a place knows nothing of it
        if found := foretold(joint, np.sqrt(UNKNOWN) * rows):
            most = int(np.argmax(np.abs(found[1])))
            where = f"{at[most]:.3g} {joint_unit('rad', prismatic(problem.model)[joint])}"
            way = ("forwards", "backwards")[most >= len(at) // 2]
            return told(joint, found[0], f"its position while it moves {way}, most at {where}")
    return None


def taken_by_place(problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], joint: int) -> float:
    """Held-out squares that a table of a joint's position, for each direction of motion, surely takes of what is left.

    Zero where it does not surely predict them.
    """
    table = rows_at(problem, step.state, table_of_places(step.state.motion, joint)[0], whitening, joint)
    base = ground(step.verdicts, step.state.prior, step.folded)
    # numbers of about the size of what is left, as in `follows_motion`
    table = np.sqrt(UNKNOWN) * float(residual_rms(problem, step.state)[joint]) * table
    grown = judge_grown(step.rows, base, (joint,), table[:, None])
    worse, better = (v.own(step.rows, (joint,)) for v in (step.verdicts, grown))
    return max(float((worse - better).sum()), 0.0) if t_value(worse, better) > T_REST else 0.0


def parts_of(
    problem: Problem,
    step: Step,
    whitening: Float[np.ndarray, "F nv"],
    line: tuple[float, float, int],
    names: Sequence[str],
) -> tuple[Part, ...]:
    """What the power beyond the noise goes with at each joint, judged on held-out data; `names` are the recordings'.

    Shares are of that power, by what each predicts alone: what goes with two things counts twice.
    """
    base = ground(step.verdicts, step.state.prior, step.folded)
    weight, speed = (
        np.moveaxis(x, 2, 0).reshape(len(step.rows.y), -1)
        for x in (np.asarray(problem.records.weight), relative_speed(problem))
    )
    out = []
    for joint, at in enumerate(problem.model.joint_names):
        used = weight[joint] > 0
        beyond = (step.verdicts.error[joint][used] / weight[joint][used]) ** 2 - 1
        total = float(beyond.sum())
        if total <= LEAST_BEYOND * used.sum():
            continue
        still = float(beyond[speed[joint][used] < STANDSTILL].sum()) / total
        shares: list[_Share] = [(still, "standstill", None, None)]
        for kind, columns in _dependences(problem, step.state, joint):
            rows = rows_at(problem, step.state, columns, whitening, joint)
            grown = judge_grown(step.rows, base, (joint,), rows[:, None])
            worse, better = (v.own(step.rows, (joint,)) for v in (step.verdicts, grown))
            if t_value(worse, better) > T_BETTER:
                file = _recording_of(worse - better, step, problem, names) if kind == "recording" else None
                shares.append((float((worse - better).sum()) / total, kind, None, file))
        if line[0] < LINE_P and line[2] == joint:
            shares.append((_share_of_line(problem, step, line), "frequency", (0.9 * line[1], 1.1 * line[1]), None))
        kept = sorted((s for s in shares if s[0] > LEAST_SHARE), reverse=True, key=lambda s: s[0])
        out += [Part(kind, (at,), min(share, 1.0), band, file) for share, kind, band, file in kept]
    return tuple(out)


def _dependences(problem: Problem, state: State, joint: int) -> list[tuple[Dependence, Float[np.ndarray, "k nN"]]]:
    """Smooth functions of the joint's position, velocity, load and time, and a constant for each recording."""
    records = problem.records
    kinds: list[tuple[Dependence, np.ndarray]] = [*dependences(state.motion, joint).items()]
    fitted = [at for at in records.spans if records.fitted[at.slot, at.row : at.row + at.rows].any()]
    if len(fitted) > 1:
        constants = np.zeros((len(fitted), *records.shape[:2]))
        for own, at in zip(constants, fitted, strict=True):
            own[at.slot, at.sample : at.sample + at.samples] = 1.0
        kinds.append(("recording", constants.reshape(len(fitted), -1)))
    return kinds


def rows_at(
    problem: Problem, state: State, columns: Float[np.ndarray, "k nN"], whitening: np.ndarray, joint: int
) -> Float[np.ndarray, "k T"]:
    """Whitened rows, at a joint, of columns that stand at all samples, as sensors that follow all torque read them."""
    n, samples, _, _ = problem.records.shape
    response = (whitening[:, joint] * state.response(problem.records.omega))[None]
    rows = filter_rows(problem.records, columns.reshape(-1, n, samples), response, fitted=True)
    return (rows * np.asarray(problem.records.weight)[:, :, joint]).reshape(len(columns), -1)


def _recording_of(drop: Float[np.ndarray, " blocks"], step: Step, problem: Problem, names: Sequence[str]) -> str:
    """The recording whose blocks a constant of its own helps most."""
    block, spans = step.rows.block.reshape(problem.records.shape[0], -1), problem.records.spans
    rows = (block[at.slot, at.row : at.row + at.rows] for at in spans)
    each = [drop[np.unique(own[own >= 0])].sum() if (own >= 0).any() else -np.inf for own in rows]
    return names[int(np.argmax(each))]


def _share_of_line(problem: Problem, step: Step, line: tuple[float, float, int]) -> float:
    n, _, count, _ = problem.records.shape
    frequency, power = noise.periodogram(
        step.verdicts.residual[line[2]].reshape(n, count).T, float(problem.records.rate)
    )
    near = np.abs(frequency / line[1] - 1) < 0.1
    return float(power[near].sum() / max(power.sum(), 1e-300))


def wrong_law(at: tuple[str, ...], drop: float, flexible: Smooth) -> bool:
    """Whether a cause that acts at the joints `at` leaves a rest of its own there, beside the squares it removed.

    The right law leaves noise; one that only resembles it leaves a share of what it stands for.
    """
    places = flexible.strongest.at
    return flexible.p < REST_P and (not at or places[0] in at) and flexible.score > OWN_SHARE * drop


def tolerated(largest: float, tolerance: float, sticks: bool, read: bool = False) -> str:
    """Why a misfit that noise does not explain is no rest, in words; empty where there is no such reason.

    `largest` is that of any joint over its torque.
    """
    if read:
        return "the steps of the sensors and the time between samples leave as much of a model that is right"
    if sticks:
        return "it stands where joints are at rest, as dry friction allows"
    if largest > tolerance:
        return ""
    share, most = (f"{100 * x:.1f} %" for x in (largest, tolerance))
    return f"it is at most {share} of any joint's torque, within the tolerance of {most}"


def verdict(named: bool, rest: bool) -> Verdict:
    """The contract's four words: whether a cause is named, and whether something is left that is not noise."""
    if named:
        return "named+rest" if rest else "named"
    return "unknown" if rest else "nothing"


def lines(problem: Problem, residual: Float[np.ndarray, "nv T"]) -> tuple[float, float, int]:
    """The strongest spectral line of the whitened residual."""
    n, _, count, nv = problem.records.shape
    series = np.moveaxis(residual.reshape(nv, n, count), 0, 2)
    return noise.spectral_line(series, float(problem.records.rate), float(problem.records.cutoff))
