"""Dry friction at rest: set-valued, so that what is left of a joint's torque there need be no error of the model.

During a stick the friction takes any value up to its limit, whichever way the joint moved before, and the row filter
carries that to the rows around. A drive that pushes a joint which creeps makes that value go with the velocity, too. A
law of the velocity that the model lacks (Stribeck's) shows at the same speeds, but there the friction goes beyond what
the joint needs to slide; during a stick it stays within.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ..recordings.stacked import open_rows
from .holdout import predicted
from .problem import Problem
from .state import State
from .thresholds import CARRIED, ENOUGH_MOVING, LAW_AT_REST, LAW_WIDTHS, LEAST_MOVING, STANDSTILL
from .weights import relative_speed

__all__ = ["beyond_sliding", "held", "left_moving", "left_weighed", "only_sticks", "resting", "rms_of", "stands"]

PASSED = 1 / 8  # of the band of slow rows
TURNED = 0.1  # of the way to its limit: below, what friction a joint needs to slide is taken from the samples around


def resting(problem: Problem) -> Bool[np.ndarray, "n M nv"]:
    """Rows of each joint at rest, and those to which the row filter carries what happens there."""
    records = problem.records
    still = relative_speed(problem) < STANDSTILL
    index = records.row_samples()
    reach = CARRIED / float(records.cutoff) / float(records.dt)
    near = still.copy()
    for step in range(1, still.shape[1]):
        close = (index[:, step:] - index[:, :-step] <= reach)[..., None]
        if not close.any():
            break
        near[:, step:] |= still[:, :-step] & close
        near[:, :-step] |= still[:, step:] & close
    return near


def left_moving(problem: Problem, state: State, noise: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """RMS of what the state leaves beyond the `noise` (N m or N) of the rows in which each joint moves, relative to the
    RMS torque of the joint."""
    return _left_of(problem, state, noise, ~resting(problem))


def left_weighed(problem: Problem, state: State, noise: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """The same of the rows of each joint that have a weight: none at reversals."""
    return _left_of(problem, state, noise, np.asarray(problem.records.weight) > 0)


def _left_of(
    problem: Problem, state: State, noise: Float[np.ndarray, " nv"], rows: Bool[np.ndarray, "n M nv"]
) -> Float[np.ndarray, " nv"]:
    left, judged = problem.torque - predicted(problem, state), np.asarray(problem.records.judged) > 0
    torque = rms_of(problem.torque, judged)
    beyond = np.sqrt(np.maximum(rms_of(left, judged & rows) ** 2 - noise**2, 0.0))
    return beyond / np.maximum(torque, 1e-9 * max(float(torque.max()), 1e-300))


def only_sticks(
    problem: Problem,
    state: State,
    noise: Float[np.ndarray, " nv"],
    relative: Float[np.ndarray, " nv"],
    tolerance: float,
) -> bool:
    """Whether what the state leaves beyond the `noise` (N m or N) is no larger than tolerable where the joints move,
    and at rest within what dry friction can hold, or no law of the velocity.

    `relative` is what it leaves of all rows over each joint's torque: a joint below the tolerance is not looked at.
    """
    left, judged = problem.torque - predicted(problem, state), np.asarray(problem.records.judged) > 0
    still = resting(problem) & judged
    torque = rms_of(problem.torque, judged)
    moving = left_moving(problem, state, noise)
    looked_at = np.flatnonzero(relative > tolerance)
    if not len(looked_at) or np.any(moving[looked_at] > tolerance):
        return False
    if not np.any(stands(problem)[looked_at]):  # a robot whose joints stick does so at some joint for long
        return False
    rows = (judged & ~still).sum((0, 1))
    seen = rows >= np.minimum(LEAST_MOVING * judged.sum((0, 1)), ENOUGH_MOVING / problem.passed)
    if not np.all((seen & held(state, left, still))[looked_at]):
        return False
    beyond = np.sqrt(np.maximum(rms_of(beyond_sliding(problem, state, left), still) ** 2 - noise**2, 0.0))
    slides = [joint for joint in looked_at.tolist() if beyond[joint] > tolerance * torque[joint]]
    return not any(_law_of_velocity(problem, state, left, still, joint) for joint in slides)


def held(state: State, left: Float[np.ndarray, "n M nv"], still: Bool[np.ndarray, "n M nv"]) -> Bool[np.ndarray, " nv"]:
    """Whether what the state has `left` of each joint's rows at rest is no more than its dry friction from one limit to
    the other."""
    return rms_of(left, still) <= 2 * np.sqrt((_friction(state) ** 2).mean(0))


def stands(problem: Problem) -> Bool[np.ndarray, " nv"]:
    """Whether each joint stands still at times: it is as long at rest, within an eighth of the band of slow rows, as it
    would be on its way through if it passed without stopping.

    A joint that turns at constant acceleration is an eighth of its slow rows within an eighth of the band.
    """
    speed = relative_speed(problem)
    there = np.zeros((*speed.shape[:2], 1), bool)  # rows at which a joint stands are not judged, and count here
    for at in problem.records.spans:
        there[at.slot, at.row : at.row + at.rows] = True
    slow = ((speed < STANDSTILL) & there).sum((0, 1))
    return ((speed < STANDSTILL * PASSED) & there).sum((0, 1)) > 2 * PASSED * slow


def beyond_sliding(problem: Problem, state: State, left: Float[np.ndarray, "n M nv"]) -> Float[np.ndarray, "n M nv"]:
    """How far the friction of each row, which is that of the state and what it has `left`, lies outside the interval
    from minus to plus the friction that the state has for sliding at the row's speed, N m or N; zero inside.

    Where the state's friction turns over a width of the velocity, the limit is what it comes to beyond that width; of a
    joint that never gets there it is not known, and nothing counts as held. The
    row filter overshoots where friction turns at once, so the limit is as much larger as it makes the sign of the
    velocity at the most.
    """
    n, samples, *_ = problem.records.shape
    friction, turned = _friction(state), np.abs(np.asarray(state.motion.direction))
    limit = np.empty_like(friction)
    for joint, (own, part) in enumerate(zip(friction.T, turned.T, strict=True)):
        told = np.flatnonzero(part > TURNED)
        sliding = np.abs(own[told]) / part[told]
        limit[:, joint] = np.interp(np.arange(n * samples), told, sliding) if len(told) else 0.0
    response, sign = state.response(problem.records.omega), np.sign(np.asarray(state.motion.velocity))
    inside, edge, turns = (open_rows(problem.records, x, response) for x in (friction, limit, sign))
    over = np.maximum(np.abs(turns * problem.records.judged).max((0, 1)), 1.0)
    return np.maximum(np.abs(inside + left) - over * edge, 0.0)


def _friction(state: State) -> Float[np.ndarray, "nN nv"]:
    """What all friction of the state takes of each joint, N m or N."""
    friction = np.zeros((state.rigid.samples, state.rigid.nv))
    for share, term in zip(state.shares(state.theta), state.terms, strict=True):
        friction = friction + share * term.dissipative
    return friction


def rms_of(rows: Float[np.ndarray, "n M nv"], used: Bool[np.ndarray, "n M nv"]) -> Float[np.ndarray, " nv"]:
    """Of each joint's `used` rows, zero where there are none."""
    return np.sqrt(((rows * used) ** 2).sum((0, 1)) / np.maximum(used.sum((0, 1)), 1))


