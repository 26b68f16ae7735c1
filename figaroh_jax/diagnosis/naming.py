"""Which of the causes that a search has put in are named where a rest stays, and why the others are not.

Beside a rest the best of the catalogue is often a stand-in for something else. A right law differs from a stand-in in
that it takes much of what its own joints leave on held-out data, surely, and with one amplitude: one that would rather
vary with position, speed, load or time stands for another law.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..effects.catalogue import find
from ..effects.registry import related
from ..effects.sensors import TorqueOffset
from ..estimation.joint_rows import JointRows
from ..estimation.rows import Prior
from ..recordings.stacked import filter_rows, filtered_rows, open_rows
from ..results import Name
from .comparison import Ground, Hypothesis, Verdicts, fold_sums, ground, judge, judge_grown, t_needed, t_value
from .design import fitted_fields, kind, sensor_response
from .estimates import Fitted, amplitude_places, torque_slope
from .flexible import smooth_functions, to_unit
from .gates import physical_sign
from .holdout import residual_rms
from .joint import Joint
from .problem import Problem
from .search import Found, judged_without, stood_without
from .shifts import torque_change
from .stand_ins import like_roughness, outdone_beside
from .standstill import resting
from .state import State, batched
from .step import Step, stand
from .thresholds import (
    ALL_BUT,
    BESIDE_SMOOTH,
    BUYS,
    BY_PLACE,
    COUPLED,
    FEWEST_ALIKE,
    GAIN_NAMED,
    GAIN_NAMED_ROBOT,
    LAW_LEAVES,
    LIKELY,
    MARGIN,
    MASS,
    MODULATION,
    MODULATION_HELD_OUT,
    MODULATION_ROBOT,
    OWN_SHARE,
    SHARE_NAMED,
    STANDS_OUT,
    T_NAMED,
    TURNED_DOWN,
    WEIGHTLESS,
)

__all__ = [
    "LIKE_A_REST",
    "ONE_PART",
    "Standing",
    "behind_joints",
    "beside_rest",
    "beyond_simpler",
    "cause_torque",
    "elsewhere_too",
    "lone_part",
    "of_its_own",
    "reason_against",
    "standings",
    "stands_alone",
    "stands_out",
    "strong",
]


EVERYWHERE = ("gravity_tilt", "external_wrench")  # laws that act at all joints, at all times


@dataclass(frozen=True)
class Standing:
    """What the data say of one cause with all others in, on held-out squares of the joints where it acts."""

    name: Name
    whole: bool  # whether it acts on the whole robot, or through a link on many joints
    physical: bool  # whether its sign is one that exists
    gain: float
    t: float
    t_needed: float  # by the number of blocks
    share: float  # RMS torque over that of the joint, where it is largest
    acting: float = 0.0  # the same while it acts, of an effect that acts for moments
    static: bool = False  # whether it may be a torque that depends on the posture alone, at a joint or at all of them
    modulation: float = 0.0  # squares that an amplitude which varies gains, over those of the cause
    modulation_held_out: float = 0.0
    varies: bool = False  # whether left-out squares surely fall by it
    beside_smooth: float = 1.0  # gain of a cause of the whole robot beside smooth functions, or in their place
    one_part: bool = False  # a coupling of which no more than one part is surely there
    massless: bool = False  # a body whose mass is not surely there
    beside_rest: bool = True  # whether its law can be told from a rest (`Effect.beside_rest`)
    cancels: bool = False  # whether it is a share of all torque, and larger than it: a reading of less than half
    complete: bool = False  # whether smooth functions find next to nothing in what it leaves at its joints
    spoils: bool = False  # whether, of the whole robot, it surely predicts some joint worse
    outdone: bool = False  # whether what could be named in its place surely predicts better
    rough: bool = False  # whether a position that is only rough explains nearly as much
    shown: bool = True  # whether the motion tells it, as fitted, from any smooth law (`Effect.shown_by`)
    taken: float = 0.0  # held-out squares of its joints that it removes
    leaves: float = 0.0  # squares beyond noise at its joints over these
    followed: float = 0.0  # squares that smooth functions surely find in what it leaves at its joints, over these
    unmoved: bool = True  # whether no misfit of joints that move but its own is likely
    by_place: float = 0.0  # squares that a table of its joint's position surely takes of what it leaves, over these
    everywhere: bool = False  # whether a law that acts at all joints at all times may stand in its place
    alone: bool = True  # whether its joints are likely to have no other misfit (`stands_alone`)
    contested: bool = False  # whether another law of the whole robot, one that cannot be, surely takes much beside it


LIKE_A_REST = "the unexplained residual may imitate it: it is named only where nothing else is left"
ONE_PART = "of its inertia, damping and friction no more than one is surely there, as where it stands for another law"
_VARIES = "its amplitude varies with position, speed, load or time (that would add"


def reason_against(
    one: Standing,
    rest: bool,
    tolerance: float,
    certain: Callable[[Name], bool] = lambda name: False,
    fading: Collection[Name] = (),
    *,
    kept_out: Callable[[Name], float] = lambda name: 0.0,
    elsewhere: bool = False,
) -> str:
    """Why the cause is not named, in words with the number that failed; empty where it is.

    Beside a `rest` it must explain much of its joints' error, and surely; without one it must only be there, with one
    amplitude: one that would rather vary predicts better on data that were not fitted, whether or not a rest shows.
    `certain` says whether recordings kept out show it beyond doubt, where slices of the others do not or where it is
    borderline, and `kept_out` the gain there of one that they do; `fading` are those that were surely there and are
    gone in recordings kept out. A part that every drive has, and that is named at most joints `elsewhere`, need not
    take much of what a joint leaves (`elsewhere_too`).
    """
    checks = _of_all(one, tolerance)
    if rest or not (one.beside_rest or one.complete):  # what any rest looks like is taken on less only if it is all
        checks = chain(checks, _of_those_beside_rest(one, rest, certain, fading, kept_out, elsewhere))
    return next((reason for passed, reason in checks if not passed), "")


def _of_all(one: Standing, tolerance: float) -> Iterator[tuple[bool, str]]:
    """What every cause is asked, with why it is not named where it fails."""
    strict_law = one.whole or one.alone  # what else is wrong at a joint makes its law's amplitude vary
    yield (one.physical, "its fitted sign is physically impossible")
    yield (one.shown, "the motion does not tell it from a slower function of the position")
    yield (one.gain > 0, f"it does not improve the prediction of held-out data (gain {one.gain:.2g})")
    yield (
        one.share >= tolerance,
        f"its torque is {100 * one.share:.3g} % of the joint's, below the tolerance of {100 * tolerance:.3g} %",
    )
    yield (
        one.modulation_held_out <= (ALL_BUT if one.varies and strict_law else MODULATION_HELD_OUT),
        f"{_VARIES} {one.modulation_held_out:.2f} of its gain)",
    )
    yield (not one.spoils, "it predicts a joint worse, which a right law of the whole robot does not")
    yield (not one.outdone, "another cause that explains the same misfit predicts better, though it is none itself")
    yield (not one.rough, "errors of the position that an encoder's steps make explain nearly as much")
    yield (not one.massless, "its mass is not surely above zero: a link other than believed explains as much")
    yield (
        one.leaves <= LAW_LEAVES or not one.alone,
        f"where it acts {one.leaves:.2f} of what it removes stays beyond the noise, though most other joints have"
        " no misfit: another law acts there",
    )
    yield (
        one.by_place <= BY_PLACE,
        f"what it leaves goes with the joint's position and direction of motion, by {one.by_place:.2f} of what it"
        " removes: it is the smaller part of what acts there",
    )
    yield (
        one.followed <= OWN_SHARE or not one.unmoved,
        f"where it acts the motion predicts {one.followed:.2f} of what it removes once more, though most other"
        " joints have no misfit while they move: another law acts there",
    )


def _of_those_beside_rest(
    one: Standing,
    rest: bool,
    certain: Callable[[Name], bool],
    fading: Collection[Name],
    kept_out: Callable[[Name], float],
    elsewhere: bool,
) -> Iterator[tuple[bool, str]]:
    """What a cause beside a rest is asked more. `certain` costs a fit: it is asked where the answer hangs on it."""
    least, most = (GAIN_NAMED_ROBOT, MODULATION_ROBOT) if one.whole else (GAIN_NAMED, MODULATION)
    varying = one.modulation if one.whole else _without_chance(one.modulation, one.modulation_held_out)
    steadily = one.t >= one.t_needed and varying <= most  # slices show it surely, though not how much it takes
    margin = _together_beyond(max(one.t / one.t_needed, 1.0), one.gain / least, most / max(varying, 1e-9))
    yield (
        one.t >= one.t_needed or certain(one.name),
        f"its gain on held-out data is not significant: t = {one.t:.1f}, {one.t_needed:.1f} needed",
    )
    yield (
        one.gain >= least or elsewhere or (steadily and kept_out(one.name) >= least),
        f"it removes {100 * one.gain:.0f} % of the held-out error where it acts, {100 * least:.0f} % needed",
    )
    yield (
        one.modulation <= most or (one.modulation <= MODULATION_HELD_OUT and certain(one.name)),
        f"{_VARIES} {one.modulation:.2f} of its gain)",
    )
    yield (
        max(one.share, one.acting) >= SHARE_NAMED,
        f"its torque is {100 * one.share:.2g} % of the joint's, {100 * SHARE_NAMED:.0f} % needed",
    )
    yield (not one.everywhere, "a law of the whole robot explains as much where it acts, and more is left")
    yield (not one.cancels, "it cancels most of the joint's torque, as no gain beside another cause does")
    yield (one.beside_smooth > BESIDE_SMOOTH, "smooth functions of each joint's motion explain as much")
    yield (one.beside_rest or not rest or one.name in fading, LIKE_A_REST)
    yield (not one.one_part, ONE_PART)
    yield (
        not one.contested,
        "another law of the whole robot takes much beside it, with a sign that is physically impossible: what both"
        " stand for is neither",
    )
    yield (
        margin >= MARGIN or elsewhere or certain(one.name),
        f"it is borderline: t, gain and a steady amplitude together are {margin:.1f} times what each alone"
        f" needs, {MARGIN:.0f} needed",
    )


def elsewhere_too(found: Sequence[Found], against: Mapping[Name, str], joints: int) -> set[Name]:
    """Causes that are a part which every drive has (`Effect.in_every_drive`), named at most of the other joints.

    A robot file that has no rotor at five joints of six has none at the sixth. What speaks against a name where such a
    part takes little of what its joint leaves, that it may stand in for something else, is then the less likely.
    """
    out = set[Name]()
    for one in found:
        alike = [f for f in found if f.effect.name == one.effect.name and f is not one and not against[f.name]]
        if one.effect.in_every_drive and len(alike) >= max(FEWEST_ALIKE, joints // 2):
            out.add(one.name)
    return out


def behind_joints(each: Sequence[Standing], against: Mapping[Name, str]) -> dict[Name, str]:
    """Laws of one joint's posture beside a law of the whole robot that surely takes much and has no name; and why.

    Whatever that law stands for acts at all joints. What it does at one of them is a constant, or a spring, over the
    postures that were seen: where the whole is not understood, its part is not a cause of its own.
    """
    if not any(one.static and one.whole and _much(one) and against[one.name] for one in each):
        return {}
    told = "a law of the whole robot that has no name takes much of the same misfit: at this joint it may be that law"
    return {one.name: told for one in each if one.static and not one.whole and not against[one.name]}


def strong(one: Standing) -> bool:
    """Whether it surely explains much of what its joints leave, as a law that exists would, whatever speaks against its
    name: then what is left is more than sticks, which no law explains."""
    return _much(one) and one.physical and one.beside_rest and not one.whole


def _much(one: Standing) -> bool:
    """Whether it surely takes much of what its joints leave, with much torque."""
    return one.gain >= GAIN_NAMED and max(one.share, one.acting) >= SHARE_NAMED and one.t >= one.t_needed


def _without_chance(fitted: float, held_out: float) -> float:
    """What an amplitude that varies gains: by chance it gains more in the fit, and as much less on data left out."""
    return max((fitted + held_out) / 2, 0.0)


def _together_beyond(*ratios: float) -> float:
    """How far a cause is beyond what its tests need, together.

    One that passes each of them by little passes some of them by chance, and not with the next recording.
    """
    return float(np.prod(np.clip(ratios, 0.0, MARGIN)))


def stands_alone(misfit: Bool[np.ndarray, " nv"], joints: Sequence[int]) -> bool:
    """Whether a cause that acts at the `joints` is likely to be the only thing wrong there.

    That is told by the other joints (by all, if it acts on all): where most have a `misfit` in the baseline, so may
    these have one beside it.
    """
    acts = np.isin(np.arange(len(misfit)), list(joints))
    return bool(np.mean(misfit if acts.all() else misfit[~acts]) < 0.5)


def stands_out(squares: Float[np.ndarray, " nv"], joints: Sequence[int]) -> bool:
    """Whether some of a cause's `joints` have surely more of what is left than most other joints have: what all of them
    have is no trace of a law that acts at these. Always, where it acts on all."""
    acts = np.isin(np.arange(len(squares)), list(joints))
    return bool(acts.all() or squares[acts].max() > STANDS_OUT * np.median(squares[~acts]))


def of_its_own(beyond: Float[np.ndarray, " nv"], joints: Sequence[int], taken: float) -> float:
    """Squares `beyond` the noise at a cause's joints over the held-out squares that it has `taken` there: what its law
    lacks, where it stands alone."""
    return float(beyond[list(joints)].sum() / max(taken, 1e-300))


def beside_rest(
    each: Sequence[Standing],
    joints: Sequence[Sequence[int]],
    rest: bool,
    left: Float[np.ndarray, " nv"] | None = None,
    tolerance: float = 0.0,
) -> list[bool]:
    """Of each cause, by the joints where it acts, whether a rest stays beside it.

    A law of those joints that cannot be is one too: whatever it stands for, another law may stand for what it leaves.
    So is what is `left` at them beyond the noise (relative to their torque) where it is more than the cause itself and
    than the `tolerance`: whether or not it can be told from noise, the cause is the smaller part of what is wrong.
    """
    impossible = [set(at) for one, at in zip(each, joints, strict=True) if not (one.physical or one.whole)]

    def larger(one: Standing, at: Sequence[int]) -> bool:
        return left is not None and float(left[list(at)].max()) > max(one.share, tolerance)

    pairs = zip(each, joints, strict=True)
    return [rest or larger(one, at) or any(other & set(at) for other in impossible) for one, at in pairs]


def standings(
    problem: Problem, start: State, found: list[Found], joint: Joint, whitening: Float[np.ndarray, "F nv"]
) -> list[Standing]:
    """Each cause's standing in the fit of all of them."""
    if not found:
        return []
    full, places = joint.step, amplitude_places(joint.step.state, joint.causes)
    size = residual_rms(problem, stand(problem, start, whitening).state)
    grown = _Grown(problem, full, whitening, ground(full.verdicts, full.state.prior, full.folded), size)
    out = []
    for one, effect, place, at in zip(found, joint.causes, places, joint.fitted.places, strict=True):
        late, coupled = kind(effect) == "response", bool(effect.one_rotor)
        bare = stood_without(problem, start, found, one, whitening) if late else None
        without = bare.verdicts if bare else judged_without(problem, start, full, found, one, whitening)
        worse, better = (v.own(full.rows, one.joints) for v in (without, full.verdicts))
        whole = effect.acts_on not in ("joint", "pair")
        torque = cause_torque(problem, full.state, effect, place)
        varying = _taken(full.state, without) if effect.speed_law else torque
        modulation = _modulation(grown, effect, varying, without, one.joints, whole)
        share, acting = _shares_of_torque(problem, full.state, torque, effect)
        out.append(
            Standing(
                name=one.name,
                whole=whole,
                static=effect.of_position or (whole and kind(effect) == "columns"),
                physical=physical_sign(effect)
                and not (coupled and _turns_against_itself(effect, joint.fitted, at))
                and not (effect.bends and _turned_down(full.state, effect, torque))
                and not (effect.acts_on == "link" and _weighs_less_than_nothing(problem, effect, joint.fitted, at)),
                beside_rest=effect.beside_rest,
                gain=1 - float(better.sum() / max(worse.sum(), 1e-300)),
                taken=max(float((worse - better).sum()), 0.0),
                t=t_value(worse, better),
                t_needed=t_needed(len(worse), T_NAMED),
                share=share,
                acting=acting if effect.abrupt else share,
                cancels=bool(type(effect).follows_total) and not whole and share > 1,
                modulation=modulation[0],
                modulation_held_out=modulation[1],
                varies=modulation[2],
                beside_smooth=_beside_smooth(grown, bare, effect, place, one.joints) if whole else 1.0,
                one_part=coupled and _one_part(effect, joint.fitted, at),
                spoils=whole
                and kind(effect) == "columns"
                and _spoils(*(_by_joint(problem, v, full) for v in (without, full.verdicts))),
                everywhere=not whole and any(name.effect in EVERYWHERE for name in one.ambiguous),
                rough=like_roughness(problem, start, joint, found, one, whitening),
                outdone=bool(one.outdone) and outdone_beside(problem, start, joint, found, one, whitening),
                shown=effect.shown_by(*problem.reached),
                massless=effect.body and _deviations(effect, joint.fitted, at)["mass"] < MASS,
            )
        )
    impossible = [one.whole and not one.physical and _much(one) for one in out]
    return [replace(one, contested=one.whole and one.physical and any(impossible)) for one in out]


