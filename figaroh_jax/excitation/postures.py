r"""Postures that calibrate best: D-optimal among candidates, then better ones between them, with a certified bound.

A posture i tells $M_i = J_i' W J_i$ of the parameters, with J the Jacobian that `calibrate` fits with. Chosen one by
one (greedy), then one exchanged for another as long as $\log\det \sum M_i$ grows (Fedorov 1972), then moved within the
joint limits along the slope of the exact Jacobians. No choice of n candidates can be better than
$f(w) + \sum_{n \text{ largest}} g_i - p$ with $f(w) = \log\det \sum w_i M_i, \; g_i = \mathrm{tr}(M_i M(w)^{-1})$, for
any weights $0 \le w_i \le 1$ that add up to n: f is concave, and that is its tangent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..calibration.candidates import geometry_columns
from ..calibration.gauge import find_gauge
from ..effects.kinematic import Column
from ..errors import (
    InputError,
    check_count,
    check_each,
    check_finite,
    check_kind,
    check_one_of,
    check_real,
    check_switch,
)
from ..estimation import posefit
from ..estimation.posegroups import Measured, assemble, postures_of
from ..recordings.arrays import check_accuracy, postures as recorded
from ..recordings.devices import POSITION, Device, Planes, Sockets
from ..rigid.chain import chain_between
from ..rigid.model import RobotModel
from .clearance import Clearance, link_poses
from .touch import Touch, Touching

__all__ = [
    "Instrument",
    "PostureDesign",
    "View",
    "certified_bound",
    "excite_postures",
    "exchanged",
    "greedy",
    "in_order",
]

MARKER = (0.1, 0.05, 0.08)  # m, of a point in the tool frame, where the task does not say
ACCURACY = (1e-4, 1e-3)  # m, rad
STEP = 1e-5  # rad or m, of the differences between exact Jacobians
PIECE = 128  # postures of a program, few enough to be compiled quickly
_RIDGE = 1e-9
_SWEEPS, _ASCENTS, _MOVES = 20, 300, 40
_DRAWN = 200_000  # random postures at the most, until enough candidates are seen and clear
_BATCH = 4_000
_NEARBY = 0.15  # of the range of a joint: where further candidates are looked for once some are known
_INSIDE = 0.01  # of a cosine, 1 cm or 1 mm: what moving postures keep from the edge of what is allowed
_WALL = 300.0  # weight of what postures violate while they move
_GAIN = 1e-9  # of the log determinant, below which nothing is exchanged

Level = Literal["frames", "joint_offset", "full"]


@dataclass(frozen=True)
class View:
    """What a device can see of its target (a board, a reflector), all of it in the base frame, m and rad.

    `mount` "world": the device stands at `place` and looks along `axis` (None: around itself); the target is the tool
    frame, whose z axis points to the device within `tilt`. "hand": the device is the tool frame and looks along its z
    axis; the target is at `place`, and `axis` is its normal.
    """

    place: tuple[float, float, float]
    axis: tuple[float, float, float] | None = None
    mount: Literal["hand", "world"] = "world"
    cone: float = 0.5  # half angle of what the device sees
    tilt: float = 1.0  # largest angle between the target's normal and the line of sight
    near: float = 0.1
    far: float = 10.0

    def room(self, tool: Float[np.ndarray, "postures 4 4"]) -> Float[np.ndarray, "postures 4"]:
        """What is left of cone, tilt (cosines) and distances (m); below zero where the target is not seen."""
        place, z = np.array(self.place), tool[:, :3, 2]
        way = place - tool[:, :3, 3]
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
        sight = way / length[:, None]  # from the tool to the place
        along = np.ones(len(tool))  # cosine at the place
        if self.axis is not None:
            along = -(sight @ (np.array(self.axis) / np.linalg.norm(self.axis)))
        at_tool = (sight * z).sum(1)
        device, target = (at_tool, along) if self.mount == "hand" else (along, at_tool)
        inside = np.stack([device - np.cos(self.cone), target - np.cos(self.tilt)], 1)
        return np.column_stack([inside, length - self.near, self.far - length])


@dataclass(frozen=True)
class Instrument:
    """What measures the postures: as in the `measurement` of a task.

    `touched`: the planes or sockets, and `point` the tool point that touches them. Kind "own": a `device` of your own
    (`own_device`), and `seen`, which gives what it measures of poses (n, 4, 4) of the tool in the base frame.
    """

    kind: Literal["pose", "position", "plane", "socket", "own"]
    base_frame: str
    tool_frame: str
    unknown: tuple[str, ...] = ("base_frame", "tool_frame")
    accuracy: tuple[float, float] = ACCURACY  # one sigma, m and rad
    view: View | None = None  # None: everything is seen
    touched: tuple[Touch, ...] = ()
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, in the tool frame
    device: Device | None = None
    seen: Callable[[Float[np.ndarray, "n 4 4"]], Any] | None = None


class _Parameter(NamedTuple):
    """A parameter that is calibrated: what, where, unit."""

    name: str
    unit: str


@dataclass(frozen=True, repr=False)
class PostureDesign:
    """Postures in the order in which they are to be measured, and what they tell."""

    model: RobotModel
    instrument: Instrument
    position: Float[np.ndarray, "postures nv"]  # rad or m
    parameters: tuple[_Parameter, ...]  # those that postures can tell
    std: Float[np.ndarray, " parameters"]  # to be expected, m or rad
    logdet: float
    bound: float  # that no choice among the candidates exceeds
    chosen_logdet: float  # of the choice among the candidates, before the postures were moved
    random_logdet: float  # median of random choices
    candidates: int
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        told = f"{len(self.parameters)} parameters, {self.efficiency:.1%} of the bound"
        return f"PostureDesign: {len(self.position)} postures of '{self.model.name}'; {told}"

    @property
    def efficiency(self) -> float:
        """exp((logdet - bound) / parameters): 1 is the bound of the candidates, which moved postures may exceed."""
        return self._share(self.logdet)

    @property
    def chosen_efficiency(self) -> float:
        """The same of the choice among the candidates."""
        return self._share(self.chosen_logdet)

    @property
    def random_efficiency(self) -> float:
        """The same of random choices, the median."""
        return self._share(self.random_logdet)

    def _share(self, logdet: float) -> float:
        return float(np.exp((logdet - self.bound) / len(self.parameters)))


def tool_poses(
    model: RobotModel, instrument: Instrument, q: Float[np.ndarray, "postures nv"]
) -> Float[np.ndarray, "postures 4 4"]:
    """Poses of the tool frame in the base frame."""
    poses = np.moveaxis(link_poses(model, q), 3, 0)
    world = np.concatenate([np.broadcast_to(np.eye(4), (len(q), 1, 4, 4)), poses], axis=1)
    base, tool = (
        world[:, model.frames[k].parent + 1] @ np.asarray(model.frame_placement)[k]
        for k in (model.frame_index(instrument.base_frame), model.frame_index(instrument.tool_frame))
    )
    return np.linalg.solve(base, tool)


def touching_of(model: RobotModel, instrument: Instrument) -> Touching | None:
    """What keeps postures at planes or sockets; None for a device that only looks."""
    if instrument.kind not in ("plane", "socket"):
        return None
    plane = instrument.kind == "plane"
    if not instrument.touched or (plane and any(one.axis is None for one in instrument.touched)):
        need = "place and axis (the normal)" if plane else "place"
        raise InputError(f"excite.touch: postures that touch a {instrument.kind} need its {need}, in the base frame")
    return Touching(lambda q: tool_poses(model, instrument, q), instrument.point, instrument.touched, plane)


def _axes(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Axes (rows) whose third is the normal."""
    x = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


