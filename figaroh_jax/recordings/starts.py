r"""Where devices begin: base frame, tool frame, sockets and planes in closed form from the nominal robot's poses.

For N postures `R`, `p` are rotation (N, 3, 3) and origin (N, 3) of the tool frame in the base frame (m). What was not
measured is NaN and is left out. Without noise and with a right robot the frames are exact.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

__all__ = ["fit_plane", "place_points", "place_poses", "place_sockets", "rigid_transform"]

Array = np.ndarray


def rigid_transform(a: Float[Array, "n 3"], b: Float[Array, "n 3"]) -> Float[Array, "4 4"]:
    """Pose T with the least sum of |T a - b|^2 (Kabsch 1976)."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = _nearest_rotation((b - middle_b).T @ (a - middle_a))
    pose[:3, 3] = middle_b - pose[:3, :3] @ middle_a
    return pose


def place_points(
    R: Float[Array, "n 3 3"], p: Float[Array, "n 3"], points: Float[Array, "n markers 3"], estimated: tuple[str, ...]
) -> tuple[Float[Array, "4 4"], Float[Array, "markers 3"]]:
    r"""Pose of the base frame in the device's frame and the markers in the tool frame (m), from measured points.

    With both unknown $A x_{ik} + b = p_i + R_i m_k$ is linear in $A = R_B'$, b and m; A is then made a rotation and b
    and m are solved again. The better of this and of the base alone is taken.
    """
    markers = np.zeros((points.shape[1], 3))
    seen = np.isfinite(points).all(axis=2)
    i, k = np.nonzero(seen)
    x = points[i, k]
    base = rigid_transform(p[i], x) if "base_frame" in estimated else np.eye(4)
    if "tool_frame" not in estimated:
        return base, markers
    options = [(base, _markers(base, R, p, points))]
    if "base_frame" in estimated and len(x) * 3 >= 12 + markers.size:
        pick = np.eye(len(markers))[k]
        own = np.einsum("nm,nij->nimj", pick, R[i]).reshape(len(x) * 3, -1)
        fixed = np.einsum("ij,nk->nijk", np.eye(3), x).reshape(len(x) * 3, 9)
        linear = np.hstack([fixed, np.tile(np.eye(3), (len(x), 1)), -own])
        A = np.linalg.lstsq(linear, p[i].reshape(-1), rcond=1e-10)[0][:9].reshape(3, 3)
        base = np.eye(4)
        base[:3, :3] = _nearest_rotation(A).T
        rest = np.linalg.lstsq(linear[:, 9:], (p[i] - x @ base[:3, :3]).reshape(-1), rcond=1e-10)[0]
        base[:3, 3] = -base[:3, :3] @ rest[:3]
        options.append((base, rest[3:].reshape(-1, 3)))

    def cost(option: tuple[Array, Array]) -> float:
        base, markers = option
        return float(
            np.sum(((p[i] + np.einsum("nij,nj->ni", R[i], markers[k])) @ base[:3, :3].T + base[:3, 3] - x) ** 2)
        )

    return min(options, key=cost)


def _markers(base: Array, R: Array, p: Array, points: Array) -> Array:
    """Markers in the tool frame for a known base: the mean over the postures that show each."""
    local = np.einsum("nji,nkj->nki", R, (points - base[:3, 3]) @ base[:3, :3] - p[:, None])
    return np.nanmean(local, axis=0)


def place_poses(
    R: Float[Array, "n 3 3"], p: Float[Array, "n 3"], poses: Float[Array, "n 4 4"], estimated: tuple[str, ...]
) -> tuple[Float[Array, "4 4"], Float[Array, "4 4"]]:
    r"""Pose of the base frame in the device's frame and pose of the marker in the tool frame, from measured poses.

    Rotations first, $M_i X' = B R_i$, as the null vector of a linear system for both (Shah 2013), or the nearest mean
    where one of them is known; then both translations, which are linear.
    """
    seen = np.isfinite(poses).all(axis=(1, 2))
    R_m, x = poses[seen, :3, :3], poses[seen, :3, 3]
    R, p = R[seen], p[seen]
    base, tool = np.eye(4), np.eye(4)
    if {"base_frame", "tool_frame"} <= set(estimated):
        base[:3, :3], tool[:3, :3] = _both_rotations(R, R_m)
        turn = _about_the_axis(base[:3, :3], R, p, x)
        base[:3, :3], tool[:3, :3] = base[:3, :3] @ turn, turn.T @ tool[:3, :3]
    elif "base_frame" in estimated:
        base[:3, :3] = _nearest_rotation(np.einsum("nij,nkj->ik", R_m, R))
    elif "tool_frame" in estimated:
        tool[:3, :3] = _nearest_rotation(np.einsum("nji,njk->ik", R, R_m))
    turned = base[:3, :3] @ R
    columns = [np.broadcast_to(np.eye(3), turned.shape)] * ("base_frame" in estimated)
    columns += [turned] * ("tool_frame" in estimated)
    if columns:
        linear = np.concatenate(columns, axis=2).reshape(3 * len(x), -1)
        found = np.linalg.lstsq(linear, (x - p @ base[:3, :3].T).reshape(-1), rcond=1e-10)[0]
        if "base_frame" in estimated:
            base[:3, 3], found = found[:3], found[3:]
        if "tool_frame" in estimated:
            tool[:3, 3] = found
    return base, tool


