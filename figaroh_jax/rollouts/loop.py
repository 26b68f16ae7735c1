"""The loop that turns a command into a motion: drives, joints with friction and limits, and one step of an integrator.

`Loop` holds every number as an array, with a neutral value where the robot has no such thing (no Stribeck force, no
delay, an infinite limit), so that one compiled program serves all structures and every number can be differentiated.
Samples stand on the last axis: `q` is (nq, samples), `v` (nv, samples), `act` (nu, samples), `u` (nu, samples).

A step follows MuJoCo 4.0 (`mj_step`): smooth torques at the beginning of the step, then dry friction and joint limits
as its soft constraints, solved exactly (`friction`), then the integrator. Equal to MuJoCo C within rounding. With
`law="hard"` friction is the torque that stops the joint within one step, limited to its level, as in BAM.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..effects.base import Effect
from ..rigid.dynamics import joint_masses, joint_torques
from ..rigid.kinematics import ancestors
from ..rigid.manifold import integrate
from ..rigid.model import RobotModel
from ..rigid.spatial import cross, quaternion_rotation, rotate, rotate_back
from . import own
from .friction import Rows, Solution, corrected, inverse, product, row_force, solve_rows, solved, stiffened, times

__all__ = [
    "Activation",
    "Carried",
    "Drives",
    "Integrator",
    "Joints",
    "Linear",
    "Loop",
    "Pairs",
    "State",
    "Step",
    "acts_across",
    "advance",
    "alike",
    "brought_back",
    "turns",
    "integrated",
    "observe",
]

Activation = Literal["none", "integrator", "filter", "filterexact"]
Integrator = Literal["euler", "implicitfast", "rk4", "explicit"]  # explicit: euler whose damping is, too
_TINY = 1e-15  # MuJoCo's mjMINVAL
STIFFEST = 0.9999  # impedance of a soft constraint, beyond which MuJoCo takes none
_HARD = 1e-9  # softness that a hard friction keeps, as a share of the joint's mobility


class Drives(eqx.Module):
    """Actuators: force = clip(gain(l, l') control + bias(l, l')), l = transmission q; torque = transmission' force.

    `gain` and `bias` are MuJoCo's three numbers (constant, of the length, of the rate). `voltage` limits the force
    before the part that follows the rate (back-EMF) is added, `force_range` limits the sum. `scale` multiplies the
    control and the part of the bias that follows the length: what a wrong stiffness of a servo does.
    """

    transmission: Any  # (nu, nv), gear included
    gain: Any  # (nu, 3)
    bias: Any  # (nu, 3)
    scale: Any  # (nu,) 1: as the file says
    command_range: Any  # (nu, 2)
    force_range: Any  # (nu, 2), N m or N at the actuator
    voltage: Any  # (nu,) N m or N
    dead_band: Any  # (nu,) error of the command without a force, rad or m
    delay: Any  # (nu,) s
    time_constant: Any  # (nu,) s, of a filter
    activation_range: Any  # (nu, 2)
    names: tuple[str, ...] = eqx.field(static=True)
    activation: tuple[Activation, ...] = eqx.field(static=True)
    early: tuple[bool, ...] = eqx.field(static=True)  # the force takes the activation of the end of the step
    across: bool = eqx.field(static=True, default=False)  # one acts on joints of several branches (`acts_across`)


class Joints(eqx.Module):
    """What acts at each coordinate beside the rigid body, the drives and gravity; arrays (nv,) unless said."""

    armature: Any  # kg m2
    damping: Any  # N m s/rad
    friction: Any  # N m, level of dry friction
    stribeck_force: Any  # N m, more at rest
    stribeck_speed: Any  # rad/s
    load_ratio: Any  # N m of friction per N m of |drive - external| torque at the gear: both where it holds a weight
    stiffness: Any  # N m/rad
    rest: Any  # rad, of the spring
    play: Any  # rad, of the spring: no torque within
    offset: Any  # N m, constant
    ripple_sine: Any  # N m
    ripple_cosine: Any
    ripple_order: Any  # 1/rad
    friction_rate: Any  # 1/s, b of the soft law
    friction_share: Any  # (1 - d) / d of the soft law
    torque_range: Any  # (nv, 2), N m, of what the drives give together
    limit: Any  # (nv, 2), rad
    limit_margin: Any  # rad
    limit_solref: Any  # (nv, 2)
    limit_solimp: Any  # (nv, 5)
    reading: Any  # rad, what the encoder reads beside the position


class Pairs(eqx.Module):
    """Couplings of two coordinates by a motor that turns with the sum or the difference of both; arrays (pairs,).

    Inertia and damping are what the motion of one does at the other; what they do at its own is the joint's armature
    and damping. The dry friction holds the motor.
    """

    inertia: Any  # kg m2
    damping: Any  # N m s/rad
    friction: Any  # N m
    at: tuple[tuple[int, int, int], ...] = eqx.field(static=True)  # both coordinates, sign of the second

    def rows(self, n: int) -> np.ndarray:
        """How each motor turns with the coordinates, (pairs, n)."""
        found = np.zeros((len(self.at), n))
        for k, (i, j, sign) in enumerate(self.at):
            found[k, i], found[k, j] = 1.0, sign
        return found

    def across(self, size: Any, n: int) -> Array:
        """What `size` (pairs,) of one coordinate's motion is at the other, (n, n)."""
        each = np.zeros((len(self.at), n, n))
        for k, (i, j, sign) in enumerate(self.at):
            each[k, i, j] = each[k, j, i] = sign
        return jnp.einsum("k,kij->ij", jnp.asarray(size), each)