class _Calibrated:
    """Rows of postures, weighted by the accuracy, in the parameters that postures can tell."""

    def __init__(self, model: RobotModel, instrument: Instrument, level: Level, position: np.ndarray) -> None:
        self.model, self.instrument, self.touching = model, instrument, touching_of(model, instrument)
        chain = sorted(chain_between(model, instrument.base_frame, instrument.tool_frame).joints)
        every = geometry_columns(model, chain)
        columns = [c for c in every if level == "full" or (level == "joint_offset" and c.effect == "joint_offset")]
        self.columns: Sequence[Column] = columns
        self.measured = self._assembled(np.resize(position, (PIECE, position.shape[1])))
        names = [_Parameter(c.label, c.unit) for c in columns]
        names += [_Parameter(name, unit) for name, unit in self.measured.own]
        self.names = names
        J = self._jacobian(self.measured.problem)
        flat = J.reshape(-1, J.shape[2])
        # the devices' own first: they are estimated at every level
        order = [*range(len(columns), len(names)), *range(len(columns))]
        dependent = find_gauge(flat, order).dependent
        self.kept = np.array([k for k in range(len(names)) if k not in dependent])

    def _assembled(self, position: np.ndarray) -> Measured:
        given: dict[str, Any] = {"unknown": self.instrument.unknown}
        kind, seen = self.instrument.kind, self.seen(position)
        given |= {"device": self.instrument.device, "measured": seen} if kind == "own" else {kind: seen}
        base, tool = self.instrument.base_frame, self.instrument.tool_frame
        several = (recorded(q=position, base_frame=base, tool_frame=tool, **given),)
        postures, sizes = postures_of(self.model, several), [1.0] * len(self.columns)
        found = assemble(self.model, several, postures, self.columns, sizes)
        if self.touching is None:
            return found
        (group,) = found.problem.groups
        return found._replace(problem=replace(found.problem, groups=(replace(group, device=self._touched()),)))

    def _touched(self) -> Device:
        """The planes or sockets where they are."""
        at, point, unknown = self.touching, np.array(self.instrument.point, float), self.instrument.unknown
        assert at is not None
        estimated = tuple(name for name in unknown if name == "tool_frame")
        if not at.plane:
            return Sockets(point, estimated, at.place)
        return Planes(point, estimated, np.array([_axes(axis) for axis in at.axis]), at.place)

    def seen(self, position: np.ndarray) -> np.ndarray:
        """What the device sees of the nominal robot: poses, points of a marker, the number of what is touched."""
        if self.touching is not None:
            return self.touching.which(position)
        found = tool_poses(self.model, self.instrument, position)
        if self.instrument.kind == "own":
            assert self.instrument.seen is not None
            return np.asarray(self.instrument.seen(found))
        return found if self.instrument.kind == "pose" else (found @ np.array([*MARKER, 1.0]))[:, None, :3]

    def rows(self, position: np.ndarray) -> Float[np.ndarray, "postures rows parameters"]:
        """Weighted Jacobian of each posture, by one program for any number of them."""
        missing = -len(position) % PIECE
        full = np.concatenate([position, np.repeat(position[-1:], missing, axis=0)])
        parts = [self._piece(full[k : k + PIECE]) for k in range(0, len(full), PIECE)]
        return np.concatenate(parts)[: len(position)][:, :, self.kept]

    def _piece(self, position: Float[np.ndarray, "piece nv"]) -> Float[np.ndarray, "piece rows unknowns"]:
        (group,) = self.measured.problem.groups
        seen = self.seen(position)
        assert not len(group.at), "columns of the geometry are the same in all postures"
        samples, rows = len(position), np.shape(group.measured)[1]
        replaced = (position.T, seen, np.ones((samples, rows), bool), np.zeros((0, 6, samples)))
        fresh = eqx.tree_at(lambda g: (g.position, g.datum, g.measured, g.fields), group, replaced)
        problem = eqx.tree_at(lambda p: p.groups, self.measured.problem, (fresh,))
        return self._jacobian(problem)

    def _jacobian(self, problem: posefit.Problem) -> Float[np.ndarray, "postures rows unknowns"]:
        with jax.enable_x64(True):
            _, J = posefit.linearise(problem, np.zeros(len(problem.scale)))
        samples = np.shape(problem.groups[0].position)[1]
        J = (J / np.asarray(problem.scale))[: samples * np.shape(problem.groups[0].measured)[1]]
        J = J.reshape(-1, samples, J.shape[1]).swapaxes(0, 1)
        channels = np.array(problem.groups[0].device.channels())
        sigma = np.where(channels == POSITION, *self.instrument.accuracy)
        return J / sigma[:, None]


