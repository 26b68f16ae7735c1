r"""A person's segments: inertial parameters from motion capture and force plates, beside anthropometric tables.

The six rows of the root are all that is measured: the wrench with which the plates hold the person, in the frame of the
pelvis, is linear in the ten parameters of every segment. The motion shows a part of them; a table gives the rest,
as a prior of stated width, and every interval says which of the two it comes from.

The table is de Leva's (Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, Journal of Biomechanics 29(9),
1223-1230, 1996, table 4): shares of the body mass, distance of the centre of mass from the proximal joint and radii of
gyration (about the antero-posterior, the lateral and the long axis) in shares of the segment's length. Lengths are
those between joint centres (the table's rows SJC-EJC, EJC-WJC, HJC-KJC and KJC-AJC), for a model has joints there; the
rows from the knee to a malleolus are another length. The numbers were compared with two public copies of the table, of
BMClab (all agree) and of biobuddy (all but a rounding of the head's mass and its shank, which ends at the malleolus).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from ..errors import InputError
from ..estimation.consistency import bodies, physical_fit
from ..estimation.markers import scaled, segments_of
from ..rigid.inertia import from_com, to_com
from ..rigid.kinematics import forward_kinematics
from ..rigid.manifold import difference
from ..rigid.model import RobotModel
from .plates import PLATE, balanced, standing
from .wrenches import wrench_regressor

__all__ = [
    "PLATE",
    "Capture",
    "Payload",
    "Segments",
    "anthropometric",
    "balanced",
    "capture",
    "identify_segments",
    "name_payload",
    "predicted",
    "standing",
]

Sex = Literal["female", "male"]


class _Segment(NamedTuple):
    mass: float  # share of the body's
    centre: float  # share of the length, from the proximal joint; 0: of a segment whose length no joint shows
    radii: tuple[float, float, float]  # antero-posterior, lateral, long axis


_TABLE: dict[str, dict[Sex, _Segment]] = {
    "head": {"female": _Segment(0.0668, 0, (0, 0, 0)), "male": _Segment(0.0694, 0, (0, 0, 0))},
    "trunk": {"female": _Segment(0.4257, 0, (0, 0, 0)), "male": _Segment(0.4346, 0, (0, 0, 0))},
    "upper arm": {
        "female": _Segment(0.0255, 0.5754, (0.278, 0.260, 0.148)),
        "male": _Segment(0.0271, 0.5772, (0.285, 0.269, 0.158)),
    },
    "forearm": {
        "female": _Segment(0.0138, 0.4559, (0.261, 0.257, 0.094)),
        "male": _Segment(0.0162, 0.4574, (0.276, 0.265, 0.121)),
    },
    "hand": {"female": _Segment(0.0056, 0, (0, 0, 0)), "male": _Segment(0.0061, 0, (0, 0, 0))},
    "thigh": {
        "female": _Segment(0.1478, 0.3612, (0.369, 0.364, 0.162)),
        "male": _Segment(0.1416, 0.4095, (0.329, 0.329, 0.149)),
    },
    "shank": {
        "female": _Segment(0.0481, 0.4352, (0.267, 0.263, 0.092)),
        "male": _Segment(0.0433, 0.4395, (0.251, 0.246, 0.102)),
    },
    "foot": {"female": _Segment(0.0129, 0, (0, 0, 0)), "male": _Segment(0.0137, 0, (0, 0, 0))},
}
_WORDS = {  # of links' names
    "head": ("head", "skull"),
    "trunk": ("pelvis", "abdomen", "thorax", "trunk", "torso", "clavicle", "lumbar", "base_link"),
    "upper arm": ("upperarm", "upper_arm", "humerus"),
    "forearm": ("lowerarm", "lower_arm", "forearm", "radius"),
    "hand": ("hand",),
    "thigh": ("upperleg", "upper_leg", "thigh", "femur"),
    "shank": ("lowerleg", "lower_leg", "shank", "shin", "tibia"),
    "foot": ("foot",),
}
_OFFSET = np.array([2.0, 2.0, 2.0, 0.5, 0.5, 0.5])  # N, N m: one sigma of a plate's zero
_SIX = (np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2]))  # of a moment: xx xy yy xz yz zz
_SEGMENT = 1e-5  # of the body's mass: what has less stands in the model for its joints alone
_EDGE = 0.5  # s at either end of a recording, which a filter of few hertz bends


class Capture(NamedTuple):
    """Motion and wrench of one recording, filtered alike, without its ends."""

    name: str
    position: Float[np.ndarray, "samples nq"]
    velocity: Float[np.ndarray, "samples nv"]
    acceleration: Float[np.ndarray, "samples nv"]
    wrench: Float[np.ndarray, "samples 6"]  # of all plates on the person, at and in the root's frame, N and N m
    zero: Float[np.ndarray, "samples 6 6"]  # what a plate's offset, at and in the world's frame, does there


class Segments(NamedTuple):
    """Inertial parameters of the segments that the data and the table give together."""

    model: RobotModel
    table: RobotModel  # the prior
    links: tuple[str, ...]  # segments, in the order of the parameters
    parameters: Float[np.ndarray, "segments 10"]
    covariance: Float[np.ndarray, "P P"]
    seen: Float[np.ndarray, "segments 10"]  # share of the prior's variance that the data took away, 0 to 1
    noise: Float[np.ndarray, "6"]  # one sigma of the rows, N and N m
    samples: float  # independent ones, by the correlation of the residual

    @property
    def status(self) -> list[list[str]]:
        """`identified` where the data halve the prior's standard deviation, else `prior only`."""
        return [["identified" if x > 0.75 else "prior only" for x in row] for row in self.seen]

    @property
    def std(self) -> Float[np.ndarray, "segments 10"]:
        """One standard deviation of each parameter: kg, kg m, kg m^2."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 10)

    def mass(self) -> tuple[float, float]:
        """Mass of the body and its standard deviation, kg."""
        pick = np.tile(np.eye(10)[0], len(self.links))
        return float(pick @ self.parameters.ravel()), float(np.sqrt(pick @ self.covariance @ pick))

    def centre(self, q: Float[np.ndarray, " nq"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Centre of mass of the body in the world at a position, and its standard deviations, m."""
        poses = np.asarray(forward_kinematics(self.model, q))[[self.model.link_names.index(k) for k in self.links]]
        moments = np.zeros((3, 10 * len(self.links)))
        for k, pose in enumerate(poses):
            moments[:, 10 * k] = pose[:3, 3]
            moments[:, 10 * k + 1 : 10 * k + 4] = pose[:3, :3]
        total = self.mass()[0]
        centre = moments @ self.parameters.ravel() / total
        slope = moments / total
        slope[:, ::10] -= centre[:, None] / total
        return centre, np.sqrt(np.einsum("ip,pq,iq->i", slope, self.covariance, slope))


