"""The recorded torque against that of the model: columns, signs, units, gravity and clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..rigid.model import RobotModel, prismatic
from .findings import LIKE, SOFT, UNLIKE, Finding, Look, named
from .likeness import Likeness, Sampled, likeness, matrix_of_likeness, rigid_torque, share_of_gravity, stretch_of_time

__all__ = ["TURNED_POSITION", "torque_findings"]

DEGREE = np.pi / 180
LIGHT = 4.0  # times too small: a nominal model may well be three times too heavy
TURNED_POSITION = "(-1 in transmission.position)"  # ends a finding, by which a draft knows it
SURELY_OFF = 1.3  # times: a clock that is off by as much within two standard errors is no question of links or noise
STANDARD = 9.81  # m/s2
HEAVY = 0.2  # share of a torque's spread that the rigid body should make up before its absence means anything


class _Fit(NamedTuple):
    """Each joint's own torque against the nominal model's, and which of them tell anything."""

    own: list[Likeness]
    nominal: Float[np.ndarray, "rows nv"]
    heavy: np.ndarray  # joints whose torque should show the rigid body
    spread: Float[np.ndarray, " nv"]  # standard deviation of the measured torque


def torque_findings(look: Look, motion: Sampled) -> Iterator[Finding]:
    """What looks wrong about the torque, since the model needs another one for this motion."""
    assert motion.torque is not None
    fit = _fit(look.model, motion)
    like = np.array([one.correlation for one in fit.own])
    if (fit.heavy & (like < 0.9)).any() or not np.any(np.asarray(look.model.gravity)):
        found = _other_reading(look, motion)
        if found is not None:
            yield found
            return
    lacks = fit.heavy & (like < UNLIKE)
    if fit.heavy.any() and lacks.sum() >= 0.5 * fit.heavy.sum():
        yield Finding(
            False,
            f"torque of {named(look, lacks)} does not follow what the model needs for this motion (correlation"
            f" {', '.join(f'{r:.2f}' for r in like[lacks])}): is it measured torque or current with its sign, with"
            " gravity in it, of this robot, at these columns and stamps?",
            unlike=tuple(name for name, at in zip(look.joints, lacks, strict=True) if at),
        )
        return
    weightless = _weightless(look.model, motion) & (like < 0.9)  # alike but small is a unit
    if weightless.any():
        yield Finding(
            False,
            f"torque of {named(look, weightless)} holds none of the gravity that the model needs there: is it what a"
            " controller adds to its gravity compensation? Record the torque or current of the drives",
            grave=True,
        )
        return
    scale = [*_scale(look, fit, like)]
    yield from scale
    if scale:  # a torque n times as large looks like a clock the root of n times as fast
        return
    stretch, error = stretch_of_time(look.model, motion)
    if error < 0.15 and abs(np.log(stretch)) > max(np.log(1.5), 3 * error):
        yield Finding(
            False,
            f"the clock looks wrong: the inertial torque fits a clock {stretch:.2g} times as fast,"
            f" {motion.rate * stretch:.4g} Hz instead of {motion.rate:.4g} Hz (+-{100 * error:.0f} %)",
            grave=abs(np.log(stretch)) - 2 * error > np.log(SURELY_OFF),
        )


def _fit(model: RobotModel, motion: Sampled, nominal: Float[np.ndarray, "rows nv"] | None = None) -> _Fit:
    """`nominal` is the model's torque along the motion, where that is known."""
    assert motion.torque is not None
    nominal, torque = rigid_torque(model, motion) if nominal is None else nominal, motion.torque
    columns = zip(nominal.T, torque.T, motion.velocity.T, motion.acceleration.T, strict=True)
    own = [likeness(*each) for each in columns]
    return _Fit(own, nominal, _heavy(own, torque), np.std(torque, axis=0))


def _heavy(own: Sequence[Likeness], torque: np.ndarray) -> np.ndarray:
    """Joints that carry something: what the rigid body needs beside friction and rotor is much of their torque.

    A torque of one value throughout is of no drive that moves its joint, and says nothing about the columns.
    """
    expected, spread = np.array([one.expected for one in own]), np.std(torque, axis=0)
    return (expected > HEAVY * spread) & (expected > 0.03 * expected.max()) & (spread > 0)


