r"""Distances between the bodies of a robot, the floor and boxes: rows of an optimiser, and what is known to be clear.

Each collision shape stands in a capsule that encloses it, so distances between capsules are never above those of the
shapes. With x, y the nearest points of two axes and n the unit vector from y to x, $d = |x - y| - r_x - r_y$ and its
gradient by the motion of the bodies is n at x and -n at y: the nearest points themselves need no gradient (envelope
theorem), so all of it is closed-form arithmetic in NumPy with nothing to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..formats.collision import Shape, enclosed_points, rotation
from ..rigid.kinematics import ancestors
from ..rigid.model import RobotModel

__all__ = ["Box", "Capsule", "Clearance", "clearance_of", "enclosing_capsule", "farthest", "link_poses"]

LOOKED = 400  # random postures in which pairs are looked at
SELDOM = 0.10  # share of them in which a pair must be clear
OFTEN = 0.10  # share of random postures in which capsules are too near: it pays to know how much the meshes leave
FITTED, SURE = 30, 0.98  # instants of a motion in which its shapes are looked at, and the share of the least gap there
SEEN = 80  # postures in which these are looked at
FEW = 2  # shapes of a link that get a capsule each; of more than these, one goes around all
STILL = 1e-6  # m: a distance that changes less is none of a motion's
WORLD = -1
_TINY = 1e-9
_SEARCHED = 40  # steps of the search for the point of an axis next to a box; each leaves 0.62 of the interval

# distances (samples, pairs) at poses (links, 4, 4, samples), of pairs of links
MeshDistance = Callable[[np.ndarray, Sequence[tuple[int, int]]], Float[np.ndarray, "samples pairs"]]


class Capsule(NamedTuple):
    """All points within `radius` of the way from `start` to `end` (m), fixed to a frame; a sphere where these agree."""

    frame: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


class Box(NamedTuple):
    """A box that stands in the world, m; `turn` is roll, pitch, yaw in rad."""

    name: str
    size: tuple[float, float, float]  # edges
    at: tuple[float, float, float]  # its middle
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


class _Link(NamedTuple):
    """A rigid part of the robot: its moving joint (-1: fixed to the world), a name, its capsules and exact shapes."""

    joint: int
    name: str
    start: Float[np.ndarray, "capsules 3"]  # in the joint's frame
    end: Float[np.ndarray, "capsules 3"]
    radius: Float[np.ndarray, " capsules"]
    shapes: tuple[Shape, ...]  # posed in the joint's frame


@dataclass(frozen=True)
class Clearance:
    """Which bodies keep `margin` (m) from which, and how near they come."""

    model: RobotModel
    margin: float
    links: tuple[_Link, ...]
    pairs: tuple[tuple[int, int], ...]  # of links, kept apart by their capsules
    slack: tuple[float, ...] = ()  # m, of each pair: by so much at the least its capsules are too near, by the meshes
    exact: tuple[tuple[int, int], ...] = ()  # of links whose capsules are too coarse: looked at by mesh distance alone
    floor: float | None = None  # height, m
    floor_links: tuple[int, ...] = ()
    boxes: tuple[Box, ...] = ()
    box_links: tuple[tuple[int, ...], ...] = ()  # for each box
    mesh_distance: MeshDistance | None = None
    notes: tuple[str, ...] = ()
    rows: _Rows = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", _Rows(self))

    def name(self, row: int) -> str:
        """The two bodies of a row."""
        return self.rows.names[row]

    def exact_distances(
        self, q: Float[np.ndarray, "samples nv"], pairs: Sequence[tuple[int, int]]
    ) -> Float[np.ndarray, "samples pairs"] | None:
        """Between the exact shapes of pairs of links, m; None where coal is not installed."""
        return None if self.mesh_distance is None else self.mesh_distance(link_poses(self.model, q), pairs)

    def distances(self, q: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples rows"]:
        """Of each pair of capsules, of each capsule from the floor and from each box, m; negative: they overlap.

        The slack of a pair is added, so its distance is an estimate, which the meshes have to confirm in the end.
        """
        return self.rows.near(link_poses(self.model, q))[0]

    def capsule_distances(self, q: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples rows"]:
        """The same without slack: never above the distances of the shapes, m."""
        distance = self.distances(q)
        distance[:, : len(self.rows.slack)] -= self.rows.slack
        return distance

    def fitted(self, q: Float[np.ndarray, "samples nv"]) -> Clearance:
        """With the slack of each pair that its shapes leave in a motion, where its capsules alone are too near."""
        if self.mesh_distance is None or not self.pairs:
            return self
        slack, own = list(self.slack or [0.0] * len(self.pairs)), self.capsule_distances(q)
        for k, pair in enumerate(self.pairs):
            near = own[:, : len(self.rows.pair)][:, self.rows.pair == k].min(axis=1)
            close = np.flatnonzero(near < self.margin)
            if not len(close):
                continue
            some = np.unique(np.append(close[:: max(1, len(close) // FITTED)], near.argmin()))
            exact = self.exact_distances(q[some], [pair])
            assert exact is not None
            counts = exact[:, 0] <= max(2 * self.margin, float(exact.min()))
            slack[k] = SURE * max(0.0, float((exact[:, 0] - near[some])[counts].min()))
        return replace(self, slack=tuple(slack))

    def with_gradient(
        self, q: Float[np.ndarray, "samples nv"]
    ) -> tuple[
        Float[np.ndarray, "samples rows"],
        Callable[[Float[np.ndarray, "samples rows"]], Float[np.ndarray, "samples nv"]],
    ]:
        """`distances`, and the gradient by q of a function whose gradient by them is given."""
        poses = link_poses(self.model, q)
        distance, contact = self.rows.near(poses)
        return distance, lambda cotangent: self.rows.back(poses, contact, cotangent)


class _Contact(NamedTuple):
    """Nearest points in the world, and the unit vector from the second to the first."""

    first: Float[np.ndarray, "samples rows 3"]
    second: Float[np.ndarray, "samples rows 3"]
    normal: Float[np.ndarray, "samples rows 3"]


class _Rows:
    """The capsules side by side, and the rows that they make."""

    def __init__(self, given: Clearance) -> None:
        links = given.links
        self.model, self.given = given.model, given
        owner = np.repeat(np.arange(len(links)), [len(link.radius) for link in links])
        self.owner = owner
        self.joint = np.array([link.joint for link in links], int)[owner]
        self.start, self.end, self.radius = (
            np.concatenate([getattr(link, name) for link in links]) for name in ("start", "end", "radius")
        )
        of = [np.flatnonzero(owner == k) for k in range(len(links))]
        self.pair_rows = {(a, b): len(of[a]) * len(of[b]) for a, b in given.pairs}
        slack = dict(zip(given.pairs, given.slack, strict=True)) if given.slack else {}
        self.slack = np.repeat([slack.get(pair, 0.0) for pair in given.pairs], list(self.pair_rows.values()))
        self.pair = np.repeat(np.arange(len(given.pairs)), list(self.pair_rows.values()))  # of each row of a pair
        self.both = np.array([(i, j) for a, b in given.pairs for i in of[a] for j in of[b]], int).reshape(-1, 2)
        self.low = np.array([i for a in given.floor_links for i in of[a]], int)
        self.boxed = [np.array([i for a in some for i in of[a]], int) for some in given.box_links]
        name = [links[k].name for k in owner]
        self.names = [f"{name[i]} - {name[j]}" for i, j in self.both] + [f"{name[i]} - floor" for i in self.low]
        self.names += [f"{name[i]} - {b.name}" for b, some in zip(given.boxes, self.boxed, strict=True) for i in some]
        self.first = np.concatenate([self.both[:, 0], self.low, *self.boxed]).astype(int)  # capsule of each row
        # the second is fixed to the world but for pairs
        self.second = np.concatenate([self.both[:, 1], np.full(len(self.first) - len(self.both), -1)]).astype(int)

    def near(self, poses: Float[np.ndarray, "links 4 4 samples"]) -> tuple[np.ndarray, _Contact]:
        a, b = (_moved(poses, self.joint, x) for x in (self.start, self.end))
        i, j = self.both.T
        x, y = _segments(a[:, i], b[:, i], a[:, j], b[:, j])
        parts = [_between(x, y, self.radius[i] + self.radius[j] - self.slack)]
        if len(self.low):
            parts.append(_above(a[:, self.low], b[:, self.low], self.radius[self.low], self.given.floor or 0.0))
        for box, some in zip(self.given.boxes, self.boxed, strict=True):
            parts.append(_beside(a[:, some], b[:, some], self.radius[some], box))
        distance, contacts = np.concatenate([d for d, _ in parts], axis=1), [c for _, c in parts]
        return distance, _Contact(*(np.concatenate([c[k] for c in contacts], axis=1) for k in range(3)))

    def back(
        self, poses: np.ndarray, contact: _Contact, cotangent: Float[np.ndarray, "samples rows"]
    ) -> Float[np.ndarray, "samples nv"]:
        """Forces of the contacts on the links, moved along the tree as a Jacobian's transpose does."""
        model, out = self.model, np.zeros((len(cotangent), self.model.nv))
        active = np.flatnonzero(cotangent.any(axis=1))
        if not len(active):
            return out
        poses, cotangent, samples = poses[..., active], cotangent[active], len(active)
        contact = _Contact(*(x[active] for x in contact))
        force, torque = np.zeros((2, samples, len(model.joints), 3))
        push = cotangent[..., None] * contact.normal
        for capsule, at, sign in ((self.first, contact.first, 1.0), (self.second, contact.second, -1.0)):
            joint = np.where(capsule >= 0, self.joint[capsule], WORLD)
            used = np.flatnonzero(joint >= 0)
            own, moment = sign * push[:, used], sign * np.cross(at[:, used], push[:, used])
            which = (joint[used] == np.arange(len(model.joints))[:, None]).astype(float)
            force += np.einsum("lr,srk->slk", which, own)
            torque += np.einsum("lr,srk->slk", which, moment)
        above = ancestors(model.joints)
        force, torque = (np.einsum("jl,slk->sjk", above, x) for x in (force, torque))
        degrees = model.dofs
        for k, (joint, column) in enumerate(zip(degrees.joint, degrees.column, strict=True)):
            pose = poses[joint]
            axis = np.einsum("rcs,c->sr", pose[:3, :3], np.asarray(model.axis)[k])
            origin = pose[:3, 3].T
            turned = (axis * (torque[:, joint] - np.cross(origin, force[:, joint]))).sum(1)
            moved = turned if degrees.turns[k] else (axis * force[:, joint]).sum(1)
            out[active, column] += float(np.asarray(model.ratio)[joint]) * moved
        return out


