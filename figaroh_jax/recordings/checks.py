"""The check of every recording before any work: against the model's limits, against itself, against its torque.

What cannot be right is refused, what looks wrong is said, both with what would be right. A finding names the file and
the joint or row. The thresholds keep clear of what the public recordings of real robots show (`benchmarks/
wrong_recordings.py` measures both sides).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.model import RobotModel, prismatic
from .dataset import Memory, Recording, carrying, check_order, unnamed
from .findings import LIKE, SOFT, UNLIKE, Finding, Look, and_more, effort_unit, named, unit_of
from .likeness import sampled
from .torque_checks import torque_findings
from .wild import limits, lost_rows, pulses, wild_steps, wild_torque

if TYPE_CHECKING:
    from pathlib import Path

    from ..formats.config import RecordingEntry, Task


__all__ = [
    "Checked",
    "Finding",
    "check_columns",
    "check_recording",
    "check_recordings",
    "check_rollouts",
    "checked_recordings",
    "position_findings",
    "refuse_unmeasured",
    "report_findings",
]

DEGREE = np.pi / 180
STILL = 1e-3  # rad or m: a joint that stays within it stands
HARD = 20.0  # times a limit: no robot does that
FEWEST = 8  # rows of which anything can be said
WHEEL = 20.0  # rad/s of a joint without limits: faster than wheels turn; 0.35 rad/s in degrees read as rad


class Checked(NamedTuple):
    """What the check says of recordings that were not refused."""

    warnings: tuple[str, ...]
    contradictions: tuple[str, ...]  # those by which recordings and model contradict each other: nothing is named


def check_recordings(task: Task | None, model: RobotModel, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Warnings about recordings of torque, of a task or from arrays, also sent to the log `figaroh_jax`.

    Raises `InputError` with every finding that cannot be right.
    """
    return checked_recordings(task, model, recordings).warnings


def checked_recordings(task: Task | None, model: RobotModel, recordings: Sequence[Recording]) -> Checked:
    """The same, with those of the warnings that contradict the model gravely.

    These are a torque of another size, sign, column or clock, or gravity along another axis, in any recording; and a
    joint's torque that does not follow the model in most of the recordings that are fitted.
    """
    entries: dict[Path | Memory, RecordingEntry] = {entry.place: entry for entry in task.data} if task else {}
    for recording in recordings:
        check_columns(recording, model)
    found = [
        (recording.file.name, finding)
        for recording in recordings
        for finding in check_recording(recording, model, entries.get(recording.file))
    ]
    fitted = [recording for recording in recordings if recording.role == "fit"]
    if fitted and all(_stands(recording) for recording in fitted):
        names = ", ".join(recording.file.name for recording in fitted)
        found.append((names, Finding(True, "no joint moves: a fit needs motion of every joint that it is to identify")))
    warnings = report_findings(found)
    names = [recording.file.name for recording in fitted if recording.torque is not None]
    unlike = Counter(joint for name, finding in found if name in names for joint in finding.unlike)
    most = {joint for joint, count in unlike.items() if count > len(names) / 2}
    grave = [(name, finding) for name, finding in found if finding.grave or most.intersection(finding.unlike)]
    return Checked(warnings, _texts(grave))


def _texts(found: Sequence[tuple[str, Finding]]) -> tuple[str, ...]:
    """Findings, each once with the files that it is about."""
    files: dict[Finding, list[str]] = {}
    for name, finding in found:
        files.setdefault(finding, []).append(name)
    return tuple(f"{', '.join(names)}: {finding.text}" for finding, names in files.items())


def report_findings(found: Sequence[tuple[str, Finding]]) -> tuple[str, ...]:
    """Warnings, one a text with the files that it is about; raises `InputError` with what cannot be right."""
    wrong = _texts([one for one in found if one[1].wrong])
    if wrong:
        raise InputError(wrong[0] if len(wrong) == 1 else "\n  " + ";\n  ".join(wrong))
    texts = _texts(found)
    for text in texts:
        logging.getLogger("figaroh_jax").warning("check: %s", text)
    return tuple(f"check: {text}" for text in texts)


