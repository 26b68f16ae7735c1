r"""Markers on bodies as measured data: sizes of segments by `fit`, joint positions by inverse kinematics over time.

A person's model has the right joints and the wrong lengths. Each segment carries a scale, by which everything that is
fixed on it moves: the joints that it carries and its markers. With the scales s, the markers' places m and the
positions $q_t$ of the frames t free, the misfit is

$$\sum_t \sum_k w_{tk}^2 \, |T_k(q_t, s)\, (s_k m_k) - z_{tk}|^2 + \lambda^2 |q_t - \bar q_t|^2$$

The positions are eliminated frame by frame (variable projection, Golub and Pereyra 1973, with Kaufman's derivative,
1975): a fit sees a few scales and no positions, and a frame costs a solve of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from ..compiled.precision import in_float64
from ..effects.extended import ExtendedModel
from ..errors import InputError, nearest
from ..rigid.kinematics import axis_twists, forward_kinematics, movers, pose_columns
from ..rigid.manifold import integrate, neutral
from ..rigid.model import Leaf, RobotModel

__all__ = ["MarkerData", "Sizes", "joint_positions", "marker_data", "scaled", "segment_sizes", "segments_of"]

_STIFF = 0.02  # 1/rad, 1/m: weight of a position's distance from where it was, beside markers in their sigmas
_BEYOND = 30.0  # 1/rad, 1/m: weight of a position beyond its limit
_LONGEST = 0.3  # rad, m: of one step of a position; a longer one may turn a joint round
_TURNS = 4  # Gauss-Newton steps of the positions for each set of scales
_BLOCK = 200  # frames at once


class MarkerData(eqx.Module):
    """Places of markers over time, and what of the segments is open: data of `fit` (`free="segments"`)."""

    seen: Float[Leaf, "frames markers 3"]  # m, in the world
    weight: Float[Leaf, "frames markers"]  # 1 / sigma; 0: not seen
    place: Float[Leaf, "markers 3"]  # m, in the frame of the link that carries it, unscaled
    start: Float[Leaf, "frames nq"]  # positions to search from
    scale: Float[Leaf, " segments"]
    shift: Float[Leaf, "markers 3"]  # m, of the markers against their places
    link: tuple[int, ...] = eqx.field(static=True)  # tree index of each marker's link
    segment: tuple[int, ...] = eqx.field(static=True)  # segment of each tree joint's link, -1: it keeps its size
    names: tuple[str, ...] = eqx.field(static=True)  # of the segments
    labels: tuple[str, ...] = eqx.field(static=True)  # of the markers

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """A scale for each segment, then three coordinates for each marker."""
        sizes = [(f"segments {name}", "1", 0.1) for name in self.names]
        return (*sizes, *((f"markers {label} {axis}", "m", 0.01) for label in self.labels for axis in "xyz"))

    def moved(self, numbers: Float[Array, " unknowns"]) -> MarkerData:
        """With the scales and the markers' places changed by so much."""
        count = len(self.names)
        parts = jnp.asarray(self.scale) + numbers[:count], jnp.asarray(self.shift) + numbers[count:].reshape(-1, 3)
        return eqx.tree_at(lambda d: (d.scale, d.shift), self, parts)

    def residual(self, model: ExtendedModel) -> Float[Array, " rows"]:
        """Predicted less seen times the weight at the best positions, and how far these are from `start`."""
        robot = self.robot(model.robot)
        q = jax.lax.stop_gradient(_solved(robot, self, jnp.asarray(self.start), _TURNS))
        rows, slopes = _rows(robot, self, q), jax.lax.stop_gradient(_slopes(robot, self, q))
        basis = jnp.linalg.qr(slopes)[0]
        inside = jnp.einsum("trk,tk->tr", basis, jnp.einsum("tsk,ts->tk", basis, rows))
        return (rows - inside + jax.lax.stop_gradient(inside)).reshape(-1)

    def robot(self, robot: RobotModel) -> RobotModel:
        """The robot with the segments' present sizes."""
        return scaled(robot, self.segment, jnp.asarray(self.scale))


class Sizes(NamedTuple):
    """Sizes of a person's segments by markers."""

    data: MarkerData  # with the sizes, the markers' places and the positions found
    scale: Float[np.ndarray, " segments"]
    std: Float[np.ndarray, " segments"]  # one sigma; the prior's where the markers show nothing
    rms: float  # m, of the markers


