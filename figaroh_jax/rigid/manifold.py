"""The space of configurations: steps along it, the way between two of them, draws from it.

A step `v` is a velocity kept for one second, in the child's axes where a joint has several degrees of freedom, so that
`integrate` is right multiplication by the exponential of the joint's group (SO(3), SE(2), SE(3)), as in Pinocchio. A
quaternion is x, y, z, w. The functions take any leading batch axes, compute in float64 and can be differentiated, at
zero too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.precision import in_float64
from ..errors import InputError, check_real
from .model import DOF_NAMES, Joint, RobotModel

__all__ = ["bracket", "difference", "integrate", "neutral", "random_configuration"]

_SMALL = 0.1  # rad; below it the series are exact to 1e-15 and closed forms lose digits
_WITH_QUATERNION = ("spherical", "free")
_ARCSINE = (2.0, 1 / 3, 3 / 20, 5 / 56, 35 / 576, 63 / 1408, 231 / 6656)  # 2 asin(n) / n


def neutral(model: RobotModel) -> Float[np.ndarray, " nq"]:
    """The configuration of zeros and unit quaternions."""
    q = np.zeros(model.nq)
    for joint, columns, _ in _independent(model):
        if joint.kind in _WITH_QUATERNION:
            q[columns.stop - 1] = 1.0
    return q


@in_float64
def integrate(
    model: RobotModel, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
) -> Float[Array, "*batch nq"]:
    r"""The configuration that the velocity `v`, kept for one second, reaches from `q`.

    For each joint $q \oplus v = q \exp(v)$ in the joint's group; a sum for revolute and prismatic joints. q in rad and
    m, v in rad/s and m/s (child axes). Raises `InputError` where the shapes do not fit the model.
    """
    _check(model, q=q, v=v)
    return _integrate(model, jnp.asarray(q, jnp.float64), jnp.asarray(v, jnp.float64))


@jax.jit
def _integrate(model: RobotModel, q: Array, v: Array) -> Array:
    return jnp.concatenate([_STEP.get(kind, jnp.add)(q[..., at], v[..., dof]) for kind, at, dof in _runs(model)], -1)


@in_float64
def difference(
    model: RobotModel, q0: Float[ArrayLike, "*batch nq"], q1: Float[ArrayLike, "*batch nq"]
) -> Float[Array, "*batch nv"]:
    r"""The velocity that reaches `q1` from `q0` in one second, $\log(q_0^{-1} q_1)$ for each joint.

    The shortest turn for quaternions and for the angle of a planar joint (reached up to whole turns there). Units as
    `integrate`. Raises `InputError` where the shapes do not fit the model.
    """
    _check(model, q0=q0, q1=q1)
    return _difference(model, jnp.asarray(q0, jnp.float64), jnp.asarray(q1, jnp.float64))


@jax.jit
def _difference(model: RobotModel, q0: Array, q1: Array) -> Array:
    parts = [_WAY.get(kind, _minus)(q0[..., at], q1[..., at]) for kind, at, _ in _runs(model)]
    return jnp.concatenate(parts, -1)


def random_configuration(
    model: RobotModel, rng: Any = 0, shape: tuple[int, ...] = ()
) -> Float[np.ndarray, "*shape nq"]:
    """Configurations drawn evenly within the limits: an array `(*shape, nq)`.

    `rng` is a seed, a `numpy.random.Generator` or a key of `jax.random`. Where the model gives no limit, angles are
    drawn from one turn and ways from one metre to either side; rotations evenly from all of them.
    """
    if isinstance(rng, jax.Array):
        key = jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng
        rng = [int(x) for x in np.ravel(key)]
    rng = np.random.default_rng(rng)
    q = np.empty((*shape, model.nq))
    for joint, at, dof in _independent(model):
        if joint.kind in _WITH_QUATERNION:
            quaternion = rng.normal(size=(*shape, 4))
            q[..., at.stop - 4 : at.stop] = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
            at = slice(at.start, at.stop - 4)
        limit = np.asarray(model.position_limit)[dof][: at.stop - at.start]
        q[..., at] = rng.uniform(*_span(joint, limit), size=(*shape, len(limit)))
    return q


def bracket(model: RobotModel, v: Float[Array, "*batch nv"], w: Float[Array, "*batch nv"]) -> Float[Array, "*batch nv"]:
    """Lie bracket of two velocities, joint by joint: zero for joints of one degree of freedom."""
    parts = [_BRACKET.get(kind, _no_bracket)(v[..., dof], w[..., dof]) for kind, _, dof in _runs(model)]
    return jnp.concatenate(parts, -1)


def _check(model: RobotModel, **arrays: ArrayLike) -> None:
    batches = set()
    for name, array in arrays.items():
        check_real(name, array)
        width, shape = model.nv if name == "v" else model.nq, np.shape(array)
        if shape[-1:] != (width,):
            raise InputError(f"{name} has shape {shape}; its last axis must hold {width} numbers")
        batches.add(shape[:-1])
    if len(batches) > 1:
        names = " and ".join(arrays)
        raise InputError(f"{names} have the batch axes {' and '.join(map(str, batches))}; give both alike")


def _independent(model: RobotModel) -> list[tuple[Joint, slice, slice]]:
    """The joints that have columns of their own, in the order of these, with their columns of q and of v."""
    found = [
        (joint, at, slice(joint.coordinate, joint.coordinate + len(DOF_NAMES[joint.kind])))
        for joint, at in zip(model.joints, model.dofs.positions, strict=True)
        if not joint.follows
    ]
    return sorted(found, key=lambda entry: entry[2].start)


def _runs(model: RobotModel) -> list[tuple[str, slice, slice]]:
    """Kind and columns of q and of v of the independent joints, those of one degree of freedom side by side as one."""
    runs: list[tuple[str, slice, slice]] = []
    for joint, at, dof in _independent(model):
        kind = joint.kind if joint.kind in _STEP else ""
        if runs and not kind and not runs[-1][0]:
            at, dof = slice(runs[-1][1].start, at.stop), slice(runs[-1][2].start, dof.stop)
            runs.pop()
        runs.append((kind, at, dof))
    return runs


def _minus(x: Array, y: Array) -> Array:
    return y - x


def _no_bracket(v: Array, w: Array) -> Array:
    return jnp.zeros_like(v)


def _span(joint: Joint, limit: Float[np.ndarray, "numbers 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end of each number, finite."""
    turns = np.array([joint.kind == "revolute", False, joint.kind == "planar"][: len(limit)], bool)
    half, (lower, upper) = np.where(turns, np.pi, 1.0), limit.T
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2 * half, -half))
    high = np.where(np.isfinite(upper), upper, np.where(np.isfinite(lower), lower + 2 * half, half))
    return low, high