def _weightless(model: RobotModel, motion: Sampled) -> np.ndarray:
    """Joints without gravity in their torque; none unless most of those that should have it lack it."""
    assert motion.torque is not None
    slope, error, expected = share_of_gravity(model, motion)
    spread = np.std(motion.torque, axis=0)
    asked = (expected > HEAVY * spread) & (expected > 0.05 * expected.max()) & (spread > 0)
    lacks = asked & (slope + 3 * error < 0.3) & (slope > -0.3)
    return lacks if lacks.sum() > 0.5 * asked.sum() else np.zeros(len(lacks), bool)


def _scale(look: Look, fit: _Fit, like: np.ndarray) -> Iterator[Finding]:
    """Torque in another unit: the model's gravity says how large it should be."""
    slopes = np.array([one.slope for one in fit.own])
    sure = (like > LIKE) & fit.heavy
    if not sure.any():  # a torque that is read too large leaves no joint heavy
        share = slopes * np.array([one.expected for one in fit.own]) / np.maximum(fit.spread, 1e-300)
        sure = (like > LIKE) & (slopes > SOFT) & (share > HEAVY)
    if not sure.any():
        return
    slopes = slopes[sure]
    middle = float(np.median(slopes))
    if 1 / LIGHT < middle < SOFT:
        return
    names = ", ".join(f"{look.joints[j]} {slope:.3g}" for j, slope in zip(np.flatnonzero(sure), slopes, strict=True))
    guess = next((f"it looks like {u}" for u, s in _TORQUE_UNITS if 0.5 < middle / s < 2), None)
    guess = guess or "a current or a share of the rated torque needs its constant (transmission.torque)"
    yield Finding(False, f"torque is {middle:.3g} times what the model needs ({names}): {guess}", grave=True)


_TORQUE_UNITS = (("mN m", 1e3), ("N cm", 1e2), ("kN m", 1e-3))


def _other_reading(look: Look, motion: Sampled) -> Finding | None:
    """The reading of the columns that makes torque and motion belong together, where the given one does not."""
    motion = motion.thinned(120)
    assert motion.torque is not None
    given = _fit(look.model, motion)
    best, text = -np.inf, ""
    readings = list(_readings(look, motion, given.nominal))
    signals = zip(*((one.position, one.velocity, one.acceleration) for _, one in readings), strict=True)
    position, velocity, acceleration = (np.concatenate(each) for each in signals)
    together = Sampled(position, velocity, acceleration, None, motion.rate)  # one call for all
    nominal = np.split(rigid_torque(look.model, together), len(readings))
    turned = [(said, motion, rigid_torque(model, motion)) for said, model in _gravities(look.model)]
    read = [(said, other, own) for (said, other), own in zip(readings, nominal, strict=True)]
    first = 2 if look.model.nv > 1 else 1  # a unit, or the sign of all torques, is simpler
    for said, other, own in [*read[:first], *turned, *read[first:]]:
        fit = _fit(look.model, other, own)
        heavy = given.heavy | fit.heavy
        gain = _misfit(given.own, heavy) - _misfit(fit.own, heavy)
        if gain > best + 0.3 and _belongs(fit, heavy):  # the simpler reading, which comes first, wins a draw
            best, text = gain, said
    if best < np.log(5.0):
        return None
    return Finding(False, f"torque does not match the motion as read; {text}", grave=True)


def _belongs(fit: _Fit, heavy: np.ndarray) -> bool:
    """Whether nearly every joint that carries something follows the model, at a size that is no accident."""
    if not heavy.any():
        return False
    like = np.array([one.correlation for one in fit.own])[heavy]
    slope = np.array([one.slope for one in fit.own])[heavy]
    return bool(np.median(like) > LIKE and np.mean(like > UNLIKE) > 0.6 and np.median(slope) > 0.1)


def _misfit(own: Sequence[Likeness], heavy: np.ndarray) -> float:
    """Sum of the logarithms of what is not explained; a correlation of the wrong sign explains nothing."""
    like = np.array([one.correlation for one, at in zip(own, heavy, strict=True) if at])
    return float(np.sum(np.log(1.02 - like * np.abs(like))))