def check_recording(recording: Recording, model: RobotModel, entry: RecordingEntry | None = None) -> list[Finding]:
    """Everything that looks wrong about one recording (joint side, SI units), the gravest first."""
    if model.nq != model.nv or len(recording.time) < FEWEST:
        return []
    motion = sampled(recording.time, recording.position, recording.torque)
    unit = entry.units.position if entry is not None else "rad"
    look = Look(recording.position, recording.joints, model, unit, recording, entry, motion, recording.time)
    found = [Finding(False, recording.wild)] if recording.wild else []
    for check in (_clock, _unit_without_joint, _ranges, _jumps, _zero_rows, _torque_values):
        found += check(look)
    if any(finding.wrong for finding in found):
        return [finding for finding in found if finding.wrong]  # the rest follows from these
    for check in (_velocity, _speeds, _held_samples, _written_twice, _coarse, _clipped):
        found += check(look)
    if motion is not None and recording.torque is not None and not _stands(recording):
        sound = _soundest(look)
        if sound != slice(0, len(recording.time)):  # wild samples are told; they say nothing of the columns
            motion = sampled(recording.time[sound], recording.position[sound], recording.torque[sound])
        if motion is not None:
            found += torque_findings(replace(look, model=carrying(model, recording.load)), motion)
    return found


def check_rollouts(task: Task, model: RobotModel, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Warnings about recordings of commands and positions, as `check_recordings`: clock, unit, range, jumps.

    What these say of a motion holds without torque; `InputError` with every finding that cannot be right.
    """
    entries: dict[Path | Memory, RecordingEntry] = {entry.place: entry for entry in task.data}
    found = []
    for recording in recordings if model.nq == model.nv else ():
        entry = entries.get(recording.file)
        unit = entry.units.position if entry is not None else "rad"
        look = Look(recording.position, recording.joints, model, unit, recording, entry, time=recording.time)
        if len(recording.time) >= FEWEST and recording.position.shape[1] == model.nv:
            told = [finding for check in (_clock, _unit_without_joint, _ranges) for finding in check(look)]
            told += () if any(finding.wrong for finding in told) else _jumps(look)
            told += [Finding(False, recording.wild)] if recording.wild else []
            found += [(recording.file.name, finding) for finding in told]
    return report_findings(found)


def check_columns(recording: Recording, model: RobotModel) -> None:
    """Refuse positions of another number of joints than the robot's, and columns named in another order."""
    if recording.position.shape[1] != model.nq:
        raise InputError(
            f"recording '{recording.name}': q has {recording.position.shape[1]} columns, but robot '{model.name}' has"
            f" {model.nq} numbers of position ({', '.join(model.joint_names)}); joints that stand still are left out by"
            " load_urdf(..., joints=[...])"
        )
    if isinstance(recording.file, Memory) and recording.joints != unnamed(len(recording.joints)):
        check_order(recording.file, recording.joints, model, all_known=False)


def position_findings(
    position: Float[np.ndarray, "rows nv"],
    model: RobotModel,
    unit: str,
    time: Float[np.ndarray, " rows"] | None = None,
) -> list[Finding]:
    """What looks wrong about positions by themselves: unit and range; `time` (s) where they are a motion."""
    look = Look(position, model.dof_names, model, unit, time=time)
    return [finding for check in (_unit_without_joint, _ranges) for finding in check(look)]


def _stands(recording: Recording) -> bool:
    low, high = np.percentile(recording.position, [1, 99], axis=0)
    return bool((high - low < STILL).all())


# Time


def _clock(look: Look) -> Iterator[Finding]:
    """Stamps in another unit than seconds."""
    time = look.recording.time
    step = float(np.median(np.diff(time)))
    if step < 0.1 or _stands(look.recording):
        return
    unit, seconds = next(((u, s) for u, s in _CLOCKS if 1e-5 < step * s <= 0.1), ("ms", 1e-3))
    _, _, speed, _ = limits(look.model)
    top = np.abs(np.diff(look.position, axis=0)).max(axis=0) / step
    slow = bool((top < 0.02 * np.where(np.isfinite(speed), speed, 3.0)).all())
    advice = f"the stamps look like {unit}: add units: {{time: {unit}}}"
    if look.entry is not None and look.entry.time is None:
        advice = f"rate: {1 / step:g} Hz looks like a period instead of a frequency"
    whole = bool(np.all(time == np.round(time)))
    yield Finding(
        slow and (whole or step > 0.5),
        f"{look.entry.time if look.entry and look.entry.time else 'time'}: one sample every {step:.4g} s over"
        f" {time[-1] - time[0]:.4g} s; {advice}",
    )


_CLOCKS = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))