class Payload(NamedTuple):
    """A load that a person carries: at which segment, and how sure."""

    link: str
    mass: float
    std: float
    costs: dict[str, float]  # misfit in squared sigmas with the load at each segment, without one ("")


def anthropometric(
    robot: RobotModel, mass: float, sex: Sex = "male", scale: Float[np.ndarray, " segments"] | None = None
) -> RobotModel:
    """The person with inertial parameters from de Leva's table (1996) for a body mass (kg).

    `robot` is the model with its own inertias; `scale` the segments' sizes, in the order of `segments_of`, by which it
    is scaled first. Long segments have the table's centre of mass and radii of gyration on the line to the next joint;
    of head, hands, feet and trunk, whose ends no joint marks, the model's own are scaled. A link is told by its name
    (`left_upperleg`, `thigh`, ...). Raises `InputError` for a link with a mass that no segment of the table is.
    An example: `docs/people.md`.
    """
    if not mass > 0:
        raise InputError(f"anthropometric: the body mass is {mass} kg; more than zero is expected")
    if sex not in ("female", "male"):
        raise InputError(f"anthropometric: sex is '{sex}'; the table has female and male")
    names, segment = segments_of(robot)
    sizes = np.ones(len(names)) if scale is None else np.asarray(scale, float)
    grown = scaled(robot, segment, sizes)
    arrays = np.asarray(grown.placement, float), np.asarray(grown.frame_placement, float)
    grown = eqx.tree_at(lambda m: (m.placement, m.frame_placement), grown, arrays)
    own_mass, own_com, own_about = (np.asarray(part) for part in to_com(np.asarray(robot.inertia, float)))
    kinds = {i: _kind(joint.link) for i, joint in enumerate(robot.joints) if own_mass[i] > 0}
    totals = {kind: sum(own_mass[i] for i, other in kinds.items() if other == kind) for kind in set(kinds.values())}
    sides = {"head": 1, "trunk": 1}
    inertias = np.zeros_like(np.asarray(robot.inertia, float))
    for i, kind in kinds.items():
        row, size = _TABLE[kind][sex], sizes[segment[i]]
        whole = row.mass * mass * (1 if kind in sides else 2)
        m = whole * own_mass[i] / totals[kind]
        com, about = own_com[i] * size, own_about[i] * (m / own_mass[i]) * size**2
        way = _distal(grown, i)
        if row.centre and way is not None:
            com, about = row.centre * way, _about(way, m, row.radii)
        inertias[i] = from_com(m, com, about)
    return eqx.tree_at(lambda r: r.inertia, grown, inertias)


