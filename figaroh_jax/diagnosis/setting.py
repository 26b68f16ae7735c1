"""What a diagnosis knows before it looks for any cause: recordings, baseline, the noise and what makes it white."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..estimation.noise import Spectrum
from ..recordings.bandwidth import Band
from ..recordings.dataset import Recording
from ..recordings.signals import Resampled, Signals, as_slow_as_torque, joint_by_joint, prepare_all
from ..recordings.stacked import stack
from ..simulators.contract import Backend
from .flexible import friction_width
from .floor import noise_floor, noise_rms, whitening_of
from .holdout import fold_squares, residual_rms
from .joint import Joint
from .layout import held_rows, layout
from .problem import Problem
from .repeats import checked_repeats
from .state import State, baseline, stated_effects, with_width
from .step import Step, stand, with_causes
from .thresholds import MOST_OF_RESIDUAL, OF_ANOTHER_WIDTH, PASSED_FOR_NOISE, WEIGHT_ROUNDS
from .weights import weighted_by_speed, white_where_better, without_held, without_reversals

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess

__all__ = ["Setting", "begun_with", "prepared_signals", "setting_beside", "setting_of", "weighed_by_residual"]


class Setting(NamedTuple):
    """What is known before any cause is looked for: data, baseline, noise and what makes it white."""

    problem: Problem
    start: State
    spectrum: Spectrum
    whitening: Float[np.ndarray, "F nv"]
    white: bool  # whether the rows are weighted by their joint's residual, not by the noise's spectrum


class _Read(NamedTuple):
    """The recordings as they are prepared with one `band` of positions, and what the baseline then leaves."""

    signals: list[Signals]  # holdout recordings behind the others
    band: Band  # as for `prepare_all`
    begun: tuple[Problem, State]
    squares: Float[np.ndarray, " nv"]

    def moves_as(self, signals: Sequence[Signals]) -> bool:
        """Whether its positions are those of other signals."""
        return all(np.array_equal(a.position, b.position) for a, b in zip(self.signals, signals, strict=True))


def prepared_signals(
    backend: Backend, recordings: Sequence[Recording], preprocess: Preprocess, known: Baseline | None, trust: float
) -> tuple[list[Signals], Band, tuple[Problem, State]]:
    """The recordings prepared, holdout recordings behind the others, the `band` of their positions, the baseline.

    Each position is taken down to the band of its own motion only where the baseline then predicts left-out parts
    better: coarse encoders need it, and it takes the abrupt parts of a fine one away. Every joint counts alike, by the
    ratio of its errors, so that one with a cause in it does not decide for all.

    Where that does no harm, all are taken down further for as long as the torque follows better (`as_slow_as_torque`).
    Where it does, each joint is asked alone (`joint_by_joint`).
    """
    resampled: Resampled = {}

    def read(band: Band, like: _Read | None = None) -> _Read:
        sticks = known is None or known.coulomb
        prepared = prepare_all(recordings, preprocess, band=band, resampled=resampled, sticks=sticks)
        signals = sorted(checked_repeats(prepared, backend.robot.dof_names), key=lambda s: s.role == "holdout")
        if like and like.moves_as(signals):
            return like
        begun = begun_with(backend, signals, known, trust)
        return _Read(signals, band, begun, _baseline_squares(*begun))

    plain = read(None)
    own = read(math.inf, like=plain)
    better = own is plain or np.mean(np.log(own.squares / plain.squares)) < 0
    best = as_slow_as_torque(own, read) if better else joint_by_joint(plain, own, read)
    return best.signals, best.band, best.begun


def _baseline_squares(problem: Problem, start: State) -> Float[np.ndarray, " nv"]:
    """Squares of each joint's error on parts left out of the baseline's fit, in which a joint weighs by what it leaves.

    None is less than 1e-12 of their sum: a joint without error decides nothing.
    """
    step, _ = weighed_by_residual(problem, start)
    squares = fold_squares(problem, step.state, step.verdicts.folds, problem.layout.fold)
    return np.maximum(squares, max(1e-12 * squares.sum(), 1e-300))


def weighed_by_residual(problem: Problem, start: State) -> tuple[Step, Float[np.ndarray, "F nv"]]:
    """The baseline of rows that are weighed by what it leaves of their joint, and that weight."""
    torque = np.sqrt(((problem.torque * problem.records.judged) ** 2).mean((0, 1)))
    white = np.ones((len(problem.records.omega), 1)) / np.maximum(torque, 1e-9 * torque.max())
    residual = residual_rms(problem, stand(problem, start, white).state)
    white = white * torque / np.maximum(residual, 1e-9 * residual.max())
    return stand(problem, start, white), white


def begun_with(
    backend: Backend, signals: Sequence[Signals], known: Baseline | None, trust: float
) -> tuple[Problem, State]:
    """The recordings on one clock, and the baseline."""
    records = stack(signals, backend.robot, joined=True)
    records = without_reversals(eqx.tree_at(lambda r: r.weight, records, records.weight + records.standing))
    held = held_rows(signals, records)
    names, width = tuple(one.name for one in signals), np.zeros(backend.robot.nv)
    problem = Problem(backend, records, layout(signals, records), trust, width, held, names)
    return problem, baseline(problem, *stated_effects(backend.robot, known))


def setting_of(
    problem: Problem, start: State, forbid: Sequence[str], progress: Callable[[str, float], None]
) -> Setting:
    """The recordings on one clock, the baseline, and the noise; holdout recordings stand behind the others."""
    progress("estimating the noise", 0.08)
    problem = without_held(problem, start)
    spectrum, whitening = noise_floor(problem, start, forbid)
    problem = friction_width(problem, start, whitening)
    start = with_width(problem, start)
    for _ in range(WEIGHT_ROUNDS):
        weighted = weighted_by_speed(problem, start, whitening)
        if weighted is problem:
            break
        problem = weighted
        spectrum, whitening = noise_floor(problem, start, forbid)
    whitening, white = white_where_better(problem, start, whitening)
    return Setting(problem.within_trust(), start, spectrum, whitening, white)


def setting_beside(here: Setting, joint: Joint, forbid: Sequence[str]) -> Setting | None:
    """The setting with new noise, weights and width of friction at the joints where a cause has passed for noise, or
    for such a width; None without any.

    What no group of the rich model follows, as a ripple of many periods, counts as noise until it is known (not where
    repeats tell the noise), weights by the baseline's residual hold every cause, and a wide reversal of the friction
    makes up for some of it. What that reversal then lacks where the joint creeps may have been told as a law of the
    speed: it goes where another width in its place leaves no more. The rows of such a joint say too little of what it
    shares with the others: links and laws of the whole robot follow these alone.

    `joint` is the fit of all that was found. The other joints keep what they have, so that what is told of them does
    not hang on a cause elsewhere.
    """
    problem, first, state = here.problem, stand(here.problem, here.start, here.whitening), joint.step.state
    before, residual = residual_rms(problem, first.state), residual_rms(problem, state)
    most = residual < MOST_OF_RESIDUAL * before
    if not most.any():
        return None
    turned, problem = _turned_elsewhere(problem, state, here.whitening, OF_ANOTHER_WIDTH * residual, most)
    if laws := [one for one in joint.causes if one.speed_law and most[int(one.at[0])] and not turned[int(one.at[0])]]:
        others = [one for one in joint.causes if not any(one is law for law in laws)]
        at = np.isin(np.arange(len(most)), [int(one.at[0]) for one in laws])
        bare = with_causes(problem, with_width(problem, here.start), others, here.whitening).state
        instead, problem = _turned_elsewhere(problem, bare, here.whitening, residual, at)
        turned, state = turned | instead, bare if instead.any() else state
    state = with_width(problem, state)
    spectrum, _ = noise_floor(problem, state, forbid)
    passed = most & (noise_rms(problem, spectrum) < PASSED_FOR_NOISE * noise_rms(problem, here.spectrum))
    if here.white and not problem.layout.repeats:
        passed = most
    passed |= turned
    if not passed.any():
        return None
    spectrum = here.spectrum._replace(
        coefficients=np.where(passed, spectrum.coefficients, here.spectrum.coefficients),
        covariance=np.where(passed[:, None, None], spectrum.covariance, here.spectrum.covariance),
    )
    own = 1 / np.maximum(residual, 1e-12 * residual.max()) if here.white else whitening_of(problem, spectrum)
    whitening = np.where(passed, own, here.whitening)
    even = problem.weighted(problem.records.fitted)
    weight = np.where(passed, weighted_by_speed(even, state, whitening).records.weight, problem.records.weight)
    start = with_width(problem, here.start)
    return here._replace(problem=problem.weighted(weight), start=start, spectrum=spectrum, whitening=whitening)


def _turned_elsewhere(
    problem: Problem,
    state: State,
    whitening: Float[np.ndarray, "F nv"],
    most: Float[np.ndarray, " nv"],
    joints: Bool[np.ndarray, " nv"],
) -> tuple[Bool[np.ndarray, " nv"], Problem]:
    """The joints whose friction reverses over another width beside what the state holds, and the problem with it.

    `most` is what the state may then leave (RMS, N m or N).
    """
    other = friction_width(problem, state, whitening, np.flatnonzero(joints).tolist())
    if other is problem:
        return np.zeros_like(joints), problem
    now = residual_rms(other, stand(other, with_width(other, state), whitening).state)
    turned = (other.width != problem.width) & (now < most)
    return turned, problem.with_width(np.where(turned, other.width, problem.width)) if turned.any() else problem