def link_poses(model: RobotModel, q: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "links 4 4 samples"]:
    """Pose of every joint frame in the world; for robots of revolute and prismatic joints. The samples last."""
    poses: list[np.ndarray] = []
    placement, axes = np.asarray(model.placement, float), np.asarray(model.axis, float)
    ratio, offset = np.asarray(model.ratio, float), np.asarray(model.offset, float)
    for k, joint in enumerate(model.joints):
        x = ratio[k] * q[:, joint.coordinate] + offset[k]
        dof = int(model.dofs.first[k])
        own = np.zeros((4, 4, len(q)))
        own[3, 3] = 1.0
        axis = axes[dof]
        if model.dofs.turns[dof]:
            K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            turn = np.eye(3)[..., None] + K[..., None] * np.sin(x) + (K @ K)[..., None] * (1 - np.cos(x))
            own[:3, :3] = turn
        else:
            own[:3, :3] = np.eye(3)[..., None]
            own[:3, 3] = axis[:, None] * x
        carried = placement[k] if joint.parent < 0 else poses[joint.parent]
        if joint.parent < 0:
            poses.append(np.einsum("ij,jks->iks", carried, own))
        else:
            poses.append(np.einsum("ijs,jks->iks", np.einsum("ijs,jk->iks", carried, placement[k]), own))
    return np.stack(poses) if poses else np.zeros((0, 4, 4, len(q)))


