"""The check of every recording before any work: against the model's limits, against itself, against its torque.

What cannot be right is refused, what looks wrong is said, both with what would be right. A finding names the file and
the joint or row. The thresholds keep clear of what the public recordings of real robots show (`benchmarks/
wrong_recordings.py` measures both sides).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.model import RobotModel, prismatic
from .dataset import Memory, Recording
from .likeness import (
    Likeness,
    Sampled,
    likeness,
    matrix_of_likeness,
    rigid_torque,
    sampled,
    share_of_gravity,
    stretch_of_time,
)

if TYPE_CHECKING:
    from pathlib import Path

    from ..formats.config import RecordingEntry, Task


__all__ = ["Finding", "check_recording", "check_recordings", "position_findings", "report_findings"]

DEGREE = np.pi / 180
STILL = 1e-3  # rad or m: a joint that stays within it stands
HARD = 20.0  # times a limit: no robot does that
SOFT = 3.0  # times a limit: worth a word
LIGHT = 4.0  # times too small: a nominal model may well be three times too heavy
LIKE = 0.8  # partial correlation of a torque that belongs to its joint
UNLIKE = 0.4
HEAVY = 0.2  # share of a torque's spread that the rigid body should make up before its absence means anything


class Finding(NamedTuple):
    """Something about a recording; `wrong` is refused, else it is a warning."""

    wrong: bool
    text: str


@dataclass(frozen=True, eq=False)
class _Look:
    """What the checks look at; those of positions alone need no recording."""

    position: Float[np.ndarray, "samples nv"]
    joints: tuple[str, ...]
    model: RobotModel
    unit: str = "rad"  # that the task says of the position
    series: Recording | None = None
    entry: RecordingEntry | None = None
    motion: Sampled | None = None

    @property
    def recording(self) -> Recording:
        assert self.series is not None
        return self.series

    @cached_property
    def span(self) -> Float[np.ndarray, " nv"]:
        """Range of each joint without its outermost per cent."""
        low, high = np.percentile(self.position, [1, 99], axis=0)
        return high - low


def check_recordings(task: Task | None, model: RobotModel, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Warnings about recordings of torque, of a task or from arrays, also sent to the log `figaroh_jax`.

    Raises `InputError` with every finding that cannot be right.
    """
    entries: dict[Path | Memory, RecordingEntry] = {entry.place: entry for entry in task.data} if task else {}
    found = [
        (recording.file.name, finding)
        for recording in recordings
        for finding in check_recording(recording, model, entries.get(recording.file))
    ]
    fitted = [recording for recording in recordings if recording.role == "fit"]
    if fitted and all(_stands(recording) for recording in fitted):
        names = ", ".join(recording.file.name for recording in fitted)
        found.append((names, Finding(True, "no joint moves: a fit needs a motion of every joint that is to be told")))
    return report_findings(found)


def report_findings(found: Sequence[tuple[str, Finding]]) -> tuple[str, ...]:
    """Warnings, one a text with the files that it is about; raises `InputError` with what cannot be right."""
    files: dict[Finding, list[str]] = {}
    for name, finding in found:
        files.setdefault(finding, []).append(name)
    texts = [(finding.wrong, f"{', '.join(names)}: {finding.text}") for finding, names in files.items()]
    wrong = [text for bad, text in texts if bad]
    if wrong:
        raise InputError("\n  ".join(wrong) if len(wrong) == 1 else "\n  ".join(["", *wrong]))
    for _, text in texts:
        logging.getLogger("figaroh_jax").warning("check: %s", text)
    return tuple(f"check: {text}" for _, text in texts)


def check_recording(recording: Recording, model: RobotModel, entry: RecordingEntry | None = None) -> list[Finding]:
    """Everything that looks wrong about one recording (joint side, SI units), the gravest first."""
    if model.nq != model.nv or len(recording.time) < 8:
        return []
    motion = sampled(recording.time, recording.position, recording.torque)
    unit = entry.units.position if entry is not None else "rad"
    look = _Look(recording.position, recording.joints, model, unit, recording, entry, motion)
    found: list[Finding] = []
    for check in (_clock, _unit_without_joint, _ranges, _jumps, _zero_rows, _torque_values):
        found += check(look)
    if any(finding.wrong for finding in found):
        return [finding for finding in found if finding.wrong]  # the rest follows from these
    for check in (_velocity, _speeds, _held_samples, _coarse, _clipped):
        found += check(look)
    if motion is not None and recording.torque is not None and not _stands(recording):
        found += _torque_against_model(look, motion)
    return found


