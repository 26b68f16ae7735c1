"""All causes in one fit: as predicts best what it was not fitted to, and how sure its values are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .gaining import kept_squares, surely_less
from .holdout import part_error, residual_rms, weighted_rms
from .joint import Joint, polished, with_misfit, with_parts
from .problem import Problem
from .search import Found
from .setting import Setting
from .standstill import resting
from .step import stand
from .thresholds import FEWER, STANDSTILL, WHITE_GAIN
from .weights import relative_speed

__all__ = ["as_moves", "as_predicts_best", "as_weighed_in_motion", "as_weighed_otherwise", "together"]


def together(here: Setting, found: list[Found]) -> Joint:
    """The causes in one fit."""
    return polished(here.problem, here.start, [one.effect for one in found], here.whitening)


def as_moves(here: Setting) -> Joint:
    """The model without any cause, fitted to the rows in which each joint moves.

    Rows at rest say of its friction no more than that it is at least as much: beside many of them the friction that
    slides is told too small.
    """
    moving = np.asarray(here.problem.records.judged) * ~resting(here.problem)
    level = np.ones_like(here.whitening) / np.maximum(residual_rms(here.problem, here.start), 1e-300)
    return together(here._replace(problem=here.problem.weighted(moving), whitening=level, white=True), [])


def as_predicts_best(
    settings: Sequence[Setting], named: list[Found], known: Joint | None
) -> tuple[Setting, Joint, Joint]:
    """The named causes in one fit as predicts parts left out best, by their error in N m; and as the first setting has
    them.

    Weights by speed find causes and name them; the model that is handed over is also asked to predict slow rows, and
    the width of friction beside all causes need not be that beside the named ones. Where the noise is far below what
    the model leaves, its spectrum is a poor weight: each joint's residual alone may do better. Another fit than that
    which parts prefer is taken where recordings kept out surely prefer it. `known` is the fit of the first setting with
    its own weights, where it has been made.
    """
    best, first, kept = None, None, []  # one fit at a time: rows and columns are large
    held = bool(settings[0].problem.held.any())
    for here in settings:
        for weight in _weights(here.problem):
            one = here._replace(problem=here.problem.weighted(weight))
            joint = known if known and first is None else together(one, named)
            error, first = part_error(one.problem, joint.step), first or joint
            if held:
                kept.append((one, kept_squares(one.problem, joint.step)))
            best = (error, one, joint) if best is None or error < best[0] else best
    assert best is not None and first is not None
    error, chosen, joint = best
    if not chosen.white:
        residual = weighted_rms(chosen.problem, joint.step.state)
        level = np.broadcast_to(1 / np.maximum(residual, 1e-12 * residual.max()), chosen.whitening.shape)
        white = chosen._replace(whitening=level, white=True)
        step = stand(white.problem, joint.step.state, level)  # the laws' shapes as they are
        if part_error(white.problem, step) < (1 - WHITE_GAIN) * error:
            chosen, joint = white, together(white, named)
    squares = kept_squares(chosen.problem, joint.step) if held else np.zeros(0)
    for one, own in kept:
        if surely_less(squares, own):
            chosen, joint, squares = one, together(one, named), own
    return *_as_rows_count(chosen, joint, named), first


def _as_rows_count(here: Setting, joint: Joint, named: list[Found]) -> tuple[Setting, Joint]:
    """The fit in which rows count beside what is believed of the links as parts left out ask for.

    Whitened rows count as independent ones. What a model leaves goes on from one to the next, so that many say what one
    does, and the links follow it further than they are believed to move. Recordings kept out have the last word.
    """
    error, best = part_error(here.problem, joint.step), here
    for times in FEWER:
        one = here._replace(whitening=here.whitening / np.sqrt(times))
        step = stand(one.problem, joint.step.state, one.whitening)  # the laws' shapes as they are
        own = part_error(one.problem, step)
        if own >= error:
            break
        error, best = own, one
    if best is here:
        return here, joint
    other = together(best, named)
    if here.problem.held.any():
        fewer, all_of = (kept_squares(one.problem, fit.step) for one, fit in ((best, other), (here, joint)))
        if surely_less(fewer, all_of):
            return here, joint
    return best, other


def _weights(problem: Problem) -> list[Float[np.ndarray, "n M nv"]]:
    """Weights of the rows by their speed, and all alike."""
    by_speed, alike = np.asarray(problem.records.weight), np.asarray(problem.records.judged)
    return [by_speed] if np.array_equal(by_speed, alike) else [by_speed, alike]


def as_weighed_otherwise(here: Setting, by_speed: Problem, joint: Joint) -> Joint:
    """The answer's fit with what its intervals owe to its parts, to weights of slow rows and to the spectrum."""
    problem, judged = here.problem, np.asarray(here.problem.records.judged)
    slow = [judged, np.asarray(by_speed.records.weight), judged * (relative_speed(problem) >= STANDSTILL)]
    white = np.ones_like(here.whitening) / np.maximum(weighted_rms(problem, joint.step.state), 1e-300)
    own = np.asarray(problem.records.weight)
    weights = [(w, here.whitening) for w in slow if not np.array_equal(w, own)]
    joint = with_parts(problem, joint, here.whitening)
    return with_misfit(problem, here.start, joint, [*weights, (own, white)])


def as_weighed_in_motion(here: Setting, by_speed: Joint) -> Joint:
    """The fit by whose weights causes are found, with what its intervals owe to its parts, to slow rows and to the
    spectrum.

    Whether a cause has a size is asked of this one: a fit that is asked for rows at rest, where no law of the velocity
    holds, gives part of a law of the motion away, and which fit predicts best changes from one recording to the next.
    """
    problem = here.problem
    white = np.ones_like(here.whitening) / np.maximum(weighted_rms(problem, by_speed.step.state), 1e-300)
    own = np.asarray(problem.records.weight)
    moving = own * (relative_speed(problem) >= STANDSTILL)
    joint = with_parts(problem, by_speed, here.whitening)
    return with_misfit(problem, here.start, joint, [(moving, here.whitening), (own, white)])
