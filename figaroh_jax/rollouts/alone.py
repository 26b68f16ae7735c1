"""One joint of an arm at a time, the other joints moving as they were measured.

Encoders tell the motion of every joint, so what the others do to one joint is known up to their noise: a mass and a
torque that follow the time (`loop.Carried`). Each joint is then a loop of one coordinate, a hundred times cheaper than
the arm, and a wrong model of one joint does not reach the fits of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..compiled.batching import program
from ..effects.base import Place
from ..rigid.dynamics import joint_masses, joint_torques
from ..rigid.model import Joint, RobotModel
from .data import Run, regular
from .loop import Carried, Loop
from .parameters import unit_payload

__all__ = ["alone", "carried_by", "inseparable", "motion", "separable"]

_SPAN, _ORDER = 0.06, 3  # s over which, and degree of the polynomial by which, motions are differentiated
_STEP = 1e-4  # rad or m, of the central difference that tells gravity's slope
_SAMPLES = 1024  # one program takes so many


def separable(loop: Loop) -> bool:
    """Whether each drive acts at one joint, and every joint turns or slides and is measured."""
    return loop.robot.nv > 1 and not inseparable(loop)


def inseparable(loop: Loop) -> str:
    """Why the joints of an arm cannot be taken one by one, and what would let them; empty where they can."""
    way, robot = np.asarray(loop.drives.transmission), loop.robot
    for j in robot.joints:
        if j.follows:
            leader = robot.dof_names[j.coordinate]
            return f"'{j.name}' follows '{leader}'; leave '{leader}' out of robot.joints where it does not matter"
        if j.kind not in ("revolute", "prismatic"):
            return f"'{j.name}' has several axes; hold it (root: fixed) where it does not move"
    if sorted(loop.measured) != list(range(robot.nv)):
        return "not every joint is measured"
    several = [name for name, row in zip(loop.drives.names, way, strict=True) if (row != 0).sum() != 1]
    return f"drive '{several[0]}' does not act at one joint" if several else ""


def alone(loop: Loop, runs: Sequence[Run], carried: Sequence[np.ndarray], joint: int) -> tuple[Loop, tuple[Run, ...]]:
    """The loop of one coordinate of an arm, and its recordings; `carried` of `carried_by`."""
    way = np.asarray(loop.drives.transmission)
    drives = np.flatnonzero(way[:, joint])
    kept = {name: np.asarray(getattr(loop.drives, name))[drives] for name in _DRIVES}
    own = eqx.tree_at(
        lambda d: [*(getattr(d, name) for name in kept), d.transmission],
        loop.drives,
        [*kept.values(), way[drives][:, [joint]]],
    )
    tuples = {name: tuple(getattr(own, name)[k] for k in drives) for name in ("activation", "early")}
    tuples["names"] = tuple(f"drive {k}" for k in range(len(drives)))  # without names of its own all share a program
    own = type(own)(**{name: getattr(own, name) for name in (*kept, "transmission")}, **tuples)
    joints = jax.tree.map(lambda x: np.asarray(x)[joint : joint + 1], loop.joints)
    masses = _masses_at(loop)
    whole = masses + np.diag(np.asarray(loop.joints.armature))
    one = Carried(
        mass=masses[joint, joint][None],
        bias=np.zeros(1),
        slope=np.zeros(1),
        place=np.zeros(1),
        share=np.linalg.inv(whole)[joint, joint] * whole[joint, joint],
        payload=np.zeros(len(loop.robot.joints)),
    )
    column = int(np.flatnonzero(np.array(loop.measured) == joint)[0])
    small = Loop(
        robot=_one_joint(loop.robot, joint), drives=own, joints=joints, start=np.asarray(loop.start)[[joint]],
        dt=loop.dt, integrator=loop.integrator, law=loop.law,
        limited=loop.limited, measured=(0,), carried=one,
        effects=tuple(replace(e, at=Place((0,))) for e in loop.effects if tuple(e.places.tolist()) == (joint,)),
    )  # fmt: skip
    mine = tuple(
        run._replace(
            command=run.command[:, drives],
            position=run.position[:, [column]],
            velocity=None if run.velocity is None else run.velocity[:, [column]],
            trusted=run.trusted if run.trusted is None or run.trusted.ndim == 1 else run.trusted[:, [column]],
            carried=load[:, joint],
        )
        for run, load in zip(runs, carried, strict=True)
    )
    return small, mine


_DRIVES = ("gain", "bias", "scale", "command_range", "force_range", "voltage", "dead_band", "delay", "time_constant",
           "activation_range")  # fmt: skip


def _one_joint(robot: RobotModel, joint: int) -> RobotModel:
    """A robot of that joint alone: its rigid body is what the joint carries."""
    tree = next(i for i, one in enumerate(robot.joints) if one.coordinate == joint and not one.follows)
    mine = robot.joints[tree]
    dof = int(np.flatnonzero(robot.dofs.joint == tree)[0])
    return RobotModel(
        placement=np.eye(4)[None],
        axis=np.asarray(robot.axis)[[dof]],
        inertia=np.zeros((1, 10)),
        ratio=np.ones(1),
        offset=np.zeros(1),
        gravity=np.asarray(robot.gravity),
        frame_placement=np.zeros((0, 4, 4)),
        position_limit=np.asarray(robot.position_limit)[[joint]],
        velocity_limit=np.asarray(robot.velocity_limit)[[joint]],
        effort_limit=np.asarray(robot.effort_limit)[[joint]],
        joints=(Joint("joint", mine.kind, -1, 0, "link"),),
        frames=(),
        name="joint",
    )


def _masses_at(loop: Loop) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(_masses(loop.robot, np.asarray(loop.start, float)[:, None]))[..., 0]


def carried_by(loop: Loop, runs: Sequence[Run]) -> list[np.ndarray]:
    """What each joint carries from each row of each recording to the next, (rows, nv, 4 + 3 links).

    Mass, bias, slope and place as in `loop.Carried`; then what a kilogram at each link's centre of mass adds to mass,
    bias and slope.
    """
    return [_carried(loop, run) for run in runs]


def _carried(loop: Loop, run: Run) -> np.ndarray:
    n, links = loop.robot.nv, len(loop.robot.joints)
    q, v, a = motion(loop, run)
    found = np.zeros((len(q), n, 4 + 3 * links))
    with jax.enable_x64(True):
        units = np.asarray(unit_payload(loop, np.arange(links)))
        bodies = [np.asarray(loop.robot.inertia), *(np.eye(links)[k][:, None] * units[k] for k in range(links))]
        for first in range(0, len(q), _SAMPLES):
            part = np.clip(np.arange(first, first + _SAMPLES), 0, len(q) - 1)
            for k, body in enumerate(bodies):
                robot = eqx.tree_at(lambda r: r.inertia, loop.robot, body)
                load = np.moveaxis(np.asarray(_loads(robot, q[part].T, v[part].T, a[part].T)), -1, 0)
                at = slice(0, 3) if k == 0 else slice(1 + 3 * k, 4 + 3 * k)
                found[first : first + _SAMPLES, :, at] = load[: len(q) - first]
    found[..., 3] = q
    return found


def motion(loop: Loop, run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration of every joint between each row and the next, (rows, nv) each."""
    from scipy.signal import savgol_filter  # its distributions are slow to import

    n, places = loop.robot.nv, np.array(loop.measured)
    period = regular(run.name, run.time)
    rows = min(max(5, round(_SPAN / period) // 2 * 2 + 1), (len(run.time) - 1) // 2 * 2 + 1)
    position = np.zeros((len(run.time), n))
    position[:, places] = run.position - np.asarray(loop.joints.reading)[places]
    middle = lambda x: np.concatenate([(x[1:] + x[:-1]) / 2, x[-1:]])  # noqa: E731
    q, v, a = (middle(savgol_filter(position, rows, min(_ORDER, rows - 1), k, period, axis=0)) for k in range(3))
    return q, v, a


def _load_rows(robot: RobotModel, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """(nv, 3, samples): mass, bias and slope of each joint."""
    n, count = q.shape
    masses = joint_masses(robot, q)
    own = jnp.diagonal(masses).T
    moves = jnp.repeat(_STEP * jnp.concatenate([jnp.eye(n), -jnp.eye(n)], 1), count, axis=1)
    still = jnp.zeros((n, 2 * n * count))
    near = jnp.concatenate([q, jnp.tile(q, (1, 2 * n)) + moves], 1)
    torque = joint_torques(robot, near, jnp.concatenate([v, still], 1), jnp.concatenate([a, still], 1))
    sides = torque[:, count:].reshape(n, 2, n, count)
    slope = jnp.einsum("jkjs->kjs", sides)
    slope = (slope[0] - slope[1]) / (2 * _STEP)
    return jnp.stack([own, torque[:, :count] - own * a, slope], 1)


_loads, _masses = program(_load_rows), program(joint_masses)