class Carried(eqx.Module):
    """What the rest of a robot does to one joint while the other joints move as they were measured; arrays (samples,).

    The torque of the rigid body at the joint is mass a + bias + slope (q - place). Every coordinate of the loop adds to
    the joint's position: one, or the motor and the twist of a spring behind it.
    """

    mass: Any  # kg m2 (kg), armature not included
    bias: Any  # N m (N): gravity, and all that the other joints' motion needs here
    slope: Any  # N m/rad
    place: Any  # rad (m)
    share: Any  # 1 / mass as seen by soft constraints, over that of the joint alone: the others may give way
    payload: Any  # (links,) kg, added to each link of the arm


class Linear(eqx.Module):
    """The rigid body's torques to first order about known samples, at three accelerations: 0 and two of a step.

    What a parameter of the rigid body adds stands in `more`, whose value is 0: so the many directions of a derivative
    share one differentiation of the rigid body.
    """

    q: Any  # (nv, samples)
    v: Any
    a: Any  # (3, nv, samples)
    torque: Any  # (3, nv, samples), armature not included
    by_q: Any  # (3, nv, nv, samples)
    by_v: Any  # (nv, nv, samples), at every acceleration the same
    mass: Any  # (nv, nv, samples)
    more: Any  # (3, nv, samples)

    def at(self, k: int, q: Array, v: Array) -> Array:
        """Torque (nv, samples) at the acceleration `k`."""
        return self.torque[k] + times(self.by_q[k], q - self.q) + times(self.by_v, v - self.v) + self.more[k]


class Loop(eqx.Module):
    """A robot, its drives and what acts at its joints, in steps of `dt` seconds."""

    robot: RobotModel
    drives: Drives
    joints: Joints
    start: Any  # (nq,) the configuration at which the softness of the constraints is set (MuJoCo's qpos0)
    dt: Any  # s
    integrator: Integrator = eqx.field(static=True)
    law: Literal["soft", "hard"] = eqx.field(static=True)
    limited: bool = eqx.field(static=True)  # whether any joint limit acts
    measured: tuple[int, ...] = eqx.field(static=True)  # coordinates that the encoders read
    carried: Carried | None = None  # in place of the robot's rigid body
    linear: Linear | None = None  # in place of the robot's rigid body, for derivatives
    pairs: Pairs | None = None
    effects: tuple[Effect, ...] = ()  # that act by their own torque beside the joints' numbers (`own`)

    def __repr__(self) -> str:
        drives, more = ", ".join(self.drives.names) or "none", "".join(f"\n  {effect}" for effect in self.effects)
        scheme = f"steps of {self.dt} s ({self.integrator}), {self.law} friction"
        return f"Loop of {self.robot}; drives: {drives}; {scheme}{more}"

    def with_effects(self, *effects: Effect) -> Loop:
        """The loop with these effects in place of those it had: yours, or any of the catalogue with a `torque`.

        What has no sign of the velocity acts from the beginning of each step on; dry friction holds the joint.

        >>> import figaroh_jax as fj
        >>> loop, _ = fj.load_loop(fj.DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}}, joints=["elbow"])
        >>> ripple = fj.place(fj.CATALOGUE["torque_ripple"], loop.robot, ["elbow"], sine=0.2, order=6.0)
        >>> loop.with_effects(ripple).effects[0].name
        'torque_ripple'
        """
        return dataclasses.replace(self, effects=own.placed(self.robot, effects))

    @property
    def columns(self) -> np.ndarray:
        """Column of q of each coordinate, -1 where no one number tells it."""
        found = np.full(self.robot.nv, -1)
        for joint, at in zip(self.robot.joints, self.robot.dofs.positions, strict=True):
            if joint.kind in ("revolute", "prismatic") and not joint.follows:
                found[joint.coordinate] = at.start
        return found


