"""The ten inertial parameters of a link in their different forms.

The parameters are Pinocchio's, `[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`: mass (kg), first moments (kg m) and
rotational inertia (kg m^2) about the origin of the frame in which they are given, so that torques are linear in them.
The functions take numpy or JAX arrays and answer in kind, so that a model can be built without 64-bit JAX.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

__all__ = [
    "from_com",
    "from_pseudo_inertia",
    "is_physical",
    "pseudo_inertia",
    "rotational_inertia",
    "to_com",
    "transform",
]

_ROWS, _COLUMNS = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)  # of Ixx, Ixy, Iyy, Ixz, Iyz, Izz
_PLACE = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])


def _space(array: Any) -> Any:
    return array.__array_namespace__()


def rotational_inertia(parameters: Float[Any, "*batch 10"]) -> Float[Any, "*batch 3 3"]:
    """Symmetric matrix of inertia (kg m^2) about the frame's origin."""
    return parameters[..., 4:][..., _PLACE]


def pseudo_inertia(parameters: Float[Any, "*batch 10"]) -> Float[Any, "*batch 4 4"]:
    r"""Second moments of the mass in homogeneous coordinates, $P = \int [x; 1][x; 1]' dm$.

    $P = [[S, h], [h', m]]$ with $S = \tfrac12 \mathrm{tr}(I) 1 - I$ (Wensing, Kim, Slotine 2018); a link is physical if
    and only if P is positive semidefinite.
    """
    xp, inertia = _space(parameters), rotational_inertia(parameters)
    trace = (inertia[..., 0, 0] + inertia[..., 1, 1] + inertia[..., 2, 2])[..., None, None]
    top = xp.concatenate([0.5 * trace * np.eye(3) - inertia, parameters[..., 1:4, None]], axis=-1)
    bottom = xp.concatenate([parameters[..., None, 1:4], parameters[..., None, :1]], axis=-1)
    return xp.concatenate([top, bottom], axis=-2)


def from_pseudo_inertia(matrix: Float[Any, "*batch 4 4"]) -> Float[Any, "*batch 10"]:
    """Ten parameters whose `pseudo_inertia` is `matrix`."""
    xp, second = _space(matrix), matrix[..., :3, :3]
    trace = (second[..., 0, 0] + second[..., 1, 1] + second[..., 2, 2])[..., None, None]
    inertia = (trace * np.eye(3) - second)[..., _ROWS, _COLUMNS]
    return xp.concatenate([matrix[..., 3, 3:], matrix[..., 3, :3], inertia], axis=-1)


def transform(parameters: Float[Any, "*batch 10"], placement: Float[Any, "*batch 4 4"]) -> Float[Any, "*batch 10"]:
    """Parameters of the same link in another frame: `placement` is the pose of the present frame in the new one."""
    xp = _space(parameters)
    return from_pseudo_inertia(placement @ pseudo_inertia(parameters) @ xp.swapaxes(placement, -1, -2))


def from_com(
    mass: Float[Any, "*batch"] | float, com: Float[Any, "*batch 3"], inertia: Float[Any, "*batch 3 3"]
) -> Float[Any, "*batch 10"]:
    """Ten parameters from the mass (kg), centre of mass (m) and the inertia about it (kg m^2), axes as the frame."""
    xp = _space(com)
    m = xp.asarray(mass)[..., None]
    square = xp.sum(com * com, axis=-1)[..., None, None] * np.eye(3) - com[..., :, None] * com[..., None, :]
    about_origin = (inertia + m[..., None] * square)[..., _ROWS, _COLUMNS]
    return xp.concatenate([m, m * com, about_origin], axis=-1)


def to_com(
    parameters: Float[Any, "*batch 10"],
) -> tuple[Any, Any, Any]:
    """Mass (kg), centre of mass (m, zero for a massless link) and inertia about it (kg m^2)."""
    xp, mass = _space(parameters), parameters[..., :1]
    com = parameters[..., 1:4] / xp.where(mass == 0.0, 1.0, mass)
    square = xp.sum(com * com, axis=-1)[..., None, None] * np.eye(3) - com[..., :, None] * com[..., None, :]
    return mass[..., 0], com, rotational_inertia(parameters) - mass[..., None] * square


def is_physical(parameters: Float[Any, "*batch 10"], tolerance: float = 1e-9) -> Bool[Any, "*batch"]:
    """Whether a distribution of mass exists with these parameters: `pseudo_inertia` positive semidefinite.

    The smallest eigenvalue may be negative by `tolerance` times the largest.
    """
    values = _space(parameters).linalg.eigvalsh(pseudo_inertia(parameters))
    return values[..., 0] >= -tolerance * abs(values[..., -1])
