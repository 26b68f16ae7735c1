"""Rows that no robot made, as logs have them: wild samples, lost packets, streams that stood still, rows that lack.

They are found, told and left out, or given their time. A low pass spreads a wild position over all rows within half a
period of its cutoff, where its acceleration is that of no motion: eight of 3000 rows move every number of a fit.
Without them the stamps have gaps: short ones are bridged, and rows near long ones count for nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..rigid.model import RobotModel, prismatic

if TYPE_CHECKING:
    from .dataset import Recording

__all__ = [
    "Wild",
    "bridged",
    "limits",
    "lost_rows",
    "lost_time",
    "pulses",
    "stopped_rows",
    "wild_rows",
    "wild_steps",
    "wild_torque",
    "without_wild_rows",
]

FEWEST = 50  # rows from which it is known what is usual
MOST = 0.02  # of the rows: where more are wild, something else is wrong, and all of them stay
BEYOND = 20.0  # times the usual step of a joint (98 % are smaller): no motion goes as far from one row to the next
SHORT = 3  # rows for which a sample stands aside at the most
ASIDE = 10.0  # times the steps that 95 % are below: how far it does at the least
BACK = 0.25  # of how far a sample stands aside: what the rows before and after it may differ by
OF_RANGE = 2.0  # of the range of a torque: stops of a real arm, of one row at 100 Hz, stand .7 to 1.1 aside
AS_BEFORE = 0.3  # of the speed before a pulse: a change by less is no stop
SOUND = 10  # rows of a stretch that belongs to the motion
STOPPED = 0.2  # of the rows: where more repeat the row before, the log is faster than its stream
REPEATS = 3  # rows: a stream that repeats fewer has not stopped
MOVED_ON = 4.0  # usual steps that the motion has made meanwhile, in one joint at least
SUDDEN = 3.0  # times the steps before and after it: the step with which a stream goes on
AROUND = 3  # steps before and after, which tell how fast the joints were
ALONG = 0.3  # of such a step: what of it may not be along the motion of the joints
STANDS = 0.05  # of the fastest joint's usual step: a joint with less stands still
LONGEST = 0.5  # s: over more than that no motion goes on as it was

Rows = Bool[np.ndarray, " rows"]
Mask = Bool[np.ndarray, "rows nv"]


class Wild(NamedTuple):
    """Rows that no robot made, and what is said of them."""

    rows: Rows
    lost: Rows  # those of them that are packets which never came
    text: str


def without_wild_rows(recording: Recording, model: RobotModel) -> Recording:
    """The recording (joint side) without rows that no robot made: `wild` says which, `stamps` are all that it had.

    They are those of `wild_rows`; stamps that run on evenly over rows that lack are moved first (`lost_time`: `clock`
    are all stamps then). Where nothing is found, the recording is given back as it is.

    >>> import numpy as np, figaroh_jax as fj
    >>> t = np.arange(500)[:, None] / 250.0
    >>> q = 0.5 * np.sin(t + np.arange(4))
    >>> q[100, 2] += 1.0  # a wild sample
    >>> run = fj.recording(q=q, tau=np.cos(t + np.arange(4)), rate=250)
    >>> found = fj.cleaning.without_wild_rows(run, fj.load_urdf(fj.DEMO))
    >>> len(found.time), found.wild
    (499, '1 wild row is left out: position of joint 3 jumps by 0.9985 rad in row 100, counted from 0')
    """
    clock, lacking = recording.time, ""
    if model.nq == model.nv and len(clock) >= FEWEST:
        clock, lacking = lost_time(recording.position, clock)
    stamps = recording.time
    if lacking:
        recording = replace(recording, time=clock, stamps=stamps, clock=clock, wild=lacking)
    found = wild_rows(recording, model)
    if found is None:
        return recording
    series = {key: getattr(recording, key) for key in ("time", "position", "velocity", "torque", "command", "trusted")}
    shorter = {key: values[~found.rows] for key, values in series.items() if values is not None}
    text = f"{found.text}; {lacking}" if lacking else found.text
    return replace(recording, **shorter, stamps=stamps, clock=clock, wild=text)


def bridged(recording: Recording, model: RobotModel) -> Recording:
    """The recording with straight lines through the positions of rows that no robot made, which count for nothing.

    Rows are as many as before, for a simulation takes every command; through lost packets the command holds.
    """
    found = wild_rows(recording, model)
    if found is None:
        return recording
    kept, command = np.flatnonzero(~found.rows), recording.command
    every = np.arange(len(found.rows))
    if command is not None and found.lost.any():
        came = np.flatnonzero(~found.lost)
        command = command[came[np.maximum(np.searchsorted(came, every, side="right") - 1, 0)]]

    def through(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
        return np.stack([np.interp(every, kept, one[kept]) for one in values.T], axis=1)

    trusted = np.ones(recording.position.shape, bool) if recording.trusted is None else recording.trusted
    return replace(
        recording,
        position=through(recording.position),
        velocity=None if recording.velocity is None else through(recording.velocity),
        command=command,
        trusted=trusted & ~found.rows[:, None],
        wild=found.text,
    )


def wild_rows(recording: Recording, model: RobotModel) -> Wild | None:
    """Rows of a recording (joint side) that no robot made, or None where there are none that can be left out.

    These are positions to which a joint jumps and from which it comes back, or that the motion begins or ends with;
    torque of one to three rows that stands aside from that around it by twice its range, or by half of it where the
    motion goes on as before, or far beyond the joint's limit; rows of zeros in the middle of a motion; rows in which
    positions, or torques, of all joints repeat while the robot moves on (`stopped_rows`). None too where the others are
    more than 2 % of all, as where a joint jumps and does not come back: something else is wrong then, which
    `check_recordings` tells.
    """
    if model.nq != model.nv or len(recording.time) < FEWEST:
        return None
    shape, stopped = recording.position.shape, stopped_rows(recording.position, recording.torque)
    moved, forced, lost = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape[0], bool)
    rows = np.flatnonzero(~stopped)
    while True:  # many of them hide others: they are part of what is usual
        position = recording.position[rows]
        torque = None if recording.torque is None else recording.torque[rows]
        both = np.hstack([position, torque]) if torque is not None and shape[1] == 1 else None
        for values in (position, torque, both):
            if values is not None and values.shape[1] > 1 and values.any():
                lost[rows[lost_rows(values)]] = True
        came = rows[~lost[rows]]  # beside a row of zeros, one at which friction turns would stand aside
        moved[came] |= _wild_positions(recording.position[came], recording.time[came], model)
        if recording.torque is not None:
            torque = recording.torque[came]
            alone = pulses(torque) & _goes_on(recording.position[came])[:, None]
            forced[came] |= wild_torque(torque, model) | pulses(torque, OF_RANGE) | alone
        wild = lost | moved.any(axis=1) | forced.any(axis=1)
        if wild.mean() > MOST:
            return None
        if not wild[rows].any():
            break
        rows = np.flatnonzero(~wild & ~stopped)
    wild |= stopped
    return Wild(wild, lost, _told(recording, model, moved, forced, lost, stopped)) if wild.any() else None


def limits(model: RobotModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper position, speed and torque; infinite where the model gives none (zero counts as none)."""
    low, high = np.asarray(model.position_limit, float).T
    none = ~(high > low)
    rates = [np.asarray(x, float) for x in (model.velocity_limit, model.effort_limit)]
    speed, effort = (np.where(x > 0, x, np.inf) for x in rates)
    return np.where(none, -np.inf, low), np.where(none, np.inf, high), speed, effort


