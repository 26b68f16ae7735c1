"""From recordings and columns to one least-squares problem, with a note of what each of its rows is.

Recordings of one kind, with the same frames, share their device and its unknowns; the sockets of every recording are
its own. Fit and holdout recordings stand in one problem: what is fitted is a matter of weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Int

from ..effects.kinematic import Column, Postures
from ..errors import InputError
from ..recordings import starts
from ..recordings.devices import Device, Planes, Points, Poses, Sockets
from ..recordings.poses import PoseRecording
from ..rigid.chain import chain_between
from ..rigid.kinematics import poses_on_host
from ..rigid.model import RobotModel
from . import posefit
from .gravity import gravity_moments

__all__ = ["Measured", "assemble", "devices_of", "postures_of", "shared"]


class Measured(NamedTuple):
    """A problem with its columns, and for each row and posture where it comes from."""

    problem: posefit.Problem
    columns: tuple[Column, ...]
    channel: Int[np.ndarray, " rows"]
    posture: Int[np.ndarray, " rows"]  # among all postures; -1: a constraint
    item: Int[np.ndarray, " rows"]  # rows of one point or one orientation share a number
    measured: Bool[np.ndarray, " rows"]
    socket: Int[np.ndarray, " rows"]  # socket that a row belongs to, numbered over all groups; -1: none
    recording: Int[np.ndarray, " postures"]
    row: Int[np.ndarray, " postures"]  # in the file
    holdout: Bool[np.ndarray, " postures"]
    plain: bool = False  # to be fitted by plain least squares, without priors and without weights of postures

    @property
    def fitted(self) -> Bool[np.ndarray, " rows"]:
        """Rows that were measured and are not held out; constraints are always fitted."""
        return self.measured & ~np.where(self.posture >= 0, self.holdout[self.posture], False)

    @property
    def own(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of the devices' unknowns, which stand behind the columns'."""
        return tuple((name, unit) for g in self.problem.groups for name, unit, _ in g.device.unknowns())


def postures_of(model: RobotModel, recordings: Sequence[PoseRecording]) -> tuple[Postures, ...]:
    """What the effects need to know of the postures of each recording."""
    duration = max(sum(float(np.ptp(r.time)) for r in recordings), 1e-9)
    found = []
    for recording in recordings:
        q = recording.position
        torque, moment = gravity_moments(model, q)
        payload = np.zeros_like(torque)
        if recording.load is not None:
            payload = gravity_moments(_loaded(model, recording), q)[0] - torque
        before = np.concatenate([q[:1], q[:-1]])
        found.append(
            Postures(q, before, torque + payload, moment, payload, recording.time - recording.time[0], duration)
        )
    return tuple(found)


def _loaded(model: RobotModel, recording: PoseRecording) -> RobotModel:
    load = recording.load
    assert load is not None
    frame = model.frame_index(load.frame)
    parent = model.frames[frame].parent
    if parent < 0:
        return model
    point = np.asarray(model.frame_placement[frame]) @ np.array([*load.com, 1.0])
    inertia = np.array(model.inertia)
    inertia[parent, :4] += load.mass * np.array([1.0, *point[:3]])
    return eqx.tree_at(lambda m: m.inertia, model, inertia)