class _Motion(NamedTuple):
    position: Float[np.ndarray, "frames nq"]
    residual: Float[np.ndarray, "frames markers 3"]  # m, predicted less seen; NaN where not seen


def segments_of(robot: RobotModel) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the segments, the links with a mass, and the segment of each link.

    Massless links between the axes of one anatomical joint have no size: theirs is that of the next link with a mass.

    >>> import figaroh_jax as fj
    >>> fj.markers.segments_of(fj.load_urdf(fj.DEMO))[0]
    ('turret', 'upper_arm', 'forearm', 'hand')
    """
    mass = np.asarray(robot.inertia)[:, 0]
    names = tuple(joint.link for joint, m in zip(robot.joints, mass, strict=True) if m > 0)
    index = [names.index(joint.link) if m > 0 else -1 for joint, m in zip(robot.joints, mass, strict=True)]
    for i, joint in enumerate(robot.joints):
        children = [k for k, other in enumerate(robot.joints) if other.parent == i]
        if index[i] < 0 and len(children) > 1:  # a base without a mass, such as a pelvis that its joints hang on
            index[i] = len(names)
            names = (*names, joint.link)
    return names, tuple(index)


def scaled(robot: RobotModel, segment: Sequence[int], scale: Any) -> RobotModel:
    """The robot whose segments are `scale` times as long: the joints and frames that a link carries move with it.

    Inertial parameters stay; `identification.people.anthropometric` gives those of the new sizes.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> names, segment = fj.markers.segments_of(robot)
    >>> twice = fj.markers.scaled(robot, segment, 2.0 * np.ones(len(names)))
    >>> bool(np.allclose(twice.placement[-1][:3, 3], 2 * np.asarray(robot.placement[-1][:3, 3])))
    True
    """
    one = jnp.concatenate([jnp.asarray(scale), jnp.ones(1)])[np.asarray(segment)]
    carried = jnp.concatenate([one, jnp.ones(1)])
    joints = carried[np.array([joint.parent for joint in robot.joints])]
    frames = carried[np.array([frame.parent for frame in robot.frames])]
    place = jnp.asarray(robot.placement)
    place = place.at[:, :3, 3].multiply(joints[:, None])
    marked = jnp.asarray(robot.frame_placement).at[:, :3, 3].multiply(frames[:, None])
    return eqx.tree_at(lambda r: (r.placement, r.frame_placement), robot, (place, marked))


def marker_data(
    robot: RobotModel,
    markers: Mapping[str, tuple[str, Sequence[float]]],
    seen: Mapping[str, Float[np.ndarray, "frames 3"]],
    sigma: float = 0.005,
    start: Float[np.ndarray, "frames nq"] | None = None,
) -> MarkerData:
    """Data of markers: by label the link and the place on it (m), and by label the places in the world (m).

    NaN where a marker was not seen; `sigma` (m) is the deviation of a marker from its place on the bone, soft tissue
    included. `start`: positions to search from (default: neutral). Raises `InputError` for unknown links and labels,
    wrong shapes, and a motion of which a frame shows fewer than six coordinates.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, zero = fj.load_urdf(fj.DEMO), np.zeros((2, 4))
    >>> places = {"tip": ("hand", (0.0, 0.0, 0.1)), "side": ("hand", (0.1, 0.0, 0.0))}
    >>> poses = np.asarray(fj.frame_placement(robot, zero, "hand"))
    >>> seen = {label: poses[:, :3, :3] @ np.array(at) + poses[:, :3, 3] for label, (_, at) in places.items()}
    >>> data = fj.markers.marker_data(robot, places, seen, start=zero)
    >>> data.seen.shape
    (2, 2, 3)
    """
    names, segment = segments_of(robot)
    for label, (link, place) in markers.items():
        if link not in robot.link_names:
            raise InputError(
                f"marker '{label}': robot '{robot.name}' has no link '{link}'{nearest(link, robot.link_names)}"
            )
        if np.shape(place) != (3,) or not np.isfinite(np.asarray(place, float)).all():
            raise InputError(f"marker '{label}': its place on '{link}' is {place}; three finite numbers in m")
    unknown = [label for label in seen if label not in markers]
    if unknown or not seen:
        raise InputError(f"markers: {'no marker was seen' if not seen else unknown[0] + ' is not on a link'}")
    frames = {np.shape(one) for one in seen.values()}
    if len(frames) > 1 or len(next(iter(frames))) != 2 or next(iter(frames))[1] != 3:
        raise InputError(f"markers: shapes {sorted(frames)}; each is (frames, 3), all with the same frames")
    labels = tuple(label for label in markers if label in seen)
    places = np.stack([np.asarray(seen[label], float) for label in labels], axis=1)
    present = np.asarray(np.isfinite(places).all(axis=2))
    if (present.sum(axis=1) < 2).any():
        raise InputError(f"markers: frame {int(np.argmax(present.sum(axis=1) < 2))} shows fewer than two of them")
    index = [robot.link_names.index(markers[label][0]) for label in labels]
    if start is None:
        start = _upright(robot, index, np.array([markers[label][1] for label in labels], float), places)
    return MarkerData(
        seen=np.where(present[..., None], places, 0.0),
        weight=present / sigma,
        place=np.array([markers[label][1] for label in labels], float),
        start=np.asarray(start, float),
        scale=np.ones(len(names)),
        shift=np.zeros((len(labels), 3)),
        link=tuple(index),
        segment=segment,
        names=names,
        labels=labels,
    )


def segment_sizes(
    robot: RobotModel, data: MarkerData, spread: float = 0.15, misplaced: float = 0.006, turns: int = 6
) -> Sizes:
    """Sizes of the segments and places of the markers, positions eliminated frame by frame.

    Gauss-Newton on the same misfit as `fit(robot, data, ["segments", "markers"])`, whose rows it takes apart: a frame's
    positions never enter a matrix with those of another. `spread` is one sigma of a scale about one, `misplaced` (m) of
    each coordinate of a marker about its place. A few dozen frames of a motion of all joints are enough.
    An example: `docs/people.md`.
    """
    count, labels = len(data.names), len(data.labels)
    precision = np.concatenate([np.full(count, spread**-2.0), np.full(3 * labels, misplaced**-2.0)])
    first = np.concatenate([np.ones(count), np.zeros(3 * labels)])
    data = eqx.tree_at(lambda d: d.start, data, joint_positions(robot, data).position)
    for _ in range(turns):
        y = np.concatenate([np.asarray(data.scale), np.ravel(data.shift)])
        q, rows, slopes, by_scale, turned = (np.asarray(x) for x in _opened(robot, data))
        slope = np.zeros((*rows.shape, len(y)))
        slope[:, :, :count] = by_scale
        for m in range(labels):
            at = slice(3 * m, 3 * m + 3)
            slope[:, at, count + 3 * m : count + 3 * m + 3] = turned[:, m]
        basis = np.linalg.qr(slopes)[0]
        own = slope - basis @ (np.swapaxes(basis, 1, 2) @ slope)
        normal = np.einsum("trp,trq->pq", own, own, optimize=True) + np.diag(precision)
        step = np.linalg.solve(normal, np.einsum("trp,tr->p", own, rows) + precision * (y - first))
        y = y - step
        parts = y[:count], y[count:].reshape(-1, 3), q
        data = eqx.tree_at(lambda d: (d.scale, d.shift, d.start), data, parts)
    found = joint_positions(robot, data)
    data = eqx.tree_at(lambda d: d.start, data, found.position)
    std = np.sqrt(np.diag(np.linalg.inv(normal)))[:count]  # pyright: ignore[reportPossiblyUnboundVariable]
    return Sizes(data, np.asarray(data.scale), std, float(np.sqrt(np.nanmean(found.residual**2))))


@in_float64
def _opened(robot: RobotModel, data: MarkerData) -> tuple[Array, ...]:
    return _open(robot, data)


@eqx.filter_jit
def _open(robot: RobotModel, data: MarkerData) -> tuple[Array, ...]:
    """Best positions; the rows there and their derivatives by positions, scales and the markers' coordinates."""
    grown = data.robot(robot)
    q = _solved(grown, data, jnp.asarray(data.start), _TURNS)
    columns = pose_columns(grown, q.T)[np.array(data.link)]
    turned = jnp.transpose(columns[:, 1:], (3, 0, 2, 1)) * jnp.asarray(data.weight)[..., None, None]

    def rows(scale: Array) -> Array:
        other = eqx.tree_at(lambda d: d.scale, data, scale)
        return _rows(other.robot(robot), other, q)

    by_scale = jax.jacfwd(rows)(jnp.asarray(data.scale))
    return q, _rows(grown, data, q), _slopes(grown, data, q), by_scale, turned