def capture(
    robot: RobotModel,
    time: Float[np.ndarray, " samples"],
    position: Float[np.ndarray, "samples nq"],
    plates: Sequence[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "samples 6"]]],
    cutoff: float = 6.0,
    name: str = "",
) -> Capture:
    """A recording for `identify_segments`: positions of the joints (by `joint_positions`) and one plate or two.

    A plate is its pose in the world and what it exerts on the person: force (N) and torque about its origin (N m), in
    its own axes. Everything passes one zero-phase Butterworth filter of fourth order (`cutoff`, Hz); velocities and
    accelerations are differences along the configuration manifold. Raises `InputError` for wrong shapes and stamps.
    An example: `docs/people.md`.
    """
    from scipy.signal import butter, sosfiltfilt

    time, q = np.asarray(time, float), np.asarray(position, float)
    if q.shape != (len(time), robot.nq) or not np.isfinite(q).all():
        raise InputError(f"capture {name}: position has shape {q.shape}; finite ({len(time)}, {robot.nq}) is expected")
    steps = np.diff(time)
    if len(time) < 50 or not np.allclose(steps, steps.mean(), rtol=0, atol=0.02 * steps.mean()) or steps.min() <= 0:
        raise InputError(f"capture {name}: time needs fifty stamps or more, evenly spaced and rising")
    dt = float(steps.mean())
    if not 0 < cutoff < 0.4 / dt:
        raise InputError(f"capture {name}: cutoff {cutoff:g} Hz; between 0 and {0.4 / dt:.3g} Hz at this rate")
    low = butter(4, 2 * cutoff * dt, output="sos")
    smooth = lambda x: sosfiltfilt(low, x, axis=0)  # noqa: E731
    total, zero = _root_wrench(robot, q, plates, name)
    way = smooth(np.cumsum(np.concatenate([np.zeros((1, robot.nv)), np.asarray(difference(robot, q[:-1], q[1:]))]), 0))
    q = _along(robot, q, smooth)
    v = np.gradient(way, dt, axis=0, edge_order=2)
    a = np.gradient(v, dt, axis=0, edge_order=2)
    inner = slice(int(_EDGE / dt), -int(_EDGE / dt))
    return Capture(name, q[inner], v[inner], a[inner], smooth(total)[inner], zero[inner])


