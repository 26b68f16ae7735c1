"""What the measuring leaves of a model that is right: steps and noise of the encoders, steps of the torque, samples
between which friction turns, a low pass that takes the corners off a motion.

None of it is noise of the torque. It is there again where a motion is repeated, it goes with the motion, and smooth
functions of the motion predict some of it; so a rest that it explains says nothing of the model. It is found by reading
the motion once more: the state's own torque along the prepared motion, both sampled, stepped and prepared as the
recordings were, against the state's torque along what comes out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..formats.recording_keys import Preprocess
from ..recordings.bandwidth import Band, encoder_step
from ..recordings.dataset import Recording
from ..recordings.resampling import read_clock
from ..recordings.signals import Signals, prepare_all
from ..recordings.stacked import stack
from .holdout import predicted
from .problem import Problem
from .standstill import held, resting, rms_of, stands
from .state import State, on_motion
from .thresholds import CARRIED, ENOUGH_MOVING, LEAST_MOVING

__all__ = ["Reader", "only_read"]

READINGS = 3  # of all recordings, each with its encoders' steps and noise drawn anew
AS_MUCH = 2.0  # times the squares that readings leave: what chance makes of a few reversals
EVERYWHERE = 1.25  # times, where readings err in nearly all rows, so that none says how the model does without
QUIET = 0.5  # of the noise: rows whose readings err by less say how the model does without that


@dataclass(frozen=True)
class Reader:
    """Recordings as they were read, in the order of the problem's, and how they were prepared."""

    recordings: Sequence[Recording]
    signals: Sequence[Signals]
    preprocess: Preprocess
    band: Band

    @property
    def rounding(self) -> Float[np.ndarray, " nv"]:
        """RMS of the error that the steps of each joint's torque make, step / sqrt(12) (N m or N); zero without."""
        torques = [r.torque for r in self.recordings if r.torque is not None and r.role == "fit"]
        steps = [[encoder_step(own) for own in torque.T] for torque in torques]
        return np.max(steps, axis=0) / np.sqrt(12.0)

    def errors(
        self, problem: Problem, state: State, generator: np.random.Generator
    ) -> Float[np.ndarray, "readings n M nv"] | None:
        """Rows that each reading of the state's own torque differs by from its prediction, N m or N.

        Dry friction that turns over a width of the velocity turns at once in what is read, and is predicted with that
        width where this predicts the readings better: samples further apart than that make such a width of it, finer
        ones do not. None for a robot with quaternions, and where the readings' rows would be others.
        """
        if problem.model.nq != problem.model.nv:
            return None
        sharp = problem.with_width(np.zeros_like(problem.width)) if np.any(problem.width) else problem
        true = on_motion(sharp, state) if sharp is not problem else state
        torque = true.torque(true.theta).reshape(*problem.records.velocity.shape)
        wide, out = [], []
        for _ in range(READINGS):
            read = [
                _read(recording, signals, torque[at.slot, at.sample : at.sample + at.samples], generator)
                for recording, signals, at in zip(self.recordings, self.signals, problem.records.spans, strict=True)
            ]
            records = stack(prepare_all(read, self.preprocess, band=self.band), problem.model, joined=True)
            if records.spans != problem.records.spans:
                return None
            records = eqx.tree_at(
                lambda r: (r.weight, r.judged), records, (problem.records.weight, problem.records.judged)
            )
            again = Problem(problem.backend, records, problem.layout, problem.trust, sharp.width, problem.held)
            out.append(again.torque - predicted(again, on_motion(again, state)))
            if sharp is not problem:
                again = again.with_width(problem.width)
                wide.append(again.torque - predicted(again, on_motion(again, state)))
        if not wide:
            return np.stack(out)
        judged = np.asarray(problem.records.judged) > 0
        turned, widened = (rms_of(np.sqrt((np.stack(x) ** 2).mean(0)), judged) for x in (out, wide))
        return np.where(widened < turned, np.stack(wide), np.stack(out))


