"""Why each cause that a search has found is named, or is not: what left-out and kept-out data, noise and a rest say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..results import Name, Nearest
from .answer_fit import together
from .floor import noise_rms, short, sober_spectrum
from .gaining import Fall, beside_all, foretells
from .holdout import residual_rms
from .joint import Joint
from .naming import (
    Standing,
    behind_joints,
    beside_rest,
    elsewhere_too,
    of_its_own,
    reason_against,
    standings,
    stands_alone,
    stands_out,
)
from .rest import Follows, Significance, relative_rest, roughly_predictable, taken_by_place
from .search import Found, Search, chance_beside
from .setting import Setting
from .standstill import left_weighed, only_sticks, resting
from .step import stand, with_causes
from .thresholds import ALL_BUT, NO_REST, REST_P, SURE_DROP, WEIGHED_ALIKE

__all__ = [
    "KeptOut",
    "Left",
    "Searched",
    "as_slow_noise",
    "doubted_rest",
    "made_by_other_joints",
    "reasons_against",
    "standings_of",
    "sticks_alone",
]


class Left(NamedTuple):
    """What all causes together leave, and whether it is more than noise."""

    rest: Significance
    p_value: float  # of the whole catalogue on it
    excess: float  # over the noise
    line: tuple[float, float, int]  # the strongest in its spectrum
    more: Float[np.ndarray, " nv"]  # squares by which smooth functions of each joint find more in it than chance gives
    beyond: Float[np.ndarray, " nv"]  # each joint's squares, moving, beyond those of noise, where they surely are
    misfit: Bool[np.ndarray, " nv"]  # whether, without any cause, they are, or are more than is tolerable
    followed: Float[np.ndarray, " nv"]  # `more` where such functions surely predict what was not fitted, else zero
    moved: Bool[np.ndarray, " nv"]  # `misfit` of the rows in which the joint moves
    follows: Follows | None = None  # a joint of which most of it follows the motion


class Searched(NamedTuple):
    """What a search has found, all of it in one fit, and what that leaves."""

    before: Setting  # as it was set out with
    here: Setting  # with the width of friction that the causes leave
    search: Search
    found: list[Found]
    joint: Joint
    left: Left
    strict: bool  # whether a rest stays, beside which a cause must show more to be named
    gone: tuple[Nearest, ...] = ()  # causes that came in and went before they were judged
    fading: tuple[Name, ...] = ()  # causes that were there and are gone in recordings kept out

    @property
    def all_told(self) -> bool:
        """Whether nothing is left beside what was found, however much that is."""
        return not self.left.rest.there and self.left.excess <= NO_REST


class KeptOut:
    """What recordings kept out say of single causes beside all that was found; each answer costs a fit, made once."""

    def __init__(self, searched: Searched, claims: Mapping[Name, float]) -> None:
        self.searched, self.claims = searched, claims
        self.falls: dict[Name, Fall] = {}

    def borne_out(self, name: Name) -> bool:
        """Whether they surely show the cause, which may have no name alone."""
        return self.fall(name).surely(self.claims[name])

    def certain(self, name: Name) -> bool:
        """Whether they show it beyond doubt; never where nothing is kept out."""
        return bool(self.searched.here.problem.held.any()) and self.fall(name).certainly(self.claims[name])

    def gain(self, name: Name) -> float:
        """Share of the squares of its joints there that it takes, where they show it beyond doubt."""
        return self.fall(name).own if self.certain(name) else 0.0

    def fall(self, name: Name) -> Fall:
        """By how much the error on what is kept out falls with the cause in, beside all others."""
        if name not in self.falls:
            here, found, step = self.searched.here, self.searched.found, self.searched.joint.step
            one = next(f for f in found if f.name == name)
            self.falls[name] = beside_all(here.problem, here.start, here.whitening, found, step, one)
        return self.falls[name]


def standings_of(searched: Searched) -> list[Standing]:
    """What the data say of each cause, with what is left at its joints."""
    _, here, _, found, joint, left, *_ = searched
    each = standings(here.problem, here.start, found, joint, here.whitening)
    own = {j for f in found if f.effect.waves for j in f.joints}
    placed = {j: taken_by_place(here.problem, joint.step, here.whitening, j) for j in own}
    return [
        replace(
            one,
            complete=bool(left.more[list(f.joints)].max() <= ALL_BUT * (f.cost[0] - f.cost[1])),
            leaves=of_its_own(left.beyond, f.joints, one.taken),
            alone=stands_alone(left.misfit, f.joints),
            followed=of_its_own(left.followed, f.joints, one.taken) * stands_out(left.followed, f.joints),
            unmoved=stands_alone(left.moved, f.joints),
            by_place=sum(placed[j] for j in f.joints if f.effect.waves) / max(one.taken, 1e-300),
        )
        for one, f in zip(each, found, strict=True)
    ]


def doubted_rest(searched: Searched, forbid: Sequence[str], generator: np.random.Generator) -> bool:
    """Whether the catalogue still scores more than noise on what is left, though nothing in it passes."""
    here, step, left = searched.here, searched.joint.step, searched.left
    problem, whitening = here.problem, here.whitening
    doubted = left.p_value < REST_P
    if not doubted or left.rest.there or not short(problem, step.state):
        return doubted
    sober = sober_spectrum(problem, step.state, forbid)
    if foretells(problem, stand(problem, here.start, whitening), step, sober):
        return True
    return chance_beside(problem, step, sober, whitening, forbid, generator) < REST_P


def reasons_against(
    searched: Searched, each: Sequence[Standing], kept_out: KeptOut, doubted: bool, tolerance: float
) -> dict[Name, str]:
    """Why each cause that was found is not named; empty where it is."""
    here, found, joint = searched.here, searched.found, searched.joint
    noise = noise_rms(here.problem, here.spectrum)
    beyond = relative_rest(here.problem, joint.step.state, noise)
    doubt = bool(found) and doubted and float(beyond.max()) > tolerance and not sticks_alone(here, joint, tolerance)
    weighed = left_weighed(here.problem, joint.step.state, noise)  # rows at reversals say nothing of a law

    def beside(rest: bool) -> list[bool]:
        return beside_rest(each, [f.joints for f in found], rest, np.minimum(beyond, weighed), tolerance)

    # a rest of the answer is one for its names; where more than a few are found, each is asked as if there were one
    rests, left = beside(searched.strict or doubt), beside(not searched.all_told or doubt)
    if not all(left):  # what passed for noise at a cause's joints may be what it stands in for
        # what any rest looks like may stand in for something at another joint, too
        places = [list(f.joints) if f.effect.beside_rest else list(range(here.problem.model.nv)) for f in found]
        at, moving = sorted({j for own in places for j in own}), ~np.any(resting(here.problem), axis=2)
        rough = roughly_predictable(here.problem, joint.step, here.whitening, tolerance, moving, at)
        rests, left = (
            [rest or bool(rough[own].any()) for rest, own in zip(r, places, strict=True)] for r in (rests, left)
        )

    def refused(each: Sequence[Standing]) -> dict[Name, str]:
        asked, pairs = (tolerance, kept_out.certain, searched.fading), list(zip(each, rests, strict=True))

        def reason(one: Standing, rest: bool, elsewhere: bool = False) -> str:
            return reason_against(one, rest, *asked, kept_out=kept_out.gain, elsewhere=elsewhere)

        against = {one.name: reason(one, rest) for one, rest in pairs}
        alike = elsewhere_too(found, against, here.problem.model.nv)
        against |= {one.name: reason(one, rest, True) for one, rest in pairs if one.name in alike}
        return against | behind_joints([one for one, rest in pairs if rest], against)

    freed = [
        replace(o, beside_rest=True) if many and not rest else o
        for o, many, rest in zip(each, rests, left, strict=True)
    ]
    if freed != list(each):  # many that leave nothing: where each is named that counts, none is a part of a rest
        against = refused(freed)
        if not any(against[one.name] and one.share >= tolerance for one in each):
            return against
    return refused(each)


def made_by_other_joints(searched: Searched, each: Sequence[Standing], against: dict[Name, str]) -> dict[Name, str]:
    """Why a cause that nothing speaks `against` may be what another joint leaves, where it may.

    Rows as sure as the noise of their joint's sensor hold a misfit there as firmly as the truth: links that are fitted
    to it are wrong at the joints beside, and a cause of these takes that back. Weighed by what it leaves of its own
    joints, a misfit holds no link.
    """
    here, joint, found = searched.here, searched.joint, searched.found
    asked = [k for k, f in enumerate(found) if not against[f.name] and not each[k].whole]
    if not asked or not searched.strict or here.white:
        return {}
    problem, size = here.problem, residual_rms(here.problem, joint.step.state)
    white = np.ones((len(problem.records.omega), 1)) / np.maximum(size, 1e-12 * size.max())
    whole, out = with_causes(problem, here.start, list(joint.causes), white), {}
    for k in asked:
        one, others = found[k], [effect for n, effect in enumerate(joint.causes) if n != k]
        step = with_causes(problem, here.start, others, white)
        worse, better = (s.verdicts.own(whole.rows, one.joints).sum() for s in (step, whole))
        gain = 1 - float(better / max(worse, 1e-300))
        if gain < WEIGHED_ALIKE * each[k].gain:
            out[one.name] = (
                f"it removes {100 * each[k].gain:.0f} % of the held-out error where it acts, {100 * gain:.0f} % with"
                " each joint weighed by what it leaves: what is wrong at another joint may have made it"
            )
    return out


def as_slow_noise(
    searched: Searched, named: list[Found], forbid: Sequence[str], generator: np.random.Generator
) -> float | None:
    """How often noise as slow as the motion scores as much as the catalogue does, where the named causes may be that.

    None where they are not: repeats tell noise apart, much is removed, such noise seldom does as much, or recordings
    kept out surely want the causes, for the noise of one recording says nothing of another.
    """
    here, joint = searched.here, searched.joint
    problem, whitening = here.problem, here.whitening
    if problem.layout.repeats or max(f.cost[0] - f.cost[1] for f in named) >= SURE_DROP:
        return None
    sober, bare = sober_spectrum(problem, joint.step.state, forbid), stand(problem, here.start, whitening)
    chance = chance_beside(problem, bare, sober, whitening, forbid, generator)
    if chance < REST_P or foretells(problem, bare, together(here, named).step, sober):
        return None
    return chance


def sticks_alone(here: Setting, joint: Joint, tolerance: float) -> bool:
    """Whether what is left beside the causes of a fit is that of joints at rest.

    A fit that is also asked for slow rows gives part of their sticks to the friction of the joints that move.
    """
    state, noise = joint.step.state, noise_rms(here.problem, here.spectrum)
    return only_sticks(here.problem, state, noise, relative_rest(here.problem, state, noise), tolerance)
