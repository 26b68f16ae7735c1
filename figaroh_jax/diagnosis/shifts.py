"""The true motion behind position sensors that err, and the torque of the links along it.

JAX evaluates inverse dynamics, many samples in one program; the equations of the sensors are solved on the host.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect, Motion, changed
from ..recordings.rowfilter import low_pass
from ..recordings.signals import let_through
from ..recordings.stacked import Records
from ..rigid.dynamics import torques_on_host
from ..rigid.model import Leaf, RobotModel

__all__ = ["difference", "links_torque", "rigid_torque", "shift_torques", "shifted", "torque_change"]

AT_ONCE = 2_000_000  # numbers of a torque of all samples, for several effects: more are moved one after another
TURNS = 3  # of Newton's method for the true motion
ENDS, TINY = 6, 1e-6  # samples whose derivatives are held; what makes them zero
EVERY = 4  # samples between which derivatives of the torque are straight
ROUNDING = 1e-9  # of the largest derivative of the torque
STEP = 1e-4  # of central differences, rad, rad/s or rad/s2 (m for rad)
OF_THE_MOTION, BAND = 0.97, 4.0  # share of the velocities' power below a frequency; times that one, the load's band
IN_DOUBT = 0.02  # of a load's RMS: what the model does not know of it
DOUBTS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # times that: over which the step of an abrupt sensor is averaged


def rigid_torque(
    model: RobotModel, q: Float[Leaf, "*batch nv"], v: Float[Leaf, "*batch nv"], a: Float[Leaf, "*batch nv"]
) -> Float[np.ndarray, "*batch nv"]:
    """`inverse_dynamics` in NumPy."""
    return torques_on_host(model, *(np.asarray(x) for x in (q, v, a)))


def links_torque(
    model: RobotModel,
    q: Float[Leaf, "*batch nN nv"],
    v: Float[Leaf, "*batch nN nv"],
    a: Float[Leaf, "*batch nN nv"],
    records: Records,
) -> Float[np.ndarray, "*batch nN nv"]:
    """`rigid_torque` over samples of all recordings, as many of each, with what it is known to carry."""
    torque = rigid_torque(model, q, v, a)
    if records.carried is None:
        return torque
    torque = torque.reshape(*torque.shape[:-2], len(records.carried), -1, torque.shape[-1]).copy()
    bodies = np.unique(records.carried, axis=0)
    for body in bodies[bodies.any((1, 2))]:
        loaded = eqx.tree_at(lambda m: m.inertia, model, model.inertia + body)
        here = (records.carried == body).all((1, 2))
        torque[..., here, :, :] = rigid_torque(loaded, q, v, a).reshape(torque.shape)[..., here, :, :]
    return torque.reshape(np.shape(q))


def shifted(
    effects: Effect,
    motion: Motion,
    records: Records,
    turns: int = TURNS,
    as_read: Float[np.ndarray, "nN nv"] | None = None,
) -> Motion:
    """The true motion of the links for each of a batch of position sensors that have read `motion`.

    A sensor whose error follows the load feels that of the true motion, so q + error(load(q)) = q_measured is solved:
    Newton's steps, with the joint's inertia and stiffness along the motion. Without `turns` the load is that of
    `motion`, right to first order. `as_read` is the links' torque along `motion`, where that is known.

    Position, velocity and acceleration of the answer have a leading axis of effects.
    """
    return _moved(effects, motion, _shifts(effects, motion, records, turns, as_read), records)


def _shifts(
    effects: Effect, motion: Motion, records: Records, turns: int, as_read: Float[np.ndarray, "nN nv"] | None
) -> Float[np.ndarray, "effects nN"]:
    """By how much each sensor's joint stands elsewhere than was read."""
    shift = _errors(effects, motion, records)
    if not turns:
        return shift
    if as_read is None:
        as_read = links_torque(motion.model, motion.position, motion.velocity, motion.acceleration, records)
    compliances, shift = _compliances(effects, motion, records, as_read), np.zeros_like(shift)
    for turn in range(turns):
        if turn:
            loads = _torques(effects, motion, shift, records)
        else:  # the motion as it was read
            loads = np.broadcast_to(as_read, (len(shift), *as_read.shape))
        missing = (_errors(effects, motion, records, loads) - shift).reshape(-1, *records.position.shape[:2])
        change = [own.solve(one) for own, one in zip(compliances, missing, strict=True)]
        shift = shift + np.reshape(change, shift.shape)
    return shift


