"""What may stand in a cause's place in the fit of all: rivals of when it came in, and a rough position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, JointEffect, Leaf, Motion, Scalar, place, shape
from .comparison import shares_of_wins
from .gaining import predicts_better
from .holdout import kept_out_error
from .joint import Joint, polished
from .problem import Problem
from .search import Found
from .state import State
from .step import Step
from .thresholds import LIKE_ROUGHNESS, OUTDONE, ROUGH

__all__ = ["Rough", "like_roughness", "outdone_beside"]


class Rough(JointEffect):
    """A position that bends more than the link does, as the steps of an encoder make it; no cause that has a name.

    Of a motion of frequency f it has 1 + (2 pi f)^2 width: to first order what a low-pass filter would take off.
    """

    name, title = "rough", "rough position"
    equation = "q_measured = q - width a"
    width: Scalar = shape("s^2", (1e-4,), (1e-8, 1e-2))

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """-width a, rad or m."""
        return -self.width * self.here(motion.acceleration)


def outdone_beside(
    problem: Problem, start: State, joint: Joint, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> bool:
    """Whether what predicted better than a cause as it came in does so in its place beside all others, too.

    As it comes in, the misfits of all causes to come are still there, and a rival with more numbers follows some of
    them as well. Recordings kept out may reject it, however well it does on slices of those that are fitted. Without
    them it stays outdone: two stand-ins for one cause each do better than that cause beside the other stand-in.
    """
    if not problem.held.any():
        return True
    known, error = [f.name for f in found], kept_out_error(problem, joint.step)
    blocks = [joint.step.verdicts.blocks]
    for other in one.outdone:
        if other.name in known:  # beside which it has come in
            continue
        step = _with(problem, start, joint, found.index(one), [other.effect], whitening)
        both = sorted({*one.joints} & {*other.joints})
        if not predicts_better(problem, kept_out_error(problem, step), error, both):
            blocks.append(step.verdicts.blocks)
    return bool(shares_of_wins(np.stack(blocks), np.random.default_rng(0))[0] < OUTDONE)


def like_roughness(
    problem: Problem, start: State, joint: Joint, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> bool:
    """Whether a position that is only rough explains nearly as much as a gear that winds up.

    A link follows its motor up to its resonance. Where that lies below the cutoff, the gear is a low-pass filter of the
    position as well, and takes off what the steps of an encoder add. A gear that is there bends the motion the other
    way below its resonance, and follows all of the load. Positions that were taken far below the cutoff are not rough.
    """
    bands = problem.records.bands
    if not one.effect.winds_up or bands is None:
        return False
    if np.max(bands[:, int(one.effect.at[0])]) < ROUGH * float(problem.records.cutoff):
        return False
    at, rough = found.index(one), place(Rough, problem.model, one.name.at, width=1e-4)
    bare, other = (_with(problem, start, joint, at, instead, whitening).verdicts.cost for instead in ([], [rough]))
    return bool(bare - other > LIKE_ROUGHNESS * (bare - joint.step.verdicts.cost))


def _with(
    problem: Problem,
    start: State,
    joint: Joint,
    at: int,
    instead: Sequence[Effect],
    whitening: Float[np.ndarray, "F nv"],
) -> Step:
    """The fit of all causes with others in the place of one, or with none there."""
    causes = [*joint.causes[:at], *instead, *joint.causes[at + 1 :]]
    return polished(problem, start, causes, whitening).step