def _check_instrument(one: Instrument) -> None:
    """Refuse what a device cannot be; its kind and frames are asked for where its rows are made."""
    check_kind("instrument", one, Instrument, "Instrument('position', base_frame='base', tool_frame='hand'), say")
    check_accuracy(one.accuracy, may_lack=False)
    check_finite("point", one.point)
    if np.shape(one.point) != (3,):
        raise InputError(f"point is {one.point!r:.100}; three numbers in m are expected, in the tool frame")
    if one.view is not None:
        check_kind("view", one.view, View, "View(place=(1, 0, 1), axis=(-1, 0, 0)), say")
    check_each("touched", one.touched, Touch, "Touch(place=(0.5, 0, 0), axis=(0, 0, 1)), say")


def _limits(model: RobotModel, given: Float[np.ndarray, "nv 2"] | None) -> Float[np.ndarray, "nv 2"]:
    """Least and greatest position of each joint: a turn where there is no limit."""
    if given is not None:
        check_real("position_limit", given)
    limits = np.array(model.position_limit if given is None else given, float)
    if limits.shape != (model.nv, 2):
        raise InputError(f"position_limit has shape {limits.shape}; least and greatest of each joint, {(model.nv, 2)}")
    wrong = ~(limits[:, 0] <= limits[:, 1])  # nan too
    if given is not None and wrong.any():
        low, high = limits[int(np.argmax(wrong))]
        raise InputError(
            f"position_limit: '{model.dof_names[int(np.argmax(wrong))]}' may move from {low:g} to {high:g}: the least"
            " comes first"
        )
    return np.where(np.isfinite(limits), limits, [-np.pi, np.pi])