def position_findings(position: Float[np.ndarray, "rows nv"], model: RobotModel, unit: str) -> list[Finding]:
    """What looks wrong about positions that have no order in time: unit and range."""
    look = _Look(position, model.dof_names, model, unit)
    return [finding for check in (_unit_without_joint, _ranges) for finding in check(look)]


def _stands(recording: Recording) -> bool:
    low, high = np.percentile(recording.position, [1, 99], axis=0)
    return bool((high - low < STILL).all())


def _limits(model: RobotModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper position, speed and torque; infinite where the model gives none (zero counts as none)."""
    low, high = np.asarray(model.position_limit, float).T
    none = ~(high > low)
    rates = [np.asarray(x, float) for x in (model.velocity_limit, model.effort_limit)]
    speed, effort = (np.where(x > 0, x, np.inf) for x in rates)
    return np.where(none, -np.inf, low), np.where(none, np.inf, high), speed, effort


# Time


def _clock(look: _Look) -> Iterator[Finding]:
    """Stamps in another unit than seconds."""
    time = look.recording.time
    step = float(np.median(np.diff(time)))
    if step < 0.1 or _stands(look.recording):
        return
    unit, seconds = next(((u, s) for u, s in _CLOCKS if 1e-5 < step * s <= 0.1), ("ms", 1e-3))
    _, _, speed, _ = _limits(look.model)
    top = np.abs(np.diff(look.position, axis=0)).max(axis=0) / step
    slow = bool((top < 0.02 * np.where(np.isfinite(speed), speed, 3.0)).all())
    advice = f"stamps that look like {unit}: add units: {{time: {unit}}}"
    if look.entry is not None and look.entry.time is None:
        advice = f"rate: {1 / step:g} Hz looks like a period in place of a frequency"
    whole = bool(np.all(time == np.round(time)))
    yield Finding(
        slow and (whole or step > 0.5),
        f"{look.entry.time if look.entry and look.entry.time else 'time'}: one sample in {step:.4g} s over"
        f" {time[-1] - time[0]:.4g} s; {advice}",
    )


_CLOCKS = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))


def _unit_without_joint(look: _Look) -> Iterator[Finding]:
    straight = np.array(prismatic(look.model))
    unit = look.unit
    if unit == "mm" and not straight.any():
        yield Finding(
            True, "units: {position: mm}, but every joint of the robot turns; positions are in rad or units: deg"
        )
    if unit == "deg" and straight.all():
        yield Finding(
            True, "units: {position: deg}, but every joint of the robot slides; positions are in m or units: mm"
        )
    elif unit == "deg" and _small(look, ~straight):
        yield Finding(
            False,
            f"units: {{position: deg}}, but no joint moves by more than {look.span[~straight].max() / DEGREE:.3g}"
            " degrees: it looks like rad; leave units: {position: deg} out",
        )


def _small(look: _Look, turns: np.ndarray) -> bool:
    """Whether a motion in degrees is so small that it fits the joints when it is read as rad."""
    low, high, *_ = _limits(look.model)
    span = look.span[turns]
    fits = bool((span / DEGREE <= 1.1 * (high - low)[turns]).all())
    return bool(2e-5 < span.max() < (0.2 if fits and np.isfinite(high - low)[turns].all() else 0.12))


# Position


def _ranges(look: _Look) -> Iterator[Finding]:
    """Positions far outside what the model's joints can reach."""
    low, high, speed, _ = _limits(look.model)
    bottom, top = np.percentile(look.position, [2, 98], axis=0)
    turns = ~np.array(prismatic(look.model))
    room = np.where(np.isfinite(high - low), high - low, 4 * np.pi)
    over = np.maximum(np.maximum(low - bottom, top - high), 0.0)
    free = ~np.isfinite(high - low) & turns
    over = np.where(free, np.maximum(np.abs(look.position).max(axis=0) - 16 * np.pi, 0.0), over)
    far = over > np.maximum(room, np.where(turns, np.pi, 0.05))
    if far.any():
        yield from _far(look, far, over)
    elif (over > 0.05 * room).any():
        names = _named(look, over > 0.05 * room)
        worst = int(np.argmax(over / room))
        yield Finding(
            False,
            f"position of {names} lies outside the model's limits ({look.joints[worst]}: {bottom[worst]:.4g} to"
            f" {top[worst]:.4g}, limits {low[worst]:.4g} to {high[worst]:.4g} {_unit(look, worst)}): a zero offset"
            " (transmission.offset), a sign or another order of columns?",
        )


def _far(look: _Look, far: np.ndarray, over: np.ndarray) -> Iterator[Finding]:
    low, high, *_ = _limits(look.model)
    position, worst = look.position, int(np.argmax(np.where(far, over, 0.0)))
    straight = np.array(prismatic(look.model))
    factor = np.where(straight, 1e-3, DEGREE)
    fits = np.asarray(((position * factor >= low - 0.2) & (position * factor <= high + 0.2)).all(axis=0))
    top = position[:, worst][np.argmax(np.abs(position[:, worst]))]
    said = (
        f"position of {_named(look, far)} cannot be right: {look.joints[worst]} reads {top:.5g} {_unit(look, worst)},"
        f" limits {low[worst]:.4g} to {high[worst]:.4g}"
    )
    if look.unit == "rad" and straight[far].all():
        advice = "looks like mm: add units: {position: mm}"
    elif look.unit == "rad" and fits[~straight].all() and (np.abs(position).max() < 800):
        advice = "looks like degrees: add units: {position: deg} (or, if these are motor angles, transmission.position)"
    elif look.unit == "deg":
        advice = "units: {position: deg} is given; are these encoder counts or motor angles (transmission.position)?"
    else:
        advice = "looks like encoder counts, or the motor side of a gear (transmission.position)"
    yield Finding(True, f"{said}; {advice}")


def _jumps(look: _Look) -> Iterator[Finding]:
    """Single wild rows and turns of 2 pi that the encoder lost."""
    position, time = look.position, look.recording.time
    steps, dt = np.diff(position, axis=0), np.diff(time)[:, None]
    _, _, speed, _ = _limits(look.model)
    low, high, *_ = _limits(look.model)
    usual = np.percentile(np.abs(steps), 98, axis=0) + 1e-9
    allowed = np.where(np.isfinite(speed), 5 * speed * dt, np.inf)
    turns = ~np.array(prismatic(look.model))
    least = np.where(turns, 0.1, 0.01)
    wild = (np.abs(steps) > 20 * usual) & (np.abs(steps) > least)
    wild &= (np.abs(steps) > allowed) | (np.abs(steps) > 1.0) | (np.abs(steps) > 200 * usual)
    for j in np.flatnonzero(wild.any(axis=0)).tolist():
        rows = np.flatnonzero(wild[:, j]) + 1
        biggest = steps[rows - 1, j]
        if turns[j] and (np.abs(np.abs(biggest) - 2 * np.pi) < 0.3).all():
            yield Finding(
                True,
                f"position of {look.joints[j]} jumps by 2 pi in row {rows[0]}{_more(rows)}: the encoder wraps around;"
                " unwrap it (numpy.unwrap)",
            )
            continue
        k = rows[int(np.argmax(np.abs(biggest)))]
        room = high[j] - low[j] if np.isfinite(high[j] - low[j]) else 4 * np.pi
        value = max(position[k - 1 : k + 1, j], key=abs)
        beyond = max(low[j] - value, value - high[j]) > room or abs(steps[k - 1, j]) > 8 * np.pi
        yield Finding(
            bool(beyond),
            f"position of {look.joints[j]} jumps by {steps[k - 1, j]:.4g} {_unit(look, j)} in row {k} (from 0)"
            f"{_more(rows)}: a wild sample or lost rows; delete these rows, or keep them out by preprocess.window",
        )


def _zero_rows(look: _Look) -> Iterator[Finding]:
    """Rows of zeros in the middle of a motion: packets that never came."""
    for key in ("position", "torque"):
        values = getattr(look.recording, key)
        if values is None or values.shape[1] < 2 or not values.any():
            continue
        steps = np.abs(np.diff(values, axis=0))
        usual = np.percentile(steps, 95, axis=0)
        sudden = np.mean((steps > 3 * usual) & (steps > 0), axis=1) > 0.49
        rows = np.flatnonzero((values[1:-1] == 0).all(axis=1) & (sudden[:-1] | sudden[1:])) + 1
        if len(rows):
            yield Finding(
                False,
                f"{key} is zero at every joint in row {rows[0]} (from 0){_more(rows)}: lost packets? Delete these rows",
            )


def _held_samples(look: _Look) -> Iterator[Finding]:
    """A sampled-and-held recording: every row several times."""
    position, torque = look.position, look.recording.torque
    moving = look.span > STILL
    if not moving.any():
        return
    both = position[:, moving] if torque is None else np.hstack([position[:, moving], torque[:, moving]])
    edges = np.flatnonzero((np.diff(both, axis=0) != 0).any(axis=1))
    gaps = np.diff(edges)
    if len(gaps) < 8:
        return
    times = float(np.median(gaps))
    if times < 2 or np.mean(np.abs(gaps - times) <= 1) < 0.7:
        return
    rate = (len(position) - 1) / (look.recording.time[-1] - look.recording.time[0])
    yield Finding(
        False,
        f"every row stands there {times:.0f} times: the recording was held at about {rate / times:.4g} Hz, the stamps"
        f" say {rate:.4g} Hz; keep one row of each",
    )


def _coarse(look: _Look) -> Iterator[Finding]:
    """Steps of the position that are large against its motion."""
    bad = {}
    for j in np.flatnonzero(look.span > 20 * STILL):
        levels = np.unique(look.position[:, j])
        if len(levels) < 2:
            continue
        step = float(np.median(np.diff(levels)))
        if look.span[j] / step < 25:
            bad[look.joints[j]] = step
    if bad:
        name, step = max(bad.items(), key=lambda item: item[1])
        yield Finding(
            False,
            f"position of {', '.join(bad)} comes in steps of {step:.3g} {_unit(look, look.joints.index(name))}"
            f" ({name}): fewer than 25 steps over the whole motion; log more digits, or lower preprocess.cutoff",
        )


# Velocity


def _velocity(look: _Look) -> Iterator[Finding]:
    """A logged velocity against the differentiated position."""
    logged = look.recording.velocity
    if logged is None or look.motion is None:
        return
    read = sampled(look.recording.time, look.position, logged)
    if read is None or read.torque is None:
        return
    fast = look.span > 10 * STILL
    if not fast.any():
        return
    slope, like = np.ones(len(fast)), np.ones(len(fast))
    for j in np.flatnonzero(fast):
        x, y = read.velocity[:, j], read.torque[:, j]
        slope[j] = (x @ y) / max(x @ x, 1e-300)
        like[j] = (x @ y) / max(np.sqrt((x @ x) * (y @ y)), 1e-300)
    yield from _velocity_said(look, slope[fast], like[fast], np.flatnonzero(fast))


def _velocity_said(look: _Look, slope: np.ndarray, like: np.ndarray, at: np.ndarray) -> Iterator[Finding]:
    names = [look.joints[j] for j in at]
    flipped = [name for name, r in zip(names, like, strict=True) if r < -LIKE]
    if flipped:
        yield Finding(
            False, f"velocity of {', '.join(flipped)} has the opposite sign of the position's rate: one is negated"
        )
    foreign = [name for name, r in zip(names, like, strict=True) if abs(r) < UNLIKE]
    if foreign:
        yield Finding(
            False,
            f"velocity of {', '.join(foreign)} does not follow the position's rate: columns in another order, or"
            " another quantity?",
        )
    factor = np.median(np.abs(slope[np.abs(like) > LIKE])) if (np.abs(like) > LIKE).any() else 1.0
    if 0.7 < factor < 1.4:
        return
    time = look.recording.time
    rate = (len(time) - 1) / (time[-1] - time[0])
    if abs(factor * DEGREE - 1) < 0.2:
        text = "it looks like degrees: add units: {velocity: deg/s}, or units: {position: deg} where both are"
    elif abs(factor / DEGREE - 1) < 0.2:
        text = "the position looks like degrees: add units: {position: deg, velocity: rad/s}"
    else:
        text = f"the clock looks wrong: a rate of {rate * factor:.4g} Hz in place of {rate:.4g} Hz would fit"
    hard = factor > 300 or factor < 1 / 300
    yield Finding(bool(hard), f"velocity is {factor:.4g} times the position's rate; {text}")


def _speeds(look: _Look) -> Iterator[Finding]:
    """Speed and its model's limit."""
    if look.motion is None:
        return
    _, _, limit, _ = _limits(look.model)
    top = np.percentile(np.abs(look.motion.velocity), 99, axis=0)
    fast = top > SOFT * limit
    if not fast.any():
        return
    worst = int(np.argmax(top / limit))
    rate = look.motion.rate
    yield Finding(
        bool(top[worst] > HARD * limit[worst]),
        f"{look.joints[worst]} moves at {top[worst]:.4g} {_unit(look, worst)}/s, {top[worst] / limit[worst]:.3g} times"
        f" the model's limit ({_named(look, fast)} in all): is {rate:.5g} Hz the right rate, is the position in"
        " degrees (units: {position: deg}) or on the motor side (transmission.position)?",
    )


# Torque


def _torque_values(look: _Look) -> Iterator[Finding]:
    """Torques that no drive gives, and torques that were not measured."""
    torque = look.recording.torque
    if torque is None:
        return
    if not np.ptp(torque, axis=0).any():
        what = "zero" if not torque.any() else "constant"
        yield Finding(True, f"torque is {what} at every joint: it was not measured; name the column that holds it")
        return
    dead = np.ptp(torque, axis=0) == 0
    if dead.any():
        yield Finding(False, f"torque of {_named(look, dead)} never changes: it was not measured there")
    effort = _limits(look.model)[3]
    ceiling = np.where(np.isfinite(effort), effort, 1e4)
    usual, top = np.percentile(np.abs(torque), 99, axis=0), np.abs(torque).max(axis=0)
    wild = (top > 3 * ceiling) & (top > 10 * usual)
    for j in np.flatnonzero(wild).tolist():
        rows = np.flatnonzero(np.abs(torque[:, j]) > np.maximum(3 * ceiling[j], 10 * usual[j]))
        yield Finding(
            bool(top[j] > 1e3 * ceiling[j]),
            f"torque of {look.joints[j]} reads {torque[rows[0], j]:.4g} {_effort(look, j)} in row {rows[0]} (from 0)"
            f"{_more(rows)}, limit {ceiling[j]:.4g}: wild samples; delete these rows",
        )
    high = (usual > SOFT * ceiling) & ~wild
    if high.any():
        worst = int(np.argmax(usual / ceiling))
        yield Finding(
            bool(usual[worst] > 1e3 * ceiling[worst]),
            f"torque of {_named(look, high)} is {usual[worst] / ceiling[worst]:.3g} times the model's effort limit"
            f" ({look.joints[worst]}: {usual[worst]:.4g} {_effort(look, worst)}): is it in mN m, a share of the rated"
            " torque, or a current (units: {torque: A} with transmission.torque)?",
        )


def _clipped(look: _Look) -> Iterator[Finding]:
    """A torque that stays at its own largest value: the drive, or the log, was at its end."""
    torque = look.recording.torque
    if torque is None:
        return
    for j in np.flatnonzero(look.span > STILL).tolist():
        column, levels = torque[:, j], np.unique(torque[:, j])
        if len(levels) < 30:
            continue  # steps of the sensor, not a limit
        for end in (column.max(), column.min()):
            at = column == end
            runs = _runs(at)
            if end != 0 and at.mean() > 0.01 and (runs >= 5).sum() and runs.max() < len(at) / 2:
                yield Finding(
                    False,
                    f"torque of {look.joints[j]} stays at {end:.4g} {_effort(look, j)} for {at.mean():.1%} of the"
                    " samples: the drive was at its limit, or the log clips; leave such motions out, or record slower",
                )


def _runs(flags: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return edges[1::2] - edges[::2]


# Torque against the model


class _Fit(NamedTuple):
    """Each joint's own torque against the nominal model's, and which of them tell anything."""

    own: list[Likeness]
    nominal: Float[np.ndarray, "rows nv"]
    heavy: np.ndarray  # joints whose torque should show the rigid body


def _torque_against_model(look: _Look, motion: Sampled) -> Iterator[Finding]:
    assert motion.torque is not None
    fit = _fit(look.model, motion)
    like = np.array([one.correlation for one in fit.own])
    if (fit.heavy & (like < 0.9)).any():
        found = _other_reading(look, motion)
        if found is not None:
            yield found
            return
    lacks = fit.heavy & (like < UNLIKE)
    if fit.heavy.any() and lacks.sum() >= 0.5 * fit.heavy.sum():
        yield Finding(
            False,
            f"torque of {_named(look, lacks)} does not follow what the model needs for this motion (correlation"
            f" {', '.join(f'{r:.2f}' for r in like[lacks])}): is it measured torque or current with its sign, with"
            " gravity in it, of this robot, at these columns and stamps?",
        )
        return
    weightless = _weightless(look.model, motion) & (like < 0.9)  # alike but small is a unit
    if weightless.any():
        yield Finding(
            False,
            f"torque of {_named(look, weightless)} holds none of the gravity that the model needs there: is it what a"
            " controller adds to its gravity compensation? Record the torque or current of the drives",
        )
        return
    yield from _scale(look, fit, like)
    stretch, error = stretch_of_time(look.model, motion)
    if error < 0.15 and abs(np.log(stretch)) > max(np.log(1.5), 3 * error):
        yield Finding(
            False,
            f"the clock looks wrong: inertial torque fits one {stretch:.2g} times as fast, {motion.rate * stretch:.4g}"
            f" Hz in place of {motion.rate:.4g} Hz (+-{100 * error:.0f} %)",
        )


def _fit(model: RobotModel, motion: Sampled) -> _Fit:
    assert motion.torque is not None
    nominal, torque = rigid_torque(model, motion), motion.torque
    columns = zip(nominal.T, torque.T, motion.velocity.T, motion.acceleration.T, strict=True)
    own = [likeness(*each) for each in columns]
    return _Fit(own, nominal, _heavy(own, torque))


def _heavy(own: Sequence[Likeness], torque: np.ndarray) -> np.ndarray:
    """Joints that carry something: what the rigid body needs beside friction and rotor is much of their torque."""
    expected = np.array([one.expected for one in own])
    return (expected > HEAVY * np.std(torque, axis=0)) & (expected > 0.03 * expected.max())


def _weightless(model: RobotModel, motion: Sampled) -> np.ndarray:
    """Joints without gravity in their torque; none unless most of those that should have it lack it."""
    assert motion.torque is not None
    slope, error, expected = share_of_gravity(model, motion)
    asked = (expected > HEAVY * np.std(motion.torque, axis=0)) & (expected > 0.05 * expected.max())
    lacks = asked & (slope + 3 * error < 0.3) & (slope > -0.3)
    return lacks if lacks.sum() > 0.5 * asked.sum() else np.zeros(len(lacks), bool)


def _scale(look: _Look, fit: _Fit, like: np.ndarray) -> Iterator[Finding]:
    """Torque in another unit: the model's gravity says how large it should be."""
    slopes = np.array([one.slope for one in fit.own])
    sure = (like > LIKE) & fit.heavy
    if not sure.any():  # a torque that is read far too large leaves no joint heavy
        sure = (like > LIKE) & (slopes > 20)
    if not sure.any():
        return
    slopes = slopes[sure]
    middle = float(np.median(slopes))
    if 1 / LIGHT < middle < SOFT:
        return
    names = ", ".join(f"{look.joints[j]} {slope:.3g}" for j, slope in zip(np.flatnonzero(sure), slopes, strict=True))
    guess = next((f"it looks like {u}" for u, s in _TORQUE_UNITS if 0.5 < middle / s < 2), None)
    guess = guess or "a current or a share of the rated torque needs its constant (transmission.torque)"
    yield Finding(False, f"torque is {middle:.3g} times what the model needs ({names}): {guess}")


_TORQUE_UNITS = (("mN m", 1e3), ("N cm", 1e2), ("kN m", 1e-3))


def _other_reading(look: _Look, motion: Sampled) -> Finding | None:
    """The reading of the columns that makes torque and motion belong together, where the given one does not."""
    motion = motion.thinned(120)
    assert motion.torque is not None
    given = _fit(look.model, motion)
    best, text = -np.inf, ""
    for said, other in _readings(look, motion, given.nominal):
        fit = _fit(look.model, other)
        heavy = given.heavy | fit.heavy
        gain = _misfit(given.own, heavy) - _misfit(fit.own, heavy)
        if gain > best + 0.3 and _belongs(fit, heavy):  # the simpler reading, which comes first, wins a draw
            best, text = gain, said
    if best < np.log(5.0):
        return None
    return Finding(False, f"torque does not belong to the motion as read; {text}")


def _belongs(fit: _Fit, heavy: np.ndarray) -> bool:
    """Whether nearly every joint that carries something follows the model, at a size that is no accident."""
    if not heavy.any():
        return False
    like = np.array([one.correlation for one in fit.own])[heavy]
    slope = np.array([one.slope for one in fit.own])[heavy]
    return bool(np.median(like) > LIKE and np.mean(like > UNLIKE) > 0.6 and np.median(slope) > 0.1)


def _misfit(own: Sequence[Likeness], heavy: np.ndarray) -> float:
    """Sum of the logarithms of what is not explained; a correlation of the wrong sign explains nothing."""
    like = np.array([one.correlation for one, at in zip(own, heavy, strict=True) if at])
    return float(np.sum(np.log(1.02 - like * np.abs(like))))


def _readings(look: _Look, motion: Sampled, nominal: np.ndarray) -> Iterator[tuple[str, Sampled]]:
    """Other readings of the same columns, the simpler first: units, signs, swapped pairs, zeros a quarter turn off."""
    torque, joints, n = motion.torque, look.joints, len(look.joints)
    assert torque is not None
    turns = ~np.array(prismatic(look.model))
    if look.unit == "rad":
        text = "it would with positions in degrees: add units: {position: deg}"
        yield text, motion.scaled(np.where(turns, DEGREE, 1e-3))
    else:
        text = f"it would with positions in rad: leave units: {{position: {look.unit}}} out"
        yield text, motion.scaled(np.where(turns, 1 / DEGREE, 1e3))
    if n > 1:
        yield (
            "torque of every joint has the opposite sign of what the model needs: the log gives the load's torque"
            " (transmission.torque with -1 on its diagonal), or robot.gravity points the wrong way",
            replace(motion, torque=-torque),
        )
    yield from _turned(joints, motion, torque)
    order = _assigned(matrix_of_likeness(motion, nominal, torque))
    if order is not None:
        text = ", ".join(f"{joints[j]} takes the column given for {joints[c]}" for j, c in enumerate(order) if c != j)
        yield f"the torque columns stand in another order: {text}", replace(motion, torque=torque[:, order])
    yield from _swapped(joints, motion, torque, turns)
    for j in np.flatnonzero(turns):
        for quarter in (1, 2, -1):
            offset = np.zeros(n)
            offset[j] = quarter * np.pi / 2
            text = f"it would with {offset[j]:+.4f} rad added to the position of {joints[j]} (transmission.offset)"
            yield text, motion.moved(offset)


def _turned(joints: Sequence[str], motion: Sampled, torque: np.ndarray) -> Iterator[tuple[str, Sampled]]:
    """The sign of one joint's torque, of its position, of both."""
    for j, name in enumerate(joints):
        sign = np.ones(len(joints))
        sign[j] = -1.0
        text = f"torque of {name} has the opposite sign of what the model needs (-1 in transmission.torque)"
        yield text, replace(motion, torque=torque * sign)
        turned = motion.scaled(sign)
        yield f"it would with the opposite sign of the position of {name} (-1 in transmission.position)", turned
        text = f"it would with the opposite sign of position and torque of {name} (-1 in both matrices of transmission)"
        yield text, replace(turned, torque=torque * sign)


def _swapped(
    joints: Sequence[str], motion: Sampled, torque: np.ndarray, turns: np.ndarray
) -> Iterator[tuple[str, Sampled]]:
    """Columns of two joints exchanged: of position, or of everything."""
    for i in range(len(joints)):
        for j in range(i + 1, len(joints)):
            if turns[i] != turns[j]:
                continue
            swap = list(range(len(joints)))
            swap[i], swap[j] = j, i
            pair, moved = f"{joints[i]} and {joints[j]}", motion.with_columns(swap)
            yield f"it would with the position columns of {pair} swapped", moved
            text = f"it would with position and torque columns of {pair} swapped"
            yield text, replace(moved, torque=torque[:, swap])


def _assigned(matrix: Sequence[Sequence[Likeness]]) -> list[int] | None:
    """Torque column of each joint that makes all of them most alike; None for the order as it is."""
    from scipy.optimize import linear_sum_assignment

    like = np.array([[max(one.correlation, 0.0) for one in row] for row in matrix])
    _, order = linear_sum_assignment(-like)
    return None if (order == np.arange(len(order))).all() else order.tolist()


# Words


def _named(look: _Look, which: np.ndarray) -> str:
    names = [name for name, at in zip(look.joints, which, strict=True) if at]
    return "every joint" if len(names) == len(look.joints) > 1 else ", ".join(names)


def _unit(look: _Look, joint: int) -> str:
    return "m" if prismatic(look.model)[joint] else "rad"


def _effort(look: _Look, joint: int) -> str:
    return "N" if prismatic(look.model)[joint] else "N m"


def _more(rows: np.ndarray) -> str:
    return f" and {len(rows) - 1} more" if len(rows) > 1 else ""