def turns(loop: Loop) -> np.ndarray:
    """Whether each coordinate turns, (nv,)."""
    return loop.robot.dofs.turns[np.argsort(loop.robot.dofs.column)]


def brought_back(loop: Loop) -> np.ndarray:
    """Which joints a drive brings back to their command, (nv,): others leave any motion."""
    back = (np.asarray(loop.drives.transmission) != 0) & (np.asarray(loop.drives.bias)[:, [1]] < 0)
    return back.any(0)


def alike(loop: Loop, *, slides: bool = False) -> np.ndarray:
    """Which of the measured joints one number counts, (measured,): those that turn, or that slide.

    All where no joint is of that kind: a number of rad and m together is neither.
    """
    turning = turns(loop)[list(loop.measured)]
    wanted = ~turning if slides else turning
    return wanted if wanted.any() else np.ones(len(turning), bool)


class State(NamedTuple):
    """Where the robot is; the samples on the last axis."""

    q: Array
    v: Array
    act: Array  # activations of the drives, then the states of effects that have one


class Step(NamedTuple):
    """What solving a step found, accelerations and acting constraints: enough to differentiate it without a search."""

    solution: Solution  # of the constraints (rk4: stacked over four stages)
    a: Array  # (nv, samples) of the integrator


def mobility(loop: Loop) -> Array:
    """Diagonal of the inverse inertia at the start (MuJoCo's dof_invweight0), (nv, 1); mean over ball and free axes.

    Behind it that of each pair's motor (tendon_invweight0).
    """
    matrix = _masses(loop, jnp.asarray(loop.start, jnp.float64)[:, None])[..., 0]
    n = loop.robot.nv
    whole = solved(matrix[..., None] * jnp.ones(n), jnp.eye(n)) if n < 3 else jnp.linalg.inv(matrix)
    diagonal = jnp.diagonal(whole)
    if loop.carried is not None:
        return (loop.carried.share * diagonal)[:, None]
    for joint in loop.robot.joints:
        at = slice(joint.coordinate, joint.coordinate + 3)
        parts = {"free": (at, slice(at.stop, at.stop + 3)), "spherical": (at,)}.get(joint.kind, ())
        for part in parts:
            diagonal = diagonal.at[part].set(diagonal[part].mean())
    if loop.pairs is not None:
        rows = loop.pairs.rows(n)
        diagonal = jnp.concatenate([diagonal, jnp.einsum("ki,ij,kj->k", rows, whole, rows)])
    return diagonal[:, None]


def _angles(loop: Loop, q: Array) -> Array:
    columns = loop.columns
    if np.array_equal(columns, np.arange(len(q))):
        return q
    return jnp.where((columns < 0)[:, None], 0.0, q[columns])


def _control(loop: Loop, act: Array, u: Array) -> tuple[Array, Array]:
    """What the gains multiply, and the rate of the activation."""
    drives = loop.drives
    low, high = (jnp.asarray(drives.command_range)[:, k, None] for k in (0, 1))
    u = jnp.clip(u, low, high)
    rate = jnp.zeros_like(u)
    if all(kind == "none" for kind in drives.activation):
        return u, rate
    time = jnp.maximum(jnp.asarray(drives.time_constant)[:, None], _TINY)
    kinds = np.array(drives.activation)[:, None]
    rate = jnp.where(kinds == "integrator", u, jnp.where(kinds == "none", 0.0, (u - act) / time))
    early = np.array(drives.early)[:, None]
    state = jnp.where(early, _next_activation(loop, act, rate), act)
    return jnp.where(kinds == "none", u, state), rate


