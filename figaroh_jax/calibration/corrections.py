"""From the fit of a calibration to what people read: parameters with their status, causes, corrected joints, frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled.batching import program
from ..effects.base import Effect
from ..effects.extended import extend
from ..effects.kinematic import Column, Postures, shape_of
from ..estimation import marginal
from ..estimation.data import PoseData
from ..estimation.posefit import DRAFT_OPTIONS, ties
from ..estimation.posegroups import Measured, shared
from ..estimation.posesolver import Solution
from ..estimation.solution import Fit, numbers
from ..recordings.devices import Device
from ..recordings.poses import PoseRecording
from ..results import Cause, Estimate, Gain, Name
from ..rigid.model import RobotModel
from . import levels, thresholds
from .calibrated import Outlier, Parameter, Shown
from .candidates import Block
from .gauge import Gauge, find_gauge

__all__ = [
    "causes_of",
    "centred",
    "corrected",
    "correlations_of",
    "frames_of",
    "gauge_of",
    "identifiable",
    "outlier_cause",
    "parameters_of",
    "shown_of",
    "solution_of",
    "twist_pose",
    "twists_of",
]


def gauge_of(final: Measured, fit: marginal.Linear, used, free) -> tuple[Gauge, list[int]]:
    """Dependence among the free unknowns: the frames stand first, then offsets, then geometry, then effects.

    It is looked for at the nominal geometry, where a dependence is exact.
    """
    linear = levels.linearise(final, np.where(fit.prior == marginal.FLAT, fit.at, 0.0))
    order = [int(k) for k in np.flatnonzero(free)]
    effects = {k for k, c in enumerate(final.columns) if c.effect not in ("joint_offset", "link_geometry")}
    first = sorted(range(len(order)), key=lambda i: (linear.prior[order[i]] != marginal.FLAT, order[i] in effects, i))
    rows = np.flatnonzero(used)
    return find_gauge(linear.jacobian[rows][:, order], first), order


def identifiable(measured: Measured) -> list[Column]:
    """The columns of offsets and geometry that the measured postures tell from the frames and from those before."""
    linear = levels.linearise(measured, np.zeros(len(measured.columns) + len(measured.own)))
    gauge, order = gauge_of(measured, linear, measured.fitted, np.ones(len(linear.at), bool))
    held = {order[k] for k in gauge.dependent}
    return [column for k, column in enumerate(measured.columns) if k not in held]


def solution_of(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    final: Measured,
    linear: marginal.Linear,
    posterior: marginal.Posterior,
    found: Solution,
    used: np.ndarray,
    free: np.ndarray,
    named: Sequence[Block],
) -> Fit:
    """The calibration as a fit: corrected robot, devices in their places, numbers with their covariance.

    Effects at the joints' sensors stand in the model; those that move links (twists) have no form there.
    """
    scale = np.asarray(final.problem.scale)
    each = [(c.label, c.unit) for c in final.columns] + list(final.own)
    kept = np.array([k for k in np.flatnonzero(free) if each[k][0]], int)  # empty columns have no name
    names, units = (tuple(each[k][place] for k in kept) for place in (0, 1))
    covariance = (marginal.honest_covariance(posterior, linear.prior) * scale[:, None] * scale)[np.ix_(kept, kept)]
    weight = np.where(linear.posture >= 0, posterior.weight[linear.posture], 1.0)
    weight = np.where(used, np.sqrt(weight) / posterior.noise[linear.channel], 0.0)
    return Fit(
        model=extend(
            corrected(model, twists_of(model, final, linear.at)), *_effects_of(model, final, linear.at, named)
        ),
        data=_data_of(recordings, final, linear.at * scale, weight),
        values=(linear.at * scale)[kept],
        covariance=covariance,
        hidden=np.zeros(len(kept)),
        cost=np.float64(found.cost),
        rows=_by_posture(final, weight * linear.residual),
        rank=len(kept),
        outcome=None,
        stats={"num_steps": found.steps},
        free=numbers("calibration", names, units, tuple(scale[kept].tolist())),
        failure="" if found.converged else "the solver did not converge within its steps",
    )


def _by_posture(final: Measured, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of `PoseData.residual`: each device's posture by posture, then its constraints."""
    found, first = [], 0
    for group in final.problem.groups:
        samples, count = np.shape(group.measured)
        found.append(rows[first : first + samples * count].reshape(count, samples).T.reshape(-1))
        first += samples * count
        tied = ties(group.device)
        found.append(rows[first : first + tied])
        first += tied
    return np.concatenate(found)


