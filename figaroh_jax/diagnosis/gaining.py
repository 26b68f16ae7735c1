"""Which causes predict data that was kept out: what does not lower its error is not named, however well it fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..estimation.noise import Spectrum, whitening
from ..estimation.rows import Prior
from ..results import Gain, Name
from .holdout import Held, held_squares, weighted_of_errors, weighted_squares, whitened_wanted
from .joint import Joint, polished
from .problem import Problem
from .search import Found, stood_without
from .state import State
from .step import Step, stand
from .thresholds import BY_CHANCE, BY_CHANCE_BESIDE, BY_CHANCE_UNSHOWN, GAIN, HELD, KEPT_OF_CLAIM, RISES

__all__ = [
    "Fall",
    "Gaining",
    "beside_all",
    "fall",
    "foretells",
    "kept_squares",
    "predicts_better",
    "surely_less",
    "without_losses",
]

EXACT, DRAWS = 12, 4000  # blocks up to which every choice of signs is made; choices beyond
FEWEST = 6  # blocks that together say that a cause is there
NEARLY_ALL = 0.9  # of the squares of its joints: a stand-in on a short recording took .7 in every block


class Gaining(NamedTuple):
    """Causes that all lower the error on the data held out, with that error."""

    named: list[Found]
    joint: Joint
    order: list[int]  # of the named, by what each gains as it comes in
    gains: list[Gain]  # of each, in that order
    holdout: Gain  # of all together
    worse: list[Name]  # those that did not
    links_held: bool = False  # whether the links are held near those of the fit without causes


class Fall(NamedTuple):
    """What a cause does to the error on data kept out as it comes in."""

    own: float  # share of the squares that goes of the joints where it acts, while they move
    chance: float  # p-value of what these data want of it: of the blocks' products with signs at random
    each: float  # sum over the joints of that share
    whole: float  # squares of all rows that go, N m or N, squared
    worse: float  # p-value of their rise
    every: bool = False  # whether every block wants it, and there are more than a few

    @property
    def gains(self) -> bool:
        """Whether the cause predicts better where it acts, not by chance, and the robot is not predicted worse for it.

        The squares of the robot are asked joint by joint: those in N m are the large joints', which any change of the
        fit moves by more than a small joint has.
        """
        return self.own > 0 and self.chance < BY_CHANCE and self.each > 0 and self.worse > RISES

    def surely(self, claim: float) -> bool:
        """The same of a cause that shows beside what has no name alone; `claim` is the share that it takes in slices of
        the recordings that are fitted."""
        return (
            self.chance < BY_CHANCE_BESIDE
            and self.own >= KEPT_OF_CLAIM * claim
            and self.each > 0
            and self.worse > RISES
        )

    def certainly(self, claim: float) -> bool:
        """Whether the joints where it acts show the cause beyond doubt.

        Where few blocks have most of what it takes, slices cannot tell it from chance: a recording of its own can. The
        signs of a short one's few blocks are never so unlikely: there it takes nearly all that is left, in every block.
        """
        surely = self.chance < BY_CHANCE_UNSHOWN or (self.every and self.own > NEARLY_ALL)
        return surely and self.own >= KEPT_OF_CLAIM * claim


def fall(before: Held, after: Held, joints: Sequence[int]) -> Fall:
    """What becomes of the error of each block and joint for a cause that acts at the `joints`.

    Whether data kept out show a cause is asked of the products of their error without it and of what it takes of that:
    of a cause that is not there their signs are chance. Half of the squares' fall is that; the other half asks for its
    size as fitted too, and tells little in few blocks.
    """
    places, (rows, moving) = list(joints), before.squares - after.squares
    wanted = after.wanted[:, places].sum(1)
    drop, had = moving.sum(0), np.maximum(before.squares[1].sum(0), 1e-300)
    return Fall(
        own=float(drop[places].sum() / had[places].sum()),
        chance=_by_chance(wanted),
        each=float((drop / had).sum()),
        whole=float(rows.sum()),
        worse=_by_chance(-rows.sum(1)),
        every=len(wanted) >= FEWEST and bool((wanted > 0).all()),
    )


def _by_chance(gain: Float[np.ndarray, " blocks"]) -> float:
    """How often the blocks' differences with signs at random sum to as much: exact for few blocks.

    What a cause takes is most where it acts most: a few blocks have nearly all of it, and their mean and deviation say
    little of whether every block has some.
    """
    if len(gain) <= EXACT:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(gain))[:, None] >> np.arange(len(gain))) & 1)
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (DRAWS, len(gain)))
        signs[0] = 1.0
    return float(np.mean(signs @ gain >= gain.sum() - 1e-12 * np.abs(gain).sum()))


def without_losses(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    named: list[Found],
    joint: Joint,
    strict: bool,
    borne_out: Callable[[Name], bool] = lambda name: False,
    claims: Mapping[Name, float] | None = None,
) -> Gaining:
    """The causes without those that do not lower the error on the data held out, the worst first (`Fall`).

    Each is judged as it comes in: by what it gains alone, or else after all the others, for some show only beside
    another, or beside what has no name (`borne_out`). All together never raise the error of the robot on all rows held
    out, be it by chance: what is handed over predicts no worse than the model without causes. Where links that move
    with them do, the links are held (`_beside_links`). `claims` are the shares that causes take in slices of which
    recordings kept out must surely show a part: any rest looks like these, or they act on the whole robot, alike in
    every motion.
    """
    claims = claims or {}
    worse: list[Name] = []
    later: list[Name] = []  # come in behind the others
    passed: set[Name] = set()  # in some order of these causes
    while True:
        order, squares, power = _by_gain(problem, start, whitening, joint.causes, [f.name in later for f in named])
        falls = [fall(a, b, named[k].joints) for k, (a, b) in zip(order, pairwise(squares), strict=True)]
        pairs = [(named[k].name, k, one) for k, one in zip(order, falls, strict=True)]
        passed |= {n for n, _, one in pairs if (one.surely(claims[n]) if n in claims else one.gains)}
        passed |= {name for name, _, one in pairs if name not in passed and strict and one.own > 0 and borne_out(name)}
        failing = [(one.own, k) for name, k, one in pairs if name not in passed or one.own <= 0]
        if not failing and _rises(squares):
            kept = _beside_links(problem, start, whitening, named, joint, claims)
            if kept is not None:
                return kept._replace(worse=worse)
            failing = [(one.whole, k) for _, k, one in pairs]
        if not failing:
            return _gaining(problem, named, joint, order, squares, power)._replace(worse=worse)
        least = min(failing)[1]
        if named[least].name not in later and len(named) > 1:
            later.append(named[least].name)
            continue
        worse.append(named[least].name)
        later.clear()
        passed.clear()
        named = [f for k, f in enumerate(named) if k != least]
        joint = polished(problem, start, [f.effect for f in named], whitening)


def _gaining(
    problem: Problem,
    named: list[Found],
    joint: Joint,
    order: list[int],
    squares: Sequence[Held],
    power: Float[np.ndarray, "2 nv"],
) -> Gaining:
    """The causes with what each gains in that order, and all together."""
    pairs = zip(order, pairwise([one.squares for one in squares]), strict=True)
    gains = [_told(a, b, power, named[k], problem) for k, (a, b) in pairs]
    whole = _relative(squares[0].squares[0], squares[-1].squares[0], power[0])
    return Gaining(named, joint, order, gains, whole, [])


def _rises(squares: Sequence[Held]) -> bool:
    """Whether the error of the robot on all rows held out is more with all causes than without any."""
    return bool(squares[-1].squares[0].sum() > squares[0].squares[0].sum())


def _beside_links(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    named: list[Found],
    joint: Joint,
    claims: Mapping[Name, float],
) -> Gaining | None:
    """Causes that surely lower the error where they act, in a fit whose links stay near those of the fit without them;
    None where they do not, or where each such fit predicts the robot worse too.

    Links move with any cause, and by chance the large joints, which have most of the robot's squares, are predicted
    worse for it than small ones better. They are held no more than is needed, for what they keep is not the cause's.
    Deviations are those of the fit whose links move, and say how far the values are from it.
    """
    if problem.bounded or not problem.held.any():
        return None
    theta, count = stand(problem, start, whitening).state.theta, start.rigid.width
    for times in HELD:
        mean, precision = np.array(start.prior.mean), np.array(start.prior.precision)
        mean[:count], precision[:count] = theta[:count], times * precision[:count]
        held = replace(start, prior=Prior(mean, precision))
        fit = polished(problem, held, [one.effect for one in named], whitening)
        order, squares, power = _by_gain(problem, held, whitening, fit.causes, [False] * len(named))
        falls = {
            named[k].name: fall(before, after, named[k].joints)
            for k, (before, after) in zip(order, pairwise(squares), strict=True)
        }
        if not all(one.own > 0 and (one.surely(claims[n]) if n in claims else one.gains) for n, one in falls.items()):
            return None
        if not _rises(squares):
            moves = np.diag((fit.fitted.value - joint.fitted.value) ** 2)
            fitted = replace(fit.fitted, covariance=joint.fitted.covariance + moves)
            found = _gaining(problem, named, fit._replace(fitted=fitted), order, squares, power)
            return found._replace(links_held=True)
    return None


def beside_all(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    found: list[Found],
    full: Step,
    one: Found,
) -> Fall:
    """What a cause does to the kept-out error with all else in that was found, named or not.

    What has no name is still there: without it the fit bends, and a cause that is true may seem to predict nothing. The
    squares have the weights of the fit, in which slow rows count little. `full` is the fit with all that was found.
    """
    bare = stood_without(problem, start, found, one, whitening)
    return fall(*weighted_squares(problem, bare, full), one.joints)


def predicts_better(
    problem: Problem, before: Float[np.ndarray, "n M nv"], after: Float[np.ndarray, "n M nv"], joints: Sequence[int]
) -> bool:
    """Whether data kept out surely prefer one fit to another: by the squares of some joints, which count alike.

    `before` and `after` are the fits' errors there (`kept_out_error`): two whole fits would take twice the memory.

    Less than what any cause must gain is no preference, however sure: two laws that are the same to these torques, as a
    rotor on a vertical axis of the base and the link that it drives, differ by what priors make of them.
    """
    worse, better = weighted_of_errors(problem, before, after)
    places = list(joints)
    drop, had = (worse.squares - better.squares)[1][:, places], worse.squares[1][:, places].sum(0)
    gain = (drop / np.maximum(had, 1e-300)).sum(1)
    return bool(gain.sum() > GAIN * len(places) and _by_chance(gain) < BY_CHANCE)


def foretells(problem: Problem, bare: Step, full: Step, spectrum: Spectrum) -> bool:
    """Whether recordings kept out surely want what one fit has beyond another: noise of one recording, however slow,
    says nothing of another. `spectrum` is that of the noise."""
    if not problem.held.any():
        return False
    frequency = np.asarray(problem.records.omega) / (2 * np.pi)
    response = whitening(spectrum, frequency, problem.gain, float(problem.records.cutoff))
    return _by_chance(whitened_wanted(problem, bare, full, response)) < BY_CHANCE_BESIDE


def kept_squares(problem: Problem, step: Step) -> Float[np.ndarray, " blocks"]:
    """Squares of the robot's error (N m or N) on all rows of data kept out of a fit, block by block."""
    return weighted_squares(problem, step, step)[0].squares[0].sum(1)