def _upright(
    robot: RobotModel, links: Sequence[int], local: Float[np.ndarray, "markers 3"], places: np.ndarray
) -> Float[np.ndarray, "frames nq"]:
    """The neutral posture, of a free robot each frame's nearest as a rigid body (Kabsch 1976)."""
    start = np.tile(neutral(robot), (len(places), 1))
    if robot.joints[0].kind != "free":
        return start
    poses = np.asarray(forward_kinematics(robot, start[0]))[links]
    model = np.einsum("mij,mj->mi", poses[:, :3, :3], local) + poses[:, :3, 3]
    for row, seen in zip(start, places, strict=True):
        there = np.isfinite(seen).all(1)
        middle, centre = model[there].mean(0), seen[there].mean(0)
        turn = Rotation.align_vectors(seen[there] - centre, model[there] - middle)[0]
        row[:3], row[3:7] = centre - turn.apply(middle), turn.as_quat()
    return start


def joint_positions(robot: RobotModel, data: MarkerData, turns: int = 15) -> _Motion:
    """Positions of every frame by inverse kinematics (rad, m), and the markers' residuals.

    Damped Gauss-Newton steps from `data.start`, all frames at once; a position that no marker shows stays there.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, q = fj.load_urdf(fj.DEMO), np.array([[0.1, 0.2, -0.3, 0.1]])
    >>> places = {"tip": ("hand", (0.0, 0.0, 0.1)), "side": ("hand", (0.1, 0.0, 0.0))}
    >>> pose = np.asarray(fj.frame_placement(robot, q, "hand"))
    >>> seen = {label: pose[:, :3, :3] @ np.array(at) + pose[:, :3, 3] for label, (_, at) in places.items()}
    >>> found = fj.markers.joint_positions(robot, fj.markers.marker_data(robot, places, seen))
    >>> bool(np.abs(found.residual).max() < 1e-3)  # m
    True
    """
    answers = []
    for first in range(0, len(np.asarray(data.seen)), _BLOCK):
        block = slice(first, first + _BLOCK)
        parts = [np.asarray(x)[block] for x in (data.seen, data.weight, data.start)]
        more = _BLOCK - len(parts[0]) if first else 0  # blocks of one size, so that one program does
        parts = [np.concatenate([x, np.repeat(x[-1:], more, axis=0)]) for x in parts]
        q, gone = _searched(robot, eqx.tree_at(lambda d: (d.seen, d.weight, d.start), data, tuple(parts)), turns)
        count = len(parts[0]) - more
        answers.append((np.asarray(q)[:count], np.asarray(gone)[:count]))
    q, gone = (np.concatenate(x) for x in zip(*answers, strict=True))
    return _Motion(q, np.where(np.asarray(data.weight)[..., None] > 0, gone, np.nan))


