"""Rotors that the robot's file lacks, where a search has taken in a body that holds them.

What a body adds to the inertia about the joints that carry it is what their rotors add, and its ten numbers gain more
than any one of them: of a robot whose links are not well known and whose file has no rotors, the best next cause is
often a body. It is none where the rotors predict what was not fitted as well, one number for each joint in place of
ten. A body that is there weighs something, which no rotor does: the links would have to.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..effects.base import place
from ..effects.transmission import RotorInertia
from ..results import Name, Nearest
from ..rigid.model import RobotModel
from .comparison import t_value
from .estimates import amplitude_places
from .problem import Problem
from .search import Found, judged_without
from .state import State
from .step import Step, with_causes
from .thresholds import T_ALIKE

__all__ = ["AS_ROTORS", "rotors_for_bodies"]

AS_ROTORS = "rotors of the joints that carry it explain as much, one number each"


def rotors_for_bodies(
    problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"], forbid: Collection[str]
) -> tuple[list[Found], list[Nearest]]:
    """The causes, each body as the rotors of the joints that carry it where these predict left-out data as well; and
    the bodies that have gone."""
    gone = list[Nearest]()
    if problem.bounded or RotorInertia.name in forbid:
        return found, gone
    for body in [f for f in found if f.effect.body]:
        own = _carriers(problem.model, body)
        joints = sorted(own - _with_rotor(start, found))
        full = with_causes(problem, start, [f.effect for f in found], whitening)
        while True:
            rotors = [_rotor(problem.model, j, body) for j in joints]
            others = [*(f for f in found if f is not body), *rotors]
            step = with_causes(problem, start, [f.effect for f in others], whitening)
            sizes = _sizes(step, others, rotors)
            if all(size > 0 for size in sizes):
                break
            joints = [j for j, size in zip(joints, sizes, strict=True) if size > 0]
        turning = own & _with_rotor(start, others)
        if turning and _as_well(full, step, len(body.effect.amplitudes()) - len(joints)):
            told = [_told(problem, start, step, others, one, body, whitening) for one in rotors]
            found = [*(f for f in found if f is not body), *told]
            worse, better = (one.verdicts.own(one.rows, body.joints).sum() for one in (step, full))
            gone.append(Nearest(body.name, 1 - float(better / worse), AS_ROTORS))
    return found, gone


def _as_well(full: Step, step: Step, fewer: int) -> bool:
    """Whether a fit with so many numbers fewer predicts left-out data as well, and costs no more than these may save.

    Without a load that is there the links would have to carry it, far from where they are believed: that is the cost
    (Schwarz's criterion, squares against the logarithm of the rows for each number).
    """
    rise = step.verdicts.cost - full.verdicts.cost
    return t_value(step.verdicts.blocks, full.verdicts.blocks) < T_ALIKE and rise < fewer * np.log(full.rows.size)


def _carriers(robot: RobotModel, body: Found) -> set[int]:
    """Coordinates of the joints that carry a body."""
    i, out = robot.link_names.index(body.name.at[0]), set[int]()
    while i >= 0:
        joint = robot.joints[i]
        if joint.kind in ("revolute", "prismatic"):
            out.add(joint.coordinate)
        i = joint.parent
    return out


def _with_rotor(start: State, found: list[Found]) -> set[int]:
    """Coordinates of the joints whose drive has a rotor, of the baseline or among the causes."""
    own = {int(j) for term in start.terms if term.name == RotorInertia.name for j in np.ravel(term.at)}
    return own | {int(np.ravel(f.effect.at)[0]) for f in found if f.effect.name == RotorInertia.name}


def _rotor(robot: RobotModel, joint: int, body: Found) -> Found:
    """A rotor that came in with a body."""
    name = Name(RotorInertia.name, (robot.dof_names[joint],))
    effect = place(RotorInertia, robot, name.at)
    return Found(name, effect, body.p_value, body.heldout, body.cost, body.t, 1 - body.p_value, (), (joint,))


def _sizes(step: Step, causes: list[Found], rotors: list[Found]) -> list[float]:
    """Inertias of the rotors in the fit of all causes, kg m2 or kg."""
    places = amplitude_places(step.state, [f.effect for f in causes])
    return [float(step.state.theta[at[0]]) for f, at in zip(causes, places, strict=True) if f in rotors]


def _told(
    problem: Problem,
    start: State,
    full: Step,
    causes: list[Found],
    one: Found,
    body: Found,
    whitening: Float[np.ndarray, "F nv"],
) -> Found:
    """The rotor with what it gains beside all others; the body that it takes the place of predicts no better."""
    without = judged_without(problem, start, full, causes, one, whitening)
    before, after = (v.own(full.rows, one.joints) for v in (without, full.verdicts))
    return replace(
        one,
        heldout=(without.heldout, full.verdicts.heldout),
        cost=(without.cost, full.verdicts.cost),
        t=t_value(without.blocks, full.verdicts.blocks),
        ambiguous=(body.name,),
        share=1 - float(after.sum() / before.sum()),
    )