def _readings(look: Look, motion: Sampled, nominal: np.ndarray) -> Iterator[tuple[str, Sampled]]:
    """Other readings of the same columns, the simpler first: units, signs, swapped pairs, zeros a quarter turn off."""
    torque, joints, n = motion.torque, look.joints, len(look.joints)
    assert torque is not None
    turns = ~np.array(prismatic(look.model))
    if look.unit == "rad":
        text = "it would with positions in degrees: add units: {position: deg}"
        yield text, motion.scaled(np.where(turns, DEGREE, 1e-3))
    else:
        text = f"it would with positions in rad: remove units: {{position: {look.unit}}}"
        yield text, motion.scaled(np.where(turns, 1 / DEGREE, 1e3))
    if n > 1:
        yield (
            "torque of every joint has the opposite sign of what the model needs: the log gives the load's torque"
            " (transmission.torque with -1 on its diagonal), or robot.gravity points the wrong way",
            replace(motion, torque=-torque),
        )
    yield from _turned(joints, motion, torque)
    order = _assigned(matrix_of_likeness(motion, nominal, torque))
    if order is not None:
        text = ", ".join(f"{joints[j]} takes the column given for {joints[c]}" for j, c in enumerate(order) if c != j)
        yield f"the torque columns are in a different order: {text}", replace(motion, torque=torque[:, order])
    yield from _swapped(joints, motion, torque, turns)
    for j in np.flatnonzero(turns):
        for quarter in (1, 2, -1):
            offset = np.zeros(n)
            offset[j] = quarter * np.pi / 2
            text = f"it would with {offset[j]:+.4f} rad added to the position of {joints[j]} (transmission.offset)"
            yield text, motion.moved(offset)


def _gravities(model: RobotModel) -> Iterator[tuple[str, RobotModel]]:
    """The robot with gravity along each other axis of its base."""
    given = np.asarray(model.gravity, float)
    size = float(np.linalg.norm(given)) or STANDARD
    for axis in (2, 0, 1):
        for sign in (-1.0, 1.0):
            other = sign * size * np.eye(3)[axis]
            if other @ given > 0.9 * size**2:  # it is the one given
                continue
            there, here = (", ".join(f"{x:g}" for x in vector + 0.0) for vector in (other, given))
            text = f"it would with robot.gravity: [{there}] in place of [{here}]"
            yield text, eqx.tree_at(lambda m: m.gravity, model, other)


def _turned(joints: Sequence[str], motion: Sampled, torque: np.ndarray) -> Iterator[tuple[str, Sampled]]:
    """The sign of one joint's torque, of its position, of both."""
    for j, name in enumerate(joints):
        sign = np.ones(len(joints))
        sign[j] = -1.0
        text = f"torque of {name} has the opposite sign of what the model needs (-1 in transmission.torque)"
        yield text, replace(motion, torque=torque * sign)
        turned = motion.scaled(sign)
        yield f"it would with the opposite sign of the position of {name} {TURNED_POSITION}", turned
        text = f"it would with the opposite sign of position and torque of {name} (-1 in both matrices of transmission)"
        yield text, replace(turned, torque=torque * sign)


def _swapped(
    joints: Sequence[str], motion: Sampled, torque: np.ndarray, turns: np.ndarray
) -> Iterator[tuple[str, Sampled]]:
    """Columns of two joints exchanged: of position, or of everything."""
    for i in range(len(joints)):
        for j in range(i + 1, len(joints)):
            if turns[i] != turns[j]:
                continue
            swap = list(range(len(joints)))
            swap[i], swap[j] = j, i
            pair, moved = f"{joints[i]} and {joints[j]}", motion.with_columns(swap)
            yield f"it would with the position columns of {pair} swapped", moved
            text = f"it would with position and torque columns of {pair} swapped"
            yield text, replace(moved, torque=torque[:, swap])


def _assigned(matrix: Sequence[Sequence[Likeness]]) -> list[int] | None:
    """Torque column of each joint that makes all of them most alike; None for the order as it is."""
    from scipy.optimize import linear_sum_assignment

    like = np.array([[max(one.correlation, 0.0) for one in row] for row in matrix])
    _, order = linear_sum_assignment(-like)
    return None if (order == np.arange(len(order))).all() else order.tolist()