def _unit_without_joint(look: Look) -> Iterator[Finding]:
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
            " degrees: it looks like rad; remove units: {position: deg}",
            grave=True,
        )


def _small(look: Look, turns: np.ndarray) -> bool:
    """Whether a motion in degrees is so small that it fits the joints when it is read as rad."""
    low, high, *_ = limits(look.model)
    span = look.span[turns]
    fits = bool((span / DEGREE <= 1.1 * (high - low)[turns]).all())
    return bool(2e-5 < span.max() < (0.2 if fits and np.isfinite(high - low)[turns].all() else 0.12))


# Position


def _ranges(look: Look) -> Iterator[Finding]:
    """Positions far outside what the model's joints can reach."""
    low, high, speed, _ = limits(look.model)
    bottom, top = np.percentile(look.position, [2, 98], axis=0)
    turns = ~np.array(prismatic(look.model))
    room = np.where(np.isfinite(high - low), high - low, 4 * np.pi)
    over = np.maximum(np.maximum(low - bottom, top - high), 0.0)
    free = ~np.isfinite(high - low) & turns
    wound = np.maximum(np.abs(look.position).max(axis=0) - 16 * np.pi, 0.0)
    if look.time is not None:  # a wheel may turn for ever, but not at the speed of degrees or counts read as rad
        top = np.percentile(np.abs(np.diff(look.position, axis=0)) / np.diff(look.time)[:, None], 98, axis=0)
        wound = np.where(top > np.where(np.isfinite(speed), SOFT * speed, WHEEL), wound, 0.0)
    over = np.where(free, wound, over)
    far = over > np.maximum(room, np.where(turns, np.pi, 0.05))
    if far.any():
        yield from _far(look, far, over)
    elif (over > 0.05 * room).any():
        names = named(look, over > 0.05 * room)
        worst = int(np.argmax(over / room))
        yield Finding(
            False,
            f"position of {names} lies outside the model's limits ({look.joints[worst]}: {bottom[worst]:.4g} to"
            f" {top[worst]:.4g}, limits {low[worst]:.4g} to {high[worst]:.4g} {unit_of(look, worst)}): a zero offset"
            " (transmission.offset), a sign or another order of columns?",
        )