def identify_segments(
    captures: Sequence[Capture], table: RobotModel, trust: float = 0.25, effective: float | None = None
) -> Segments:
    """Inertial parameters of a person's segments by the wrench of the plates, with the table as the prior.

    `table` is the scaled person with the table's inertias (`anthropometric`); `trust` how far these are believed
    (relative, one sigma of each segment's mass, centre and moments about it). The least squares of the six rows, each
    by its own noise, of the plates' zeros in each recording, and of the prior over segments that are bodies (a
    semidefinite programme). The residual is correlated in time, for markers slide
    with the skin and filters smooth: rows count as the number of independent ones that its correlation leaves
    (`effective` overrides it). Raises `InputError` where nothing was captured. An example: `docs/people.md`.
    """
    if not captures:
        raise InputError("identify_segments: no recording; give one `capture` or more")
    masses = np.asarray(table.inertia)[:, 0]
    index = [i for i, mass in enumerate(masses) if mass > _SEGMENT * masses.sum()]
    columns = np.concatenate([10 * i + np.arange(10) for i in index])
    mean, root = _believed(table, index, trust)
    W = np.concatenate([_rows(table, one)[:, :, columns] for one in captures])
    y, Z = np.concatenate([one.wrench for one in captures]), _zeros(captures)
    X = np.concatenate([W, Z], axis=2)
    zeros = np.diag(np.tile(1 / _OFFSET, len(captures)))
    prior = np.asarray(block_diag(root, zeros)), np.concatenate([mean, np.zeros(len(zeros))])
    sigma, count = np.array([10.0, 10.0, 10.0, 3.0, 3.0, 3.0]), float(len(X)) / 20
    for _ in range(4):  # the noise from the residual, and back
        factor = _factor(X, y, sigma, count / len(X), *prior)
        x = np.linalg.lstsq(factor[:, :-1], factor[:, -1], rcond=None)[0]
        gone = y - X @ x
        sigma = np.maximum(gone.std(axis=0), [0.1] * 3 + [0.02] * 3)
        count = effective or _independent(gone, [len(one.wrench) for one in captures])
    factor = _factor(X, y, sigma, count / len(X), *prior)
    whole = eqx.tree_at(lambda m: m.inertia, table, np.asarray(table.inertia))
    links = [body for k, body in enumerate(bodies(whole)) if k in index]
    shifted = [replace(body, columns=tuple(range(10 * k, 10 * k + 10))) for k, body in enumerate(links)]
    best = physical_fit(factor, shifted)
    covariance = np.linalg.inv(factor[:, :-1].T @ factor[:, :-1])[: len(columns), : len(columns)]
    before = (np.linalg.inv(root) ** 2).sum(axis=1)
    inertia = np.array(table.inertia, float)
    inertia[index] = best[: len(columns)].reshape(-1, 10)
    return Segments(
        model=eqx.tree_at(lambda m: m.inertia, table, inertia),
        table=table,
        links=tuple(table.link_names[i] for i in index),
        parameters=inertia[index],
        covariance=covariance,
        seen=(1 - np.diag(covariance) / before).reshape(-1, 10),
        noise=sigma,
        samples=count,
    )


def _believed(
    table: RobotModel, index: Sequence[int], trust: float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, "P P"]]:
    """The table's parameters and the root of their precision.

    Mass, centre and moments about it are believed each for itself: what a segment weighs more, or farther out, turns
    harder about its joint too. One sigma is `trust` times the mass, the distance of the centre (5 cm at the least) and
    the moments, which grow with the mass beside.
    """
    mass, com, about = (np.asarray(part)[index] for part in to_com(np.asarray(table.inertia, float)))
    roots = []
    for m, c, moments in zip(mass, com, about, strict=True):
        scale = np.sqrt(np.diag(moments))
        wide = [m, *[max(0.05, float(np.linalg.norm(c)))] * 3, *np.outer(scale, scale)[_SIX]]
        slope = np.zeros((10, 10))
        slope[:, 0] = from_com(m, c, moments) / m  # as dense everywhere
        for k, e in enumerate(np.eye(3)):  # quadratic in the centre: exact
            slope[:, 1 + k] = (from_com(m, c + e, moments) - from_com(m, c - e, moments)) / 2
        slope[4:, 4:] = np.eye(6)
        roots.append(np.linalg.inv(slope * (trust * np.array(wide))))
    return np.asarray(table.inertia, float)[index].ravel(), np.asarray(block_diag(*roots))


def _zeros(captures: Sequence[Capture]) -> Float[np.ndarray, "samples 6 offsets"]:
    """What the plates' offsets do: six for each recording, before which plates are set to zero."""
    every = [np.zeros((len(one.wrench), 6, 6 * len(captures))) for one in captures]
    for k, (own, one) in enumerate(zip(every, captures, strict=True)):
        own[:, :, 6 * k : 6 * k + 6] = one.zero
    return np.concatenate(every)


