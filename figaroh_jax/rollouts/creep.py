"""Whether friction holds a robot's joints where MuJoCo's soft constraint lets them creep.

MuJoCo keeps a joint at rest by a constraint that gives way (its documentation, "Computation: constraint model"): held
against a torque it moves at the speed at which the pull of the constraint, `friction_rate` times the speed, is the
softness, `friction_share` over the joint's mass, times that torque. By the defaults an arm of hobby servos sinks by
14 mrad a second, and what is fitted to a robot that stands then makes up for it. No cause does: where a search by the
file's friction ends beside a rest, the same search with the stiffest one that an MJCF can state is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..results import Name
from .arm import baseline_alone
from .causes import Candidate, catalogue
from .fit import Fit, fit
from .found import Named, Search
from .gates import rms_of, standing
from .loop import STIFFEST, Loop, mobility, turns
from .parameters import put
from .screening import LATE, ROUGH, Standing, excess_of, joint_of
from .setting import Setting, Structure, by_recording, largest_forces, thinned
from .shared import t_together
from .thresholds import CONFIDENT, GAIN, GAIN_BESIDE_REST, HOPEFUL, T_BESIDE_REST, t_of, t_of_recordings

__all__ = ["REMARK", "creep_notes", "creep_speed", "fitted_with_both", "searched_with_both", "stiff"]

REMARK = "The robot's friction holds joints that the soft friction of the file lets creep."
_FRICTION = "friction_loss"

Seek = Callable[..., Search]


def stiff(loop: Loop) -> Loop:
    """The loop whose friction holds as well as an MJCF can state: impedance `STIFFEST`, two steps of time constant."""
    joints = loop.joints
    share = np.minimum(np.asarray(joints.friction_share), (1 - STIFFEST) / STIFFEST)
    rate = np.maximum(np.asarray(joints.friction_rate), 1.0 / (STIFFEST * float(loop.dt)))
    return eqx.tree_at(lambda m: (m.joints.friction_share, m.joints.friction_rate), loop, (share, rate))


def creep_speed(loop: Loop) -> np.ndarray:
    """The speed (nv,) at which a joint moves while its friction holds all that it can: rad/s or m/s."""
    if loop.law == "hard":
        return np.zeros(loop.robot.nv)
    share, rate, level = (np.asarray(getattr(loop.joints, f"friction{x}")) for x in ("_share", "_rate", ""))
    with jax.enable_x64(True):
        easy = np.asarray(mobility(loop))[: loop.robot.nv, 0]
    return share * easy * level / rate


def searched_with_both(
    seek: Seek,
    here: Setting,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    forbid: Sequence[str] = (),
) -> Search:
    """The search with the file's friction; where it leaves a rest, with friction that holds if that surely predicts
    better.

    Then `friction_loss` is named at every joint whose recordings left out bear that out, before all other causes.
    """
    found = seek(here, progress, forbid=forbid)
    if not _is_asked(here, found, forbid):
        return found
    progress("asking whether friction holds", 0.9)
    sound = found.setting or here
    structure = found.structure._replace(loop=stiff(found.structure.loop))
    free = [int(k) for k in found.last.free if k >= 0]
    look = _fitted(sound, structure, found.last, free)
    before, after = (x.sums.cost.sum((0, 1)) for x in (found.last, look))
    if not (np.isfinite(look.cost) and (after < (1 - HOPEFUL) * before).any()):
        return found
    other = seek(replace(here, loop=stiff(here.loop)), progress, forbid=forbid)
    return _better(here, found, other) if np.isfinite(other.last.cost) else found


def fitted_with_both(here: Setting, first: Fit) -> tuple[Setting, Fit, tuple[str, ...]]:
    """The baseline's fit with friction that holds where recordings left out are surely predicted better by it, and
    what is said of that; else the fit as it is."""
    structure = Structure(here.loop, here.known.table, here.data)
    if not _creeps(put(*structure[:2], first.theta)) or excess_of(here, structure, first).max() < 1.0:
        return here, first, ()
    some, held = thinned(here), replace(here, loop=stiff(here.loop))
    other = _fitted(held, structure._replace(loop=held.loop), first, here.baseline)
    both = [_stands(some, structure._replace(loop=s.loop), f) for s, f in ((here, first), (held, other))]
    level = np.asarray(put(*structure[:2], other.theta).joints.friction)
    told, t = _told(some, both[0], both[1], [j for j in range(here.loop.robot.nv) if level[j] > 0], GAIN)
    if t < T_BESIDE_REST:
        return here, first, ()
    names, speed = here.loop.robot.dof_names, creep_speed(put(*structure[:2], other.theta))
    at = ", ".join(f"{names[j]} ({1e3 * speed[j]:.2g} {_unit(here.loop, j)}/s)" for j, _, _ in told)
    return (
        held,
        other,
        (
            f"friction holds where the soft friction of the file would let joints creep: {at}; recordings left out are"
            f" predicted better by stiff friction (solimpfriction {STIFFEST}), which the fit and model/robot.xml have",
        ),
    )


def _unit(loop: Loop, joint: int) -> str:
    return "mrad" if turns(loop)[joint] else "mm"


def _is_asked(here: Setting, found: Search, forbid: Sequence[str]) -> bool:
    """Whether a rest is left by friction that creeps."""
    rest = found.verdict in ("unknown", "named+rest") and np.isfinite(found.last.cost)
    if not rest or _FRICTION in forbid:
        return False
    return _creeps(put(found.structure.loop, found.structure.table, found.last.theta))


def _creeps(loop: Loop) -> bool:
    """Whether a joint's friction would hold better if it were stiff."""
    return loop.law == "soft" and bool((creep_speed(loop) > 2 * creep_speed(stiff(loop))).any())