def only_read(
    problem: Problem,
    state: State,
    noise: Float[np.ndarray, " nv"],
    relative: Float[np.ndarray, " nv"],
    tolerance: float,
    errors: Float[np.ndarray, "readings n M nv"] | None,
    rounding: Float[np.ndarray, " nv"],
) -> bool:
    """Whether what the state leaves beyond the `noise` (N m or N) is no more than readings of a right model leave, and
    no larger than tolerable in the rows where readings leave little, if there are such rows; or is what they leave, row
    by row, but for what is tolerable; or no more than the `rounding` of the torque (RMS, N m or N), which repeats with
    a motion and is asked alone where there are no `errors`.

    `relative` is what it leaves of all rows over each joint's torque: a joint below the tolerance is not looked at. Of
    a joint that stands still at times the rows at rest only have to stay within what its dry friction can hold.
    """
    judged = np.asarray(problem.records.judged) > 0
    left, torque = problem.torque - predicted(problem, state), rms_of(problem.torque, judged)
    large, rounded = relative > tolerance, rms_of(left, judged) ** 2 - noise**2 <= rounding**2
    if errors is None:
        return bool(large.any() and rounded[large].all())
    still = judged & resting(problem) & stands(problem)
    used, squares = judged & ~still, (errors**2).mean(0)
    reach = int(np.ceil(CARRIED / float(problem.records.cutoff) * float(problem.records.rate)))
    spread = np.stack([_largest_near(one, reach) for one in np.moveaxis(squares, 2, 0)], axis=2)
    quiet = used & (spread < (QUIET * noise) ** 2)
    beyond, rest = (rms_of(left, rows) ** 2 - noise**2 for rows in (used, quiet))
    enough = np.minimum(LEAST_MOVING * judged.sum((0, 1)), ENOUGH_MOVING / problem.passed)
    explained, without = rms_of(np.sqrt(squares), used) ** 2, quiet.sum((0, 1)) >= enough
    told = without & (beyond <= AS_MUCH * explained) & (rest <= (tolerance * torque) ** 2)
    told |= ~without & (beyond <= EVERYWHERE * explained)
    told |= rms_of(left - errors.mean(0), used) ** 2 - noise**2 <= (tolerance * torque) ** 2
    told &= held(state, left, still)
    return bool(large.any() and (told | rounded)[large].all())


def _read(
    recording: Recording, signals: Signals, torque: Float[np.ndarray, "samples nv"], generator: np.random.Generator
) -> Recording:
    """The recording with the prepared motion, read by its encoders once more, and a torque along it."""
    from scipy.interpolate import CubicSpline  # scipy is slow to import

    at = np.clip(read_clock(recording.time, recording.position), signals.time[0], signals.time[-1])
    true, read = CubicSpline(signals.time, signals.position)(at), np.array(recording.position)
    for joint, own in enumerate(true.T):
        step, place = encoder_step(read[:, joint]), generator.random()
        error, sigma = read[:, joint] - own, 0.0
        if len(own) > 2:  # white: what the neighbours do not tell
            sigma = float(np.median(np.abs(error[2:] - 2 * error[1:-1] + error[:-2]))) / 0.6745 / 6**0.5
        drawn = own + generator.standard_normal(len(own)) * sigma * (sigma > step)
        read[:, joint] = step * (np.round(drawn / step + place) - place) if step else drawn
    given = np.stack([_at(at, signals.time, *columns) for columns in zip(torque.T, signals.velocity.T, strict=True)], 1)
    return replace(recording, position=read, torque=None if recording.torque is None else given, trusted=None)


def _at(
    at: Float[np.ndarray, " samples"],
    time: Float[np.ndarray, " n"],
    torque: Float[np.ndarray, " n"],
    velocity: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " samples"]:
    """The torque at some instants; it jumps where the velocity changes its sign."""
    out, after = np.interp(at, time, torque), np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    v, w = velocity[after - 1], velocity[after]
    turns = v * w < 0
    gone = (at - time[after - 1]) / (time[after] - time[after - 1]) > v / np.where(turns, v - w, 1.0)
    return np.where(turns, np.where(gone, torque[after], torque[after - 1]), out)


def _largest_near(rows: Float[np.ndarray, "n M"], reach: int) -> Float[np.ndarray, "n M"]:
    padded = np.pad(rows, ((0, 0), (reach, reach)))
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1).max(-1)