def wild_steps(
    position: Float[np.ndarray, "rows nv"], time: Float[np.ndarray, " rows"], model: RobotModel
) -> Bool[np.ndarray, "steps nv"]:
    """Steps of the position from one row to the next that no joint makes."""
    steps, dt = np.diff(position, axis=0), np.diff(time)[:, None]
    return _leaps(steps, dt, float(np.median(dt)), _usual(steps), model)


def _leaps(
    steps: Float[np.ndarray, "steps nv"],
    dt: Float[np.ndarray, "steps 1"],
    period: float,
    usual: Float[np.ndarray, " nv"],
    model: RobotModel,
) -> Bool[np.ndarray, "steps nv"]:
    each = np.abs(steps) / np.maximum(np.round(dt / period), 1.0)  # a gap in the stamps is no jump
    speed = limits(model)[2]
    allowed = np.where(np.isfinite(speed), 5 * speed * dt, np.inf)
    least = np.where(prismatic(model), 0.01, 0.1)
    wild = (each > BEYOND * usual) & (np.abs(steps) > least)
    return wild & ((np.abs(steps) > allowed) | (np.abs(steps) > 1.0) | (each > 10 * BEYOND * usual))


def _usual(steps: Float[np.ndarray, "steps nv"]) -> Float[np.ndarray, " nv"]:
    return np.percentile(np.abs(steps), 98, axis=0) + 1e-9


