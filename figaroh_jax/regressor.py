"""Joint torque as a linear function of the links' inertial parameters: tau = W(q, v, a) pi.

W has a row for each coordinate and ten columns for each link, in the tree order of the model and in Pinocchio's order
`[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`. A joint feels only the links that it moves, so most of W is zero on a
branched robot; `packed_regressor` holds the other blocks alone, and `figaroh_jax.streaming` condenses W without ever
holding it. Inside the kernels the sample is the last axis, and samples go through in chunks whose temporaries stay in
the processor's cache.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from .chunks import chunk_size, over_samples
from .errors import InputError
from .kinematics import Motion, ancestors, check_shapes, motion, revolute, world_axes
from .model import RobotModel
from .spatial import rotate_back

__all__ = [
    "coordinate_blocks",
    "coordinate_rows",
    "dense_rows",
    "joint_torque_regressor",
    "packed_regressor",
    "packed_rows",
    "pairs",
]

Vector = list[Array]  # the three components of vectors, each (any, samples)


def pairs(model: RobotModel) -> Int[np.ndarray, "pairs 2"]:
    """Tree joint and link of every block of W that can differ from zero: the joint moves the link. Sorted by joint."""
    return np.argwhere(ancestors(model.joints) > 0)


def joint_torque_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv columns"]:
    """Regressor W with `W @ model.inertia.ravel()` the torques of `inverse_dynamics` (N m; N for a prismatic joint).

    q, v, a in rad, rad/s, rad/s^2 (m for prismatic joints); 10 columns a link, in float64. The rows of joints that
    share a coordinate add up, each times its ratio. Atkeson, An and Hollerbach (1986), in classical accelerations.
    Raises `InputError` where the shapes do not fit the model.
    """
    with jax.enable_x64(True):
        check_shapes(model, q=q, v=v, a=a)
        shape = (*np.shape(q)[:-1], model.nv, 10 * len(model.joints))
        return over_samples(dense_rows, 0, _chunk(model), model, q, v, a).reshape(shape)


def packed_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "samples nv"],
    v: Float[ArrayLike, "samples nv"],
    a: Float[ArrayLike, "samples nv"],
) -> Float[Array, "pairs 10 samples"]:
    """Blocks of the regressor that can differ from zero, one for each of `pairs(model)`, the samples last, in float64.

    A row belongs to a joint of the tree, not to a coordinate: mimic joints have rows of their own, without their ratio.
    Units and errors as `joint_torque_regressor`.
    """
    with jax.enable_x64(True):
        check_shapes(model, q=q, v=v, a=a)
        if np.ndim(q) != 2:
            raise InputError(f"q has shape {np.shape(q)}; a packed regressor takes (samples, joints)")
        return over_samples(packed_rows, -1, _chunk(model), model, q, v, a)


def _chunk(model: RobotModel) -> int:
    return chunk_size(10 * len(pairs(model)))


def coordinate_blocks(model: RobotModel) -> tuple[Int[np.ndarray, "blocks 2"], Int[np.ndarray, " pairs"]]:
    """Coordinate and link of each block of W that can differ from zero, and the block to which each pair adds."""
    moved = pairs(model)
    coordinate = np.array([joint.coordinate for joint in model.joints], int)
    blocks, place = np.unique(np.stack([coordinate[moved[:, 0]], moved[:, 1]], 1), axis=0, return_inverse=True)
    return blocks, place.reshape(-1)


def coordinate_rows(
    model: RobotModel, q: Float[Array, "nv samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "blocks 10 samples"]:
    """Kernel: the blocks of `coordinate_blocks`, the samples last."""
    rows = packed_rows(model, q, v, a, scale=model.ratio)
    blocks, place = coordinate_blocks(model)
    if (place == np.arange(len(blocks))).all():
        return rows
    return jnp.zeros((len(blocks), *rows.shape[1:]), rows.dtype).at[place].add(rows)


def dense_rows(
    model: RobotModel, q: Float[Array, "nv samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "samples nv columns"]:
    """Kernel of `joint_torque_regressor`: arguments with the samples last, W with the samples first."""
    rows, (blocks, _) = coordinate_rows(model, q, v, a), coordinate_blocks(model)
    source = np.full((model.nv, len(model.joints)), len(rows))  # zeros, where no block is
    source[tuple(blocks.T)] = np.arange(len(rows))
    # samples first before the zeros come in: the blocks that are there fit the cache, all of W may not
    filled = jnp.pad(rows.reshape(-1, q.shape[-1]).T.reshape(-1, *rows.shape[:2]), ((0, 0), (0, 1), (0, 0)))
    return _once(filled)[:, source.ravel()].reshape(-1, model.nv, 10 * len(model.joints))


def packed_rows(
    model: RobotModel,
    q: Float[Array, "nv samples"],
    v: Float[Array, "nv samples"],
    a: Float[Array, "nv samples"],
    scale: Float[ArrayLike, " nj"] | None = None,
) -> Float[Array, "pairs 10 samples"]:
    r"""Kernel of `packed_regressor`: the samples last, the dtype that of `q`; rows times `scale` of their joint.

    With the joint's moment $u = s_j$ and $l = s_j \times (p_i - p_j)$ (prismatic: $u = 0$, $l = s_j$) in the frame of
    link i, and there $w$, $\alpha$ and $c$ of the link, the columns of the row are
    $$l \cdot c, \quad l^T ([\alpha] + [w]^2) + c \times u, \quad u^T (L(\alpha) + [w] L(w)), \quad L(w) I = I w$$
    """
    joint, link = pairs(model).T
    u, lever, w, al, c = _pair_vectors(model, joint, link, motion(model, q, v, a), scale)
    mass = _dot(lever, c)
    return jnp.stack(_once([mass, *_moment_columns(u, lever, w, al, c), *_inertia_columns(u, w, al)]), axis=1)


def _pair_vectors(
    model: RobotModel, joint: np.ndarray, link: np.ndarray, state: Motion, scale: ArrayLike | None
) -> tuple[Vector, ...]:
    """Moments u and l of each pair's joint, and w, alpha and c of its link, all in the link's frame."""
    s = world_axes(model, state.R)
    s = s if scale is None else s * jnp.asarray(scale, s.dtype)[:, None, None]
    local = (rotate_back(state.R, x) for x in (state.w, state.al, state.ac))
    rotation = state.R.reshape(len(s), 9, -1)
    # barriers: a gather or a rotation fused into each of its uses would be done again for every one of them
    links, joints = _once((jnp.concatenate([rotation, state.p, *local], 1), jnp.concatenate([s, state.p], 1)))
    links, joints = _once((links[link], joints[joint]))
    R, p, w, al, c = (_components(links, k, n) for k, n in ((0, 9), (9, 3), (12, 3), (15, 3), (18, 3)))
    axis, arm = _components(joints, 0, 3), [x - y for x, y in zip(p, _components(joints, 3, 3), strict=True)]
    u, lever = _turned_back(R, axis), _turned_back(R, _cross(axis, arm))
    turns = revolute(model)[joint]
    if not turns.all():
        slides = jnp.asarray(~turns, s.dtype)[:, None]
        u, lever = (
            [x * (1.0 - slides) for x in u],
            [x * (1.0 - slides) + y * slides for x, y in zip(lever, u, strict=True)],
        )
    return *_once((u, lever)), w, al, c


def _moment_columns(u: Vector, lever: Vector, w: Vector, al: Vector, c: Vector) -> Vector:
    """Columns of the first moments, `lever' ([al] + [w]^2) + c x u`."""
    along, square, fall = _dot(lever, w), _dot(w, w), _cross(lever, al)
    return [fall[k] + along * w[k] - square * lever[k] + _cross(c, u)[k] for k in range(3)]


def _inertia_columns(u: Vector, w: Vector, al: Vector) -> Vector:
    """Columns of the inertia, `u' (L(al) + [w] L(w))`, from the symmetric products of u with al and of u x w with w."""
    turned = _cross(u, w)
    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    diagonal = [u[i] * al[i] + turned[i] * w[i] for i in range(3)]
    mixed = {(i, j): u[i] * al[j] + u[j] * al[i] + turned[i] * w[j] + turned[j] * w[i] for i, j in pairs if i != j}
    return [diagonal[i] if i == j else mixed[i, j] for i, j in pairs]


def _once(x: Any) -> Any:
    return jax.lax.optimization_barrier(x)


def _components(x: Float[Array, "n rows samples"], first: int, count: int) -> Vector:
    return [x[:, k] for k in range(first, first + count)]


def _dot(x: Vector, y: Vector) -> Array:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _cross(x: Vector, y: Vector) -> Vector:
    return [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]


def _turned_back(R: Vector, x: Vector) -> Vector:
    return [R[k] * x[0] + R[3 + k] * x[1] + R[6 + k] * x[2] for k in range(3)]