def assemble(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    postures: Sequence[Postures],
    columns: Sequence[Column],
    sizes: Sequence[float],
) -> Measured:
    """The problem of all recordings with the given columns; `sizes` is the typical size of each coefficient."""
    first = np.cumsum([0, *(len(r.position) for r in recordings)])
    groups, meta = [], []
    for members in shared(recordings):
        group, which, rows = _group(model, [recordings[k] for k in members], [postures[k] for k in members], columns)
        groups.append(group)
        posture = np.concatenate([first[k] + np.arange(len(recordings[k].position)) for k in members])
        meta.append((posture, which, rows))
    problem = posefit.Problem(tuple(groups), posefit.sizes(groups, sizes), len(columns))
    rows = posefit.rows_of(problem)
    posture = np.full(len(rows.group), -1)
    socket, items = posture.copy(), 0
    item = posture.copy()
    for g, (own, which, count) in enumerate(meta):
        mine = np.flatnonzero((rows.group == g) & (rows.sample >= 0))
        posture[mine] = own[rows.sample[mine]]
        part = np.arange(len(mine)) // len(own) // 3
        item[mine] = items + rows.sample[mine] * (count // 3 + 1) + part
        items = item[mine].max() + 1
        if which is not None:
            socket[mine] = which[rows.sample[mine]] + 1000 * g
    lengths = [len(r.position) for r in recordings]
    return Measured(
        problem,
        tuple(columns),
        rows.channel,
        posture,
        item,
        rows.measured,
        socket,
        np.repeat(np.arange(len(recordings)), lengths),
        np.concatenate([np.arange(n) for n in lengths]),
        np.repeat([r.role == "holdout" for r in recordings], lengths),
    )


def shared(recordings: Sequence[PoseRecording]) -> list[list[int]]:
    """Recordings that share a device, by their index."""
    groups: dict[Any, list[int]] = {}
    for k, r in enumerate(recordings):
        markers = r.values.shape[1] if r.kind == "position" else 0
        same = r.kind, r.base_frame, r.tool_frame, r.unknown, markers, id(r.device), r.carried, k if r.apart else -1
        groups.setdefault(same, []).append(k)
    return list(groups.values())


def devices_of(
    model: RobotModel, recordings: Sequence[PoseRecording]
) -> list[tuple[list[int], Device, Any, Bool[np.ndarray, "postures rows"]]]:
    """For each device its recordings (indices), the device as it starts, what it measured, and which rows."""
    return [(members, *_device(model, [recordings[k] for k in members])) for members in shared(recordings)]


def _device(model: RobotModel, recordings: list[PoseRecording]) -> tuple[Device, np.ndarray, np.ndarray]:
    position = np.concatenate([r.position for r in recordings])
    R, p = _nominal(model, recordings[0].base_frame, recordings[0].tool_frame, position)
    fit = np.concatenate([np.full(len(r.position), r.role == "fit") for r in recordings])
    if not fit.any():
        _refuse_unplaced(recordings[0])
        fit = np.ones(len(fit), bool)  # nothing is estimated from them: all is known
    make = {"position": _points, "pose": _poses, "socket": _sockets, "plane": _planes, "own": _own}
    return make[recordings[0].kind](recordings, R, p, fit)


def _refuse_unplaced(recording: PoseRecording) -> None:
    """`InputError` where a recording is predicted whose device no fitted recording shows."""
    if recording.unknown or recording.kind in ("plane", "socket", "own"):
        alike = "base_frame, tool_frame and unknown"
        alike += f" and {recording.values.shape[1]} markers in a row" if recording.kind == "position" else ""
        raise InputError(
            f"{recording.file}: role: holdout, but nothing with role: fit is measured by the same device (a"
            f" {recording.kind} with the same {alike}): where it stands and what it sees is not known, and nothing can"
            " be predicted of it. Give it role: fit, or keep out a part of what the device measured"
        )


def _group(
    model: RobotModel, recordings: list[PoseRecording], postures: list[Postures], columns: Sequence[Column]
) -> tuple[posefit.Group, np.ndarray | None, int]:
    chain = chain_between(model, recordings[0].base_frame, recordings[0].tool_frame)
    position = np.concatenate([r.position for r in recordings])
    kind = recordings[0].kind
    device, datum, measured = _device(model, recordings)
    pieces = (
        (k, chain.joints.index(j), np.concatenate([field(x) for x in postures], axis=1))
        for k, column in enumerate(columns)
        for j, field in column.pieces
        if j in chain.joints
    )
    group = posefit.group_of(chain, device, position.T, len(columns), pieces, datum, measured)
    return group, datum if kind == "socket" else None, measured.shape[1]


def _nominal(model: RobotModel, base: str, tool: str, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and origin of the tool frame in the base frame, without errors."""
    poses = poses_on_host(model, np.asarray(q, float))
    world = np.concatenate([np.broadcast_to(np.eye(4), (len(q), 1, 4, 4)), poses], axis=1)
    start, end = (
        world[:, model.frames[k].parent + 1] @ np.asarray(model.frame_placement)[k]
        for k in (model.frame_index(base), model.frame_index(tool))
    )
    found = np.linalg.solve(start, end)
    return found[:, :3, :3], found[:, :3, 3]


def _points(recordings, R, p, fit) -> tuple[Device, np.ndarray, np.ndarray]:
    points = np.concatenate([r.values for r in recordings])
    unknown = recordings[0].unknown
    base, markers = starts.place_points(R[fit], p[fit], points[fit], unknown)
    device = Points(base, np.nanmean(points[fit], axis=(0, 1)), unknown, markers)
    seen = np.asarray(np.isfinite(points).all(axis=2))
    return device, np.where(seen[:, :, None], points, 0.0), np.repeat(seen, 3, axis=1)


def _poses(recordings, R, p, fit) -> tuple[Device, np.ndarray, np.ndarray]:
    poses = np.concatenate([r.values for r in recordings])
    unknown = recordings[0].unknown
    place = np.isfinite(poses[:, :3, 3]).all(axis=1)
    turned = np.isfinite(poses[:, :3, :3]).all(axis=(1, 2))
    if (fit & place & turned).any():
        base, tool = starts.place_poses(R[fit], p[fit], poses[fit], unknown)
    else:
        base, markers = starts.place_points(R[fit], p[fit], poses[fit][:, None, :3, 3], unknown)
        tool = np.eye(4)
        tool[:3, 3] = markers[0]
    centre = np.nanmean(poses[fit][:, :3, 3], axis=0)
    measured = np.repeat(np.stack([place, turned], axis=1), 3, axis=1)
    whole = np.where(np.isfinite(poses), poses, np.eye(4))
    return Poses(base, centre, unknown, tool, "sight" if recordings[0].carried else "device"), whole, measured


def _sockets(recordings, R, p, fit) -> tuple[Device, np.ndarray, np.ndarray]:
    number, pairs, distances, weights, count = [], [], [], [], 0
    for r in recordings:
        seen = r.values >= 0
        names, own = np.unique(r.values[seen], return_inverse=True)
        whole = np.zeros(len(r.values), int)
        whole[seen] = own + count
        number.append(whole)
        if r.distance is not None:
            if len(names) != 2:
                raise InputError(
                    f"{r.file}: distance is that of two sockets, but the recording has {len(names)}"
                    f" ({', '.join(str(n) for n in names)}); give each pair its own recording"
                )
            if r.role == "fit":
                pairs.append((count, count + 1))
                distances.append(r.distance)
                weights.append(np.sqrt(seen.sum()))
        count += len(names)
    socket = np.concatenate(number)
    measured = np.concatenate([r.values >= 0 for r in recordings])
    point, sockets = starts.place_sockets(R[measured], p[measured], socket[measured], recordings[0].unknown)
    device = Sockets(point, recordings[0].unknown, sockets, tuple(pairs), np.array(distances), np.array(weights))
    return device, socket, np.repeat(measured[:, None], 3, axis=1)


def _planes(recordings, R, p, fit) -> tuple[Device, np.ndarray, np.ndarray]:
    values = np.concatenate([r.values for r in recordings])
    names, plane = np.unique(np.where(values < 0, values.max(), values), return_inverse=True)
    axes, middle = [], []
    for k, name in enumerate(names):
        touched = p[(plane == k) & (values >= 0)]
        if len(touched) < 4:
            raise InputError(f"{recordings[0].file}: plane {name} was touched {len(touched)} times; four are the least")
        both = starts.fit_plane(touched)
        axes.append(both[0])
        middle.append(both[1])
    device = Planes(np.zeros(3), recordings[0].unknown, np.array(axes), np.array(middle))
    return device, plane, (values >= 0)[:, None]


def _own(recordings, R, p, fit) -> tuple[Device, np.ndarray, np.ndarray]:
    device, values = recordings[0].device, np.concatenate([r.values for r in recordings])
    if device is None:
        raise InputError(f"{recordings[0].file}: a recording of kind 'own' needs its device, see devices.own_device")
    whole: np.ndarray = np.all(np.isfinite(values).reshape(len(values), -1), axis=1)
    datum = np.where(whole.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)
    rows = jax.eval_shape(device.residual, np.eye(4), np.zeros(len(device.unknowns())), datum[0]).shape
    if rows != (len(device.channels()),):
        raise InputError(
            f"{recordings[0].file}: the device's residual has shape {rows}, but its channels are {device.channels()}"
        )
    return device, datum, np.repeat(whole[:, None], len(device.channels()), axis=1)