def name_payload(
    loaded: Sequence[Capture], person: Segments, places: Sequence[str] | None = None, heaviest: float = 20.0
) -> Payload:
    """The segment at which a person carries a load, by recordings with it and the `Segments` found without.

    At each place a load of ten parameters, believed to be up to `heaviest` kg within 0.3 m of the joint, is fitted to
    the residual; the place that explains most is named. `places`: names of links (default: all segments). The standard
    deviation of the mass holds the noise of these recordings and what the person's own parameters may be off.
    An example: `docs/people.md`.
    """
    model, results, costs = person.model, {}, {}
    size = np.array([heaviest / 2, *[heaviest * 0.15] * 3, *[heaviest * 0.05] * 6])
    rows = [_rows(model, one) for one in loaded]
    gone = np.concatenate([c.wrench - W @ np.ravel(model.inertia) for c, W in zip(loaded, rows, strict=True)])
    weight = np.sqrt(person.samples / max(1, len(gone))) / person.noise
    zeros, b = _zeros(loaded), (gone * weight).reshape(-1)
    wide = np.tile(_OFFSET, len(loaded))
    index = [model.link_index(link) for link in person.links]
    columns = np.concatenate([10 * i + np.arange(10) for i in index])
    person_rows = np.concatenate([W[:, :, columns] for W in rows]) * weight[:, None]
    unsure = person_rows.reshape(len(b), -1) @ np.linalg.cholesky(person.covariance)
    for place in ("", *(places or person.links)):
        own = np.concatenate([W[:, :, 10 * model.link_index(place) :][:, :, :10] for W in rows]) if place else zeros
        X = np.concatenate([own, zeros] if place else [zeros], axis=2) * weight[:, None]
        A = X.reshape(len(b), -1)
        normal = A.T @ A + np.diag(1 / (np.concatenate([size, wide]) if place else wide) ** 2)
        x = np.linalg.solve(normal, A.T @ b)
        costs[place] = float(b @ b - b @ A @ x)
        if not place:
            continue
        inverse = np.linalg.inv(normal)
        of_person = inverse[0] @ (A.T @ unsure)  # what the person's own parameters may be off
        results[place] = float(x[0]), float(np.sqrt(inverse[0, 0] + of_person @ of_person))
    best = min(results, key=lambda place: costs[place])
    mass, std = results[best]
    return Payload(best, mass, std, costs)


def predicted(model: RobotModel, one: Capture) -> Float[np.ndarray, "samples 6"]:
    """Wrench of the plates at and in the root's frame, N and N m, that the model needs for the motion of a capture.

    An example: `docs/people.md`.
    """
    return _rows(model, one) @ np.ravel(np.asarray(model.inertia))


def _kind(link: str) -> str:
    own = link.lower()
    for kind in ("upper arm", "forearm", "thigh", "shank", "hand", "foot", "head", "trunk"):
        if any(word in own for word in _WORDS[kind]):
            return kind
    known = ", ".join(word for words in _WORDS.values() for word in words)
    raise InputError(f"anthropometric: link '{link}' is not a segment of the table; names contain one of {known}")


def _distal(robot: RobotModel, index: int) -> Float[np.ndarray, "3"] | None:
    """Way from a link's joint to the joint at its far end, m."""
    ways = [np.asarray(robot.placement[k])[:3, 3] for k, joint in enumerate(robot.joints) if joint.parent == index]
    ways = [way for way in ways if np.linalg.norm(way) > 0.05]
    return ways[0] if ways else None