class _Compliance(NamedTuple):
    """1 + c dload/dq of one sensor along its own joint, c (K q + D v + M a) changing with the motion; diagonals.

    Below, on and above the diagonal, by central differences, sample by sample; the ends of a recording say nothing.
    What the inertia alone would need is damped: nothing at low frequencies, all at the link's resonance, where a motion
    of any size leaves no error.
    """

    whole: Float[np.ndarray, "3 n N"]
    factors: list[np.ndarray]  # Cholesky factor of the damped normal matrix of each recording, as LAPACK keeps it

    @classmethod
    def of(cls, whole: Float[np.ndarray, "3 n N"], inertial: Float[np.ndarray, "3 n N"]) -> _Compliance:
        """`inertial` is the part c M a."""
        from scipy.linalg import cholesky_banded  # slow to import

        square = _square(whole) + _square(inertial)
        square[2] += TINY
        return cls(whole, [cholesky_banded(own, check_finite=False) for own in np.moveaxis(square, 1, 0)])

    def solve(self, missing: Float[np.ndarray, "n N"]) -> Float[np.ndarray, "n N"]:
        """The change of position behind a missing error, by damped least squares."""
        from scipy.linalg import cho_solve_banded  # slow to import

        below, on, above = self.whole
        right = on * missing
        right[:, 1:] += above[:, :-1] * missing[:, :-1]
        right[:, :-1] += below[:, 1:] * missing[:, 1:]
        each = zip(self.factors, right, strict=True)
        return np.stack([cho_solve_banded((factor, False), one, check_finite=False) for factor, one in each])


def _square(diagonals: Float[np.ndarray, "3 n N"]) -> Float[np.ndarray, "3 n N"]:
    """L'L of tridiagonal L, its upper diagonals as `solveh_banded` takes them."""
    below, on, above = diagonals
    square = np.zeros_like(diagonals)
    square[2] = on**2
    square[2, :, 1:] += above[:, :-1] ** 2
    square[2, :, :-1] += below[:, 1:] ** 2
    square[1, :, 1:] = on[:, :-1] * above[:, :-1] + below[:, 1:] * on[:, 1:]
    square[0, :, 2:] = above[:, 1:-1] * below[:, 1:-1]
    return square


def _compliances(
    effects: Effect, motion: Motion, records: Records, load: Float[np.ndarray, "nN nv"]
) -> list[_Compliance]:
    """What a small change of its joint's motion changes of each sensor's reading."""
    more, here = (_errors(effects, changed(motion, load=own), records) for own in (load + 1, load))
    unit = (more - here).mean(1)
    joints = np.asarray(effects.at)[:, 0]
    few, (once, place) = _Few.of(motion, records), np.unique(joints, return_inverse=True)
    slopes = few.slopes(once, lambda q, v, a: links_torque(motion.model, q, v, a, records))
    own = few.between(np.stack([slopes[k, :, :, j] for k, j in enumerate(once)]))[place]  # (sensors, 3, n, N)
    dt, out = float(records.dt), []
    for K, D, M in unit[:, None, None, None] * own:
        inertial = np.stack([M, -2 * M, M]) / dt**2
        whole = inertial + np.stack([-D / (2 * dt), 1 + K, D / (2 * dt)])
        for part, count in ((inertial, 1), (whole, ENDS)):
            part[:, :, :count] = part[:, :, -count:] = 0.0
            for slot, first in records.joins:
                part[:, slot, first - count : first + count] = 0.0
        out.append(_Compliance.of(whole, inertial))
    return out