def _next_activation(loop: Loop, act: Array, rate: Array) -> Array:
    drives = loop.drives
    if all(kind == "none" for kind in drives.activation):
        return act
    time = jnp.maximum(jnp.asarray(drives.time_constant)[:, None], _TINY)
    exact = np.array(drives.activation)[:, None] == "filterexact"
    step = jnp.where(exact, time * (1 - jnp.exp(-loop.dt / time)), loop.dt)
    low, high = (jnp.asarray(drives.activation_range)[:, k, None] for k in (0, 1))
    return jnp.clip(act + step * rate, low, high)


class _Drive(NamedTuple):
    torque: Array  # (nv, samples) of all drives
    slope: Array  # (nu, samples) of each force by its rate, as the implicit step takes it: not where it is limited


def _drive(loop: Loop, angle: Array, v: Array, control: Array) -> _Drive:
    drives = loop.drives
    way = jnp.asarray(drives.transmission)
    length, rate = times(way[..., None], angle), times(way[..., None], v)
    gain, bias = (jnp.asarray(x)[..., None] for x in (drives.gain, drives.bias))
    scale = jnp.asarray(drives.scale)[:, None]
    force = bias[:, 0] + scale * ((gain[:, 0] + gain[:, 1] * length) * control + bias[:, 1] * length)
    idle = jnp.abs(gain[:, 0]) * scale * jnp.asarray(drives.dead_band)[:, None]
    force = force - jnp.clip(force, -idle, idle)
    volt = jnp.asarray(drives.voltage)[:, None]
    slope = bias[:, 2] + gain[:, 2] * control
    force = jnp.clip(force, -volt, volt) + slope * rate
    low, high = (jnp.asarray(drives.force_range)[:, k, None] for k in (0, 1))
    torque = times(way.T[..., None], jnp.clip(force, low, high))
    least, most = (jnp.asarray(loop.joints.torque_range)[:, k, None] for k in (0, 1))
    on = way != 0  # MuJoCo asks the joint of a drive, not those of a tendon
    alone = on & (on.sum(1, keepdims=True) == 1)
    held = (alone[..., None] & ((torque < least) | (torque > most))).any(1)
    free = (force > low) & (force < high) & ~held
    return _Drive(jnp.clip(torque, least, most), jnp.where(free, slope, 0.0))


def _passive(loop: Loop, angle: Array, v: Array) -> Array:
    j = {name: jnp.asarray(getattr(loop.joints, name))[:, None] for name in _PASSIVE}
    stretch = angle - j["rest"]
    stretch = stretch - jnp.clip(stretch, -j["play"] / 2, j["play"] / 2)
    turn = j["ripple_order"] * angle
    ripple = j["ripple_sine"] * jnp.sin(turn) + j["ripple_cosine"] * jnp.cos(turn)
    if loop.pairs is not None:
        ripple = ripple + times(loop.pairs.across(loop.pairs.damping, len(v))[..., None], v)
    return -(j["damping"] * v + j["stiffness"] * stretch + j["offset"] + ripple)


_PASSIVE = ("damping", "stiffness", "rest", "play", "offset", "ripple_order", "ripple_sine", "ripple_cosine")


class _Smooth(NamedTuple):
    """Everything at the beginning of a step but the constraints."""

    torque: Array  # (nv, samples) of drives and passive elements
    bias: Array  # gravity and velocity torques of the rigid body
    slope: Array  # (nu, samples) of each drive's force by its rate, as implicitfast takes it; else zero
    activation: Array  # at the end of the step
    rows: Rows
    shift: Array  # what turns accelerations of free joints into those of MuJoCo's axes
    rate: Array  # of the activation


def _smooth(loop: Loop, state: State, u: Array, weight: Array) -> _Smooth:
    q, v, act = state
    angle = _angles(loop, q)
    act, memory = jnp.split(act, [len(u)])
    control, rate = _control(loop, act, u)
    drive = _drive(loop, angle, v, control)
    bias = _bias(loop, q, v)
    slope = drive.slope if loop.integrator == "implicitfast" else jnp.zeros_like(drive.slope)
    torque = drive.torque + _passive(loop, angle, v)
    level = jnp.zeros_like(v)
    if loop.effects:
        more = own.acting(loop.effects, loop.robot, q, v, bias, drive.torque, memory)
        torque, level = torque - more.torque, more.level
    rows = _rows(loop, angle, v, drive.torque, bias, weight, level)
    rate, shift = jnp.concatenate([rate, jnp.zeros_like(memory)]), _shift(loop, v)
    torque = torque - jnp.asarray(loop.joints.armature)[:, None] * shift  # a free joint's acts in MuJoCo's axes
    return _Smooth(torque, bias, slope, _next_activation(loop, act, rate[: len(u)]), rows, shift, rate)


