"""Whether a torque has another constant in each recording: a sensor that was zeroed anew, another preload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import fdtrc

from ..effects.base import joint_unit
from ..effects.catalogue import related
from ..recordings.signals import Signals
from ..results import Cause, Diagnosis, Estimate, Gain, Name, Verdict
from ..rigid.model import prismatic
from .constancy import fitted_recordings, shown_of_many
from .flexible import dependences
from .holdout import kept_out_error, predicted
from .layout import QUARTERS
from .problem import Problem
from .rest import rows_at
from .setting import weighed_by_residual
from .state import State
from .step import Step

__all__ = ["EFFECT", "Zeros", "as_causes", "gain_of", "shifted", "unexplained", "zeros_that_differ"]

SURE_P = 1e-4  # chance that constants of quarters of the recordings differ as much as those of the recordings do
APART = 25.0  # their squares over those that the quarters foretell: noise as slow as a recording made 10 at most
FAR_APART = 100.0  # times, for a name: a tool or friction that only some have made 94 at most, of a fifth of the torque
RIDGE = 1e-9  # of the diagonal: columns that no row shows, or that are the same
EFFECT = "torque_offset"


class Zeros(NamedTuple):
    """Constants of a joint's torque that are not the same in all recordings that are fitted."""

    joint: int
    recordings: tuple[int, ...]
    value: Float[np.ndarray, " recordings"]  # what each has more than the mean of all rows, N m or N
    deviation: Float[np.ndarray, " recordings"]  # standard deviation, N m or N
    others: Float[np.ndarray, "recordings quarters"]  # `value` as all but one quarter of a recording tell it
    unit: str
    ratio: float  # their squares over those that the scatter of quarters foretells
    p_value: float

    @property
    def certain(self) -> bool:
        """Whether what follows the motion seldom makes them as sure."""
        return self.ratio > FAR_APART

    @property
    def spread(self) -> Estimate:
        """RMS over the recordings, N m or N, without what chance adds to it."""
        squares = float(np.mean(self.value**2))
        size = float(np.sqrt(max(squares - np.mean(self.deviation**2), 0.0)))
        chance = float(np.sqrt(np.sum((self.value * self.deviation) ** 2) / squares)) / len(self.value)
        return Estimate(size, chance, self.unit)


def zeros_that_differ(problem: Problem, start: State, tolerance: float) -> tuple[Zeros, ...]:
    """The joints of whose torque some recordings surely have another constant than others, by more than `tolerance`.

    That is a share of the joint's RMS torque. The constants are those of a fit, joint by joint, of the baseline beside
    smooth functions of the joint's own position, velocity and load: what makes another torque in another posture is
    none of theirs. Noise that is as slow as a recording is long differs between its quarters as well.
    """
    recordings = list(fitted_recordings(problem, problem.layout.block))
    if len(recordings) < 2:
        return ()
    size = np.sqrt(np.mean(problem.torque**2, axis=(0, 1)))
    step, white = weighed_by_residual(problem, start)
    out, numbers, slides = [], tuple(number for number, _ in recordings), prismatic(problem.model)
    for joint in np.flatnonzero(size > 0).tolist():
        there = [used & (step.rows.y[joint] != 0) for _, used in recordings]
        count = np.array([used.sum() for used in there])
        if count.min() <= QUARTERS:
            continue
        value, deviation, others = _constants(problem, step, white, joint, there)
        squares, foretold = (float(count @ x**2) for x in (value, deviation))
        ratio = squares / max(foretold, 1e-300)
        chance = len(size) * float(fdtrc(len(count) - 1, (QUARTERS - 1) * len(count), ratio))
        if ratio > APART and chance < SURE_P and np.sqrt(squares / count.sum()) > tolerance * size[joint]:
            unit = joint_unit("N m", slides[joint])
            out.append(Zeros(joint, numbers, value, deviation, others, unit, ratio, chance))
    return tuple(out)


def _constants(
    problem: Problem, step: Step, white: Float[np.ndarray, "F nv"], joint: int, there: Sequence[Bool[np.ndarray, " T"]]
) -> tuple[Float[np.ndarray, " fitted"], Float[np.ndarray, " fitted"], Float[np.ndarray, "fitted quarters"]]:
    """What each recording's constant has over the mean of all rows, its standard deviation, and what it has as all but
    one of its quarters tell it; N m or N.

    Deviations are those of the scores of quarters, right for residuals that are as slow.
    """
    rows, motion = step.rows, step.state.motion
    given, ones = dependences(motion, joint), np.ones((1, len(motion.time)))
    own = np.concatenate([given["position"], given["velocity"], given["load"], ones])
    *smooth, one = rows_at(problem, step.state, own, white, joint)
    Z = np.concatenate([np.stack(smooth), [one * at for at in there]]) * np.any(there, axis=0)
    X = rows.X.dense(0)[joint]
    among = rows.X.squares() + np.diag(step.state.prior.precision)
    H = np.block([[among, X.T @ Z.T], [Z @ X, Z @ Z.T]])
    inverse = np.linalg.inv(H + RIDGE * np.diag(np.maximum(np.diag(H), RIDGE)))
    e, first = step.linear.residual, len(H) - len(there)
    value = inverse @ np.concatenate([rows.X.pulled(e) - step.linear.pull, Z @ e[joint]])
    left = e[joint] - X @ value[: len(among)] - value[len(among) :] @ Z
    parts = [part for at in there for part in np.array_split(np.flatnonzero(at), QUARTERS)]
    scores = [np.concatenate([X[part].T @ left[part], Z[:, part] @ left[part]]) for part in parts]
    mean = np.eye(len(there)) - np.array([at.sum() for at in there]) / np.sum(there)
    constant, moved = mean @ value[first:], mean @ (inverse @ np.stack(scores, axis=1))[first:]
    deviation = np.sqrt((moved**2).sum(1) * QUARTERS / (QUARTERS - 1))
    # a constant from three quarters: the mean of all four, less what the fourth has over it
    over = np.array([left[part] @ one[part] / max(one[part] @ one[part], 1e-300) for part in parts])
    return constant, deviation, constant[:, None] - over.reshape(len(there), QUARTERS) / (QUARTERS - 1)


