"""Joint torque as a linear function of the links' inertial parameters: tau = W(q, v, a) pi.

W has a row for each coordinate and ten columns for each link, in the tree order of the model and in Pinocchio's order
`[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`. A joint feels only the links that it moves, so most of W is zero on a
branched robot; `packed_regressor` holds the other blocks alone, and `normal_equations` condenses W without ever holding
it. Inside the kernels the sample is the last axis, and samples go through in chunks whose temporaries stay in
the processor's cache.
"""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from ..compiled.batching import aligned, chunk_size, host_blocks, on_host, over_samples, put, to_device, two_axes
from ..compiled.kernels import known_codes, straight_answers, usable
from ..compiled.machine_code import machine_code, own_room
from ..compiled.precision import in_float64
from ..errors import InputError
from .kinematics import Motion, ancestors, check_shapes, motion, take
from .model import Joint, RobotModel, dofs
from .scalar_forms import BLOCKS, DENSE, PACKED, looped_blocks, straight
from .spatial import cross, rotate_back

__all__ = [
    "BLOCK_FORM",
    "block_codes",
    "block_rows",
    "coordinate_blocks",
    "coordinate_rows",
    "dense_rows",
    "joint_torque_regressor",
    "packed_regressor",
    "packed_rows",
    "pairs",
    "unit_wrenches",
]

_ELSEWHERE = np.array([0.0, 1.0, 1.0, 1.0])[:, None, None]  # the columns of a pose but for the origin
_ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # of the inertia, in Pinocchio's order


def pairs(model: RobotModel) -> Int[np.ndarray, "pairs 2"]:
    """Degree of freedom and link of every block of W that can differ from zero: the one moves the other.

    Sorted by degree of freedom (which is the tree joint for robots of revolute and prismatic joints).
    """
    return _pairs(model.joints)


@lru_cache(maxsize=256)
def _pairs(joints: tuple[Joint, ...]) -> np.ndarray:
    found = np.argwhere(ancestors(joints)[dofs(joints).joint] > 0)
    found.setflags(write=False)
    return found


@in_float64
def joint_torque_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv columns"]:
    """Regressor W with `W @ model.inertia.ravel()` the torques of `inverse_dynamics` (N m; N for a prismatic joint).

    q, v, a in rad, rad/s, rad/s^2 (m for sliding); 10 columns a link, in float64. The rows of joints that share a
    coordinate add up, each times its ratio. A free joint's six rows are the force and the torque about its origin, in
    its own axes. Atkeson, An and Hollerbach (1986), in classical accelerations. Raises `InputError` where the arrays
    do not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = 0.3 * np.ones((3, robot.nv))
    >>> W = fj.joint_torque_regressor(robot, q, v, a)
    >>> bool(np.allclose(W @ robot.inertia.ravel(), fj.inverse_dynamics(robot, q, v, a)))
    True
    """
    check_shapes(model, q=q, v=v, a=a)
    width = 10 * len(pairs(model))
    if on_host(model, q, v, a):
        rows = two_axes(q, v, a, host=True)
        code = machine_code(_DENSE, model, *rows)
        whole = code(own_room, *rows) if code else _dense_on_host(model, chunk_size(width), *rows)
        return to_device(whole.reshape(*np.shape(q)[:-1], model.nv, 10 * len(model.joints)))
    return over_samples(dense_rows, model, q, v, a, width=width, straight=_DENSE)


def _dense_on_host(model: RobotModel, chunk: int, *arrays: np.ndarray) -> Float[np.ndarray, "samples nv nj 10"]:
    """W with zeros that are never written: memory that the system gives out is zero already."""
    whole = aligned((len(arrays[0]), model.nv, len(model.joints), 10), fill=0.0)
    for where, parts in host_blocks(coordinate_rows, chunk, model, *arrays):
        view = np.moveaxis(whole[where], 0, -1)
        for rows, blocks in _runs(model.joints):
            put(view[rows], parts[blocks])
    return whole


@in_float64
def packed_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "samples nq"],
    v: Float[ArrayLike, "samples nv"],
    a: Float[ArrayLike, "samples nv"],
) -> Float[Array, "pairs 10 samples"]:
    """Blocks of the regressor that can differ from zero, one for each of `pairs(model)`, the samples last, in float64.

    A row belongs to a degree of freedom, not to a coordinate: mimic joints have rows of their own, without their ratio.
    Units and errors as `joint_torque_regressor`.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = 0.3 * np.ones((3, 5, robot.nv))
    >>> fj.packed_regressor(robot, q, v, a).shape
    (10, 10, 5)
    """
    check_shapes(model, q=q, v=v, a=a)
    if np.ndim(q) != 2:
        raise InputError(f"q has shape {np.shape(q)}; a packed regressor takes (samples, joints)")
    width = 10 * len(pairs(model))
    return over_samples(packed_rows, model, q, v, a, last=True, width=width, straight=_PACKED)


@lru_cache(maxsize=256)
def coordinate_blocks(joints: tuple[Joint, ...]) -> tuple[Int[np.ndarray, "blocks 2"], Int[np.ndarray, " pairs"]]:
    """Coordinate and link of each block of W that can differ from zero, and the block to which each pair adds."""
    moved = _pairs(joints)
    where = np.stack([dofs(joints).column[moved[:, 0]], moved[:, 1]], 1)
    blocks, place = np.unique(where, axis=0, return_inverse=True)
    return blocks, place.reshape(-1)