def _weighs_less_than_nothing(problem: Problem, effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> bool:
    """Whether a link, with what its cause adds, would surely have a negative mass."""
    change = float(getattr(effect, "mass", 0.0))
    whole = float(np.asarray(problem.model.inertia)[int(effect.at[0]), 0]) + change
    return whole < 0 and -whole * abs(_deviations(effect, fitted, place)["mass"]) > WEIGHTLESS * abs(change)


def _turned_down(state: State, effect: Effect, torque: Float[np.ndarray, "nN nv"]) -> bool:
    """Whether viscous friction, bent by a law's `torque`, falls towards the joint's top speed: what no lubricant does,
    and a drive at its limit looks like."""
    joint = int(effect.at[0])
    velocity, level = np.asarray(state.motion.velocity)[:, joint], torque[:, joint].copy()
    for term, share in zip(state.terms, state.shares(state.theta), strict=True):
        if term.name == "viscous_friction":
            level += share[:, joint]
    level *= np.sign(velocity)
    return bool(level[np.argmax(np.abs(velocity))] < (1 - TURNED_DOWN) * level.max())


class _Grown(NamedTuple):
    """The fit of all causes, and what judging further columns beside it needs."""

    problem: Problem
    step: Step
    whitening: Float[np.ndarray, "F nv"]
    base: Ground
    size: Float[np.ndarray, " nv"]  # RMS of what the model leaves without any cause, N m or N

    @property
    def response(self) -> np.ndarray:
        return self.whitening * self.step.state.response(self.problem.records.omega)[:, None]


def _taken(state: State, without: Verdicts) -> Float[np.ndarray, "nN nv"]:
    """What a cause changes of the torque at all samples, N m or N: its own less what all else takes when it is gone.

    Most of a friction that rises with a power of the speed is what dry and viscous friction are too: how those vary is
    nothing that speaks against it.
    """
    return state.torque(state.theta) - state.torque(without.theta)


def cause_torque(problem: Problem, state: State, effect: Effect, place: list[int]) -> Float[np.ndarray, "nN nv"]:
    """Torque of one cause at all samples, before the sensors, N m or N."""
    if kind(effect) == "position":
        return np.asarray(torque_change(batched(effect), state.motion, problem.records)[0])
    if kind(effect) == "response":
        return np.asarray(state.motion.total)
    own = np.isin(np.arange(len(state.theta)), place)
    return state.torque(np.where(own, state.theta, 0.0)) - state.known


def beyond_simpler(problem: Problem, state: State, effect: Effect, place: list[int]) -> float:
    """What an effect of one joint adds to a simpler one that it contains: RMS torque over that of the joint.

    Of a spring that rests far away all but a little is a constant. 1 for effects that contain none.
    """
    names = effect.amplitudes()
    simpler = {n for inside in type(effect).contains for n in find(inside).parameters()}
    own = [n not in simpler for n in names]
    if effect.acts_on != "joint" or kind(effect) != "columns" or all(own) or not any(own):
        return 1.0
    joint, judged = int(effect.at[0]), np.asarray(problem.records.judged)
    used, response = judged[..., joint] > 0, state.response(problem.records.omega)

    def rows(wanted: Sequence[int]) -> Float[np.ndarray, " rows"]:
        theta = np.where(np.isin(np.arange(len(state.theta)), wanted), state.theta, 0.0)
        return open_rows(problem.records, state.torque(theta) - state.known, response)[..., joint][used]

    added = rows([at for at, mine in zip(place, own, strict=True) if mine])
    shared = np.stack([rows([at]) for at, mine in zip(place, own, strict=True) if not mine], axis=1)
    left = added - shared @ np.linalg.lstsq(shared, added, rcond=None)[0]
    torque = problem.torque[..., joint][used]
    return float(np.sqrt((left**2).sum() / max(float((torque**2).sum()), 1e-300)))


def _shares_of_torque(problem: Problem, state: State, torque: np.ndarray, effect: Effect) -> tuple[float, float]:
    """RMS torque of a cause over that of the joint, where it is largest: over all rows, and while it acts.

    The latter is the RMS in which each row counts as much as the cause's square there: a play that is crossed for some
    hundredths of a second is nothing at all other times. Of a drive at its limit all samples count too: the ends of a
    recording have no rows, and may be where it is reached most. What is a constant while the joint moves is no more
    than it adds to one that the baseline has: the two are a pair of large numbers of which one takes the other off.
    """
    response = state.response(problem.records.omega)
    if kind(effect) == "response":
        own = sensor_response({effect.name: batched(effect)}, problem.records.omega)[effect.name][0]
        response = response * (1 - 1 / own)
    fitted = np.asarray(problem.records.judged)
    rows = open_rows(problem.records, torque, response) * fitted
    if TorqueOffset.name in related(effect.name, "indistinguishable_from"):
        known = [t for t in state.terms if isinstance(t, TorqueOffset) and set(effect.places) <= set(t.places.ravel())]
        rows -= bool(known) * fitted * rows.sum((0, 1)) / np.maximum(fitted.sum((0, 1)), 1)
    (size, fourth), whole = ((rows**k).sum((0, 1)) for k in (2, 4)), ((problem.torque * fitted) ** 2).sum((0, 1))
    own = fitted.sum((0, 1)) * fourth / np.maximum(size, 1e-300)
    shares = [float(np.sqrt((x / np.maximum(whole, 1e-12 * whole.max())).max())) for x in (size, own)]
    if effect.has("through"):
        shares[0] = max(shares[0], _share_of_samples(problem, torque, int(effect.at[0])))
    return shares[0], shares[1]


def _share_of_samples(problem: Problem, torque: Float[np.ndarray, "nN nv"], joint: int) -> float:
    """RMS of a cause over that of the torque of a joint, at all samples of the recordings that are fitted."""
    records, squares = problem.records, np.zeros(2)
    own = torque.reshape(np.shape(records.torque))
    for at in records.spans:
        if records.judged[at.slot, at.row : at.row + at.rows, joint].any():
            here = at.slot, slice(at.sample, at.sample + at.samples), joint
            squares += [(one[here] ** 2).sum() for one in (own, np.asarray(records.torque))]
    return float(np.sqrt(squares[0] / max(squares[1], 1e-300)))


def _modulation(
    grown: _Grown, effect: Effect, torque: np.ndarray, without: Verdicts, joints: tuple[int, ...], whole: bool
) -> tuple[float, float, bool]:
    """What an amplitude that varies gains more, in the fit and on held-out data, over what the cause gains; whether
    held-out data surely want it.

    Of a joint's law it is asked of its position, speed, load and time one by one, and the largest counts: all together
    they fit chance, and what they then predict of other data says nothing. The best of four is surer by chance alone.
    """
    step = grown.step
    base, touched = grown.base, list(range(len(step.rows.y))) if whole else list(joints)
    if kind(effect) == "response":  # it has no amplitude: its tangent must be free before
        (name,) = effect.parameters()
        beside = torque_slope(grown.problem, step.state, effect, name, grown.whitening)[None, touched]
        free = judge_grown(step.rows, base, touched, beside)
    else:
        free, beside = step.verdicts, np.zeros((0, len(touched), step.rows.y.shape[1]))
    bare, fixed = (v.own(step.rows, joints) for v in (without, free))
    drop, held, more_drop, more = without.cost - free.cost, bare.sum() - fixed.sum(), [], []
    for columns in [_varied_robot(grown, effect, torque)] if whole else _varied_joint(grown, torque, joints):
        varied = judge_grown(step.rows, base, touched, np.concatenate([beside, columns]))
        loose = varied.own(step.rows, joints)
        more_drop.append(free.cost - varied.cost)
        more.append((float((fixed - loose).sum()), t_value(fixed, loose)))
    gained, t = max(more)
    surely = t > t_needed(len(fixed), T_NAMED, len(more))
    return float(max(more_drop) / max(drop, 1e-9)), float(gained / max(held, 1e-9)), surely


def _varied_joint(grown: _Grown, torque: np.ndarray, joints: tuple[int, ...]) -> Float[np.ndarray, "4 2 rows T"]:
    """The cause's torque times x and 2 x^2 - 1, x each joint's position, speed, load and time from -1 to 1."""
    problem, motion, records = grown.problem, grown.step.state.motion, grown.problem.records
    n, samples, _, _ = records.shape
    q, v, load = (np.asarray(x) for x in (motion.angle, motion.velocity, motion.load))
    out = []
    for joint in joints:
        varying = [to_unit(x) for x in (q[:, joint], np.abs(v[:, joint]), load[:, joint], np.asarray(motion.time))]
        columns = np.stack([torque[:, joint] * f for x in varying for f in (x, 2 * x**2 - 1)])
        rows = filter_rows(records, columns.reshape(-1, n, samples), grown.response[:, joint][None], fitted=True)
        out.append((rows * np.asarray(problem.records.weight)[:, :, joint]).reshape(len(varying), 2, -1))
    return np.stack(out, axis=2)


def _varied_robot(grown: _Grown, effect: Effect, torque: np.ndarray) -> Float[np.ndarray, "k nv T"]:
    """The cause's rows times time, and those of each joint alone but one."""
    problem, state = grown.problem, grown.step.state
    if kind(effect) == "response":
        (name,) = effect.parameters()
        rows = torque_slope(problem, state, effect, name, grown.whitening)
    else:
        rows = filtered_rows(problem.records, torque, grown.response)
    time = to_unit(
        np.take_along_axis(np.asarray(problem.records.time), problem.records.row_samples(), axis=1).reshape(-1)
    )
    felt = [k for k in range(len(rows)) if np.any(rows[k])]
    alone = [rows * (np.arange(len(rows)) == k)[:, None] for k in felt[1:]]
    return np.stack([rows * time, *alone])


def _beside_smooth(
    grown: _Grown, bare: Step | None, effect: Effect, place: list[int], joints: tuple[int, ...]
) -> float:
    """Gain of the cause beside smooth functions of each joint's own motion, or in their place, whichever is larger.

    Few joints that move along one path leave little that many functions could not follow, but a law of few numbers then
    predicts better than they do. `bare` is the fit without a late sensor.
    """
    step = grown.step
    if kind(effect) == "position":
        return 1.0
    full = _with_smooth(grown, step)
    sums = fold_sums(step.rows, full.X)
    within = judge(step.rows, full, sums)
    if bare is None:
        without = judge(step.rows, full, sums, place)
    else:
        del full  # its columns are large
        without = judge(bare.rows, _with_smooth(grown, bare))
    alone, both, smooth = (v.own(step.rows, joints).sum() for v in (step.verdicts, within, without))
    return 1 - float(min(alone, both) / max(smooth, 1e-300))


def _with_smooth(grown: _Grown, step: Step) -> Hypothesis:
    """The columns of a fit and smooth functions of each joint's own motion, as its sensors read them.

    Each function is expected to be no larger than what the model leaves without any cause. Many free functions of few
    rows predict the rows left out so badly that two fits could not be compared beside them, and what they predict says
    nothing of a cause of two numbers that acts on all joints.
    """
    problem, whitening, rows = grown.problem, grown.whitening, step.rows
    n, samples, _, _ = problem.records.shape
    response = whitening * step.state.response(problem.records.omega)[:, None]
    own = []
    for joint, functions in enumerate(smooth_functions(step.state.motion)):
        filtered = filter_rows(
            problem.records, functions.reshape(-1, n, samples), response[:, joint][None], fitted=True
        )
        own.append((filtered * np.asarray(problem.records.weight)[:, :, joint]).reshape(len(functions), -1))
    prior = step.state.prior
    size = np.concatenate([np.full(len(x), s) for x, s in zip(own, grown.size, strict=True)])
    more = Prior(prior.extended(len(size)).mean, np.append(prior.precision, size**-2.0))
    places = np.split(np.arange(len(size)), np.cumsum([len(x) for x in own])[:-1])
    smooth = JointRows([(np.ascontiguousarray(x.T), at) for x, at in zip(own, places, strict=True)], len(size))
    return Hypothesis(rows.X.beside(smooth), more)


def _one_part(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> bool:
    """Whether no more than one of a coupling's parts is surely there (two standard deviations above zero).

    A rotor that turns with two joints has inertia and friction. Inertia alone is that of a link or of a rotor at one of
    them; damping alone is what a late torque looks like.
    """
    deviations = _deviations(effect, fitted, place)
    return sum(deviations[n] >= COUPLED for n in effect.one_rotor) < 2


def lone_part(joint: Joint) -> int | None:
    """The first of the couplings of which one part is surely there by the answer's own intervals, and no other likely.

    The law of a rotor at one of the joints, or of a tilt, is such a coupling's inertia; its damping and friction are
    then chance, of either sign.
    """
    for k, (effect, place) in enumerate(zip(joint.causes, joint.fitted.places, strict=True)):
        each = _deviations(effect, joint.fitted, place)
        parts = sorted(each[n] for n in effect.one_rotor)
        if parts and parts[-1] >= COUPLED and parts[-2] < LIKELY:
            return k
    return None


def _spoils(before: Float[np.ndarray, "ways nv blocks"], after: Float[np.ndarray, "ways nv blocks"]) -> bool:
    """Whether left-out data of some joint are surely predicted worse with a cause than without it, of all joints.

    What stands in for a law of the whole robot buys the joints where it fits with those where it does not. It must cost
    a joint in each way of counting its rows, by a share of what it gains: what a stick is fitted with changes with any
    cause. Squares of each joint's blocks, of all rows first.
    """
    least = max(BUYS * float((before[0] - after[0]).sum()), 0.0)
    needed = t_needed(before.shape[2], T_NAMED, before.shape[1])
    return any(
        all(t_value(now, was) > needed and (now - was).sum() > least for was, now in zip(*joint, strict=True))
        for joint in zip(before.swapaxes(0, 1), after.swapaxes(0, 1), strict=True)
    )


def _by_joint(problem: Problem, verdicts: Verdicts, full: Step) -> Float[np.ndarray, "2 nv blocks"]:
    """Squares of each joint's blocks: of all rows, and of those in which it moves."""
    moves = np.moveaxis(~resting(problem), 2, 0).reshape(full.rows.y.shape)
    ways = (verdicts, verdicts._replace(error=verdicts.error * moves))
    return np.array([[v.own(full.rows, (joint,)) for joint in range(len(moves))] for v in ways])


def _turns_against_itself(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> bool:
    """Whether a part of a coupling is surely negative (three standard deviations).

    One rotor that turns the sum, or the difference, of two joints has inertia, damping and friction of that sign.
    """
    return min(_deviations(effect, fitted, place)[n] for n in effect.one_rotor) < -3


def _deviations(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> dict[str, float]:
    """Each parameter in its standard deviations."""
    names = fitted_fields(effect)
    std = np.sqrt(np.maximum(np.diag(fitted.covariance)[list(place)], 1e-300))
    return {name: float(getattr(effect, name)) / float(s) for name, s in zip(names, std, strict=True)}