def lost_rows(values: Float[np.ndarray, "rows nv"]) -> Int[np.ndarray, " lost"]:
    """Rows of zeros in the middle of a motion."""
    steps = np.abs(np.diff(values, axis=0))
    usual = np.percentile(steps, 95, axis=0)
    sudden = np.mean((steps > 3 * usual) & (steps > 0), axis=1) > 0.49
    return np.flatnonzero((values[1:-1] == 0).all(axis=1) & (sudden[:-1] | sudden[1:])) + 1


def wild_torque(torque: Float[np.ndarray, "rows nv"], model: RobotModel) -> Mask:
    """Torque far beyond what a joint can give, and beyond all others of it."""
    effort = limits(model)[3]
    ceiling = np.where(np.isfinite(effort), effort, 1e4)
    usual, top = np.percentile(np.abs(torque), 99, axis=0), np.abs(torque).max(axis=0)
    wild = (top > 3 * ceiling) & (top > 10 * usual)
    return wild & (np.abs(torque) > np.maximum(3 * ceiling, 10 * usual))


def pulses(torque: Float[np.ndarray, "rows nv"], ranges: float = 0.5) -> Mask:
    """Torque of one to three rows that stands aside from that around it by so many of its ranges (of 94 % of it)."""
    low, high = np.percentile(torque, [3, 97], axis=0)
    return _aside(torque, np.where(high > low, ranges * (high - low), np.inf))


def _goes_on(position: Float[np.ndarray, "rows nv"]) -> Rows:
    """Rows about which the robot moves, after them as fast as before: no torque there has stopped or started it."""
    steps = np.diff(position, axis=0)
    speed = np.cumsum(np.vstack([np.zeros_like(steps[:1]), steps / _usual(steps)]), axis=0)  # in usual steps
    found, reach = np.zeros(len(position), bool), SHORT - 1 + AROUND
    rows = np.arange(reach, len(position) - reach)
    before, after = speed[rows - SHORT + 1] - speed[rows - reach], speed[rows + reach] - speed[rows + SHORT - 1]
    change, was = np.linalg.norm(after - before, axis=1), np.linalg.norm(before, axis=1)
    found[rows] = (change < AS_BEFORE * was) & (was > AROUND * AS_BEFORE)
    return found


