"""The gain on data that was not used for the fit, and the recordings as the report shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect
from ..recordings.signals import Signals
from ..recordings.stacked import filter_rows, open_rows
from ..results import Trace
from .comparison import left_out
from .design import kind, sensor_response
from .estimates import amplitude_places
from .problem import Problem
from .search import Found
from .shifts import torque_change
from .state import State, batched, extended_state
from .step import Step, stand
from .thresholds import LEAST_MOVING, STANDS

__all__ = [
    "Held",
    "fold_error",
    "fold_squares",
    "held_squares",
    "kept_out_error",
    "part_error",
    "predicted",
    "relative_error",
    "residual_rms",
    "traces",
    "weighted_of_errors",
    "weighted_rms",
    "weighted_squares",
    "whitened_wanted",
]

BLOCK, FEWEST, MANY = 1.0, 8, 16  # s; blocks of a recording: at least, and as many as it has independent ones
APART = 4.0  # periods of the cutoff from which blocks are taken for independent


class Held(NamedTuple):
    """What data not fitted say, block by block and joint by joint, N m or N, squared."""

    squares: Float[np.ndarray, "2 blocks nv"]  # of the error: of all rows, then of those that say how a joint moves
    wanted: Float[np.ndarray, "blocks nv"]  # error before the last cause times what it takes of it, of those rows


def held_squares(
    problem: Problem, start: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]
) -> tuple[list[Held], Float[np.ndarray, "2 nv"]]:
    """Squares of each joint's error on data not fitted, block by block, of the baseline, then after each cause; and of
    its torque. First of all rows, then of those in which the joint moves.

    Of the filtered torque (N m or N), over the holdout recordings with torque; without any, over parts of the others,
    each predicted by a fit to the rest.
    """
    out, step, before, kept = [], None, None, _kept_out(problem)
    moves = _moves(problem)
    for effect in [None, *causes]:
        grown = start if step is None or effect is None else extended_state(problem, step.state, effect)
        step = stand(problem, grown, whitening, step)
        error = kept_out_error(problem, step)
        out.append(_held(problem, error if before is None else before, error, moves))
        before = error
    rows = np.stack([np.ones(kept.shape), moves])
    return out, ((problem.torque * kept) ** 2 * rows).sum((1, 2))


def weighted_squares(problem: Problem, bare: Step, full: Step) -> tuple[Held, Held]:
    """As `held_squares` of a fit without and with a cause; the rows that say how a joint moves by their weights."""
    return weighted_of_errors(problem, kept_out_error(problem, bare), kept_out_error(problem, full))


def weighted_of_errors(
    problem: Problem, before: Float[np.ndarray, "n M nv"], after: Float[np.ndarray, "n M nv"]
) -> tuple[Held, Held]:
    """`weighted_squares` of the errors of two fits, `kept_out_error`."""
    weight = _by_speed(problem)
    return _held(problem, before, before, weight), _held(problem, before, after, weight)


def whitened_wanted(
    problem: Problem, bare: Step, full: Step, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, " blocks"]:
    """Error of recordings kept out times what a fit takes of it, in whitened rows weighed by speed, block by block.

    Noise that is slower than a block makes blocks alike; whitened, they are as many witnesses.
    """
    records = problem.records
    n, samples, _, nv = records.shape

    def rows(torque: Float[np.ndarray, "nN nv"], response: np.ndarray) -> Float[np.ndarray, "n M nv"]:
        return np.moveaxis(filter_rows(records, torque.T.reshape(nv, n, samples), response.T), 0, 2)

    measured = rows(records.flat(records.torque), whitening)
    before, after = (
        measured - rows(step.state.torque(step.state.theta), whitening * step.state.response(records.omega)[:, None])
        for step in (bare, full)
    )
    wanted, block = (before * (before - after) * _by_speed(problem) * problem.held).sum(2), _blocks(problem)
    return np.bincount(block[block >= 0], wanted[block >= 0])


def _held(
    problem: Problem,
    before: Float[np.ndarray, "n M nv"],
    error: Float[np.ndarray, "n M nv"],
    weight: Float[np.ndarray, "n M nv"],
) -> Held:
    block = _blocks(problem)
    used = block >= 0

    def of_blocks(x: Float[np.ndarray, "n M nv"]) -> Float[np.ndarray, "blocks nv"]:
        return np.stack([np.bincount(block[used], own) for own in x[used].T], axis=1)

    squares = [of_blocks(error**2), of_blocks(error**2 * weight)]
    return Held(np.stack(squares), of_blocks(before * (before - error) * weight))


def _speed(problem: Problem) -> Float[np.ndarray, "n M nv"]:
    """Speed of every joint at the rows of every recording, rad/s or m/s."""
    records = problem.records
    return np.take_along_axis(np.abs(np.asarray(records.velocity)), records.row_samples()[..., None], axis=1)


def _by_speed(problem: Problem) -> Float[np.ndarray, "n M nv"]:
    """What a square of each row weighs, as the fit weighs rows of that joint and speed (1: as fast ones)."""
    weight, fitted = np.asarray(problem.records.weight), np.asarray(problem.records.fitted)
    speed = _speed(problem)
    out = np.ones(speed.shape)
    for joint in range(speed.shape[2]):
        used = (fitted[..., joint] > 0) & (weight[..., joint] > 0)
        own = speed[..., joint][used]
        if len(own):
            order = np.argsort(own)
            share = (weight[..., joint][used] / fitted[..., joint][used])[order]
            out[..., joint] = np.interp(speed[..., joint], own[order], share) ** 2
    return out


def _moves(problem: Problem) -> Float[np.ndarray, "n M nv"]:
    """1 in the rows in which a joint moves: where it stands, dry friction holds any torque up to its limit, and what a
    model of the motion says of it is chance. 1 everywhere for a joint that hardly moves in the data not fitted."""
    top, kept = np.abs(np.asarray(problem.records.velocity)).max((0, 1)), _kept_out(problem) > 0
    moves = _speed(problem) >= STANDS * top
    seldom = (moves & kept).sum((0, 1)) < LEAST_MOVING * kept.sum((0, 1))
    return np.where(seldom, 1.0, moves)


def kept_out_error(problem: Problem, step: Step) -> Float[np.ndarray, "n M nv"]:
    """Each joint's error (N m or N) on data not fitted, zero in other rows."""
    state, part = step.state, problem.layout.part
    if problem.held.any():
        error = problem.torque - predicted(problem, state)
    else:
        error = _left_out(problem, state, _without_parts(problem, step), part)
    return error * _kept_out(problem)