def _far(look: Look, far: np.ndarray, over: np.ndarray) -> Iterator[Finding]:
    low, high, *_ = limits(look.model)
    position, worst = look.position, int(np.argmax(np.where(far, over, 0.0)))
    straight = np.array(prismatic(look.model))
    factor = np.where(straight, 1e-3, DEGREE)
    fits = np.asarray(((position * factor >= low - 0.2) & (position * factor <= high + 0.2)).all(axis=0))
    top = position[:, worst][np.argmax(np.abs(position[:, worst]))]
    said = (
        f"position of {named(look, far)} cannot be right: {look.joints[worst]} reads {top:.5g} {unit_of(look, worst)},"
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


def _jumps(look: Look) -> Iterator[Finding]:
    """Single wild rows and turns of 2 pi that the encoder lost."""
    position, steps = look.position, np.diff(look.position, axis=0)
    low, high, *_ = limits(look.model)
    turns = ~np.array(prismatic(look.model))
    wild = wild_steps(look.position, look.recording.time, look.model)
    for j in np.flatnonzero(wild.any(axis=0)).tolist():
        rows = np.flatnonzero(wild[:, j]) + 1
        biggest = steps[rows - 1, j]
        if turns[j] and (np.abs(np.abs(biggest) - 2 * np.pi) < 0.3).all():
            yield Finding(
                True,
                f"position of {look.joints[j]} jumps by 2 pi in row {look.row(rows[0])}{and_more(rows)}: the encoder"
                " wraps around; unwrap it (numpy.unwrap)",
            )
            continue
        k = rows[int(np.argmax(np.abs(biggest)))]
        room = high[j] - low[j] if np.isfinite(high[j] - low[j]) else 4 * np.pi
        value = max(position[k - 1 : k + 1, j], key=abs)
        beyond = max(low[j] - value, value - high[j]) > room or abs(steps[k - 1, j]) > 8 * np.pi
        yield Finding(
            bool(beyond),
            f"position of {look.joints[j]} jumps by {steps[k - 1, j]:.4g} {unit_of(look, j)} in row {look.row(k)} (from"
            f" 0){and_more(rows)}: a wild sample or lost rows; delete these rows, or exclude them with"
            " preprocess.window",
            grave=True,  # no fit follows it, and all of it is taken for noise or for an effect
        )


def _soundest(look: Look) -> slice:
    """The longest stretch of rows without wild samples: what these make of a motion says nothing of its columns."""
    position, torque = look.position, look.recording.torque
    wild = np.zeros(len(position), bool)
    steps = wild_steps(look.position, look.recording.time, look.model).any(axis=1)
    wild[1:] |= steps
    wild[:-1] |= steps
    if position.shape[1] > 1:
        wild[lost_rows(position)] = True
    if torque is not None:
        wild |= wild_torque(torque, look.model).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], wild, [True]]).astype(int)))
    first, after = edges[::2], edges[1::2]
    longest = int(np.argmax(after - first)) if len(first) else 0
    return slice(int(first[longest]), int(after[longest])) if len(first) else slice(0, 0)


def _zero_rows(look: Look) -> Iterator[Finding]:
    """Rows of zeros in the middle of a motion: packets that never came."""
    for key in ("position", "torque"):
        values = getattr(look.recording, key)
        if values is None or values.shape[1] < 2 or not values.any():
            continue
        if len(rows := lost_rows(values)):
            yield Finding(
                False,
                f"{key} is zero at every joint in row {look.row(rows[0])} (from 0){and_more(rows)}: lost packets?"
                " Delete these rows",
            )


def _held_samples(look: Look) -> Iterator[Finding]:
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
        f"every row appears {times:.0f} times: values were sampled at about {rate / times:.4g} Hz and held, the stamps"
        f" say {rate:.4g} Hz; keep one row of each",
    )


def _written_twice(look: Look) -> Iterator[Finding]:
    """Rows that repeat the one before them bit by bit, while the motion goes on as if they were not there.

    Of a value that was held, the next step makes up for it.
    """
    torque = look.recording.torque
    if torque is None:
        return
    steps = np.diff(look.position, axis=0)
    same = (steps == 0).all(axis=1) & (np.diff(torque, axis=0) == 0).all(axis=1)
    at = np.flatnonzero(same[_BESIDE : len(same) - _BESIDE]) + _BESIDE
    near = steps[at[:, None] + np.delete(np.arange(-_BESIDE, _BESIDE + 1), _BESIDE)]  # (rows, steps, joints)
    other = np.delete(near, _BESIDE, axis=1).mean(axis=1)  # all but the one that would make up for it
    square = (other**2).sum(axis=1)
    share = np.einsum("rsj,rj->rs", near, other) / np.where(square > 0, square, 1.0)[:, None]
    rows = at[(np.abs(share - 1) < 0.5).all(axis=1)] + 1
    if len(rows):
        yield Finding(
            False,
            f"position and torque of every joint in row {look.row(rows[0])} (from 0){and_more(rows)} are those of the"
            " row before, and the motion goes on as if that row were not there: a reading that was written twice."
            " Delete these rows; where no stamps say the time, they make all that follows late",
        )


_BESIDE = 4  # steps at either side of a row


def _coarse(look: Look) -> Iterator[Finding]:
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
            f"position of {', '.join(bad)} comes in steps of {step:.3g} {unit_of(look, look.joints.index(name))}"
            f" ({name}): fewer than 25 steps over the whole motion; log more digits, or lower preprocess.cutoff",
        )