def stopped_rows(position: Float[np.ndarray, "rows nv"], torque: Float[np.ndarray, "rows nv"] | None) -> Rows:
    """Rows that repeat, bit by bit and at every joint, the one before them while the robot moves on.

    Positions then go on with a step many times those around it; torques repeat while positions change. A robot that
    stands still repeats its positions too, and starts slowly. Nothing is found in a log that repeats more than a fifth
    of its rows: it samples a slower stream.
    """
    found = np.zeros(len(position), bool)
    steps = np.diff(position, axis=0)
    usual = _usual(steps)
    for values in (position, torque):
        if values is None:
            continue
        same = np.append(False, (np.diff(values, axis=0) == 0).all(axis=1))
        edges = np.flatnonzero(np.diff(np.append(same, False).astype(int)))
        for begin, end in zip(edges[::2] + 1, edges[1::2] + 1, strict=True):  # they repeat the row `begin` - 1
            if end - begin < REPEATS or begin < 2 or end > len(position) - 2:
                continue
            if values is position:
                step, beside = np.abs(steps[end - 1]), np.abs(steps[[begin - 2, end]]).max(axis=0)
                on = (step > MOVED_ON * usual) & (step > SUDDEN * beside)
            else:
                on = np.abs(position[end - 1] - position[begin - 1]) > MOVED_ON * usual
            found[begin:end] |= bool(on.any())
    return found if found.mean() <= STOPPED else np.zeros_like(found)


def lost_time(
    position: Float[np.ndarray, "rows nv"], time: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " rows"], str]:
    """Stamps (s) with the time of rows that lack under even stamps, and what is said of it (empty: none lack).

    All joints then go on at once with a step many times those around it and along their motion, m times as large: m - 1
    rows are lost. At least two joints must move, or one joint's encoder may have slipped.
    """
    from scipy.ndimage import maximum_filter1d

    steps, dt = np.diff(position, axis=0), np.diff(time)
    period, usual, size = float(np.median(dt)), _usual(steps), np.abs(steps)
    usual = np.maximum(usual, STANDS * usual.max())
    even = maximum_filter1d(dt, 2 * AROUND + 1, mode="nearest") < 1.5 * period  # where stamps have a gap, it is theirs
    beside = np.maximum(np.roll(size, 1, axis=0), np.roll(size, -1, axis=0))
    sudden = ((size > MOVED_ON * usual) & (size > SUDDEN * beside)).any(axis=1) & even
    moved, places = np.zeros(len(dt)), []
    for k in np.flatnonzero(sudden[AROUND : len(dt) - AROUND]) + AROUND:
        if not size[k - AROUND : k].any(axis=1).all():
            continue  # the stream stood still before it: no row is lost
        rate = (steps[k - AROUND : k].mean(axis=0) + steps[k + 1 : k + 1 + AROUND].mean(axis=0)) / 2 / usual
        step = steps[k] / usual
        times = float(step @ rate / max(rate @ rate, 1e-300))
        along = np.linalg.norm(step - times * rate) < ALONG * np.linalg.norm(step)
        if along and SUDDEN < times < LONGEST / period and (np.abs(rate) > 0.1).sum() > 1:
            moved[k] = (times - 1) * period
            places.append(k + 1)
    if not places or len(places) > MOST * len(time):
        return time, ""
    others = f" and {len(places) - 1} more" if len(places) > 1 else ""
    seconds = float(moved.max())
    text = (
        f"rows lack before row {places[0]} (from 0){others}, up to {seconds:.2g} s each: all joints go on by many steps"
    )
    return time + np.append(0.0, np.cumsum(moved)), f"{text} at once; the stamps after them are moved by that time"


def _wild_positions(
    position: Float[np.ndarray, "rows nv"], time: Float[np.ndarray, " rows"], model: RobotModel
) -> Mask:
    """Samples that stand aside from the motion, and those of stretches between jumps."""
    found = _aside(position, np.where(prismatic(model), 0.001, 0.01))
    leaps = wild_steps(position, time, model)
    if leaps.any():
        found |= _between_jumps(position, time, model, np.flatnonzero(leaps.any(axis=1)) + 1)[:, None]
    return found