def _about(way: Float[np.ndarray, "3"], mass: float, radii: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Moments about the centre of mass: the long axis is that of the way, the lateral one the model's z."""
    length = float(np.linalg.norm(way))
    long = way / length
    lateral = np.array([0.0, 0.0, 1.0]) - long[2] * long
    lateral = lateral / np.linalg.norm(lateral) if np.linalg.norm(lateral) > 0.1 else np.array([1.0, 0.0, 0.0])
    frame = np.stack([np.cross(long, lateral), lateral, long], axis=1)
    return frame @ np.diag(mass * length**2 * np.array(radii) ** 2) @ frame.T


def _root_wrench(
    robot: RobotModel, q: np.ndarray, plates: Sequence[tuple[np.ndarray, np.ndarray]], name: str
) -> tuple[Float[np.ndarray, "samples 6"], Float[np.ndarray, "samples 6 6"]]:
    """What the plates exert, at and in the root's frame, and the map from a wrench at and in the world's."""
    if robot.joints[0].kind != "free":
        raise InputError("capture: the person's root moves freely; load the model with root='free_flyer'")
    if not plates:
        raise InputError(f"capture {name}: no force plate")
    world = np.zeros((len(q), 6))
    for pose, wrench in plates:
        pose, wrench = np.asarray(pose, float), np.asarray(wrench, float)
        if pose.shape != (4, 4) or wrench.shape != (len(q), 6) or not np.isfinite(wrench).all():
            raise InputError(f"capture {name}: a plate is a pose (4, 4) and a finite wrench ({len(q)}, 6)")
        force, torque = wrench[:, :3] @ pose[:3, :3].T, wrench[:, 3:] @ pose[:3, :3].T
        world += np.concatenate([force, torque + np.cross(pose[:3, 3], force)], axis=1)
    root = np.asarray(forward_kinematics(robot, q))[:, 0]
    back, at = np.swapaxes(root[:, :3, :3], 1, 2), root[:, :3, 3]
    cross = np.zeros((len(q), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -at[:, 2], at[:, 1], -at[:, 0]
    cross -= np.swapaxes(cross, 1, 2)
    into = np.concatenate([np.concatenate([back, np.zeros_like(back)], 2), np.concatenate([-back @ cross, back], 2)], 1)
    return (into @ world[..., None])[..., 0], into


def _along(robot: RobotModel, q: np.ndarray, smooth: Any) -> np.ndarray:
    """Positions smoothed; quaternions as vectors of one sign, made unit again."""
    q = np.array(q)
    for joint, at in zip(robot.joints, robot.dofs.positions, strict=True):
        if joint.kind in ("free", "spherical"):
            turn = slice(at.stop - 4, at.stop)
            signs = np.cumprod(np.where((q[1:, turn] * q[:-1, turn]).sum(1) < 0, -1.0, 1.0))
            q[1:, turn] *= signs[:, None]
    q = smooth(q)
    for joint, at in zip(robot.joints, robot.dofs.positions, strict=True):
        if joint.kind in ("free", "spherical"):
            turn = slice(at.stop - 4, at.stop)
            q[:, turn] /= np.linalg.norm(q[:, turn], axis=1, keepdims=True)
    return q


def _rows(model: RobotModel, one: Capture) -> Float[np.ndarray, "samples 6 columns"]:
    return np.asarray(wrench_regressor(model, one.position, one.velocity, one.acceleration, model.link_names[0]))


def _factor(
    X: np.ndarray, y: np.ndarray, sigma: np.ndarray, share: float, root: np.ndarray, mean: np.ndarray
) -> Float[np.ndarray, "n k"]:
    """Rows of the data, thinned to their independent ones, above those of the prior; the last column is the right."""
    weight = np.sqrt(share) / sigma
    rows = np.concatenate([X, y[..., None]], axis=2) * weight[:, None]
    rows = np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode="r")
    return np.concatenate([rows, np.column_stack([root, root @ mean])])


def _independent(gone: Float[np.ndarray, "samples 6"], lengths: Sequence[int]) -> float:
    """Independent samples by the autocorrelation of the residual, summed to its first change of sign."""
    count = 0.0
    for part in np.split(gone, np.cumsum(lengths)[:-1]):
        x = (part - part.mean(0)) / np.maximum(part.std(0), 1e-12)
        spectrum = np.abs(np.fft.rfft(x, 2 * len(x), axis=0)) ** 2
        correlation = np.fft.irfft(spectrum, axis=0)[: len(x)].mean(1)
        correlation = correlation / correlation[0]
        end = int(np.argmax(correlation < 0)) or len(x)
        count += len(x) / (1 + 2 * correlation[1:end].sum())
    return max(10.0, count)