def _resistance(loop: Loop, slope: Array) -> Array:
    """Minus the torque's derivative by v as the integrator takes it, (nv, nv, samples): joints' damping and drives."""
    if loop.integrator == "explicit":
        return jnp.zeros((loop.robot.nv, loop.robot.nv, slope.shape[1]))
    damping = jnp.eye(loop.robot.nv)[..., None] * jnp.asarray(loop.joints.damping)[:, None, None]
    way = jnp.asarray(loop.drives.transmission)
    pairs = way[:, :, None, None] * way[:, None, :, None]
    if loop.drives.across:
        pairs = pairs * _together(loop.robot)[..., None]
    if loop.pairs is not None:
        damping = damping + loop.pairs.across(loop.pairs.damping, loop.robot.nv)[..., None]
    return damping - (pairs * slope[:, None, None]).sum(0)


def _resisted(loop: Loop, slope: Array, a: Array) -> Array:
    """`_resistance` times an acceleration, without the matrix: its derivatives are vectors then."""
    if loop.integrator == "explicit":
        return jnp.zeros_like(a)
    way = jnp.asarray(loop.drives.transmission)
    rate = times(way[..., None], a)
    own = jnp.asarray(loop.joints.damping)[:, None] * a
    if loop.pairs is not None:
        own = own + times(loop.pairs.across(loop.pairs.damping, len(a))[..., None], a)
    if loop.drives.across:
        share = jnp.einsum("ij,kjs->kis", _together(loop.robot), way[..., None] * a)
        return own - (way[..., None] * slope[:, None] * share).sum(0)
    return own - times(way.T[..., None], slope * rate)


def acts_across(robot: RobotModel, transmission: np.ndarray) -> bool:
    """Whether a drive acts on coordinates of which neither carries the other, as one of two fingers does.

    MuJoCo's implicit step takes what such a drive does at one of them by the speed of the other explicitly.
    """
    on = np.asarray(transmission) != 0
    return bool((on[:, :, None] & on[:, None, :] & ~_together(robot).astype(bool)).any())


def _together(robot: RobotModel) -> np.ndarray:
    """1 where one of two coordinates moves what the other one is on, (nv, nv): the places of the inertia matrix."""
    over, dofs, found = ancestors(robot.joints), robot.dofs, np.zeros((robot.nv, robot.nv))
    np.maximum.at(found, np.ix_(dofs.column, dofs.column), (over + over.T > 0)[np.ix_(dofs.joint, dofs.joint)])
    return found


def _rows(loop: Loop, angle: Array, v: Array, motor: Array, bias: Array, weight: Array, more: Array) -> Rows:
    """Dry friction (`more` of it by effects) and limits of each coordinate, as soft constraints of its acceleration."""
    j, weight, motors = loop.joints, weight[: len(v)], weight[len(v) :]
    peak, speed, ratio = (jnp.asarray(x)[:, None] for x in (j.stribeck_force, j.stribeck_speed, j.load_ratio))
    level = jnp.asarray(j.friction)[:, None] + peak * jnp.exp(-((v / speed) ** 2)) + ratio * jnp.abs(motor + bias)
    level = jnp.maximum(level + more, 0.0)
    if loop.law == "hard":
        pull, soft = -v / loop.dt, _HARD * weight * jnp.ones_like(v)
    else:
        pull = -jnp.asarray(j.friction_rate)[:, None] * v
        soft = jnp.asarray(j.friction_share)[:, None] * weight * jnp.ones_like(v)
    if not loop.limited:
        far, one = jnp.full_like(v, -jnp.inf), jnp.ones_like(v)
        return _with_pairs(loop, Rows(level, pull, soft, far, one, far, one), v, motors)
    below, above = (jnp.asarray(j.limit)[:, k, None] for k in (0, 1))
    low = _limit(loop, angle - below, v, weight)
    high = _limit(loop, above - angle, -v, weight)
    return _with_pairs(loop, Rows(level, pull, soft, *low, *high), v, motors)