def excite_postures(
    model: RobotModel,
    instrument: Instrument,
    *,
    count: int = 30,
    candidates: int = 500,
    level: Level = "full",
    position_limit: Float[np.ndarray, "nv 2"] | None = None,
    clearance: Clearance | None = None,
    polish: bool = True,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda phase, share: None,
) -> PostureDesign:
    """The `count` postures that tell most of a robot's kinematics (`level`) by what the instrument measures.

    Candidates are random within the joint limits (`position_limit`, default the model's; a turn where it has none),
    seen by the device (`instrument.view`) and clear of all that `clearance` keeps apart.
    Raises `InputError` where frames are not there, and where so few postures cannot tell all that can be told.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> tracker = fj.Instrument("position", base_frame="base", tool_frame="hand", accuracy=(5e-5, 1e-3))
    >>> found = fj.excite_postures(robot, tracker, count=12, candidates=100, level="joint_offset", polish=False)
    >>> found.position.shape, found.logdet > found.random_logdet
    ((12, 4), True)
    """
    check_kind("model", model, RobotModel, "load_urdf reads one; an ExtendedModel holds one as `.robot`")
    _check_instrument(instrument)
    for name, given, least in (("count", count, 1), ("candidates", candidates, 1), ("seed", seed, 0)):
        check_count(name, given, least)
    check_switch("polish", polish)
    check_one_of("level", level, get_args(Level))
    if clearance is not None:
        check_kind("clearance", clearance, Clearance, "`clearance_of` makes one")
    limits = _limits(model, position_limit)
    generator = np.random.default_rng(seed)
    allowed = _Allowed(model, instrument, clearance, limits)
    q = allowed.candidates(limits, candidates, count, generator)
    candidates = len(q)
    progress("rows of the candidates", 0.05)
    calibrated = _Calibrated(model, instrument, level, q)
    J = calibrated.rows(q)
    size = np.sqrt((J**2).sum(axis=(0, 1)))  # of a column; the choice does not hang on units
    rank = len(calibrated.kept)
    if count * J.shape[1] < rank:
        least = int(np.ceil(rank / J.shape[1]))
        raise InputError(
            f"excite.postures: {count} postures cannot determine {rank} parameters; at least {least} are needed"
        )
    if count > candidates:
        raise InputError(f"excite.candidates: {candidates} candidates for {count} postures; give more than that")
    scaled = J / size
    progress("choosing among the candidates", 0.2)
    chosen = exchanged(scaled, greedy(scaled, count))
    shift = 2 * float(np.log(size).sum())
    own = _logdet(scaled[chosen]) + shift
    progress("certifying", 0.6)
    bound = max(certified_bound(scaled, count, chosen) + shift, own)
    randoms = [_logdet(scaled[generator.permutation(candidates)[:count]]) + shift for _ in range(100)]
    position = q[chosen]
    if polish:
        progress("moving the postures", 0.7)
        position = _moved(calibrated, position, limits, size, allowed)
    final = calibrated.rows(position)
    position = position[in_order(position, np.asarray(model.velocity_limit, float))]
    spread = np.linalg.inv(_information(final / size)) / np.outer(size, size)
    return PostureDesign(
        model=model,
        instrument=instrument,
        position=position,
        parameters=tuple(calibrated.names[k] for k in calibrated.kept),
        std=np.sqrt(np.diag(spread)),
        logdet=_logdet(final / size) + shift,
        bound=bound,
        chosen_logdet=own,
        random_logdet=float(np.median(randoms)),
        candidates=candidates,
    )