class _Few(NamedTuple):
    """A motion at every few samples of each recording, for derivatives of its torque that are straight in between.

    The motion is low-passed far below the rate of its samples.
    """

    at: Int[np.ndarray, " few"]
    samples: int
    state: tuple[Float[np.ndarray, "n_few nv"], ...]  # position, velocity and acceleration

    @classmethod
    def of(cls, motion: Motion, records: Records) -> _Few:
        n, samples, _, nv = records.shape
        at = np.append(np.arange(0, samples - 1, EVERY), samples - 1)
        return cls(at, samples, tuple(x.reshape(n, samples, nv)[:, at].reshape(-1, nv) for x in _state(motion)))

    def slopes(
        self, joints: Int[np.ndarray, " joints"], torque: Callable[..., np.ndarray]
    ) -> Float[np.ndarray, "joints 3 n_few nv"]:
        """Derivatives of the torque in position, velocity and acceleration of the joints, by central differences."""
        moved = [np.broadcast_to(x, (len(joints), 3, 2, *x.shape)).copy() for x in self.state]
        for k, joint in enumerate(joints):
            for one in range(3):
                moved[one][k, one, :, :, joint] += np.array([[STEP], [-STEP]])
        high, low = np.moveaxis(torque(*moved).reshape(moved[0].shape), 2, 0)
        return (high - low) / (2 * STEP)

    def between(self, slopes: Float[np.ndarray, "*lead n_few"]) -> Float[np.ndarray, "*lead n N"]:
        """Values at all samples of each recording."""
        slopes = slopes.reshape(*slopes.shape[:-1], -1, len(self.at))
        begin, rise = slopes[..., :-1], np.diff(slopes) / np.diff(self.at)
        out = np.empty((*slopes.shape[:-1], self.samples))
        for k in range(EVERY):  # samples behind those at which the slopes are known
            own = out[..., k:-1:EVERY]
            np.multiply(rise[..., : own.shape[-1]], k, out=own)
            own += begin[..., : own.shape[-1]]
        out[..., -1] = slopes[..., -1]
        return out


def _errors(
    effects: Effect, motion: Motion, records: Records, loads: Float[np.ndarray, "effects nN nv"] | None = None
) -> Float[np.ndarray, "effects nN"]:
    """What each sensor reads beside the truth, under the motion's load or each under its own."""
    out = []
    for one in range(len(effects.at)):
        here = motion if loads is None else changed(motion, load=loads[one])
        effect = jax.tree.map(lambda x, i=one: np.asarray(x)[i], effects)
        out.append(_read_beside(effect, here, records))
    return np.stack(out)


def _read_beside(effect: Effect, motion: Motion, records: Records) -> Float[np.ndarray, " nN"]:
    """What one sensor reads beside the truth along a motion, as much of it as the positions have been let through.

    A play makes the position step, and the inertial torque of that step, which no link feels, would decide on which
    side the load is: an abrupt sensor is given the load in the band of the motion. How well that is known says how
    well the time of a step is: it is averaged over what the load may be.
    """
    # as it is written, on NumPy's arrays; a bound method would be a module of its own
    if not effect.abrupt:
        return np.asarray(type(effect).position_error(effect, motion))
    load = _steady_load(motion, records)
    doubt = IN_DOUBT * np.sqrt(np.mean(load**2, 0))
    each = [type(effect).position_error(effect, changed(motion, load=load + k * doubt)) for k in DOUBTS]
    return _let_through(records, np.mean(each, axis=0), int(effect.at[0]))


_STEADY: list[tuple[Any, Any, Any, np.ndarray]] = []  # the last one: all sensors of a motion share it


def _steady_load(motion: Motion, records: Records) -> Float[np.ndarray, "nN nv"]:
    """The load without what lies above the band of the motion."""
    asked = motion.load, motion.velocity, records
    if not any(all(a is b for a, b in zip(asked, known, strict=False)) for known in _STEADY):
        n, samples, _, nv = records.shape
        velocity = np.asarray(motion.velocity).reshape(n, samples, nv)
        power = (np.abs(np.fft.rfft(velocity, axis=1)) ** 2).sum((0, 2))
        most = int(np.searchsorted(np.cumsum(power), OF_THE_MOTION * power.sum()))
        band = max(BAND * most / (samples * float(records.dt)), 2 / (samples * float(records.dt)))
        load = np.asarray(motion.load)
        steady = load if band >= float(records.cutoff) else _low(records, load, band)
        _STEADY[:] = [(*asked, steady)]
    return _STEADY[0][3]