def relative_error(problem: Problem, step: Step) -> float:
    """Relative RMS error (N m over N m, all joints) on data not fitted."""
    torque = problem.torque * _kept_out(problem)
    return float(np.sqrt((kept_out_error(problem, step) ** 2).sum() / max((torque**2).sum(), 1e-300)))


def _blocks(problem: Problem) -> Int[np.ndarray, "n M"]:
    """Which block of the data not fitted a row belongs to, -1 for others: of about a second, at least `FEWEST` in a
    recording, and more in a short one where the filter does not make them alike."""
    kept = np.any(_kept_out(problem) > 0, axis=2)
    block, first, rate = np.full(kept.shape, -1), 0, float(problem.records.rate)
    apart = APART * rate / float(problem.records.cutoff)
    for at in problem.records.spans:
        here = (at.slot, slice(at.row, at.row + at.rows))
        if kept[here].any():
            width = max(1.0, min(BLOCK * rate, at.rows / FEWEST, max(apart, at.rows / MANY)))
            number = (np.arange(at.rows) // width).astype(int)
            block[here] = np.where(kept[here], first + number, -1)
            first += int(number[-1]) + 1
    return block


def _kept_out(problem: Problem) -> np.ndarray:
    """The rows whose errors count: those of holdout recordings; without any, all that are judged."""
    return problem.held if problem.held.any() else np.asarray(problem.records.judged)


def predicted(problem: Problem, state: State) -> Float[np.ndarray, "n M nv"]:
    """Rows of the torque that the state predicts, as the sensors read it, in all recordings (N m or N)."""
    return open_rows(problem.records, state.torque(state.theta), state.response(problem.records.omega))


def residual_rms(problem: Problem, state: State) -> Float[np.ndarray, " nv"]:
    """RMS of what the state leaves of the fitted rows of each joint, N m or N."""
    weight = np.asarray(problem.records.judged)
    squares = ((problem.torque - predicted(problem, state)) ** 2 * weight).sum((0, 1))
    return np.sqrt(squares / np.maximum(weight.sum((0, 1)), 1))


def weighted_rms(problem: Problem, state: State) -> Float[np.ndarray, " nv"]:
    """As `residual_rms`, of the rows as they are weighted: what a row of full weight is left with."""
    records = problem.records
    error = np.asarray(records.weight) * (problem.torque - predicted(problem, state))
    return np.sqrt((error**2).sum((0, 1)) / np.maximum(records.fitted.sum((0, 1)), 1))


def traces(
    problem: Problem,
    signals: Sequence[Signals],
    first: State,
    last: State,
    causes: list[Effect],
    found: Sequence[Found],
) -> tuple[Trace, ...]:
    """Each recording's rows: measured torque, the model's before and after, the share of each cause."""
    before, after = predicted(problem, first), predicted(problem, last)
    places = amplitude_places(last, causes)
    shares, out = {}, []
    for one, effect, at in zip(found, causes, places, strict=True):
        shares[str(one.name)] = shares.get(str(one.name), 0.0) + _share(problem, last, effect, at)
    for one, at in zip(signals, problem.records.spans, strict=True):
        rows, here = one.rows.index, (at.slot, slice(at.row, at.row + at.rows))
        out.append(
            Trace(
                name=one.name,
                role=one.role,
                time=one.time[rows],
                position=one.position[rows],
                velocity=one.velocity[rows],
                measured=None if one.torque is None else problem.torque[here],
                before=before[here],
                after=after[here],
                shares={name: share[here] for name, share in shares.items()},
                counted=np.asarray(one.rows.weight) > 0,
            )
        )
    return tuple(out)


def _share(problem: Problem, state: State, effect: Effect, place: list[int]) -> Float[np.ndarray, "n M nv"]:
    """Rows of the torque that one cause brings about, the others being as they are."""
    response = state.response(problem.records.omega)
    if kind(effect) == "response":
        own = sensor_response({effect.name: batched(effect)}, problem.records.omega)[effect.name][0]
        return open_rows(problem.records, state.motion.total, response * (1 - 1 / own))
    if kind(effect) == "position":
        return open_rows(problem.records, torque_change(batched(effect), state.motion, problem.records)[0], response)
    own = np.isin(np.arange(len(state.theta)), place)
    return open_rows(problem.records, state.torque(np.where(own, state.theta, 0.0)) - state.known, response)


def fold_error(
    problem: Problem, state: State, folds: Float[np.ndarray, "folds P"], fold: Int[np.ndarray, " T"]
) -> float:
    """Relative RMS error (N m over N m, all joints) of each fold, predicted with the coefficients without it."""
    torque = problem.torque * np.asarray(problem.records.judged)
    return float(np.sqrt(fold_squares(problem, state, folds, fold).sum() / (torque**2).sum()))


def fold_squares(
    problem: Problem, state: State, folds: Float[np.ndarray, "folds P"], fold: Int[np.ndarray, " T"]
) -> Float[np.ndarray, " nv"]:
    """Squares of each joint's error ((N m)^2 or N^2), each fold predicted with the coefficients without it."""
    error = _left_out(problem, state, folds, fold) * np.asarray(problem.records.judged)
    return (error**2).sum((0, 1))


def part_error(problem: Problem, step: Step) -> float:
    """As `fold_error`, of the parts by which the gain is told where no recording is kept out."""
    return fold_error(problem, step.state, _without_parts(problem, step), problem.layout.part)


def _without_parts(problem: Problem, step: Step) -> Float[np.ndarray, "parts P"]:
    """Coefficients of a step without each part."""
    rows = step.rows._replace(fold=problem.layout.part)
    return left_out(problem.filtered.sums(rows), step.state.prior)


def _left_out(
    problem: Problem, state: State, folds: Float[np.ndarray, "folds P"], fold: Int[np.ndarray, " T"]
) -> Float[np.ndarray, "n M nv"]:
    """What the fit without each fold leaves of it. A slot's torque is computed for the folds that have rows in it."""
    response, error = state.response(problem.records.omega), problem.torque
    (n, samples, _, nv), fold = problem.records.shape, fold.reshape(error.shape[:2])
    inside = [np.unique(own[own >= 0]).tolist() for own in fold]
    for turn in range(max(map(len, inside))):
        torque, now = np.zeros((n * samples, nv)), [own[turn] if turn < len(own) else -1 for own in inside]
        for slot, k in enumerate(now):
            if k >= 0:
                here = slice(slot * samples, (slot + 1) * samples)
                torque[here] = state.torque(folds[k], here if n > 1 else slice(None))
        told = (fold >= 0) & (fold == np.array(now)[:, None])
        error = error - open_rows(problem.records, torque, response) * told[..., None]
    return error
