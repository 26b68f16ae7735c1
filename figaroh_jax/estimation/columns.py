"""Columns of parameters at states: ten for each link, by a backend, then those of the effects at the joints.

The names of the columns, what they are at random states (all that any motion could show), and at given ones.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from ..compiled.batching import CPU_OPTIONS, DRAFT_OPTIONS, FEW, on_the_host, program
from ..effects.base import Effect, Motion, columns, place, smooth_sign
from ..effects.catalogue import find
from ..errors import InputError
from ..rigid.model import DOF_NAMES, Joint, RobotModel
from ..simulators.contract import Backend
from ..simulators.native import NativeBackend
from .base_parameters import inertial_names

if TYPE_CHECKING:
    from ..formats.config import Baseline

__all__ = [
    "column_names",
    "columns_of",
    "friction_terms",
    "joint_labels",
    "motion_at",
    "random_states",
    "state_columns",
    "structural_columns",
    "term_columns",
    "term_places",
    "term_rows",
]

STATES = 129  # more than a chunk of `batching`, so that the program of the recordings serves random states too
SHORT_NAMES = {"viscous_friction": "fv", "coulomb_friction": "fc", "rotor_inertia": "Ia", "torque_offset": "off"}


def friction_terms(model: RobotModel, known: Baseline, undriven: Collection[str] = ()) -> tuple[Effect, ...]:
    """The effects that a task's baseline asks for, those of every joint as one object with a leading axis.

    A free joint has no drive, so the six rows of a free flyer's root have no friction. A joint that is `undriven` has
    friction, but no rotor and no sensor that could be off.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> terms = fj.columns.friction_terms(robot, fj.Baseline(offset=True))
    >>> [term.name for term in terms]
    ['viscous_friction', 'coulomb_friction', 'torque_offset']
    """
    driven = [k for k, joint in enumerate(_joints(model)) if joint.kind != "free"]
    terms: list[Effect] = []
    for name in known.everywhere() if driven else ():
        effect = find(name)
        at = [k for k in driven if name not in _OF_DRIVES or model.dof_names[k] not in undriven]
        terms.append(effect(np.array(at)[:, None], **{p: np.zeros(len(at)) for p in effect.parameters()}))
    for entry in known.effects:
        effect = find(entry.effect)
        if not effect.amplitudes():
            raise InputError(f"baseline.effects: '{entry.effect}' has no parameter in which the torque is linear")
        terms.append(jax.tree.map(lambda x: np.asarray(x)[None], place(effect, model, entry.at)))
    return tuple(terms)


_OF_DRIVES = ("rotor_inertia", "torque_offset")


def _joints(model: RobotModel) -> list[Joint]:
    """The joint of each coordinate."""
    own = {int(column): model.joints[j] for j, column in zip(model.dofs.joint, model.dofs.column, strict=True)}
    return [own[k] for k in range(model.nv)]


def joint_labels(model: RobotModel) -> tuple[str, ...]:
    """What stands behind `fv` or `fc` for each coordinate: the number of the link that its joint moves, in tree order.

    It is that of `m1` to `Izz1`, whatever the order of the recording's columns. Coordinates of one spherical joint are
    told apart: `fv3.1` to `fv3.3`.

    >>> import figaroh_jax as fj
    >>> fj.columns.joint_labels(fj.load_urdf(fj.DEMO))
    ('1', '2', '3', '4')
    """
    labels = [""] * model.nv
    for number, joint in enumerate(model.joints, 1):
        if not joint.follows:
            kinds = len(DOF_NAMES[joint.kind])
            own = [f"{number}.{k + 1}" if kinds > 1 else f"{number}" for k in range(kinds)]
            labels[joint.coordinate : joint.coordinate + kinds] = own
    return tuple(labels)


def column_names(model: RobotModel, terms: Sequence[Effect]) -> tuple[str, ...]:
    """`m1` to `Izz1` and on for the links in tree order, then `fv1`, `fc1` ... of the joints that move them (not in the
    order of the columns: `joint_labels`), then other effects.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> terms = fj.columns.friction_terms(robot, fj.Baseline(offset=True))
    >>> fj.columns.column_names(robot, terms)[:4], len(fj.columns.column_names(robot, terms))
    (('m1', 'mx1', 'my1', 'mz1'), 52)
    """
    names, joints = list(inertial_names(model)), joint_labels(model)
    for term in terms:
        amplitudes = term.amplitudes()
        for at in np.asarray(term.at):
            where = "_".join(joints[k] if term.acts_on in ("joint", "pair") else str(k + 1) for k in at)
            short = SHORT_NAMES.get(term.name)
            names += [f"{short}{where}" if short else f"{term.name}.{name}{where}" for name in amplitudes]
    return tuple(names)


def structural_columns(
    model: RobotModel, terms: tuple[Effect, ...], samples: int | None = None, seed: int = 0
) -> Float[np.ndarray, "samples nv columns"]:
    """Columns at independent random states: what any motion at all could show.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> terms = fj.columns.friction_terms(robot, fj.Baseline(offset=True))
    >>> W = fj.columns.structural_columns(robot, terms)
    >>> W.shape[1:] == (robot.nv, len(fj.columns.column_names(robot, terms)))
    True
    """
    samples = samples or max(STATES, 4 * len(column_names(model, terms)) // max(model.nv, 1))
    q, v, a = random_states(model, samples, seed)
    with jax.enable_x64(True), on_the_host():  # few states: not worth a kernel of a GPU
        motion = motion_at(model, np.arange(samples) * 1.0, q, v, a, 0.0, jnp.zeros(model.nv))
        return columns_of(NativeBackend(model), terms, motion)


def random_states(
    model: RobotModel, samples: int, seed: int = 0
) -> tuple[Float[np.ndarray, "samples nq"], Float[np.ndarray, "samples nv"], Float[np.ndarray, "samples nv"]]:
    """Independent random positions (quaternions of length one), velocities and accelerations.

    >>> import figaroh_jax as fj
    >>> q, v, a = fj.columns.random_states(fj.load_urdf(fj.DEMO), 100)
    >>> q.shape
    (100, 4)
    """
    generator = np.random.default_rng(seed)
    q, v, a = (generator.normal(scale=2.0, size=(samples, n)) for n in (model.nq, model.nv, model.nv))
    for joint, where in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("spherical", "free"):
            quaternion = slice(where.stop - 4, where.stop)
            q[:, quaternion] /= np.linalg.norm(q[:, quaternion], axis=1, keepdims=True)
    return q, v, a


def motion_at(model: RobotModel, time: Any, q: Any, v: Any, a: Any, dt: Any, width: Any) -> Motion:
    """The motion (rad, rad/s, rad/s^2; m if sliding) at instants `dt` s apart, without load; `width` as in `Motion`.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 5)
    >>> fj.columns.motion_at(robot, np.zeros(5), q, v, a, 0.0, np.zeros(4)).velocity.shape
    (5, 4)
    """
    zero = jnp.zeros(jnp.shape(v))
    return Motion(model, jnp.asarray(time), jnp.asarray(q), jnp.asarray(v), jnp.asarray(a), zero, zero, dt, width)


def state_columns(
    model: RobotModel,
    terms: tuple[Effect, ...],
    width: Float[Array, " nv"],
    widths: tuple[float, ...],
    q: Float[ArrayLike, "samples nq"],
    v: Float[ArrayLike, "samples nv"],
    a: Float[ArrayLike, "samples nv"],
) -> Float[np.ndarray, "samples nv columns"]:
    """Columns at given states, unfiltered; `widths` as in `Regression.pieces`.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 5)
    >>> W = fj.columns.state_columns(robot, (), np.zeros(4), (), q, v, a)
    >>> bool(np.allclose(W @ np.asarray(robot.inertia).ravel(), fj.inverse_dynamics(robot, q, v, a), atol=1e-3))
    True
    """
    motion = motion_at(model, jnp.zeros(jnp.shape(v)[0]), q, v, a, 0.0, width)
    return columns_of(NativeBackend(model), terms, motion, widths)


def columns_of(
    backend: Backend, terms: tuple[Effect, ...], motion: Motion, widths: tuple[float, ...] = ()
) -> Float[np.ndarray, "samples nv columns"]:
    """Columns of the rigid body by its backend, then those of the effects and of the `widths` of dry friction."""
    state = (np.asarray(x) for x in (motion.position, motion.velocity, motion.acceleration))
    rigid = np.asarray(backend.joint_torque_regressor(*state))
    beside = _beside_few if len(motion.time) <= FEW else _beside_many
    return np.concatenate([rigid, *(np.asarray(x) for x in beside(terms, motion, widths))], axis=2)


def _columns_beside(
    terms: tuple[Effect, ...], motion: Motion, widths: tuple[float, ...]
) -> list[Float[Array, "samples nv columns"]]:
    signs = (smooth_sign(motion.velocity, motion.acceleration, motion.dt, w) for w in widths)
    return [*_term_columns(terms, motion), *(sign[:, :, None] for sign in signs)]


_beside_few, _beside_many = (program(_columns_beside, options, kept=True) for options in (DRAFT_OPTIONS, CPU_OPTIONS))


def term_columns(
    model: RobotModel,
    terms: tuple[Effect, ...],
    width: Float[Array, " nv"],
    q: Float[Array, "samples nq"],
    v: Float[Array, "samples nv"],
    a: Float[Array, "samples nv"],
) -> list[Float[Array, "samples nv columns"]]:
    """Columns of each effect at given states, unfiltered; to be traced."""
    return _term_columns(terms, motion_at(model, jnp.zeros(jnp.shape(v)[0]), q, v, a, 0.0, width))


def term_rows(
    model: RobotModel,
    terms: tuple[Effect, ...],
    width: Float[Array, " nv"],
    q: Float[Array, "samples nq"],
    v: Float[Array, "samples nv"],
    a: Float[Array, "samples nv"],
) -> Float[Array, "rows samples"]:
    """What of `term_columns` can differ from zero, in the order of `term_places`; to be traced."""
    motion, out = motion_at(model, jnp.zeros(jnp.shape(v)[0]), q, v, a, 0.0, width), [jnp.zeros((0, jnp.shape(v)[0]))]
    for term in terms:
        torque = jax.vmap(lambda effect: _own_torque(effect, motion))(term)  # (places, samples, joints, amplitudes)
        out.append(jnp.moveaxis(torque, 1, 3).reshape(-1, torque.shape[1]))
    return jnp.concatenate(out)


def term_places(model: RobotModel, terms: tuple[Effect, ...]) -> Int[np.ndarray, "rows 2"]:
    """Coordinate and column (behind those of the links) of each of `term_rows`."""
    places, first = [np.zeros((0, 2), int)], 0
    for term in terms:
        amplitudes = len(term.amplitudes())
        for at in np.asarray(term.at):
            rows = np.arange(model.nv) if term.acts_on in ("link", "robot") else np.asarray(at)
            grid = np.meshgrid(rows, first + np.arange(amplitudes), indexing="ij")
            places.append(np.stack([x.ravel() for x in grid], 1))
            first += amplitudes
    return np.concatenate(places)


def _term_columns(terms: tuple[Effect, ...], motion: Motion) -> list[Float[Array, "samples nv columns"]]:
    blocks = []
    for term in terms:
        columns = jax.vmap(lambda effect: _joint_columns(effect, motion))(term)
        blocks.append(jnp.moveaxis(columns, 0, 2).reshape(*columns.shape[1:3], -1))
    return blocks


def _joint_columns(effect: Effect, motion: Motion) -> Float[Array, "samples nv amplitudes"]:
    """Torque of a unit of each amplitude in the rows of all joints."""
    torque = _own_torque(effect, motion)
    if effect.acts_on in ("link", "robot"):
        return torque
    return jnp.zeros((*motion.velocity.shape, torque.shape[-1])).at[:, effect.at].add(torque)


def _own_torque(effect: Effect, motion: Motion) -> Float[Array, "samples rows amplitudes"]:
    """Torque of a unit of each amplitude in the rows of the effect's own joints, or of all where it acts on links."""
    torque = jnp.moveaxis(columns(effect, motion), 0, -1)
    return torque if effect.acts_on in ("link", "robot") else torque.reshape(torque.shape[0], -1, torque.shape[-1])