def gain_of(problem: Problem, step: Step, zeros: Sequence[Zeros]) -> Gain:
    """Error of all joints, of recordings that were `shifted`, as they were and with the constants of each recording,
    told by its other quarters. It is that on data not fitted; where recordings are kept out, of which no constant is
    known, that of the others."""
    state, kept = step.state, problem.records.judged
    error = (problem.torque - predicted(problem, state)) * kept if problem.held.any() else kept_out_error(problem, step)
    before, after, whole = error.copy(), error.copy(), float(((problem.torque * kept) ** 2).sum())
    kept = np.asarray(kept)
    for one in zeros:
        for number, value, others in zip(one.recordings, one.value, one.others, strict=True):
            at = problem.records.spans[number]
            parts = np.array_split(np.arange(at.row, at.row + at.rows), QUARTERS)
            for part, foretold in zip(parts, others, strict=True):
                used = kept[at.slot, part, one.joint]
                before[at.slot, part, one.joint] += value * used
                after[at.slot, part, one.joint] += (value - foretold) * used
    first, last = (float(np.sqrt((x**2).sum() / max(whole, 1e-300))) for x in (before, after))
    return Gain(first, last)


def shifted(signals: Sequence[Signals], zeros: Sequence[Zeros]) -> list[Signals]:
    """The recordings, of the torques with the constant that is the mean of all."""
    out = list(signals)
    for one in zeros:
        for number, value in zip(one.recordings, one.value, strict=True):
            torque: Any = np.array(out[number].torque)
            torque[:, one.joint] -= value
            out[number] = replace(out[number], torque=torque)
    return out


def told(one: Zeros, joints: Sequence[str], names: Sequence[str]) -> str:
    """What recordings have, in words."""
    return f"the torque of {joints[one.joint]} does not have one constant in all recordings: {_each(one, names)}"


def _each(one: Zeros, names: Sequence[str]) -> str:
    """What each recording has beside the mean, in words; of many, those at the ends."""
    each = ", ".join(
        f"{one.value[k]:+.3g} +- {1.96 * one.deviation[k]:.2g} {one.unit} in {names[one.recordings[k]]}"
        for k in shown_of_many(one.value)
    )
    return f"beside the mean {each}"


def as_causes(
    answer: Diagnosis,
    zeros: Sequence[Zeros],
    gains: Sequence[Gain],
    joints: Sequence[str],
    names: Sequence[str],
    forbid: Sequence[str] = (),
) -> Diagnosis:
    """The answer to recordings that were `shifted`, with the constants as causes; `forbid` names what may not be said
    to be alike."""
    causes = list(answer.causes)
    for one, gain in zip(zeros, gains, strict=True):
        name = Name(EFFECT, (joints[one.joint],))
        alike = tuple(
            Name(other, name.at) for other in related(EFFECT, "indistinguishable_from") if other not in forbid
        )
        same = next((c for c in causes if c.name == name or (c.name in alike and name in c.ambiguous_with)), None)
        note = f"the extended model has the mean of all recordings; {_each(one, names)}"
        if same:  # the mean has a name, that of the model's effect; what looks like the mean alone is no rival
            numbers, others = {**same.parameters, "spread": one.spread}, [n for n in (name, *alike) if n != same.name]
            cause = replace(same, parameters=numbers, gain=gain, ambiguous_with=tuple(others), note=note)
        else:
            cause = Cause(name, {"spread": one.spread}, 1 - one.p_value, gain, alike, len(causes) + 1, note)
        causes = [c for c in causes if c is not same] + [cause]
    verdict: Verdict = "named" if answer.verdict == "nothing" else answer.verdict
    verdict = "named+rest" if verdict == "unknown" else verdict
    causes.sort(key=lambda c: c.gain.after**2 - c.gain.before**2)
    notes = (*answer.notes, *(told(one, joints, names) for one in zeros))
    p_value = min(answer.p_value, *(one.p_value for one in zeros))
    return replace(answer, verdict=verdict, causes=tuple(causes), p_value=p_value, notes=notes)


def unexplained(answer: Diagnosis, zeros: Sequence[Zeros], joints: Sequence[str], names: Sequence[str]) -> Diagnosis:
    """The answer to recordings as they are, with what their constants say: they are noise of none of them."""
    if not zeros:
        return answer
    notes = [told(one, joints, names) for one in zeros]
    beside: dict[Verdict, Verdict] = {"nothing": "unknown", "named": "named+rest"}
    if answer.verdict in beside:
        rest = replace(answer.rest, text=notes[0], tolerated="", undecided="")
        answer = replace(answer, verdict=beside[answer.verdict], rest=rest)
    return replace(answer, notes=(*answer.notes, *notes))