def _with_pairs(loop: Loop, rows: Rows, v: Array, weight: Array) -> Rows:
    """With the dry friction of the motors that turn with two coordinates."""
    if loop.pairs is None:
        return rows
    way, j = jnp.asarray(loop.pairs.rows(len(v))), loop.joints
    first, rate = np.array([at[0] for at in loop.pairs.at], int), times(way[..., None], v)
    level = jnp.maximum(jnp.asarray(loop.pairs.friction), 0.0)[:, None] * jnp.ones_like(rate)
    pull, share = -rate / loop.dt, _HARD
    if loop.law != "hard":
        pull, share = -jnp.asarray(j.friction_rate)[first, None] * rate, jnp.asarray(j.friction_share)[first, None]
    far, one = jnp.full_like(rate, -jnp.inf), jnp.ones_like(rate)
    more = (level, pull, share * weight * one, far, one, far, one)
    parts = [jnp.concatenate(both) for both in zip(rows[:7], more, strict=True)]
    return Rows(*parts[:7], way=way)  # pyright: ignore[reportArgumentType]


def _limit(loop: Loop, distance: Array, rate: Array, weight: Array) -> tuple[Array, Array]:
    """Pull (acceleration asked for) and softness of one side's limits; -inf pull where the limit is far."""
    j = loop.joints
    margin = jnp.asarray(j.limit_margin)[:, None]
    time, ratio = (jnp.asarray(j.limit_solref)[:, k, None] for k in (0, 1))
    lowest, highest, width, middle, power = (jnp.asarray(j.limit_solimp)[:, k, None] for k in range(5))
    near = distance < margin
    depth = jnp.where(near, distance - margin, 0.0)
    x = jnp.clip(jnp.abs(depth) / width, 0.0, 1.0)
    inner = jnp.where(x <= middle, x, 0.0)
    outer = jnp.where(x > middle, 1 - x, 0.0)
    curve = jnp.where(x <= middle, inner**power / middle ** (power - 1), 1 - outer**power / (1 - middle) ** (power - 1))
    impedance = lowest + jnp.where(power == 1, x, curve) * (highest - lowest)
    direct = time <= 0
    safe = jnp.maximum(time, 2 * loop.dt)
    stiff = jnp.where(direct, -time / highest**2, 1.0 / (highest * safe * jnp.where(direct, 1.0, ratio)) ** 2)
    damp = jnp.where(direct, -ratio / highest, 2.0 / (highest * safe))
    pull = -damp * rate - stiff * impedance * depth
    return jnp.where(near, pull, -jnp.inf), (1 - impedance) / impedance * weight


def _shift(loop: Loop, v: Array) -> Array:
    """w x v at free joints: our linear rates are in the turning axes, MuJoCo's in the world's."""
    shift = jnp.zeros_like(v)
    for joint in loop.robot.joints:
        if joint.kind == "free":
            k = joint.coordinate
            shift = shift.at[k : k + 3].set(cross(v[k + 3 : k + 6], v[k : k + 3]))
    return shift


def _bias(loop: Loop, q: Array, v: Array) -> Array:
    """Gravity and velocity torques of the rigid body."""
    if loop.linear is not None:
        return loop.linear.at(0, q, v)
    if loop.carried is None:
        return joint_torques(loop.robot, q, v, jnp.zeros_like(v))
    one = loop.carried
    return jnp.broadcast_to(one.bias + one.slope * (q.sum(0) - one.place), q.shape)


def _masses(loop: Loop, q: Array) -> Array:
    armature = jnp.eye(loop.robot.nv)[..., None] * jnp.asarray(loop.joints.armature)[:, None, None]
    if loop.pairs is not None:
        armature = armature + loop.pairs.across(loop.pairs.inertia, loop.robot.nv)[..., None]
    if loop.linear is not None:
        return loop.linear.mass + armature
    if loop.carried is None:
        return joint_masses(loop.robot, q) + armature
    return jnp.broadcast_to(loop.carried.mass, q.shape[1:]) + jnp.broadcast_to(
        armature, (*armature.shape[:2], q.shape[1])
    )