def _law_of_velocity(
    problem: Problem, state: State, left: Float[np.ndarray, "n M nv"], still: Bool[np.ndarray, "n M nv"], joint: int
) -> bool:
    """Whether more friction at low speed, of one of some widths, predicts much of a joint's rows at rest that it was
    not fitted to."""
    records, motion = problem.records, state.motion
    top = np.abs(np.asarray(motion.velocity)[:, joint]).max()
    used = still[:, :, joint]
    fold, y = problem.layout.fold.reshape(used.shape)[used], left[:, :, joint][used]
    for width in LAW_WIDTHS:
        slow = np.exp(-((np.asarray(motion.velocity) / (width * top)) ** 2)) * np.asarray(motion.direction)
        x = open_rows(records, slow, state.response(records.omega))[:, :, joint][used]
        if x @ y <= 0:  # less friction than sliding: the joint has not broken loose
            continue
        error = sum(_left_out(x, y, fold == k) for k in np.unique(fold))
        if error < (1 - LAW_AT_REST) * (y @ y):
            return True
    return False


def _left_out(x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"], out: Bool[np.ndarray, " rows"]) -> float:
    """Squares of the rows left `out`, by the amplitude of the others."""
    amplitude = (x[~out] @ y[~out]) / max(float(x[~out] @ x[~out]), 1e-300)
    return float(((y[out] - amplitude * x[out]) ** 2).sum())