def _series(square: Array, closed: Callable[[Array], Array], *terms: float) -> Array:
    """`closed(angle)` of a function of the squared angle, by its series near zero: gradients stay finite there."""
    small = square < _SMALL**2
    safe = jnp.where(small, 1.0, square)
    return jnp.where(small, jnp.polyval(jnp.array(terms[::-1]), square), closed(jnp.sqrt(safe)))


def _quaternion_product(x: Array, y: Array) -> Array:
    u, s, v, t = x[..., :3], x[..., 3:], y[..., :3], y[..., 3:]
    vector = s * v + t * u + jnp.cross(u, v)
    return jnp.concatenate([vector, s * t - jnp.sum(u * v, -1, keepdims=True)], -1)


def _turn(quaternion: Array, x: Array) -> Array:
    u, s = quaternion[..., :3], quaternion[..., 3:]
    way = 2.0 * jnp.cross(u, x)
    return x + s * way + jnp.cross(u, way)


def _conjugate(quaternion: Array) -> Array:
    return quaternion * jnp.array([-1.0, -1.0, -1.0, 1.0])


def _exp_quaternion(w: Array) -> Array:
    square = jnp.sum(w * w, -1, keepdims=True)
    half = _series(square, lambda t: jnp.sin(t / 2) / t, 1 / 2, -1 / 48, 1 / 3840, -1 / 645120)
    scalar = _series(square, lambda t: jnp.cos(t / 2), 1.0, -1 / 8, 1 / 384, -1 / 46080)
    return jnp.concatenate([half * w, scalar], -1)