def _between_jumps(
    position: Float[np.ndarray, "rows nv"],
    time: Float[np.ndarray, " rows"],
    model: RobotModel,
    jumps: Int[np.ndarray, " jumps"],
) -> Rows:
    """Rows of stretches, from one jump to the next, that do not go on from the longest one as a motion does."""
    steps = np.diff(position, axis=0)
    period, usual = float(np.median(np.diff(time))), _usual(steps)
    begins, ends = np.append(0, jumps), np.append(jumps, len(position))
    first = last = longest = int(np.argmax(ends - begins))
    wild = np.ones(len(position), bool)
    wild[begins[longest] : ends[longest]] = False

    def goes_on(one: int, other: int) -> bool:
        """Whether the rows `one` and `other` may be of one motion."""
        step, dt = (position[other] - position[one])[None], np.array([[time[other] - time[one]]])
        return not _leaps(step, dt, period, usual, model).any()

    for k in range(longest + 1, len(begins)):
        if ends[k] - begins[k] >= SOUND and goes_on(ends[last] - 1, begins[k]):
            wild[begins[k] : ends[k]], last = False, k
    for k in range(longest - 1, -1, -1):
        if ends[k] - begins[k] >= SOUND and goes_on(ends[k] - 1, begins[first]):
            wild[begins[k] : ends[k]], first = False, k
    return wild


def _aside(values: Float[np.ndarray, "rows nv"], least: Float[np.ndarray, " nv"]) -> Mask:
    """Samples, up to three in a row, that are far from those before and after them, which agree with each other."""
    found = np.zeros(values.shape, bool)
    for x, own, limit in zip(values.T, found.T, least, strict=True):  # one by one: recordings may be large
        far = max(limit, ASIDE * np.percentile(np.abs(np.diff(x)), 95))
        for many in range(1, SHORT + 1):
            before, after = x[: -many - 1], x[many + 1 :]
            between, rows = (before + after) / 2, len(before)
            away = np.min([np.abs(x[1 + k : 1 + k + rows] - between) for k in range(many)], axis=0)
            aside = (away > far) & (np.abs(after - before) < BACK * away)
            for k in range(many):
                own[1 + k : 1 + k + rows] |= aside
    return found


def _told(recording: Recording, model: RobotModel, moved: Mask, forced: Mask, lost: Rows, stopped: Rows) -> str:
    """How many rows are wild, and why: the largest jump, the largest torque, packets that never came, what repeats."""
    many = int((lost | moved.any(axis=1) | forced.any(axis=1) | stopped).sum())
    moved, forced, slides, why = moved & ~lost[:, None], forced & ~lost[:, None], prismatic(model), []

    def largest(values: Float[np.ndarray, "rows nv"], which: Mask) -> tuple[int, int, str]:
        row, joint = np.unravel_index(int(np.argmax(np.where(which, np.abs(values), -1.0))), which.shape)
        return int(row), int(joint), recording.joints[joint]

    if moved.any():
        steps = np.diff(recording.position, axis=0)
        k, j, joint = largest(np.vstack([steps[:1], steps]), moved)
        size = abs(steps[max(k - 1, 0), j])
        why.append(f"position of {joint} jumps by {size:.4g} {'m' if slides[j] else 'rad'} in row {k}")
    if forced.any() and recording.torque is not None:
        k, j, joint = largest(recording.torque, forced)
        why.append(f"torque of {joint} reads {recording.torque[k, j]:.4g} {'N' if slides[j] else 'N m'} in row {k}")
    if lost.any():
        zero = np.flatnonzero(lost)
        others = f" and {len(zero) - 1} more" if len(zero) > 1 else ""
        why.append(f"zero at every joint in row {zero[0]}{others} (lost packets)")
    if stopped.any():
        begins = np.flatnonzero(np.diff(np.append(False, stopped).astype(int)) == 1)
        others = f" and {len(begins) - 1} more" if len(begins) > 1 else ""
        why.append(f"a stream stops in row {begins[0]}{others}: every joint reads the same while the robot moves on")
    return f"{many} wild row{' is' if many == 1 else 's are'} left out: {'; '.join(why)}, counted from 0"