def _fitted(here: Setting, structure: Structure, last: Fit, free: Sequence[int]) -> Fit:
    """The numbers that are free fitted from where they are, the states at the starts where there are as many."""
    start = last.start[None] if last.start.shape[1] == np.asarray(structure.data.start).shape[1] else None
    return fit(*structure, last.theta[None], [free], start, width=max(here.width, len(free)), lanes=1, iterations=LATE,
               rough=ROUGH)[0]  # fmt: skip


def _stands(here: Setting, structure: Structure, last: Fit) -> Standing:
    """A fit on the rows of `here`, and what it predicts of those that it has not seen."""
    structure = structure._replace(data=here.cut(structure.loop))
    free = [int(k) for k in last.free if k >= 0]
    return standing(here, structure, _fitted(here, structure, last, free), free)


class _Told(NamedTuple):
    """What recordings left out say of friction that holds at one joint."""

    joint: int
    gain: float
    t: float


def _told(
    here: Setting, soft: Standing, hard: Standing, joints: Sequence[int], least: float
) -> tuple[list[_Told], float]:
    """The joints at which friction that holds predicts better by a share of the squares, and t of all of them."""
    runs, each = np.array([x.run for x in here.stretches]), by_recording(here)
    told = []
    for j in joints:
        before, after = soft.held[..., j], hard.held[..., j]
        gain = float(1 - after.sum() / max(before.sum(), 1e-300))
        told.append(_Told(j, gain, t_of_recordings(before, after, runs) if each else t_of(before, after)))
    told = [one for one in told if one.t > CONFIDENT and one.gain > least]
    if not told:
        return [], 0.0
    at = [one.joint for one in told]
    if each:
        return told, t_together(soft.held, hard.held, runs, at)
    return told, t_of(soft.held[..., at].sum(-1), hard.held[..., at].sum(-1))


def _better(here: Setting, found: Search, other: Search) -> Search:
    """The search with friction that holds where recordings left out surely bear it out, else that before."""
    sound, rest = other.setting or replace(here, loop=stiff(here.loop)), other.verdict in ("unknown", "named+rest")
    some = thinned(sound)
    if rest and not by_recording(some):
        return found
    begun = [Structure(m, here.known.table, here.data) for m in (here.loop, stiff(here.loop))]
    soft, hard = _stands(some, found.structure, found.last), _stands(some, other.structure, other.last)
    first = _stands(some, begun[0], found.first), _stands(some, begun[1], other.first)
    level = np.asarray(put(other.structure.loop, other.structure.table, other.last.theta).joints.friction)
    least, joints = HOPEFUL if rest else GAIN, [j for j in range(here.loop.robot.nv) if level[j] > 0]
    alone, sure = _told(some, *first, joints, least)  # without the causes that either search has found
    told, t = _told(some, soft, hard, [one.joint for one in alone], least)
    t = min(t, sure)
    if t < T_BESIDE_REST or (rest and np.mean([one.gain for one in told]) < GAIN_BESIDE_REST):
        return found
    if other.verdict == "unknown":
        baseline_alone(sound, other)
    there = {joint_of(here, n.candidate): n for n in other.named if n.candidate.effect == _FRICTION}
    baseline = {joint_of(here, c): c for c in _frictions(here) if set(c.entries) <= set(other.last.free)}
    named = [
        Named(baseline[j], t, gain, (), rms_of(some, soft.held, j), rms_of(some, hard.held, j))
        for j, gain, _ in told
        if j in baseline and j not in there
    ]
    creeps = [*named, *(there[j] for j, _, _ in told if j in there)]
    if not creeps:
        return found
    steps = [*found.table[:1], ("friction that holds", other.table[0][1]), *other.table[1:]]
    return replace(
        other,
        verdict="named+rest" if rest else "named",
        named=[*sorted(named, key=lambda n: n.after**2 - n.before**2), *other.named],
        creeps=creeps,
        first=found.first,
        p_value=found.p_value,
        table=steps,
        held=[found.held[0], *other.held],
        setting=replace(sound, loop=here.loop),
    )


def _frictions(here: Setting) -> list[Candidate]:
    """Friction at every joint, which the baseline may have."""
    every = catalogue(here.loop, largest_forces(here.loop, here.runs), gains_known=False).candidates
    return [c for c in every if c.effect == _FRICTION]


def creep_notes(here: Setting, found: Search) -> dict[Name, str]:
    """By cause where friction holds: how fast the file's would let it move, and what the model has instead."""
    if not found.creeps:
        return {}
    last: Any = put(found.structure.loop, found.structure.table, found.last.theta)
    own = [np.asarray(x)[: here.loop.robot.nv] for x in (last.joints.friction, last.joints.armature)]  # no spring's
    speed = creep_speed(eqx.tree_at(lambda m: (m.joints.friction, m.joints.armature), here.loop, own))
    notes = dict[Name, str]()
    for one in found.creeps:
        j = joint_of(here, one.candidate)
        notes[Name(one.candidate.effect, one.candidate.at)] = (
            "it holds the joint, which the soft friction of the file would let creep by up to"
            f" {1e3 * speed[j]:.2g} {_unit(here.loop, j)}/s; model/robot.xml has it stiff (solimpfriction"
            f" {STIFFEST})"
        )
    return notes