def _accelerate(loop: Loop, state: State, u: Array, weight: Array, warm: Array) -> tuple[_Smooth, Array, Solution]:
    smooth = _smooth(loop, state, u, weight)
    masses = _masses(loop, state.q)
    return smooth, masses, solve_rows(masses, smooth.torque - smooth.bias, smooth.rows, warm)


def advance(loop: Loop, state: State, u: Array, weight: Array, warm: Array) -> tuple[State, Step]:
    """One step: the state after it, and what `integrated` needs to compute it again and differentiate it.

    `weight` is `mobility(loop)`, `warm` the acceleration of the step before (any guess will do).
    """
    if loop.integrator == "rk4":
        return _runge_kutta(loop, state, u, weight, warm, None)
    smooth, masses, solution = _accelerate(loop, state, u, weight, warm)
    force = times(masses, solution.a + smooth.shift)
    a = solved(masses + loop.dt * _resistance(loop, smooth.slope), force)
    return _moved(loop, state, a, smooth.activation), Step(solution, a)


def integrated(loop: Loop, state: State, u: Array, weight: Array, step: Step) -> State:
    """The state after a step that `advance` has solved, differentiable in everything (forward and reverse mode).

    The constraints that act are those of the solution; one Newton step from it, exact already, carries the derivatives.
    """
    if loop.integrator == "rk4":
        return _runge_kutta(loop, state, u, weight, step.a, step)[0]
    smooth = _smooth(loop, state, u, weight)
    found, whole = jax.lax.stop_gradient((step.solution, step.a))
    masses = jax.lax.stop_gradient(_masses(loop, state.q))
    implicit = inverse(masses + loop.dt * jax.lax.stop_gradient(_resistance(loop, smooth.slope)))
    first, second = _inertial(loop, state, smooth.bias, found.a, whole - smooth.shift)
    off = first + smooth.bias - smooth.torque - row_force(smooth.rows, found, found.a)
    gap = second + loop.dt * _resisted(loop, smooth.slope, whole) - first
    through = product(product(implicit, masses), stiffened(masses, smooth.rows, found))
    a = whole - times(implicit, gap) - times(through, off)
    return _moved(loop, state, a, smooth.activation)


def _inertial(loop: Loop, state: State, bias: Array, *accelerations: Array) -> list[Array]:
    """M a of the rigid body with armature for each of the accelerations, by one inverse dynamics of all of them."""
    own = jnp.asarray(loop.joints.armature)[:, None]
    across = None if loop.pairs is None else loop.pairs.across(loop.pairs.inertia, loop.robot.nv)[..., None]

    def rotors(a: Array) -> Array:
        return own * a if across is None else own * a + times(across, a)

    if (one := loop.linear) is not None:
        torques = [one.at(k, state.q, state.v) + times(one.mass, a - one.a[k]) for k, a in enumerate(accelerations, 1)]
        return [torque + rotors(a) - bias for torque, a in zip(torques, accelerations, strict=True)]
    if loop.carried is not None:
        return [loop.carried.mass * a.sum(0) + rotors(a) for a in accelerations]
    count = len(accelerations)
    a = jnp.concatenate(accelerations, 1)
    q, v = (jnp.concatenate([x] * count, 1) for x in (state.q, state.v))
    torque = joint_torques(loop.robot, q, v, a) + rotors(a)
    return [part - bias for part in jnp.split(torque, count, axis=1)]


def _moved(loop: Loop, state: State, a: Array, activation: Array) -> State:
    """Semi-implicit: the new velocity carries the position; `a` is in MuJoCo's axes at free joints."""
    v = _turned(loop, state.q, state.v + loop.dt * a, rotate)
    q = _stepped(loop, state.q, loop.dt * v)
    v = _turned(loop, q, v, rotate_back)
    return State(q, v, _remembered(loop, state, v, activation))


def _turned(loop: Loop, q: Array, v: Array, turn: Any) -> Array:
    """Linear rates of free joints from their own axes to the world's, where MuJoCo has them (`rotate`), or back."""
    for joint, at in zip(loop.robot.joints, loop.robot.dofs.positions, strict=True):
        if joint.kind == "free":
            k = joint.coordinate
            v = v.at[k : k + 3].set(turn(quaternion_rotation(q[at.start + 3 : at.stop]), v[k : k + 3]))
    return v