@in_float64
def _searched(robot: RobotModel, data: MarkerData, turns: int) -> tuple[Array, Array]:
    return _search(robot, data, turns)


@eqx.filter_jit
def _search(robot: RobotModel, data: MarkerData, turns: int) -> tuple[Array, Array]:
    robot = data.robot(robot)
    q = _solved(robot, data, jnp.asarray(data.start), turns)
    return q, jnp.moveaxis(_places(data, pose_columns(robot, q.T)), 2, 0) - jnp.asarray(data.seen)


def _solved(robot: RobotModel, data: MarkerData, q: Array, turns: int) -> Array:
    """Positions after so many damped Gauss-Newton steps; a step that worsens a frame is taken back and damped more."""
    robot, data = (
        jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, part) for part in (robot, data)
    )

    def turn(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        q, damping = state
        rows, slope = _rows(robot, data, q), _slopes(robot, data, q)
        normal, side = jnp.swapaxes(slope, 1, 2) @ slope, jnp.einsum("trk,tr->tk", slope, rows)
        size = jnp.diagonal(normal, axis1=1, axis2=2)
        weight = damping[:, None] * (size + size.mean(axis=1, keepdims=True))
        factor = jnp.linalg.cholesky(normal + weight[:, :, None] * jnp.eye(robot.nv))
        way = jax.vmap(lambda f, s: jax.scipy.linalg.cho_solve((f, True), s))(factor, side)
        way = way * jnp.minimum(1.0, _LONGEST / jnp.max(jnp.abs(way), axis=1, keepdims=True))
        new = integrate(robot, q, -way)
        good = jnp.sum(_rows(robot, data, new) ** 2, axis=1) < jnp.sum(rows**2, axis=1)
        return jnp.where(good[:, None], new, q), jnp.where(good, 0.2, 8.0) * damping

    return jax.lax.fori_loop(0, turns, turn, (jax.lax.stop_gradient(q), jnp.full(len(q), 1e-2)))[0]


def _places(data: MarkerData, columns: Float[Array, "nj 4 3 frames"]) -> Float[Array, "markers 3 frames"]:
    """Where the markers are, m."""
    size = jnp.concatenate([jnp.asarray(data.scale), jnp.ones(1)])[np.array(data.segment)[np.array(data.link)]]
    local = size[:, None] * jnp.asarray(data.place) + jnp.asarray(data.shift)
    own = columns[np.array(data.link)]
    return own[:, 0] + jnp.einsum("mi,mijt->mjt", local, own[:, 1:])


def _rows(robot: RobotModel, data: MarkerData, q: Float[Array, "frames nq"]) -> Float[Array, "frames rows"]:
    """Markers in their sigmas, then how far each single axis is from its start and beyond its limits."""
    at, column = _single(robot)
    off = jnp.moveaxis(_places(data, pose_columns(robot, q.T)), 2, 0) - jnp.asarray(data.seen)
    limit, own = jnp.asarray(robot.position_limit)[column], q[:, at]
    away = _STIFF * (own - jnp.asarray(data.start)[:, at])
    beyond = _BEYOND * (own - jnp.clip(own, limit[:, 0], limit[:, 1]))
    return jnp.concatenate([(jnp.asarray(data.weight)[..., None] * off).reshape(len(q), -1), away, beyond], axis=1)


def _slopes(robot: RobotModel, data: MarkerData, q: Float[Array, "frames nq"]) -> Float[Array, "frames rows nv"]:
    """Derivative of `_rows` along `integrate`, by the twists of the joints."""
    at, column = _single(robot)
    columns = pose_columns(robot, q.T)
    linear, angular = axis_twists(robot, columns)
    points = _places(data, columns)
    moved = jnp.asarray(movers(robot)[:, np.array(data.link)], points.dtype)
    spin = jnp.cross(angular[:, None], points[None], axis=2)
    by_dof = moved[:, :, None, None] * (linear[:, None] + spin)
    by_dof = by_dof * jnp.asarray(robot.ratio)[robot.dofs.joint][:, None, None, None]
    if robot.nd != robot.nv or (robot.dofs.column != np.arange(robot.nv)).any():  # mimic joints, joints reordered
        by_dof = jnp.zeros((robot.nv, *by_dof.shape[1:])).at[robot.dofs.column].add(by_dof)
    whole = jnp.transpose(by_dof, (3, 1, 2, 0)) * jnp.asarray(data.weight)[:, :, None, None]
    limit, own = jnp.asarray(robot.position_limit)[column], q[:, at]
    unit = jnp.asarray(np.eye(robot.nv)[column])
    outside = jnp.where((own < limit[:, 0]) | (own > limit[:, 1]), _BEYOND, 0.0)
    stiff = jnp.broadcast_to(_STIFF * unit, (len(q), *unit.shape))
    return jnp.concatenate([whole.reshape(len(q), -1, robot.nv), stiff, outside[..., None] * unit], axis=1)


def _single(robot: RobotModel) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Numbers in q and columns of v of the joints of one axis."""
    pairs = zip(robot.joints, robot.dofs.positions, strict=True)
    kept = [(at.start, j.coordinate) for j, at in pairs if j.kind in ("revolute", "prismatic") and not j.follows]
    first, second = zip(*kept, strict=True) if kept else ((), ())
    return np.array(first, int), np.array(second, int)