def surely_less(worse: Float[np.ndarray, " blocks"], better: Float[np.ndarray, " blocks"]) -> bool:
    """Whether squares fall from one fit to another by more than chance makes of the blocks' differences."""
    drop = worse - better
    return bool(drop.sum() > 0 and _by_chance(drop) < BY_CHANCE)


def _told(
    before: Float[np.ndarray, "2 blocks nv"],
    after: Float[np.ndarray, "2 blocks nv"],
    power: Float[np.ndarray, "2 nv"],
    one: Found,
    problem: Problem,
) -> Gain:
    """Error of the robot without and with a cause; where chance moves that by more than the cause gains, the error of
    the joints where it acts, while they move."""
    if after[0].sum() < before[0].sum():
        return _relative(before[0], after[0], power[0])
    places = list(one.joints)
    names = ", ".join(problem.model.joint_names[k] for k in places)
    own = _relative(before[1][:, places], after[1][:, places], power[1][places])
    return Gain(own.before, own.after, f"relative RMS of {names} in motion")


def _relative(before: np.ndarray, after: np.ndarray, power: np.ndarray) -> Gain:
    first, last = (float(np.sqrt(x.sum() / power.sum())) for x in (before, after))
    return Gain(first, last)


def _by_gain(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    causes: Sequence[Effect],
    later: Sequence[bool],
) -> tuple[list[int], list[Held], Float[np.ndarray, "2 nv"]]:
    """The order of what each cause gains on held-out data as it comes in, those that come `later` behind the others.

    With the squares of the error in that order, and of the torque.
    """
    order = list(range(len(causes)))
    squares, power = held_squares(problem, start, list(causes), whitening)
    drops = [float((before.squares - after.squares)[0].sum()) for before, after in pairwise(squares)]
    ranked = sorted(order, key=lambda k: (later[k], -drops[k]))
    if ranked != order:
        squares, power = held_squares(problem, start, [causes[k] for k in ranked], whitening)
    return ranked, squares, power