def _information(J: Float[np.ndarray, "postures rows p"]) -> Float[np.ndarray, "p p"]:
    flat = J.reshape(-1, J.shape[2])
    return flat.T @ flat


def _logdet(J: Float[np.ndarray, "postures rows p"]) -> float:
    return float(np.linalg.slogdet(_information(J))[1])


def greedy(J: Float[np.ndarray, "candidates rows p"], count: int) -> Int[np.ndarray, " count"]:
    """Candidates one after another, each the one that adds most to the log determinant."""
    inverse = np.eye(J.shape[2]) / _RIDGE
    chosen: list[int] = []
    for _ in range(count):
        gain = _gains(J, inverse)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        inverse = _added(inverse, J[chosen[-1]], 1.0)
    return np.array(chosen)


def _gains(J: Float[np.ndarray, "candidates rows p"], inverse: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " n"]:
    """What each candidate adds to the log determinant."""
    middle = (J @ inverse) @ J.swapaxes(1, 2)
    return np.linalg.slogdet(np.eye(J.shape[1]) + middle)[1]


def _added(inverse: np.ndarray, rows: Float[np.ndarray, "rows p"], sign: float) -> Float[np.ndarray, "p p"]:
    """Inverse of the information with (sign 1) or without (-1) some rows."""
    V = inverse @ rows.T
    middle = np.eye(len(rows)) + sign * (rows @ V)
    return inverse - sign * V @ np.linalg.solve(middle, V.T)


def exchanged(
    J: Float[np.ndarray, "candidates rows p"], chosen: Int[np.ndarray, " count"]
) -> Int[np.ndarray, " count"]:
    """Candidates exchanged one for one, each posture in turn for the best of all, until nothing gains."""
    chosen = np.array(chosen)
    for _ in range(_SWEEPS):
        better = False
        information = _information(J[chosen])
        inverse = np.linalg.inv(information + _RIDGE * np.eye(len(information)))
        for k in range(len(chosen)):
            without = _added(inverse, J[chosen[k]], -1.0)
            gain = _gains(J, without)
            before = gain[chosen[k]]
            gain[np.delete(chosen, k)] = -np.inf
            best = int(np.argmax(gain))
            if gain[best] > before + _GAIN:
                chosen[k], better = best, True
                inverse = _added(without, J[best], 1.0)
        if not better:
            break
    return chosen


def certified_bound(
    J: Float[np.ndarray, "candidates rows p"], count: int, chosen: Int[np.ndarray, " count"] | None = None
) -> float:
    """A log determinant that no `count` of the candidates exceed; tightened by ascent of the relaxed weights."""
    n, p = len(J), J.shape[2]
    w = np.full(n, count / n)
    if chosen is not None:
        w = 0.5 * w
        w[chosen] += 0.5
    best = np.inf
    each = (J.swapaxes(1, 2) @ J).reshape(n, p * p)
    for _ in range(_ASCENTS):
        L = np.linalg.cholesky((w @ each).reshape(p, p))
        half = np.linalg.inv(L)
        g = each @ (half.T @ half).ravel()
        value = 2 * float(np.log(np.diag(L)).sum())
        best = min(best, value + float(np.sort(g)[-count:].sum()) - float(g @ w))
        if best - value < 1e-4 * p:
            break
        w = _capped(w * (g / p * count), count)
    return best