@lru_cache(maxsize=256)
def _runs(joints: tuple[Joint, ...]) -> list[tuple[tuple[int, slice], slice]]:
    """Blocks of W that stand side by side in one row: coordinate and links, and where they are among the blocks."""
    blocks, _ = coordinate_blocks(joints)
    starts = np.flatnonzero((np.diff(blocks, axis=0, prepend=-2) != [0, 1]).any(1))
    runs = []
    for start, end in zip(starts, [*starts[1:], len(blocks)], strict=True):
        row, link = (int(x) for x in blocks[start])
        runs.append(((row, slice(link, link + end - start)), slice(start, end)))
    return runs


def coordinate_rows(
    model: RobotModel, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> tuple[Float[Array, "blocks 4 samples"], Float[Array, "blocks 6 samples"]]:
    """Kernel: the blocks of `coordinate_blocks` as `packed_rows` gives them, the samples last."""
    moments, inertias = packed_rows(model, q, v, a, scale=model.ratio)
    blocks, place = coordinate_blocks(model.joints)
    if len(blocks) == len(place):
        order = np.argsort(place)
        return take(moments, order), take(inertias, order)
    empty = (jnp.zeros((len(blocks), *x.shape[1:]), x.dtype) for x in (moments, inertias))
    first, second = (x.at[place].add(rows) for x, rows in zip(empty, (moments, inertias), strict=True))
    return first, second


def block_rows(
    model: RobotModel,
    q: Float[Array, "samples nq"],
    v: Float[Array, "samples nv"],
    a: Float[Array, "samples nv"],
    codes: bytes | None = None,
) -> Float[Array, "blocks 10 samples"]:
    """Blocks of `coordinate_blocks`, in a program; on a GPU by a kernel of their own, with `codes` of `block_codes`."""
    if usable(q, v, a):
        return straight_answers(BLOCK_FORM, model, q, v, a, codes=codes)
    return BLOCK_FORM.plain(model, q, v, a)


def block_codes(model: RobotModel) -> bytes | None:
    """What `block_rows` of a program that takes the model as an argument may know of it."""
    return known_codes(BLOCK_FORM, model) if usable() else None


def dense_rows(
    model: RobotModel, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "nv columns samples"]:
    """Kernel of `joint_torque_regressor`: the samples last."""
    rows, (blocks, _) = jnp.concatenate(coordinate_rows(model, q, v, a), axis=1), coordinate_blocks(model.joints)
    source = np.full((model.nv, len(model.joints)), len(rows))  # zeros, where no block is
    source[tuple(blocks.T)] = np.arange(len(rows))
    filled = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    return filled[source].reshape(model.nv, 10 * len(model.joints), -1)


def packed_rows(
    model: RobotModel,
    q: Float[Array, "nq samples"],
    v: Float[Array, "nv samples"],
    a: Float[Array, "nv samples"],
    scale: Float[ArrayLike, " nj"] | None = None,
) -> tuple[Float[Array, "pairs 4 samples"], Float[Array, "pairs 6 samples"]]:
    r"""Kernel of `packed_regressor`: columns of mass and first moments, and of the inertia, the samples last.

    The dtype is that of `q`; rows times `scale` of their joint. A row is $l \cdot f + u \cdot n$ with the twist (l, u)
    of the degree of freedom and the force f and the torque n of a unit of each parameter, about the world's origin.
    """
    state = motion(model, q, v, a)
    linear, angular = state.linear, state.angular
    if scale is not None:
        ratio = take(jnp.asarray(scale, q.dtype), model.dofs.joint)[:, None, None]
        linear, angular = linear * ratio, angular * ratio
    wrench, turning = unit_wrenches(state)
    twist = jnp.concatenate([linear, angular], axis=1)
    dof, link = pairs(model).T
    moments = [twist[dof][:, None, k] * wrench[link][:, :, k] for k in range(6)]
    inertias = [twist[dof][:, None, k + 3] * turning[link][:, :, k] for k in range(3)]
    return sum(moments[1:], moments[0]), sum(inertias[1:], inertias[0])


BLOCK_FORM = straight(BLOCKS, coordinate_rows, lambda model: 10 * len(coordinate_blocks(model.joints)[0]))
BLOCK_FORM = BLOCK_FORM._replace(looped=looped_blocks)
_DENSE = straight(DENSE, dense_rows, lambda model: 10 * len(pairs(model)))
_PACKED = straight(PACKED, packed_rows, lambda model: 10 * len(pairs(model)))


def unit_wrenches(state: Motion) -> tuple[Float[Array, "nj 4 6 samples"], Float[Array, "nj 6 3 samples"]]:
    r"""Wrench about the world's origin of a unit of mass and first moments, and torque of a unit of inertia.

    $t_a$ the columns of the pose, $g_a$ their accelerations: force $g_a$, torque $p \times g_a + t_a \times g_p$
    (once for the mass). An inertia E gives $R (E \alpha + w \times E w)$ with w and $\alpha$ in the link's frame.
    """
    columns, force = state.columns, state.acceleration
    torque = cross(columns, force[:, :1]) + jnp.asarray(_ELSEWHERE, force.dtype) * cross(columns[:, :1], force)
    wrench = jnp.concatenate([force, torque], axis=2)  # as one, XLA keeps them, and computes none for every pair anew
    axes = columns[:, 1:]
    turning = cross(state.w[:, None], axes)
    w, al = (rotate_back(jnp.swapaxes(axes, 1, 2), x) for x in (state.w, state.al))

    def one(i: int, j: int) -> Array:
        return axes[:, i] * al[:, j, None] + turning[:, i] * w[:, j, None]

    inertia = jnp.stack([one(i, i) if i == j else one(i, j) + one(j, i) for i, j in _ENTRIES], axis=1)
    return wrench, inertia