def _let_through(records: Records, signal: Float[np.ndarray, " nN"], joint: int) -> Float[np.ndarray, " nN"]:
    """What a joint's positions have kept of a part of them: each recording has a band of its own."""
    out, dt, cutoff = signal.reshape(records.shape[:2]).copy(), float(records.dt), float(records.cutoff)
    bands = np.full(len(records.spans), cutoff) if records.bands is None else np.asarray(records.bands)[:, joint]
    for at, band in zip(records.spans, bands, strict=True):
        own = slice(at.sample, at.sample + at.samples)
        out[at.slot, own] = let_through(out[at.slot, own, None], dt, cutoff, np.array([band]))[:, 0]
    return out.reshape(-1)


def _low(records: Records, signal: Float[np.ndarray, "nN cols"], cutoff: float) -> Float[np.ndarray, "nN cols"]:
    """Each recording low-passed as positions are; `cutoff` in Hz."""
    out = signal.reshape(*records.shape[:2], -1).copy()
    for at in records.spans:
        own = slice(at.sample, at.sample + at.samples)
        out[at.slot, own] = low_pass(out[at.slot, own], float(records.dt), cutoff)
    return out.reshape(signal.shape)


def _moved(effects: Effect, motion: Motion, errors: Float[np.ndarray, "effects nN"], records: Records) -> Motion:
    """The motion less each error of the joint of each effect."""
    one, joint = np.arange(len(errors)), np.asarray(effects.at)[:, 0]
    true = []
    for signal, delta in zip(_state(motion), _with_rates(errors, records), strict=True):
        moved = np.repeat(signal[None], len(errors), axis=0)
        moved[one, :, joint] -= delta
        true.append(moved)
    position, velocity, acceleration = true
    return changed(motion, position=position, velocity=velocity, acceleration=acceleration)


def _torques(
    effects: Effect, motion: Motion, errors: Float[np.ndarray, "effects nN"], records: Records
) -> Float[np.ndarray, "effects nN nv"]:
    """The links' torque along the motion less each error (`_moved`), one after another: a joint of it is all that
    changes."""
    moved = q, v, a = [signal.copy() for signal in _state(motion)]
    out, deltas = np.empty((len(errors), *q.shape)), _with_rates(errors, records)
    for one, joint in enumerate(np.asarray(effects.at)[:, 0].tolist()):
        read = [signal[:, joint].copy() for signal in moved]
        for signal, delta in zip(moved, deltas, strict=True):
            signal[:, joint] -= delta[one]
        out[one] = links_torque(motion.model, q, v, a, records)
        for signal, own in zip(moved, read, strict=True):
            signal[:, joint] = own
    return out


def _state(motion: Motion) -> tuple[Float[np.ndarray, "nN nv"], ...]:
    """Position, velocity and acceleration."""
    return tuple(np.asarray(x) for x in (motion.position, motion.velocity, motion.acceleration))


def _with_rates(errors: Float[np.ndarray, "effects nN"], records: Records) -> list[Float[np.ndarray, "effects nN"]]:
    """Errors of the position with those of the velocity and of the acceleration."""
    each = [errors.reshape(-1, *records.position.shape[:2])]
    for _ in range(2):
        each.append(difference(each[-1], float(records.dt)))
    return [one.reshape(len(errors), -1) for one in each]


def difference(signal: Float[np.ndarray, "*n N"], dt: float) -> Float[np.ndarray, "*n N"]:
    """Derivative by five-point central differences; the two ends hold their neighbours'.

    No row uses the ends of a recording (`rowfilter.extension`), so that another one may stand behind it.
    """
    out = np.empty_like(signal)
    inner = 8 * (signal[..., 3:-1] - signal[..., 1:-3]) - (signal[..., 4:] - signal[..., :-4])
    out[..., 2:-2] = inner / (12 * dt)
    out[..., :2], out[..., -2:] = out[..., 2:3], out[..., -3:-2]
    return out