# Velocity


def _velocity(look: Look) -> Iterator[Finding]:
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


def _velocity_said(look: Look, slope: np.ndarray, like: np.ndarray, at: np.ndarray) -> Iterator[Finding]:
    names = [look.joints[j] for j in at]
    flipped = [name for name, r in zip(names, like, strict=True) if r < -LIKE]
    if flipped:
        yield Finding(
            False,
            f"velocity of {', '.join(flipped)} has the opposite sign of the position's rate: one of them is negated",
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
    clock = False
    if abs(factor * DEGREE - 1) < 0.2:
        text = "it looks like degrees: add units: {velocity: deg/s}, or units: {position: deg} if both are"
    elif abs(factor / DEGREE - 1) < 0.2:
        text = "the position looks like degrees: add units: {position: deg, velocity: rad/s}"
    else:
        text = f"the clock looks wrong: a rate of {rate * factor:.4g} Hz instead of {rate:.4g} Hz would fit"
        clock = True
    hard = factor > 300 or factor < 1 / 300
    yield Finding(bool(hard), f"velocity is {factor:.4g} times the position's rate; {text}", grave=clock)


def _speeds(look: Look) -> Iterator[Finding]:
    """Speed and its model's limit."""
    if look.motion is None:
        return
    _, _, limit, _ = limits(look.model)
    top = np.percentile(np.abs(look.motion.velocity), 99, axis=0)
    fast = top > SOFT * limit
    if not fast.any():
        return
    worst = int(np.argmax(top / limit))
    rate = look.motion.rate
    yield Finding(
        bool(top[worst] > HARD * limit[worst]),
        f"{look.joints[worst]} moves at {top[worst]:.4g} {unit_of(look, worst)}/s, {top[worst] / limit[worst]:.3g}"
        f" times the model's limit ({named(look, fast)} in all): is {rate:.5g} Hz the right rate, is the position in"
        " degrees (units: {position: deg}) or on the motor side (transmission.position)?",
    )


# Torque


def _absolute(torque: Float[np.ndarray, "samples nv"]) -> bool:
    """Whether torques of several moving joints have lost their sign: never below zero, but down to zero.

    Gravity alone may hold a sign, but keeps a torque away from zero.
    """
    low, high = torque.min(axis=0), torque.max(axis=0)
    alive = high > 0
    near = alive & (low <= 0.005 * high) & (np.mean(torque <= 0.02 * high, axis=0) > 0.01)
    return bool(alive.sum() > 2 and (low >= 0).all() and 2 * near.sum() > alive.sum())


def _torque_values(look: Look) -> Iterator[Finding]:
    """Torques that no drive gives, and torques that were not measured."""
    torque = look.recording.torque
    if torque is None:
        return
    if not np.ptp(torque, axis=0).any():
        what = "zero" if not torque.any() else "constant"
        yield Finding(True, f"torque is {what} at every joint: it was not measured; name the column that holds it")
        return
    if _absolute(torque):
        yield Finding(
            True,
            "torque never changes its sign at any joint and falls to zero at most of them: an absolute value, as of a"
            " current without direction, is no torque; leave it out (a diagnosis of command and position needs none)",
        )
        return
    dead = (np.ptp(torque, axis=0) == 0) & ~np.isin(look.joints, look.recording.undriven)
    if dead.any():
        yield Finding(False, f"torque of {named(look, dead)} never changes: it was not measured there")
    effort = limits(look.model)[3]
    ceiling = np.where(np.isfinite(effort), effort, 1e4)
    usual, top = np.percentile(np.abs(torque), 99, axis=0), np.abs(torque).max(axis=0)
    samples = wild_torque(torque, look.model)
    wild = samples.any(axis=0)
    for j in np.flatnonzero(wild).tolist():
        rows = np.flatnonzero(samples[:, j])
        yield Finding(
            bool(top[j] > 1e3 * ceiling[j]),
            f"torque of {look.joints[j]} reads {torque[rows[0], j]:.4g} {effort_unit(look, j)} in row"
            f" {look.row(rows[0])} (from 0){and_more(rows)}, limit {ceiling[j]:.4g}: wild samples; delete these rows",
        )
    yield from _pulse(look)
    high = (usual > SOFT * ceiling) & ~wild
    if high.any():
        worst = int(np.argmax(usual / ceiling))
        yield Finding(
            bool(usual[worst] > 1e3 * ceiling[worst]),
            f"torque of {named(look, high)} is {usual[worst] / ceiling[worst]:.3g} times the model's effort limit"
            f" ({look.joints[worst]}: {usual[worst]:.4g} {effort_unit(look, worst)}): is it in mN m, a share of the"
            " rated torque, or a current (units: {torque: A} with transmission.torque)?",
        )


def _pulse(look: Look) -> Iterator[Finding]:
    """Torque of a row or two that no other supports; the largest of a recording is told."""
    torque = look.recording.torque
    assert torque is not None
    alone = pulses(torque)
    if not alone.any():
        return
    before = np.abs(np.diff(torque, axis=0, prepend=torque[:1]))
    k, j = np.unravel_index(int(np.argmax(np.where(alone, before, -1.0))), alone.shape)
    after = k + 1 + int(np.argmin(np.append(alone[k + 1 :, j], False)))
    yield Finding(
        False,
        f"torque of {look.joints[j]} is {torque[k, j]:.4g} {effort_unit(look, int(j))} in row {look.row(k)} (from 0),"
        f" {torque[k - 1, j]:.4g} before and {torque[after, j]:.4g} after it"
        f"{and_more(np.flatnonzero(alone.any(axis=1)))}: a sudden stop, or wild samples, which are to be deleted",
    )


def _clipped(look: Look) -> Iterator[Finding]:
    """A torque that stays at its own largest value: the drive, or the log, was at its end."""
    torque = look.recording.torque
    if torque is None:
        return
    for j in np.flatnonzero(look.span > STILL).tolist():
        column = torque[:, j]
        for end in (column.max(), column.min()):
            at = column == end
            if end == 0 or at.mean() <= 0.01 or len(np.unique(column)) < 30:
                continue  # few levels are steps of the sensor, not a limit
            runs = _runs(at)
            if (runs >= 5).sum() and runs.max() < len(at) / 2:
                yield Finding(
                    False,
                    f"torque of {look.joints[j]} stays at {end:.4g} {effort_unit(look, j)} for {at.mean():.1%} of the"
                    " samples: the drive was at its limit, or the log clips; leave such motions out, or move more"
                    " slowly",
                )


def _runs(flags: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return edges[1::2] - edges[::2]


def refuse_unmeasured(robot: RobotModel, recordings: Sequence[Recording]) -> None:
    """Refuse a joint whose torque has one value in all recordings of the fit: every joint is judged by its torque."""
    fitted = [one for one in recordings if one.role == "fit" and one.torque is not None]
    if not fitted:
        return
    torque = np.concatenate([one.torque for one in fitted if one.torque is not None])
    dead = np.flatnonzero(np.ptp(torque, axis=0) == 0)
    if 0 < dead.size < torque.shape[1]:  # of all joints: `check_recordings` says so
        j = int(dead[0])
        name, still = robot.dof_names[j], all(np.ptp(one.position[:, j]) == 0 for one in fitted)
        if all(name in one.undriven for one in fitted):
            driven = next(joint for joint in robot.dof_names if joint not in fitted[0].undriven)
            raise InputError(
                f"{fitted[0].file}: nothing drives {name}, and a diagnosis judges every joint by its torque. It judges"
                " the motion instead where the task names the torque as `command`, not as `torque` (of a URDF with"
                f" `actuator: {{{driven}: {{kind: torque}}}}`); identify takes the torque as it is"
            )
        instead = "identify leaves such a joint out, a diagnosis judges every joint by its torque"
        if still:
            instead = f"it stands still: name the others in robot.joints, and {name} in robot.posture"
        raise InputError(
            f"{fitted[0].file}: the torque of {name} is {torque[0, j]:g} in every row: it was not measured; {instead}"
        )