def _log_quaternion(quaternion: Array) -> Array:
    q = jnp.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    u, s = q[..., :3], q[..., 3:]
    square = jnp.sum(u * u, -1, keepdims=True)
    # 2 asin(n) / n near zero, where s is near one
    factor = _series(square, lambda n: 2.0 * jnp.arctan2(n, s) / n, *_ARCSINE)
    return factor * u


def _coefficients(square: Array) -> tuple[Array, Array]:
    """(1 - cos t) / t^2 and (t - sin t) / t^3."""
    a = _series(square, lambda t: (1.0 - jnp.cos(t)) / t**2, 1 / 2, -1 / 24, 1 / 720, -1 / 40320)
    b = _series(square, lambda t: (t - jnp.sin(t)) / t**3, 1 / 6, -1 / 120, 1 / 5040, -1 / 362880)
    return a, b


def _free_step(q: Array, v: Array) -> Array:
    linear, w = v[..., :3], v[..., 3:]
    a, b = _coefficients(jnp.sum(w * w, -1, keepdims=True))
    across = jnp.cross(w, linear)
    way = linear + a * across + b * jnp.cross(w, across)
    turned = _quaternion_product(q[..., 3:], _exp_quaternion(w))
    return jnp.concatenate([q[..., :3] + _turn(q[..., 3:], way), turned], -1)


def _free_way(q0: Array, q1: Array) -> Array:
    back = _conjugate(q0[..., 3:])
    w = _log_quaternion(_quaternion_product(back, q1[..., 3:]))
    way = _turn(back, q1[..., :3] - q0[..., :3])
    c = _inverse_coefficient(jnp.sum(w * w, -1, keepdims=True))
    across = jnp.cross(w, way)
    return jnp.concatenate([way - 0.5 * across + c * jnp.cross(w, across), w], -1)


def _inverse_coefficient(square: Array) -> Array:
    """(1 - t / 2 cot(t / 2)) / t^2."""
    return _series(square, lambda t: (1.0 - 0.5 * t / jnp.tan(t / 2)) / t**2, 1 / 12, 1 / 720, 1 / 30240, 1 / 1209600)


def _plane_turn(angle: Array, x: Array) -> Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * x[..., 0] - s * x[..., 1], s * x[..., 0] + c * x[..., 1]], -1)


def _quarter(x: Array) -> Array:
    return jnp.stack([-x[..., 1], x[..., 0]], -1)


def _planar_step(q: Array, v: Array) -> Array:
    linear, w = v[..., :2], v[..., 2:]
    a, b = _coefficients(w * w)
    way = linear + a * w * _quarter(linear) - b * w * w * linear
    return jnp.concatenate([q[..., :2] + _plane_turn(q[..., 2], way), q[..., 2:] + w], -1)


def _planar_way(q0: Array, q1: Array) -> Array:
    turn = q1[..., 2:] - q0[..., 2:]
    w = turn - 2 * jnp.pi * jnp.round(turn / (2 * jnp.pi))
    way = _plane_turn(-q0[..., 2], q1[..., :2] - q0[..., :2])
    c = _inverse_coefficient(w * w)
    return jnp.concatenate([way - 0.5 * w * _quarter(way) - c * w * w * way, w], -1)


def _free_bracket(v: Array, w: Array) -> Array:
    linear = jnp.cross(v[..., 3:], w[..., :3]) - jnp.cross(w[..., 3:], v[..., :3])
    return jnp.concatenate([linear, jnp.cross(v[..., 3:], w[..., 3:])], -1)


def _planar_bracket(v: Array, w: Array) -> Array:
    linear = v[..., 2:] * _quarter(w[..., :2]) - w[..., 2:] * _quarter(v[..., :2])
    return jnp.concatenate([linear, jnp.zeros_like(linear[..., :1])], -1)


_STEP: dict[str, Callable[[Array, Array], Array]] = {
    "spherical": lambda q, w: _quaternion_product(q, _exp_quaternion(w)),
    "planar": _planar_step,
    "free": _free_step,
}
_WAY: dict[str, Callable[[Array, Array], Array]] = {
    "spherical": lambda q0, q1: _log_quaternion(_quaternion_product(_conjugate(q0), q1)),
    "planar": _planar_way,
    "free": _free_way,
}
_BRACKET: dict[str, Callable[[Array, Array], Array]] = {
    "spherical": jnp.cross,
    "planar": _planar_bracket,
    "free": _free_bracket,
}