def _both_rotations(R: Array, R_m: Array) -> tuple[Array, Array]:
    """B and X with M_i = B R_i X for all i, the better of two ways.

    Where all postures turn about one axis many B and X do, and the null vector of the first way mixes them into no
    rotation; the second takes one of them.
    """
    ways = _by_null_vector(R, R_m), _by_turns(R, R_m)
    return min(ways, key=lambda pair: float(np.sum((R_m @ pair[1].T - pair[0] @ R) ** 2)))


def _by_turns(R: Array, R_m: Array) -> tuple[Array, Array]:
    """B and X from the turns between postures, whose vectors X' takes from the robot's to the device's (Park 1994)."""
    from scipy.spatial.transform import Rotation

    i, j = np.triu_indices(len(R), 1)
    some = slice(None, None, max(len(i) // _PAIRS, 1))
    i, j = i[some], j[some]
    a, b = (Rotation.from_matrix(np.swapaxes(x[i], 1, 2) @ x[j]).as_rotvec() for x in (R, R_m))
    told = (np.linalg.norm(a, axis=1) < _HALF_TURN) & (np.linalg.norm(b, axis=1) < _HALF_TURN)
    X = _nearest_rotation(b[told].T @ a[told]).T
    return _nearest_rotation(np.einsum("nij,kj,nlk->il", R_m, X, R)), X


def _about_the_axis(B: Array, R: Array, p: Array, x: Array) -> Float[Array, "3 3"]:
    """What the positions add to B where all postures turn about one axis: then orientations leave a turn about it open.

    With the axis a, x_i = b + B (c p_across + s a x p + p_along) + B R_i m is linear in c, s, b and m.
    """
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.swapaxes(R[:1], 1, 2) @ R[1:]).as_rotvec()
    _, size, axes = np.linalg.svd(turns, full_matrices=False)
    if len(turns) < 3 or size[1] > _ONE_AXIS * size[0]:
        return np.eye(3)
    axis = R[0] @ axes[0]
    along = np.outer(p @ axis, axis)
    columns = [(p - along) @ B.T, np.cross(axis, p) @ B.T]
    pose = np.concatenate([np.broadcast_to(np.eye(3), R.shape), B @ R], axis=2).reshape(3 * len(x), 6)
    linear = np.hstack([np.stack([one.reshape(-1) for one in columns], axis=1), pose])
    cosine, sine = np.linalg.lstsq(linear, (x - along @ B.T).reshape(-1), rcond=1e-10)[0][:2]
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis).as_matrix()


_ONE_AXIS = 0.02  # second to first singular value of the turns: what noise makes of one axis
_PAIRS, _HALF_TURN = 2000, 3.0  # rad: beyond it noise turns a vector round


def _by_null_vector(R: Array, R_m: Array) -> tuple[Array, Array]:
    """B and X as the null vector of M X' = B R (Shah 2013)."""
    eye = np.eye(3)
    # M X' - B R = 0, the entries of X' and of B row by row
    of_tool = np.einsum("nij,kl->nikjl", R_m, eye).reshape(-1, 9)
    of_base = np.einsum("ij,nlk->nikjl", eye, R).reshape(-1, 9)
    null = np.linalg.svd(np.hstack([of_tool, -of_base]), full_matrices=False)[2][-1]
    X_t, B = null[:9].reshape(3, 3), null[9:].reshape(3, 3)
    sign = np.sign(np.linalg.det(B)) or 1.0
    return _nearest_rotation(sign * B), _nearest_rotation(sign * X_t).T


def place_sockets(
    R: Float[Array, "n 3 3"], p: Float[Array, "n 3"], socket: Int[Array, " n"], estimated: tuple[str, ...]
) -> tuple[Float[Array, "3"], Float[Array, "sockets 3"]]:
    """The tool point in the tool frame and the sockets in the base frame (m): linear in both."""
    point = np.zeros(3)
    if "tool_frame" in estimated:
        centred_R = R - _means(R, socket)[socket]
        centred_p = p - _means(p, socket)[socket]
        point = -np.linalg.lstsq(centred_R.reshape(-1, 3), centred_p.reshape(-1), rcond=1e-10)[0]
    return point, _means(p + R @ point, socket)


def _means(values: Array, group: Array) -> Array:
    return np.stack([values[group == g].mean(axis=0) for g in range(group.max() + 1)])


def fit_plane(points: Float[Array, "n 3"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Axes (rows; the third is the normal) and middle of the plane nearest to the points."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle)[2]
    return axes * np.array([[1.0], [1.0], [np.sign(np.linalg.det(axes))]]), middle


def _nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation with the greatest product with `matrix`."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