def _moved(poses: np.ndarray, joint: np.ndarray, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "samples n 3"]:
    out = np.empty((poses.shape[3], len(points), 3))
    for j in np.unique(joint):
        own = np.flatnonzero(joint == j)
        if j < 0:
            out[:, own] = points[own]
        else:
            pose = poses[j]
            out[:, own] = np.einsum("rcs,nc->snr", pose[:3, :3], points[own]) + pose[:3, 3].T[:, None]
    return out


def _segments(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of the segments a-b and c-d (Ericson 2005, section 5.1.9)."""
    u, w, r = b - a, d - c, a - c
    A, E, F = (u * u).sum(-1), (w * w).sum(-1), (w * r).sum(-1)
    B, C = (u * w).sum(-1), (u * r).sum(-1)
    det = A * E - B * B
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(det > _TINY * A * E + 1e-300, np.clip((B * F - C * E) / det, 0, 1), 0.0)
        t = np.where(E > 0, (B * s + F) / E, 0.0)
        again = np.where(A > 0, np.clip(np.where(t < 0, -C, B - C) / A, 0, 1), 0.0)
    s = np.where((t < 0) | (t > 1) | (E <= 0), again, s)
    s = np.where(E <= 0, np.where(A > 0, np.clip(-C / np.where(A > 0, A, 1), 0, 1), 0.0), s)
    t = np.clip(t, 0, 1)
    return a + s[..., None] * u, c + t[..., None] * w


def _between(x: np.ndarray, y: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, _Contact]:
    way = x - y
    length = np.linalg.norm(way, axis=-1)
    normal = way / np.maximum(length, _TINY)[..., None]
    return length - radius, _Contact(x, y, normal)


def _above(a: np.ndarray, b: np.ndarray, radius: np.ndarray, floor: float) -> tuple[np.ndarray, _Contact]:
    low = np.where((a[..., 2] < b[..., 2])[..., None], a, b)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), low.shape)
    return low[..., 2] - floor - radius, _Contact(low, low * np.array([1.0, 1.0, 0.0]), up)


def _beside(a: np.ndarray, b: np.ndarray, radius: np.ndarray, box: Box) -> tuple[np.ndarray, _Contact]:
    """The distance of a point from a box is a convex function along a segment: its least by the golden section."""
    R, half = rotation(box.turn), np.array(box.size) / 2
    a, b = ((x - np.array(box.at)) @ R for x in (a, b))

    def signed(t: np.ndarray) -> np.ndarray:
        out = np.abs(a + t[..., None] * (b - a)) - half
        return np.linalg.norm(np.maximum(out, 0.0), axis=-1) + np.minimum(out.max(-1), 0.0)

    golden = (5**0.5 - 1) / 2
    low, high = np.zeros(a.shape[:-1]), np.ones(a.shape[:-1])
    for _ in range(_SEARCHED):
        left, right = high - golden * (high - low), low + golden * (high - low)
        nearer = signed(left) < signed(right)
        low, high = np.where(nearer, low, left), np.where(nearer, right, high)
    t = (low + high) / 2
    point = a + t[..., None] * (b - a)
    beyond = np.abs(point) - half
    outside = np.sign(point) * np.maximum(beyond, 0.0)
    length = np.linalg.norm(outside, axis=-1, keepdims=True)
    inside = np.sign(point) * (beyond == beyond.max(-1, keepdims=True))
    normal = np.where(length > _TINY, outside / np.maximum(length, _TINY), inside)
    distance = length[..., 0] + np.minimum(beyond.max(-1), 0.0)
    at = point @ R.T + np.array(box.at)
    return distance - radius, _Contact(at, at - distance[..., None] * (normal @ R.T), normal @ R.T)


def enclosing_capsule(points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """A capsule of small volume around the points: ends of its axis and radius, the axis near the longest extent."""
    from scipy.optimize import minimize  # slow to import
    from scipy.spatial import ConvexHull, QhullError

    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # flat, or too few: all of them then
        points = np.unique(points, axis=0)
    middle = points.mean(0)
    longest = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ longest
    across = np.linalg.norm(points - middle - along[:, None] * longest, axis=1).max()
    half = max((along.max() - along.min()) / 2 - across, 0.0)
    centre = middle + (along.max() + along.min()) / 2 * longest
    first = np.concatenate([centre - half * longest, centre + half * longest])

    def radius(x: np.ndarray) -> float:
        u = x[3:] - x[:3]
        t = np.clip((points - x[:3]) @ u / max(float(u @ u), 1e-12), 0, 1)
        return float(np.linalg.norm(points - x[:3] - t[:, None] * u, axis=1).max())

    def volume(x: np.ndarray) -> float:
        r = radius(x)
        return r**2 * float(np.linalg.norm(x[3:] - x[:3])) + 4 / 3 * r**3

    size = float(np.ptp(points, axis=0).max())
    options = {"maxfev": 1500, "xatol": 1e-4 * size, "fatol": 1e-6 * size**3}
    options["initial_simplex"] = np.concatenate([first[None], first + 0.1 * size * np.eye(6)])
    x = minimize(volume, first, method="Nelder-Mead", options=options).x
    return x[:3], x[3:], radius(x)


def clearance_of(
    model: RobotModel,
    shapes: Sequence[Shape] = (),
    *,
    margin: float = 0.02,
    bodies: Sequence[Capsule] = (),
    floor: float | None = None,
    boxes: Sequence[Box] = (),
    ignore: Iterable[Sequence[str]] = (),
    position: Float[np.ndarray, "nv 2"] | None = None,
    seed: int = 0,
) -> Clearance:
    """Distances that a motion keeps: of the robot's bodies from each other, the floor (its height, m) and boxes.

    `shapes` as `read_shapes` has them of the robot's file; `bodies` are further capsules, which stand in the place of
    the file's shapes on the frames that they name. Parts that a joint joins may touch; `ignore` names further pairs of
    links (or a link and "floor" or a box) that are not looked at. Pairs are tried in random postures within `position`
    (default: the model's limits). Raises `InputError` where there is no shape at all, a name is not known, or bodies
    are closer than the margin in nearly every posture.
    """
    links = _links(model, shapes, bodies)
    if len(links) < 2 and not (links and (floor is not None or boxes)):
        raise InputError(
            f"limits.clearance: the file of robot '{model.name}' has no collision shapes that can be read; give"
            " `bodies` (capsules, spheres) on its links, as in bodies: [{link: forearm, to: [0.4, 0, 0], radius: 0.06}]"
        )
    from .meshes import mesh_distance  # coal, where it is installed

    ignored = _ignored(links, boxes, ignore)
    apart = [
        (i, j)
        for i in range(len(links))
        for j in range(i)
        if _apart(model, links[i], links[j]) and (i, j) not in ignored
    ]
    movable = [k for k, link in enumerate(links) if link.joint >= 0]
    low = tuple(k for k in movable if floor is not None and (k, "floor") not in ignored)
    beside = tuple(tuple(k for k in movable if (k, box.name) not in ignored) for box in boxes)
    raw = Clearance(
        model, margin, links, tuple(apart), floor=floor, floor_links=low, boxes=tuple(boxes), box_links=beside
    )
    q = _postures(model, position, seed)
    return _tried(raw, mesh_distance(links), q)


def _postures(model: RobotModel, position: np.ndarray | None, seed: int) -> Float[np.ndarray, "samples nv"]:
    limits = np.array(model.position_limit if position is None else position, float)
    limits = np.clip(np.where(np.isfinite(limits), limits, [-np.pi, np.pi]), -2 * np.pi, 2 * np.pi)
    return np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (LOOKED, model.nv))


def _links(model: RobotModel, shapes: Sequence[Shape], bodies: Sequence[Capsule]) -> tuple[_Link, ...]:
    """The links of the file that have a shape; those that stand still are one."""
    frames = {frame.name: k for k, frame in enumerate(model.frames)}
    replaced, capsules, exact = {body.frame for body in bodies}, {}, {}
    for shape in shapes:
        if shape.frame in frames or shape.frame == "world":
            joint, pose = _place(model, frames, shape.frame)
            exact.setdefault((joint, shape.frame), []).append(shape._replace(pose=pose @ shape.pose))
    for key, some in exact.items():
        capsules[key] = [] if key[1] in replaced else _capsules(some)
    for body in bodies:
        if body.frame not in frames:
            raise InputError(f"bodies: the robot has no link or frame '{body.frame}'{nearest(body.frame, frames)}")
        joint, pose = _place(model, frames, body.frame)
        start, end = (pose[:3, :3] @ np.array(x, float) + pose[:3, 3] for x in (body.start, body.end))
        capsules.setdefault((joint, body.frame), []).append((start, end, float(body.radius)))
        if not any(shape.frame == body.frame for shape in shapes):
            exact.setdefault((joint, body.frame), []).append(_as_shape(start, end, float(body.radius)))
    still = [key for key in capsules if key[0] == WORLD]
    if len(still) > 1:  # one body, named after its first link
        for key in still[1:]:
            capsules[still[0]] += capsules.pop(key)
            exact[still[0]] += exact.pop(key)
    ordered = sorted(capsules, key=lambda key: key[0])
    return tuple(_Link(j, name, *_arrays(capsules[j, name]), tuple(exact[j, name])) for j, name in ordered)


def _arrays(capsules: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    start, end, radius = zip(*capsules, strict=True)
    return np.array(start), np.array(end), np.array(radius)


def _place(model: RobotModel, frames: Mapping[str, int], name: str) -> tuple[int, np.ndarray]:
    if name not in frames:
        return WORLD, np.eye(4)
    return model.frames[frames[name]].parent, np.asarray(model.frame_placement)[frames[name]]


def _capsules(shapes: Sequence[Shape]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """One capsule around each shape of a link, or one around them all."""
    if len(shapes) > FEW:
        return [enclosing_capsule(np.concatenate([_hull(shape) for shape in shapes]))]
    whole = [(enclosed_points(shape), shape) for shape in shapes]
    round_ones = ("sphere", "capsule")
    return [(x[0], x[1], s.size[0]) if s.kind in round_ones else enclosing_capsule(x) for x, s in whole]


def farthest(link: _Link) -> float:
    """Distance of the farthest point of a link, of its capsules and of its shapes, from its frame's origin, m."""
    ends = [np.linalg.norm(x, axis=1) + link.radius for x in (link.start, link.end)]
    return max(float(x.max()) for x in [*ends, *(np.linalg.norm(_hull(shape), axis=1) for shape in link.shapes)])


def _hull(shape: Shape) -> Float[np.ndarray, "n 3"]:
    """Points whose convex hull encloses the shape; of a sphere or capsule those of boxes around its ends."""
    points = enclosed_points(shape)
    if shape.kind not in ("sphere", "capsule"):
        return points
    corners = shape.size[0] * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return (points[:, None] + corners).reshape(-1, 3)


def _as_shape(start: np.ndarray, end: np.ndarray, radius: float) -> Shape:
    pose, way = np.eye(4), end - start
    length = float(np.linalg.norm(way))
    if length > _TINY:
        z = way / length
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        x /= np.linalg.norm(x)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    pose[:3, 3] = (start + end) / 2
    return Shape("", pose, "capsule", (radius, length / 2))


def _apart(model: RobotModel, one: _Link, other: _Link) -> bool:
    """Whether no joint joins the two, nor are they one rigid part."""
    joints = model.joints
    if one.joint == other.joint:
        return False
    parents = [(joints[k.joint].parent if k.joint >= 0 else None) for k in (one, other)]
    return parents[0] != other.joint and parents[1] != one.joint


def _ignored(
    links: Sequence[_Link], boxes: Sequence[Box], ignore: Iterable[Sequence[str]]
) -> set[tuple[int, int | str]]:
    names = {link.name: k for k, link in enumerate(links)}
    others = {"floor", *(box.name for box in boxes)}
    found: set[tuple[int, int | str]] = set()
    for pair in ignore:
        for name in pair:
            if name not in names and name not in others:
                raise InputError(f"ignore: no body '{name}' has a shape{nearest(name, [*names, *others])}")
        own = [names[name] for name in pair if name in names]
        if len(own) == 2:
            found |= {(own[0], own[1]), (own[1], own[0])}
        elif len(own) == 1:
            found |= {(own[0], name) for name in pair if name in others}
    return found


def _coarse(raw: Clearance, d: Float[np.ndarray, "samples rows"]) -> list[tuple[int, int]]:
    """Pairs whose capsules are too close in nearly every posture, but not always equally."""
    near = {pair: d[:, rows] for pair, rows in _rows_of(raw).items()}
    return [p for p, x in near.items() if (np.ptp(x, 0) > STILL).any() and _seldom_clear(x.min(1), raw.margin)]


def _seldom_clear(d: Float[np.ndarray, " samples"], margin: float) -> bool:
    return float(np.quantile(d, 1 - SELDOM)) < margin


def _rows_of(raw: Clearance) -> dict[tuple[int, int], list[int]]:
    at, out = 0, {}
    for pair, many in raw.rows.pair_rows.items():
        out[pair] = list(range(at, at + many))
        at += many
    return out


def _slack(
    raw: Clearance,
    exact: MeshDistance | None,
    pair: tuple[int, int],
    q: Float[np.ndarray, "samples nv"],
    d: Float[np.ndarray, " samples"],
) -> float:
    """Most of the least by which capsules that are often too near are nearer than their meshes, m."""
    close = np.flatnonzero(d < raw.margin)
    if exact is None or len(close) < OFTEN * len(d):
        return 0.0
    some = np.flatnonzero(np.abs(d - raw.margin) < raw.margin)[:SEEN]
    near = exact(link_poses(raw.model, q[some]), [pair])[:, 0]
    return 0.8 * max(0.0, float((near - d[some]).min(initial=np.inf))) if len(some) else 0.0


def _tried(raw: Clearance, exact: MeshDistance | None, q: Float[np.ndarray, "samples nv"]) -> Clearance:
    """Without what never changes; where capsules are nearly always too close, the meshes decide."""
    d = raw.distances(q)
    still = np.ptp(d, axis=0) < STILL
    pairs, coarse = _rows_of(raw), _coarse(raw, d)
    kept = [pair for pair, rows in pairs.items() if not still[rows].all()]
    notes: list[str] = []
    if coarse:
        near = None if exact is None else exact(link_poses(raw.model, q[: LOOKED // 4]), coarse)
        seen = [d[:, pairs[pair]].min(axis=1) if near is None else near[:, k] for k, pair in enumerate(coarse)]
        never = [
            (pair, float(x.min()), float(x.max()))
            for pair, x in zip(coarse, seen, strict=True)
            if near is None or np.quantile(x, SELDOM) < raw.margin
        ]
        if never:
            raise InputError(_always_close(raw, never, near is not None))
        named = ", ".join(f"{raw.links[i].name} - {raw.links[j].name}" for i, j in coarse)
        notes.append(f"capsules are too coarse for {named}: looked at by mesh distances alone")
    first, last = len(raw.rows.both), len(raw.rows.both) + len(raw.rows.low)
    low = tuple(k for k in raw.floor_links if not _fixed(raw, d, range(first, last), k, "floor"))
    beside = []
    for box, some, rows in zip(raw.boxes, raw.box_links, raw.rows.boxed, strict=True):
        first, last = last, last + len(rows)
        beside.append(tuple(k for k in some if not _fixed(raw, d, range(first, last), k, box.name)))
    smooth = tuple(pair for pair in kept if pair not in coarse)
    slack = tuple(_slack(raw, exact, pair, q, d[:, pairs[pair]].min(axis=1)) for pair in smooth)
    changed = {"floor_links": low, "box_links": tuple(beside), "mesh_distance": exact, "notes": tuple(notes)}
    return replace(raw, pairs=smooth, slack=slack, exact=tuple(coarse), **changed)


def _largest(d: np.ndarray, rows: list[int]) -> float:
    return float(d[:, rows].min(axis=1).max())


def _fixed(raw: Clearance, d: Float[np.ndarray, "samples rows"], rows: range, link: int, what: str) -> bool:
    """Whether a link's distance from the floor or a box is none of a motion's; refused where it is always too small."""
    own = [r for r in rows if raw.rows.owner[raw.rows.first[r]] == link]
    if (np.ptp(d[:, own], axis=0) < STILL).all():
        return True
    if _seldom_clear(d[:, own].min(axis=1), raw.margin):
        name = raw.links[link].name
        raise InputError(
            f"limits.clearance: '{name}' is closer than {raw.margin:g} m to '{what}' in nearly every posture"
            f" ({_largest(d, own):.3f} m at most); lower the margin, or leave the pair out by ignore:"
            f" [[{name}, {what}]]"
        )
    return False


def _always_close(raw: Clearance, never: Sequence[tuple[tuple[int, int], float, float]], exact: bool) -> str:
    names = {pair: tuple(raw.links[k].name for k in pair) for pair, _, _ in never}
    told = [f"{' and '.join(names[pair])} ({low:.3f} to {high:.3f} m)" for pair, low, high in never]
    pairs = ", ".join(f"[{', '.join(names[pair])}]" for pair, _, _ in never)
    by = "their meshes" if exact else "the capsules around their shapes"
    advice = "" if exact else "; with coal (pip install 'figaroh-jax[collision]') the meshes themselves are looked at"
    return (
        f"limits.clearance: closer than {raw.margin:g} m in nearly every posture, or too often to be kept apart, by"
        f" {by}: {'; '.join(told)}. Where bodies cannot touch each other, leave them out by ignore: [{pairs}]; else"
        f" lower the margin{advice}"
    )
