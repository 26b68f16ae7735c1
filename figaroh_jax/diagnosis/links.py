"""How far the links of the model file are from those that the torque asks for, and which of them.

The baseline fits masses and inertias beside friction before any cause is looked for. Where the torque moves them
further than they are believed, that is often the largest error of a simulation. It is told with its size, and is no
cause: ten numbers a link follow many another misfit, as a wrong gain of the torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import joint_unit
from ..effects.catalogue import find
from ..effects.inertia import LinkInertia
from ..effects.transmission import RotorInertia
from ..estimation.rows import UNKNOWN, Prior
from ..estimation.told import ABOUT_JOINT, TOLD, inertia_about_joint, possible, sizes, told_numbers
from ..formats.assembly import Welded
from ..results import Estimate, Gain, Links, MovedLink, Name
from ..rigid.model import prismatic
from .comparison import FoldSums, coefficients, left_out, told
from .holdout import relative_error, residual_rms
from .joint import Joint
from .problem import Problem
from .setting import Setting
from .state import solved, with_term
from .step import Step, stand, with_causes
from .thresholds import AS_IF_GONE, BEYOND_TRUST, GAIN_OF_A_LINK, MOST_MOVED, MOST_OF_A_GAIN, SURELY

__all__ = ["as_gain", "moved_links"]

_HELD = 1e12  # times the stated precision of the links: they stay as the file has them
_NO_BODY = "no body has these numbers beside the rest of the link: they stand for something else as well"


def moved_links(
    problem: Problem, first: Step, last: Step, whitening: Float[np.ndarray, "F nv"], welded: Sequence[Welded] = ()
) -> Links | None:
    """What the links of the model file leave beside those of the baseline `first`, and which links move in `last`.

    None where they stay within what is believed of them, all that is left being taken for noise, or predict what was
    not fitted as well as those of the baseline. `welded` are bodies that the file fixes to a link.
    """
    if problem.bounded:
        return None  # they are held there, and `link_inertia` is a cause
    about = _About(problem, last, whitening, welded)
    if about.chance > BEYOND_TRUST:
        return None
    filed = _as_filed(problem, first)
    gain = Gain(relative_error(problem, filed), relative_error(problem, first))
    if not gain.after < gain.before:
        return None
    return Links(residual_rms(problem, filed.state), gain, about.far, problem.trust, tuple(_which(about)))


def as_gain(here: Setting, joint: Joint) -> int | None:
    """The first body among the causes that one gain of all torques does as well as, where links are not well known.

    A body is free where links are held near the file: torque that is read too large asks for one.
    """
    problem, start, whitening = here.problem, here.start, here.whitening
    for k, effect in enumerate(joint.causes if not problem.bounded else ()):
        if effect.body:
            others = [other for other in joint.causes if other is not effect]
            if _gain_does(problem, with_causes(problem, start, others, whitening), joint.step, whitening):
                return k
    return None


def _gain_does(problem: Problem, bare: Step, full: Step, whitening: Float[np.ndarray, "F nv"]) -> bool:
    """Whether one gain of all torques, beside the links of the file, does what `full` has more than `bare`."""
    about = _About(problem, bare, whitening)
    sums, prior = FoldSums(*(x / about.level for x in full.folded)), full.state.prior
    filed, size = about.left([]).squares, about.left([_One("size", 0)])
    taken = filed - _left(sums, left_out(sums, prior))
    return size.surely() and filed - size.squares > (1 - GAIN_OF_A_LINK) * taken


def _as_filed(problem: Problem, step: Step) -> Step:
    """The fit of all else beside the links of the model file."""
    count, prior = len(problem.believed), step.state.prior
    held = Prior(prior.mean, np.append(_HELD * problem.believed, prior.precision[count:]))
    state = replace(step.state, prior=held)
    return replace(step, state=solved(state, coefficients(step.folded, held)))


class _One(NamedTuple):
    """A link, the rotor of a joint's drive, a body that the file fixes to a link, or the size of all links."""

    kind: Literal["link", "rotor", "welded", "size"]
    at: int  # index of the link, of the joint, of the body; 0