def _effects_of(model: RobotModel, final: Measured, at: np.ndarray, named: Sequence[Block]) -> Iterator[Effect]:
    """The named effects that have a form at the joints' sensors, with their sizes; a joint that follows has none."""
    size = dict(zip((c.label for c in final.columns), at * np.asarray(final.problem.scale), strict=False))
    for block in named:
        own = [model.joints[model.tree_index(name)] for name in block.columns[0].at]
        if block.effect.has("position_error") and not any(joint.follows for joint in own):
            joints = np.array([joint.coordinate for joint in own], int)
            values = {c.parameter: np.float64(block.effect.correction * size[c.label]) for c in block.columns}
            curved = shape_of(block.effect)[0]
            yield block.effect(joints, **values, **({curved: np.float64(block.shape)} if curved else {}))


def _data_of(
    recordings: Sequence[PoseRecording], final: Measured, values: np.ndarray, weight: np.ndarray
) -> tuple[PoseData, ...]:
    """What every device measured, the device where the fit puts it."""
    data, first, row = [], len(final.columns), 0
    for group, members in zip(final.problem.groups, shared(recordings), strict=True):
        own = values[first : first + len(group.device.unknowns())]
        first += len(own)
        samples, count = np.shape(group.measured)
        mine, tied = weight[row : row + samples * count].reshape(count, samples).T, ties(group.device)
        row += samples * count
        held = float(weight[row]) if tied else 1.0
        row += tied
        one = recordings[members[0]]
        position = np.asarray(group.position).T
        moved = group.device.moved(jnp.asarray(own))
        begins = tuple(np.cumsum([0, *(len(recordings[k].position) for k in members[:-1])]).tolist())
        data.append(PoseData(position, group.datum, mine, moved, held, one.base_frame, one.tool_frame, begins))
    return tuple(data)


def parameters_of(final: Measured, linear, posterior, gauge: Gauge, order: list[int]) -> tuple[Parameter, ...]:
    """Every number of the fit with its deviation (SI units), and whether data, prior or the gauge decide it."""
    scale = np.asarray(final.problem.scale)
    names = [(c.label, c.unit) for c in final.columns] + list(final.own)
    covariance = marginal.honest_covariance(posterior, linear.prior)
    found = []
    for place, k in enumerate(order):
        prior = posterior.precision[k] ** -0.5 if linear.prior[k] != marginal.FLAT else np.inf
        std = float(np.sqrt(covariance[k, k]))
        known = "identified" if std < thresholds.KNOWN * prior else "prior only"
        status = "gauge" if place in gauge.dependent else known
        found.append(Parameter(*(names[k][0], float(linear.at[k] * scale[k]), std * scale[k], names[k][1]), status))
    return tuple(sorted(found, key=lambda p: p.name.split()[0] in ("base_frame", "tool_frame", "socket")))