def _capped(w: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " n"]:
    """Weights scaled to add up to `count`, none above one."""
    w = np.maximum(w, 1e-12)
    full = np.zeros(len(w), bool)
    for _ in range(len(w)):
        scale = (count - full.sum()) / w[~full].sum()
        over = ~full & (w * scale > 1.0)
        if not over.any():
            return np.where(full, 1.0, w * scale)
        full |= over
    return np.minimum(w, 1.0)


class _Allowed:
    """Which postures are seen and clear, and what is missing where they are not."""

    def __init__(
        self,
        model: RobotModel,
        instrument: Instrument,
        clearance: Clearance | None,
        limits: Float[np.ndarray, "nv 2"],
    ) -> None:
        self.model, self.instrument, self.clearance = model, instrument, clearance
        self.touching, self.limits = touching_of(model, instrument), limits
        self.free = instrument.view is None and clearance is None and self.touching is None

    def onto(self, q: Float[np.ndarray, "postures nv"]) -> Float[np.ndarray, "postures nv"]:
        """The postures, touching what is to be touched."""
        return q if self.touching is None else self.touching.onto(q, self.touching.which(q))

    def drawn(self, q: Float[np.ndarray, "postures nv"], generator: np.random.Generator) -> np.ndarray:
        """Random postures, each touching one of what is to be touched."""
        if self.touching is None:
            return q
        q = self.touching.onto(q, generator.integers(len(self.touching.touched), size=len(q)))
        return q[np.abs(self.touching.missing(q, self.touching.which(q))).max(axis=1) < 1e-7]

    def room(self, q: Float[np.ndarray, "postures nv"]) -> Float[np.ndarray, "postures k"]:
        """Below zero where a posture is not allowed: of the view (cosines, m), then of the clearance (0.1 m)."""
        parts = [np.ones((len(q), 1))]
        if self.instrument.view is not None:
            parts.append(self.instrument.view.room(tool_poses(self.model, self.instrument, q)))
        if self.clearance is not None:
            parts.append((self.clearance.distances(q) - self.clearance.margin) / 0.1)
        if self.touching is not None:
            parts += [self.touching.room(q)[:, 1:], q - self.limits[:, 0], self.limits[:, 1] - q]
        return np.concatenate(parts, axis=1)

    def met(self, q: Float[np.ndarray, "postures nv"]) -> np.ndarray:
        """Which postures are seen and clear; by the meshes too where these are counted on."""
        good = np.asarray((self.room(q) >= 0).all(axis=1))
        if self.touching is not None:
            good &= self.touching.room(q)[:, 0] >= 0
        clearance = self.clearance
        if clearance is None or clearance.mesh_distance is None or not good.any():
            return good
        unsure = [p for p, s in zip(clearance.pairs, clearance.slack, strict=True) if s > 0] + list(clearance.exact)
        if unsure:
            near = clearance.exact_distances(q[good], unsure)
            assert near is not None
            good[good] = (near >= clearance.margin).all(axis=1)
        return good

    def candidates(
        self, limits: Float[np.ndarray, "nv 2"], wanted: int, least: int, generator: np.random.Generator
    ) -> Float[np.ndarray, "candidates nv"]:
        """Random postures; where few of them are allowed, others near those that are."""
        if self.free:
            return generator.uniform(limits[:, 0], limits[:, 1], (wanted, self.model.nv))
        found, drawn = np.zeros((0, self.model.nv)), 0
        batch, most = (_BATCH, _DRAWN) if self.touching is None else (_BATCH // 4, _DRAWN // 10)
        while len(found) < wanted and drawn < most:
            some = generator.uniform(limits[:, 0], limits[:, 1], (batch, self.model.nv))
            if len(found) >= 10 and len(found) < wanted * drawn / most * 4:  # too seldom: look beside those known
                near = found[generator.integers(len(found), size=batch)]
                some = near + _NEARBY * np.diff(limits)[:, 0] * generator.standard_normal(near.shape)
                some = np.clip(some, limits[:, 0], limits[:, 1])
            some = self.drawn(some, generator)
            found, drawn = np.concatenate([found, some[(self.room(some) >= 0).all(axis=1)]]), drawn + batch
        found = found[:wanted]
        found = found[self.met(found)]
        if len(found) < max(least, 2):
            ways = "widen the view (cone, tilt, near, far), bring its place into reach, or lower limits.clearance"
            if self.touching is not None:
                ways = "bring what is touched into reach, widen its radius and tilt, or lower limits.clearance"
            what = "are seen by the device" if self.touching is None else "touch"
            raise InputError(
                f"excite: {len(found)} of {drawn} random postures {what} and are clear, {least} are needed; {ways}"
            )
        return found


def _moved(
    calibrated: _Calibrated,
    position: np.ndarray,
    limits: Float[np.ndarray, "nv 2"],
    size: Float[np.ndarray, " p"],
    allowed: _Allowed,
) -> Float[np.ndarray, "postures nv"]:
    """Postures moved within the joint limits to where they tell most together, and back where that is not allowed."""
    from scipy.optimize import minimize  # slow to import

    count, nv = position.shape
    ways = np.concatenate([np.zeros((1, nv)), STEP * np.eye(nv)])

    touching = allowed.touching

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        own = allowed.onto(x.reshape(count, nv))
        around = (own[None] + ways[:, None]).reshape(-1, nv)
        J = calibrated.rows(around) / size
        J = J.reshape(len(ways), count, *J.shape[1:])
        information = _information(J[0])
        half = np.linalg.solve(information, J[0].reshape(-1, J.shape[3]).T).T.reshape(J.shape[1:])
        slope = -2 * np.einsum("dcrp,crp->cd", J[1:] - J[0], half) / STEP
        value = -float(np.linalg.slogdet(information)[1])
        if not allowed.free:
            beyond = np.minimum(allowed.room(around).reshape(len(ways), count, -1) - _INSIDE, 0.0)
            walls = _WALL * (beyond**2).sum(axis=2)
            value, slope = value + float(walls[0].sum()), slope + (walls[1:] - walls[0]).T / STEP
        if touching is not None:
            slope = touching.along(own, touching.which(own), slope)
        return value, slope.ravel()

    box = np.tile(limits, (count, 1))
    options = {"maxiter": _MOVES, "maxcor": 20, "ftol": 1e-6}
    found = minimize(objective, position.ravel(), jac=True, method="L-BFGS-B", bounds=box, options=options)
    moved = found.x.reshape(count, nv)
    if allowed.free:
        return moved
    for share in (1.0, 0.9, 0.7, 0.4, 0.0):  # back towards the candidate, which is allowed
        tried = allowed.onto(position + share * (moved - position))
        good = allowed.met(tried) if share else np.ones(count, bool)
        position, moved = np.where(good[:, None], tried, position), np.where(good[:, None], tried, moved)
        if good.all():
            break
    return position


def in_order(
    position: Float[np.ndarray, "postures nv"], speed: Float[np.ndarray, " nv"]
) -> Int[np.ndarray, " postures"]:
    """An order with short ways between postures (time at full speed): the nearest next, then parts turned round."""
    speed = np.where(np.isfinite(speed) & (speed > 0), speed, 1.0)
    way = np.abs((position[:, None] - position[None]) / speed).max(axis=2)
    left, order = set(range(1, len(position))), [0]
    while left:
        order.append(min(left, key=lambda k: way[order[-1], k]))
        left.remove(order[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                a, b, c = order[i - 1], order[i], order[j]
                after = way[b, order[j + 1]] - way[c, order[j + 1]] if j + 1 < len(order) else 0.0
                if way[a, c] + after < way[a, b] - 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    better = True
    return np.array(order)