class _Fit(NamedTuple):
    """Numbers of some links, of those the data tell, and rotors, fitted beside all else."""

    ones: tuple[_One, ...]
    numbers: list[list[int]]  # of each link, 0 to 9; of another its only one
    squares: float  # of folds that were left out
    columns: list[int]  # the numbers' among all columns
    value: Float[np.ndarray, " columns"]
    std: Float[np.ndarray, " columns"]

    def surely(self) -> bool:
        """Whether the last that has come in has a number that is told and has a value that it can have."""
        one, own = self.ones[-1], self.numbers[-1]
        if one.kind == "link":
            return bool(own)
        value, told = self.value[-1], self.std[-1] < TOLD * abs(self.value[-1])
        can_be = {"rotor": value > 0, "welded": abs(value + 1) < AS_IF_GONE, "size": value > -1}
        return bool(told and can_be[one.kind])


class _About:
    """Normal equations about the links of the model file, with rows that count as noise of all that is left.

    Behind the columns of the state stand those of the rotors that it lacks, then those of welded bodies and of
    all links.
    """

    def __init__(
        self, problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], welded: Sequence[Welded] = ()
    ):
        residual = step.rows.y - step.rows.X @ step.state.theta
        self.level = max(float((residual**2).sum()) / max(step.rows.size, 1), 1.0)
        self.robot, self.count, self.own = problem.model, len(problem.believed), len(step.state.theta)
        self.rotors = _without_rotor(problem, step)
        if self.rotors:
            places = np.array(self.rotors)[:, None]
            more = with_term(problem, step.state, find(RotorInertia.name)(places, **{"inertia": np.zeros(len(places))}))
            step = stand(problem, more, whitening, step)
        prior, sums = step.state.prior, step.folded
        filed = np.append(prior.mean[: self.count], np.zeros(len(prior.mean) - self.count))
        pulled = sums.gram @ filed
        square = sums.square - 2 * sums.moment @ filed + pulled @ filed
        self.welded, width = welded, len(prior.mean)
        on = np.zeros((width, width + len(welded) + 1))
        on[:, :width] = np.eye(width)
        for k, body in enumerate(welded):
            on[10 * body.at : 10 * body.at + 10, width + k] = body.inertia
        on[: self.count, -1] = filed[: self.count]
        moment = (sums.moment - pulled) @ on
        self.sums = FoldSums(on.T @ sums.gram @ on / self.level, moment / self.level, square / self.level)
        self.prior = Prior(prior.mean - filed, prior.precision).extended(len(welded) + 1)
        self.scale = sizes(problem.model)
        self.others = list(range(self.count, self.own))
        sums, prior = self._of(range(self.own))
        theta = coefficients(sums, prior)[: self.count]
        from scipy.special import chdtrc  # scipy is slow to import

        squares, number = float(problem.believed @ theta**2), told(sums, prior, self.count)
        self.chance, self.far = float(chdtrc(number, squares)), float(np.sqrt(squares / max(number, 1e-12)))
        self.free = _left(sums, left_out(sums, prior))  # beside all links as they are believed

    def every(self) -> list[_One]:
        """All that may move or be missing."""
        links = [_One("link", i) for i in range(self.count // 10)]
        welded = (_One("welded", k) for k in range(len(self.welded)))
        return [*links, *(_One("rotor", j) for j in self.rotors), *welded]

    def name(self, one: _One) -> Name:
        """As an effect at its place."""
        if one.kind == "rotor":
            return Name(RotorInertia.name, (self.robot.dof_names[one.at],))
        if one.kind == "size":
            return Name("torque_gain", ())
        at = self.welded[one.at].at if one.kind == "welded" else one.at
        return Name(LinkInertia.name, (self.robot.link_names[at],))

    def column(self, one: _One) -> int:
        """Where the only number of what is no link stands."""
        if one.kind == "size":
            return len(self.prior.mean) - 1
        return self.own + (self.rotors.index(one.at) if one.kind == "rotor" else len(self.rotors) + one.at)

    def left(self, ones: Sequence[_One]) -> _Fit:
        """What is left of folds that were left out, beside all else and those numbers of links that the data tell."""
        single = [self.column(one) for one in ones if one.kind != "link"]
        links, others = [one.at for one in ones if one.kind == "link"], [*self.others, *single]
        matrix, right = self.sums.gram.sum(0), self.sums.moment.sum(0)
        matrix[others, others] += self.prior.precision[others]
        tens = [list(range(10 * i, 10 * i + 10)) for i in links]
        each = iter(told_numbers(matrix, right, tens, others, self.scale[links], 1.0))
        numbers = [sorted(next(each)[0]) if one.kind == "link" else [0] for one in ones]
        columns = list[int]()
        for one, own in zip(ones, numbers, strict=True):
            columns += [10 * one.at + k for k in own] if one.kind == "link" else [self.column(one)]
        return self._judged(tuple(ones), numbers, columns)

    def bodies(self, found: _Fit) -> bool:
        """Whether bodies can have the links as fitted, numbers that are not told following."""
        links = [one.at for one in found.ones if one.kind == "link"]
        moved, own = np.asarray(self.robot.inertia, float).reshape(-1).copy(), np.array(found.columns) < self.count
        at = np.array(found.columns, int)[own]
        moved[at] += found.value[own]
        told = [10 * links.index(c // 10) + c % 10 for c in at.tolist()]
        return not links or possible(self.robot, links, moved.reshape(-1, 10)[links], told, found.std[own])

    def _of(self, columns: Sequence[int]) -> tuple[FoldSums, Prior]:
        """The sums and the prior of some columns."""
        kept = list(columns)
        sums = FoldSums(self.sums.gram[:, kept][:, :, kept], self.sums.moment[:, kept], self.sums.square)
        return sums, Prior(self.prior.mean[kept], self.prior.precision[kept])

    def _judged(self, ones: tuple[_One, ...], numbers: list[list[int]], columns: list[int]) -> _Fit:
        sums, prior = self._of([*columns, *self.others])
        own = len(columns)
        prior.precision[:own] = UNKNOWN
        folds, value = left_out(sums, prior), coefficients(sums, prior)[:own]
        inverse = np.linalg.pinv(sums.gram.sum(0) + np.diag(prior.precision), hermitian=True)
        spread = (len(folds) - 1) * folds[:, :own].var(0)  # by leaving each fold out: a rest differs between them
        std = np.sqrt(np.maximum(np.diag(inverse)[:own], spread))
        return _Fit(ones, numbers, _left(sums, folds), columns, value, std)


def _without_rotor(problem: Problem, step: Step) -> list[int]:
    """Columns of joints that turn or slide and whose drive has no rotor in the state."""
    with_one = {int(j) for term in step.state.terms if term.name == RotorInertia.name for j in np.ravel(term.at)}
    driven = {joint.coordinate for joint in problem.model.joints if joint.kind in ("revolute", "prismatic")}
    return sorted(driven - with_one)


def _left(sums: FoldSums, folds: Float[np.ndarray, "folds P"]) -> float:
    """Squares of all folds, each with the coefficients of the others."""
    fitted = np.einsum("fp,fpq,fq->f", folds, sums.gram, folds)
    return float((sums.square - 2 * (sums.moment * folds).sum(1) + fitted).sum())


def _which(about: _About) -> list[MovedLink]:
    """The links that have to move and the rotors that are missing, one after another, for most of what links gain.

    Ten numbers of a link follow much. One of a body that the file fixes to it, or of one or two rotors, counts before
    them where it takes most of what they do, and a link that a body can have before one that none has. One size of all
    links counts only where it does all that they do, and more than the best of them or what no body has: it makes up
    for some of whatever is too heavy.
    """
    now = about.left([])
    begun, whole, few = now.squares, now.squares - about.free, GAIN_OF_A_LINK * (now.squares - about.free)
    size = about.left([_One("size", 0)])
    chosen = dict[_One, tuple[float, tuple[_One, ...]]]()
    while whole > 0 and len(now.ones) < MOST_MOVED:
        ends = [about.left([*now.ones, one]) for one in about.every() if one not in now.ones]
        ends = sorted([end for end in ends if end.surely()], key=lambda end: end.squares)
        if not ends or now.squares - ends[0].squares < few:
            break
        best = _simplest(about, now, ends, few)
        does_all = not now.ones and size.surely() and size.squares < about.free + few
        if does_all and (size.squares < best.squares or not about.bodies(best)):
            return _told(about, size, {size.ones[0]: (min((begun - size.squares) / whole, 1.0), ())})
        others = [*ends, size] if not now.ones and size.surely() else ends
        alike = [e.ones[-1] for e in others if e.ones[-1] not in best.ones and e.squares - best.squares < few]
        for count in range(len(now.ones) + 1, len(best.ones) + 1):
            part = best if count == len(best.ones) else about.left(best.ones[:count])
            share = min(max((begun - part.squares) / whole, 0.0), 1.0)
            chosen[best.ones[count - 1]] = share, tuple(alike)
        now = best
    return _told(about, now, chosen)


def _simplest(about: _About, now: _Fit, ends: list[_Fit], few: float) -> _Fit:
    """The best of the ends, or another in its place that has fewer numbers or is possible."""
    best = ends[0]
    if best.ones[-1].kind != "link":
        return best
    enough = now.squares - MOST_OF_A_GAIN * (now.squares - best.squares)
    for kind in ("welded", "rotor"):
        single = next((end for end in ends if end.ones[-1].kind == kind and end.squares < enough), None)
        if single is not None:
            return single
    rotors = [end.ones[-1] for end in ends if end.ones[-1].kind == "rotor"]
    pairs = [about.left([*now.ones, a, b]) for k, a in enumerate(rotors) for b in rotors[:k]]
    pair = min((p for p in pairs if p.surely()), key=lambda p: p.squares, default=best)
    if pair is not best and pair.squares < enough:
        return pair
    links = [end for end in ends if end.ones[-1].kind == "link" and end.squares - best.squares < few]
    return next((end for end in links if about.bodies(end)), best)


def _told(about: _About, found: _Fit, chosen: dict[_One, tuple[float, tuple[_One, ...]]]) -> list[MovedLink]:
    """Each with its numbers, and what these look like."""
    names, units, filed = LinkInertia.amplitudes(), LinkInertia.units(), np.asarray(about.robot.inertia, float)
    values = {c: (float(x), float(s)) for c, x, s in zip(found.columns, found.value, found.std, strict=True)}
    bodies, out = about.bodies(found), []
    for one, own in zip(found.ones, found.numbers, strict=True):
        if one.kind == "link":
            each = {k: values[10 * one.at + k] for k in own}
            change = np.zeros(10)
            change[own] = [x for x, _ in each.values()]
            told = {names[k]: Estimate(x, s, units[names[k]]) for k, (x, s) in each.items() if abs(x) > SURELY * s}
            note = ABOUT_JOINT if inertia_about_joint(filed[one.at], change, own) else ""
            note = note if bodies else _NO_BODY
        else:
            value, std = values[about.column(one)]
            straight = one.kind == "rotor" and prismatic(about.robot)[one.at]
            told, note = {"inertia": Estimate(value, std, joint_unit("kg m2", straight))}, ""
            if one.kind == "size":
                told = {"gain": Estimate(1 + value, std, "")}
                note = "the measured torque is so many times what all links of the file ask for"
            elif one.kind == "welded":
                body = about.welded[one.at]
                mass = float(body.inertia[0])
                told = {"mass": Estimate(value * mass, std * mass, "kg")}
                holder = about.robot.link_names[body.at]
                note = f"as if {body.name} ({mass:.3g} kg), which the file fixes to {holder}, were not there"
        share, alike = chosen[one]
        instead = dict.fromkeys(name for name in map(about.name, alike) if name != about.name(one))
        out.append(MovedLink(about.name(one), share, told, tuple(instead), note))
    return out
