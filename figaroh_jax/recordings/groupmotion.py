"""Recorded configurations with quaternions (free flyers, ball joints) as one smooth path, and its rates on the group.

Components of a quaternion may be resampled and low-passed as any signal once its sign does not jump; what comes out is
brought back to length one. Rates are differences on the group itself, never of components.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.manifold import difference
from ..rigid.model import RobotModel
from .resampling import stencil

__all__ = ["continued", "coordinate_positions", "group_rates", "normalised", "position_names"]

NUMBER_NAMES = {
    "spherical": (".qx", ".qy", ".qz", ".qw"),
    "planar": (".x", ".y", ".angle"),
    "free": (".x", ".y", ".z", ".qx", ".qy", ".qz", ".qw"),
}
UNIT = 0.05  # by which the length of a recorded quaternion may differ from one


def position_names(model: RobotModel) -> tuple[str, ...]:
    """Names of the columns of q: a joint's own, or `root_joint.x` to `root_joint.qw` where it has several."""
    names = [""] * model.nq
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if not joint.follows:
            names[at] = [joint.name + part for part in NUMBER_NAMES.get(joint.kind, ("",))]
    return tuple(names)


def continued(
    model: RobotModel, q: Float[np.ndarray, "samples nq"], what: str = "q"
) -> Float[np.ndarray, "samples nq"]:
    """Quaternions of length one whose sign does not jump; `InputError`, beginning with `what`, where one is none."""
    out = np.array(q, float)
    for name, at in _quaternions(model):
        length = np.linalg.norm(out[:, at], axis=1)
        wrong = np.flatnonzero(~(np.abs(length - 1) < UNIT))
        if len(wrong):
            row = wrong[0]
            raise InputError(
                f"{what}: the quaternion of '{name}' (x y z w) has length {length[row]:.4g} in row {row} (from 0),"
                " expected 1"
            )
        turned = np.sum(out[1:, at] * out[:-1, at], axis=1) < 0
        sign = np.where(np.concatenate([[0], np.cumsum(turned)]) % 2, -1.0, 1.0)
        out[:, at] *= (sign / length)[:, None]
    return out


def normalised(model: RobotModel, q: Float[np.ndarray, "samples nq"]) -> Float[np.ndarray, "samples nq"]:
    """The same with every quaternion brought to length one."""
    out = np.array(q, float)
    for _, at in _quaternions(model):
        out[:, at] /= np.linalg.norm(out[:, at], axis=1, keepdims=True)
    return out


def group_rates(
    model: RobotModel, q: Float[np.ndarray, "samples nq"], dt: float
) -> tuple[Float[np.ndarray, "samples nv"], Float[np.ndarray, "samples nv"]]:
    r"""Velocity and acceleration of a path sampled every `dt` s, by five-point differences on the group.

    About each sample the path is $q \exp(x(t))$ with x(0) = 0, and then $v = \dot x$, $a = \ddot x$: the terms of the
    group vanish there. Exact where x is a polynomial up to degree four (for joints of one axis as `differentiate`);
    the two samples at either end use the five outermost ones. v, a in the conventions of the model (child axes).
    """
    samples = len(q)
    first = np.clip(np.arange(samples) - 2, 0, max(samples - 5, 0))
    if samples < 5:
        raise InputError(f"{samples} samples are too few for five-point differences")
    around = q[first[:, None] + np.arange(5)]
    x = np.asarray(difference(model, np.broadcast_to(q[:, None], around.shape), around))
    place, offsets = np.arange(samples) - first, np.arange(5)
    v, a = (
        np.einsum("so,sok->sk", np.array([stencil(offsets - p, order) for p in range(5)])[place], x) / dt**order
        for order in (1, 2)
    )
    return v, a


def coordinate_positions(model: RobotModel, q: Float[np.ndarray, "samples nq"]) -> Float[np.ndarray, "samples nv"]:
    """Position of each coordinate, rad or m; zero where no one number tells it (joints of several axes)."""
    if model.nq == len(model.joint_names):
        return q
    out = np.zeros((len(q), model.nv))
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("revolute", "prismatic"):
            out[:, joint.coordinate] = q[:, at.start]
    return out


def _quaternions(model: RobotModel) -> list[tuple[str, slice]]:
    return [
        (joint.name, slice(at.stop - 4, at.stop))
        for joint, at in zip(model.joints, model.dofs.positions, strict=True)
        if joint.kind in ("spherical", "free") and not joint.follows
    ]