def correlations_of(
    final: Measured, posterior: marginal.Posterior, parameters: Sequence[Parameter], most: int = 12
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of identified parameters whose errors go together by more than a half, the strongest first."""
    names = [c.label for c in final.columns] + [name for name, _ in final.own]
    known = {p.name for p in parameters if p.status == "identified"}
    kept = np.array([k for k, name in enumerate(names) if name in known], int)
    covariance = posterior.covariance[np.ix_(kept, kept)]
    size = np.sqrt(np.diag(covariance))
    correlation = np.triu(covariance / np.where(np.outer(size, size) > 0.0, np.outer(size, size), 1.0), 1)
    strongest = np.argsort(-np.abs(correlation), axis=None)[:most]
    pairs = [(*np.unravel_index(k, correlation.shape), correlation.flat[k]) for k in strongest]
    return tuple((names[kept[i]], names[kept[j]], float(r)) for i, j, r in pairs if abs(r) > 0.5)


def causes_of(
    parameters: Sequence[Parameter],
    level: str,
    named: Sequence[Block],
    blocks: Sequence[Block],
    table: dict[str, tuple[float, float]],
    folds: Sequence[levels.Fold],
) -> tuple[Cause, ...]:
    """Offsets beyond what a good zeroing leaves, the largest first; then the effects `named`."""
    channel = 0 if np.isfinite(table["frames"][0]) else 1
    unit, scale = (("mm", 1e3), ("deg", 180.0 / np.pi))[channel]
    fall = Gain(scale * table["frames"][channel], scale * table["joint_offset"][channel], unit)
    offsets = [p for p in parameters if p.name.startswith("joint_offset") and p.status == "identified"]
    found = [
        Cause(Name("joint_offset", (p.name.split(" ", 1)[1],)), {"offset": Estimate(p.value, p.std, p.unit)}, 1.0, fall)
        for p in sorted(offsets, key=lambda p: -abs(p.value))
        if level != "frames" and abs(p.value) > thresholds.OFFSET_SIGMAS * np.hypot(p.std, thresholds.OFFSET)
    ]
    gain = Gain(scale * levels.pooled([f.plain for f in folds])[channel], scale * table["chosen"][channel], unit)
    by_name = {p.name: p for p in parameters}
    for block in named:
        values = {c.parameter: by_name[c.label] for c in block.columns}
        estimates = {key: Estimate(p.value, p.std, p.unit) for key, p in values.items()}
        if shape_of(block.effect)[0]:
            estimates[shape_of(block.effect)[0]] = Estimate(float(block.shape), block.shape_std, "1")
        share = np.mean([any(blocks[j].name == block.name for j in f.choice.effects) for f in folds])
        found.append(Cause(block.name, estimates, float(share), gain))
    return tuple(found)


def outlier_cause(outlier: Outlier) -> Cause:
    """A posture that was left out, as a cause of its own."""
    size = {"size": Estimate(outlier.size, float("nan"), "1")}
    note = f"row {outlier.row} of {outlier.file} deviates by {outlier.size:.0f} times the noise; it was left out"
    return Cause(Name("outlier", ()), size, 1.0, Gain(float("nan"), float("nan"), "mm"), note=note)


def twists_of(model: RobotModel, final: Measured, at: np.ndarray) -> dict[str, np.ndarray]:
    """Constant twist of each joint: offsets and geometry, not what depends on the posture."""
    scale = np.asarray(final.problem.scale)
    twists: dict[str, np.ndarray] = {}
    q, none = np.zeros((1, model.nv)), np.zeros((1, 0))
    one = Postures(q, q, none, none, none, np.zeros(1), 1.0)
    for k, column in enumerate(final.columns):
        if column.effect in ("joint_offset", "link_geometry"):
            ((joint, field),) = column.pieces
            name = model.joints[joint].name
            twists[name] = twists.get(name, np.zeros(6)) + at[k] * scale[k] * field(one)[:, 0]
    return twists


def corrected(model: RobotModel, twists: dict[str, np.ndarray]) -> RobotModel:
    """The model with each joint moved on its link by the twist (m, rad) under its name."""
    placement = np.array(model.placement)
    for k, joint in enumerate(model.joints):
        if joint.name in twists:
            placement[k] = placement[k] @ twist_pose(twists[joint.name])
    return eqx.tree_at(lambda m: m.placement, model, placement)


def twist_pose(twist: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """The pose E of a twist of the chain: its translation, then its rotation."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return pose


def frames_of(final: Measured, at: np.ndarray) -> dict[str, np.ndarray]:
    """Poses (4 x 4, m) and points (m) of every device where the scaled unknowns `at` put them, by name."""
    values = at * np.asarray(final.problem.scale)
    start, found = len(final.columns), {}
    for g, group in enumerate(final.problem.groups):
        count = len(group.device.unknowns())
        mark = f" {g + 1}" if len(final.problem.groups) > 1 else ""
        for name, value in _places(group.device, values[start : start + count]).items():
            found[name + mark] = np.asarray(value)
        start += count
    return found


@partial(program, cpu=DRAFT_OPTIONS)
def _places(device: Device, unknown: Array) -> dict[str, Array]:
    return device.places(unknown)


def centred(measured: Measured, residual: np.ndarray) -> np.ndarray:
    """Residuals at held-out sockets, from the mean of their own postures: no fitted posture shows where they are."""
    found = residual.copy()
    held = np.zeros(len(residual), bool)
    held[measured.posture >= 0] = measured.holdout[measured.posture[measured.posture >= 0]]
    for socket in np.unique(measured.socket[held & (measured.socket >= 0)]):
        rows = np.flatnonzero((measured.socket == socket) & measured.measured)
        parts = residual[rows].reshape(3, -1)
        found[rows] = (parts - parts.mean(axis=1, keepdims=True)).reshape(-1)
    return found


def shown_of(final: Measured, recordings, frames, after) -> tuple[Shown, ...]:
    """Points and errors of every recording, for rows of three positions."""
    before, after = centred(final, frames), centred(final, after)
    shown = []
    for k, recording in enumerate(recordings):
        rows = (final.channel == 0) & final.measured & (final.posture >= 0)
        rows &= np.where(final.posture >= 0, final.recording[final.posture], -1) == k
        items, first, count = np.unique(final.item[rows], return_index=True, return_counts=True)
        if not len(items) or count.max() != 3 or recording.kind == "own":
            continue
        place = np.flatnonzero(rows)
        triple = np.array([place[final.item[place] == item] for item in items])
        at = recording.values[..., :3, 3] if recording.kind == "pose" else recording.values
        row = tuple(int(final.row[final.posture[t[0]]]) for t in triple)
        if recording.kind in ("socket", "plane"):
            at = recording.position[:, :3] * 0.0
        where = at.reshape(len(recording.position), -1, 3)
        points = np.array([where[r, min(i, where.shape[1] - 1)] for r, i in zip(row, _repeat(row), strict=True)])
        shown.append(Shown(recording.name, recording.role, points, before[triple], after[triple], row))
    return tuple(shown)


def _repeat(rows: Sequence[int]) -> list[int]:
    """How often each row has stood there before: the number of the marker."""
    seen: dict[int, int] = {}
    counts = []
    for row in rows:
        counts.append(seen.get(row, 0))
        seen[row] = counts[-1] + 1
    return counts