def _stepped(loop: Loop, q: Array, step: Array) -> Array:
    """The position after a step, whose linear part at free joints is along the world's axes."""
    if loop.robot.nq == loop.robot.nv:
        return q + step
    own, world = step, jnp.zeros_like(q)
    for joint, at in zip(loop.robot.joints, loop.robot.dofs.positions, strict=True):
        if joint.kind == "free":
            k = joint.coordinate
            own, world = own.at[k : k + 3].set(0.0), world.at[at.start : at.start + 3].set(step[k : k + 3])
    return integrate(loop.robot, q.T, own.T).T + world


def _remembered(loop: Loop, state: State, v: Array, activation: Array) -> Array:
    """Activations at the end of a step, and behind them the states of effects."""
    if not loop.effects:
        return activation
    memory = state.act[len(loop.drives.names) :]
    return jnp.concatenate([activation, own.after(loop.effects, memory, v, loop.dt)])


def _runge_kutta(
    loop: Loop, state: State, u: Array, weight: Array, warm: Array, step: Step | None
) -> tuple[State, Step]:
    """The classical scheme of fourth order, the constraints solved at each stage."""
    shares, solutions, rates, now = (0.0, 0.5, 0.5, 1.0), [], [], state
    start = _turned(loop, state.q, state.v, rotate)  # stages add up in MuJoCo's axes
    for k, share in enumerate(shares):
        if k:
            now = _stage(loop, state, start, rates[-1], share)
        smooth = _smooth(loop, now, u, weight)
        if step is None:
            solution = solve_rows(_masses(loop, now.q), smooth.torque - smooth.bias, smooth.rows, warm)
            a = warm = solution.a
        else:
            solution = jax.lax.stop_gradient(jax.tree.map(lambda x, k=k: x[k], step.solution))
            masses = jax.lax.stop_gradient(_masses(loop, now.q))
            (first,) = _inertial(loop, now, smooth.bias, solution.a)
            a = corrected(masses, smooth.rows, solution, first + smooth.bias - smooth.torque)
        solutions.append(solution)
        speed, change = (_turned(loop, now.q, x, rotate) for x in (now.v, a + smooth.shift))
        way = share * loop.dt * rates[-1].q if k else jnp.zeros_like(speed)
        rates.append(State(_along(loop, way, speed), change, smooth.rate))
    weights = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
    mean = jax.tree.map(lambda *parts: sum(w * r for w, r in zip(weights, parts, strict=True)), *rates)
    after, drives = _stage(loop, state, start, mean, 1.0), len(loop.drives.names)
    active = _next_activation(loop, state.act[:drives], mean.act[:drives])
    after = State(after.q, after.v, _remembered(loop, state, after.v, active))
    return after, Step(jax.tree.map(lambda *x: jnp.stack(x), *solutions), solutions[-1].a)


def _along(loop: Loop, way: Array, speed: Array) -> Array:
    """How fast the logarithm of a turn grows where it is `way`: the spin w itself at zero (Munthe-Kaas 1999).

    w + s x w / 2 + g s x (s x w) with g = (1 - |s|/2 cot(|s|/2)) / |s|^2, by its series.
    """
    for joint in loop.robot.joints:
        if joint.kind in ("spherical", "free"):
            at = slice(joint.coordinate + 3 * (joint.kind == "free"), joint.coordinate + 3 * (joint.kind == "free") + 3)
            turn, spin = way[at], speed[at]
            x, once = (turn**2).sum(0), cross(turn, spin)
            g = 1 / 12 + x * (1 / 720 + x * (1 / 30240 + x * (1 / 1209600 + x / 47900160)))
            speed = speed.at[at].set(spin + once / 2 + g * cross(turn, once))
    return speed


def _stage(loop: Loop, state: State, start: Array, rate: State, share: float) -> State:
    """The state after a share of a step at this rate; `start` is its velocity in MuJoCo's axes."""
    q, v, act = (share * loop.dt * r for r in rate)
    q = _stepped(loop, state.q, q)
    return State(q, _turned(loop, q, start + v, rotate_back), state.act + act)


def observe(loop: Loop, state: State) -> Array:
    """What the encoders read, (measured, samples), rad or m."""
    measured = np.array(loop.measured)
    return _angles(loop, state.q)[measured] + jnp.asarray(loop.joints.reading)[measured, None]