def torque_change(
    effects: Effect,
    motion: Motion,
    records: Records,
    as_read: Float[np.ndarray, "nN nv"] | None = None,
    turns: int = TURNS,
) -> Float[np.ndarray, "effects nN nv"]:
    """Exact torque of a batch of position sensors: of the links' true motion, less that of the motion as it was read.

    (A torque sensor's is left to the row filter, which is exact in frequency.) `as_read` is the latter torque.
    """
    if as_read is None:
        as_read = links_torque(motion.model, motion.position, motion.velocity, motion.acceleration, records)
    out, few = np.empty((len(effects.at), *as_read.shape)), max(1, AT_ONCE // as_read.size)
    for part in (slice(start, start + few) for start in range(0, len(out), few)):
        some = jax.tree.map(lambda x, part=part: np.asarray(x)[part], effects)
        out[part] = _torques(some, motion, _shifts(some, motion, records, turns, as_read), records)
        out[part] -= as_read
    return out


def shift_torques(effects: Effect, motion: Motion, records: Records) -> Float[np.ndarray, "effects k nv nN"]:
    """Torque of a unit of each amplitude of position sensors whose errors are linear in them, to first order.

    With errors e of joint j it is -(K_j e + D_j e' + M_j e''), the derivatives of inverse dynamics in the position, the
    velocity and the acceleration of the joint: the same for all sensors.
    """
    names = effects.amplitudes()
    errors = _unit_errors(effects, motion, records).reshape(len(effects.at), len(names), *records.position.shape[:2])
    rates = difference(errors, float(records.dt))
    pushes = difference(rates, float(records.dt))
    loads = _load_slopes(motion, records)
    out = np.empty((*errors.shape[:2], loads.shape[2], loads.shape[3]))
    for one, joint in enumerate(np.asarray(effects.at)[:, 0].tolist()):
        for unit, parts in zip(out[one], zip(errors[one], rates[one], pushes[one], strict=True), strict=True):
            unit[:] = 0.0
            for slope, part in zip(loads, parts, strict=True):
                unit -= slope[joint] * part.reshape(-1)
    # a joint whose position shows in no torque has columns of rounding alone
    largest = max(loads.max(), -loads.min())
    out[np.maximum(out.max((2, 3)), -out.min((2, 3))) < ROUNDING * largest] = 0.0
    return out


_SLOPES: list[tuple[Any, np.ndarray, np.ndarray]] = []  # the last ones: all sensors of a motion share them


def _load_slopes(motion: Motion, records: Records) -> Float[np.ndarray, "3 nv nv nN"]:
    """Derivatives of the links' torque by position, velocity and acceleration of each joint (second axis).

    The motion alone decides, not what it is known to carry.
    """
    model, inertia = motion.model, np.asarray(motion.model.inertia)
    if not any(position is motion.position and np.array_equal(known, inertia) for position, known, _ in _SLOPES):
        few = _Few.of(motion, records)
        slopes = few.slopes(np.arange(records.shape[3]), lambda q, v, a: rigid_torque(model, q, v, a))
        full = few.between(np.moveaxis(slopes, (1, 3), (0, 2)))  # (3, joint, torque of, n, N)
        _SLOPES[:] = [(motion.position, inertia, full.reshape(*full.shape[:3], -1))]
    return _SLOPES[0][2]


def _unit_errors(effects: Effect, motion: Motion, records: Records) -> Float[np.ndarray, "effects k nN"]:
    """What each sensor reads beside the truth with a unit of each of its amplitudes."""
    names, out = effects.amplitudes(), []
    for one in range(len(effects.at)):
        effect = jax.tree.map(lambda x, i=one: np.asarray(x)[i], effects)
        for unit in np.eye(len(names)):
            units = changed(effect, **dict(zip(names, unit, strict=True)))
            out.append(_read_beside(units, motion, records))
    return np.reshape(out, (len(effects.at), len(names), -1))
