"""Whether recordings that are said to repeat one another do, and which others would."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ..recordings.signals import SAME_MOTION, Signals, apart, common_rows
from .flexible import to_unit
from .layout import FOLDS, block_width

__all__ = ["CHANGED_SQUARES", "changed_torques", "checked_repeats", "foretold_by_others", "repeats_not_said"]

CHANGED_SQUARES = 0.5  # of the squares by which the torques of two repeats differ: what follows the motion is no noise
CHANGED = 0.02  # of a joint's torque: repeats that differ by less are repeats
ASIDE = 0.02  # of a joint's motion (standard deviation): repeats that stand that far from each other are none
CONSTANT = 5.0  # times what repeats differ by from row to row: by more they differ all along
RIDGE = 1e-4  # of the functions that a difference is followed by: those that a slice does not show stay small
REVERSAL = 0.02  # of a joint's fastest speed, over which its friction changes sign


def checked_repeats(signals: Sequence[Signals], joints: Sequence[str]) -> list[Signals]:
    """The recordings, each repeat with a note of how near it is; one that moves otherwise loses its label.

    What two recordings of other motions differ by is no noise: without the label they are two excitations. Nor is it
    where a joint's torque is another one though it moves alike: the robot is warmer by then, or carries more.
    """
    out, leaders = [], {}
    for one in signals:
        leader = leaders.setdefault(one.repeat, one) if one.repeat and one.role == "fit" else one
        if leader is one:
            out.append(one)
            continue
        note = _compared(leader, one)
        if apart(leader, one) > SAME_MOTION:
            text = f"{one.name} does not repeat {leader.name}: {note}; taken as another excitation"
            out.append(replace(one, repeat=None, notes=(*one.notes, text)))
        elif (aside := _aside(leader, one)) is not None:
            text = (
                f"{one.name} moves as {leader.name} does, but reads {joints[aside[0]]} {aside[1]:+.3g} rad (or m) from"
                " there all along: its encoder has another zero, or the robot stood elsewhere. Taken as another"
                " excitation"
            )
            out.append(replace(one, repeat=None, notes=(*one.notes, text)))
        elif changed := changed_torques(leader, one):
            most = max(changed, key=lambda joint: changed[joint][0])
            text = (
                f"{one.name} moves as {leader.name} does, but the torque of {joints[most]} is another one: they differ"
                f" by {changed[most][1]:.2g} N m (or N) RMS, most of which follows the motion, as noise does not."
                " Something changed between them; taken as another excitation"
            )
            out.append(replace(one, repeat=None, changed_since=leader.name, notes=(*one.notes, text)))
        else:
            out.append(replace(one, notes=(*one.notes, f"{one.name} repeats {leader.name}: {note}")))
    return out


def _aside(first: Signals, second: Signals) -> tuple[int, float] | None:
    """The joint whose position stands farthest aside in the second of two repeats, by how much; None where none does.

    A turn more is no other position. Joints with positions of several numbers are not asked.
    """
    if first.position.shape != first.velocity.shape:
        return None
    own, other = common_rows(first, second)
    q, p = first.position[first.rows.index[own]], second.position[second.rows.index[other]]
    by, motion = np.mean(p - q, axis=0), q.std(axis=0)
    by -= 2 * np.pi * np.round(by / (2 * np.pi)) * (np.abs(by) > np.pi)
    far = np.abs(by) / np.maximum(motion, 1e-3 * max(float(motion.max()), 1e-12))
    far *= np.abs(by) > CONSTANT * (p - q).std(axis=0)
    joint = int(np.argmax(far))
    return (joint, float(by[joint])) if far[joint] > ASIDE else None


def repeats_not_said(signals: Sequence[Signals]) -> tuple[str, ...]:
    """Notes on fitted recordings that move as another one does though no label says so: they could tell the noise."""

    def before(k: int) -> Iterator[Signals]:
        one = fitted[k]
        return (o for o in fitted[:k] if not (one.repeat and o.repeat) and _as_long_and_far(o, one) and near(o, one))

    def near(first: Signals, second: Signals) -> bool:
        return apart(first, second) <= SAME_MOTION and _aside(first, second) is None

    fitted = [one for one in signals if one.role == "fit" and not one.changed_since]
    likes = [next(before(k), None) for k in range(len(fitted))]
    text = "{} moves as {} does: with the same `repeat` under `data` their differences would tell the noise"
    return tuple(text.format(one.name, like.name) for one, like in zip(fitted, likes, strict=True) if like)


def _as_long_and_far(first: Signals, second: Signals) -> bool:
    """Whether two recordings last as long and their joints move as far; without that none repeats the other."""
    ends = [one.time[-1] - one.time[0] for one in (first, second)]
    far = [np.ptp(one.position, axis=0) for one in (first, second)]
    return max(ends) <= 1.2 * min(ends) and bool(np.all(np.abs(far[0] - far[1]) <= 0.2 * np.max(far, axis=0)))


def _compared(first: Signals, second: Signals) -> str:
    """How two repeats differ, in words."""
    own, other = common_rows(first, second)
    q, p = first.position[first.rows.index[own]], second.position[second.rows.index[other]]
    late = 1e3 * float(np.mean(second.rows.row_times[other] - first.rows.row_times[own]))
    text = f"its clock is {late:+.4g} ms off, positions within {(q - p).std(axis=0).max():.2g} rad (or m)"
    if first.torque is not None and second.torque is not None:
        torque = first.torque[first.rows.index[own]] - second.torque[second.rows.index[other]]
        text += f", torques within {torque.std(axis=0).max():.2g} N m (or N)"
    return text


def changed_torques(first: Signals, second: Signals) -> dict[int, tuple[float, float]]:
    """The joints whose torque changed from one repeat to another: by what share of it, and by how much (RMS, N m or N).

    Noise of some slices of the recordings does not foretell that of others, whatever its spectrum is. What friction,
    load or posture made then is foretold by functions of the joint's own motion: most of the squares of the difference.
    Constants say nothing, as torque sensors drift. Of a robot whose joints have positions of several numbers, nothing.
    """
    out: dict[int, tuple[float, float]] = {}
    if first.torque is None or second.torque is None or first.position.shape != first.velocity.shape:
        return out
    own, other = common_rows(first, second)
    index = first.rows.index[own]
    torques = [_over_rows(first, first.torque, index), _over_rows(second, second.torque, second.rows.index[other])]
    torque, difference = (torques[0] + torques[1]) / 2, torques[1] - torques[0]
    seconds = first.rows.row_times[own]
    slices = ((seconds - seconds[0]) // block_width(first)).astype(int) % FOLDS
    for joint in np.flatnonzero(torque.any(axis=0)):
        motion = (first.position[index, joint], first.velocity[index, joint], torque[:, joint])
        y = difference[:, joint]
        all_of_it = float(np.var(y))
        left = min(float(np.mean((y - foretold_by_others(y, one, slices)) ** 2)) for one in _of_own_motion(*motion))
        followed, level = float(np.sqrt(max(all_of_it - left, 0.0))), float(np.sqrt(np.mean(torque[:, joint] ** 2)))
        if left < (1 - CHANGED_SQUARES) * all_of_it and followed > CHANGED * level:
            out[int(joint)] = (followed / level, float(np.sqrt(all_of_it)))
    return out


def _over_rows(
    one: Signals, x: Float[np.ndarray, "samples nv"], index: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows nv"]:
    """Means over the samples from each row to the next."""
    sums, step = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)]), max(one.rows.step, 1)
    low, high = np.maximum(index - step // 2, 0), np.minimum(index + step - step // 2, len(x))
    return (sums[high] - sums[low]) / (high - low)[:, None]


def _of_own_motion(
    position: Float[np.ndarray, " rows"], velocity: Float[np.ndarray, " rows"], torque: Float[np.ndarray, " rows"]
) -> list[Float[np.ndarray, "rows k"]]:
    """Functions of a joint's position, of its speed and direction, and of its torque as the load; with a constant."""
    x, load = to_unit(position), to_unit(torque)
    fastest = max(float(np.abs(velocity).max()), 1e-12)
    speed, s = to_unit(np.abs(velocity)), np.tanh(velocity / (REVERSAL * fastest))
    one, curve = np.ones_like(x), 2 * speed**2 - 1
    return [
        np.polynomial.chebyshev.chebvander(x, 6),
        np.stack([one, s, s * speed, s * curve, s * x, speed, curve], axis=1),
        np.stack([one, s, load, 2 * load**2 - 1, s * load], axis=1),
    ]


def foretold_by_others(
    y: Float[np.ndarray, " rows"], functions: Float[np.ndarray, "rows k"], slices: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, " rows"]:
    """What functions that are fitted to the other slices say of each."""
    out, ridge = np.zeros_like(y), RIDGE * len(y) * np.eye(functions.shape[1])
    for number in np.unique(slices):
        own = slices == number
        F = functions[~own]
        out[own] = functions[own] @ np.linalg.solve(F.T @ F + ridge, F.T @ y[~own])
    return out
