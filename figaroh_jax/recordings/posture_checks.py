"""The check of recordings of postures before a calibration: joints against limits, measurements against the model.

The measured points are laid over the model's by the rotation, shift, scale and tool point that fit best. What is left,
as a share of the points' spread, is a few per cent for a robot out of calibration and tens of per cent for columns in
the wrong order or unit; the scale shows millimetres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..rigid.model import RobotModel, prismatic
from .checks import DEGREE, Finding, position_findings, report_findings
from .likeness import frame_poses
from .poses import PoseRecording

if TYPE_CHECKING:
    from pathlib import Path

    from ..formats.config import RecordingEntry, Task
    from .dataset import Memory

__all__ = ["OFF", "check_pose_recording", "check_pose_recordings", "spread_of"]

OFF = 0.12  # share of the points' spread that no calibration leaves
FEWEST = 8
TURNED = 0.15  # rad between orientations that no calibration leaves
CLEARLY = 0.2  # of what is left as written that may be left the other way round, for it to be the right one
FAIR = 5e-3  # rad between orientations, that are right as they are


def check_pose_recordings(task: Task | None, model: RobotModel, recordings: Sequence[PoseRecording]) -> tuple[str, ...]:
    """Warnings about recordings of postures, of a task or from arrays, also sent to the log `figaroh_jax`.

    Raises `InputError` where they are wrong.
    """
    entries: dict[Path | Memory, RecordingEntry] = {entry.place: entry for entry in task.data} if task else {}
    found = [(r.file.name, f) for r in recordings for f in check_pose_recording(r, model, entries.get(r.file))]
    return report_findings(found)


def check_pose_recording(
    recording: PoseRecording, model: RobotModel, entry: RecordingEntry | None = None
) -> list[Finding]:
    """Everything that looks wrong about one recording of postures, the gravest first."""
    if model.nq != model.nv or recording.position.shape[1] != model.nv:
        return []  # the kinematics refuse another number of joints
    unit = entry.units.position if entry is not None else "rad"
    found = position_findings(recording.position, model, unit)
    if any(finding.wrong for finding in found):
        return [finding for finding in found if finding.wrong]
    if len(recording.position) > 2 and not np.ptp(recording.position, axis=0).any():
        return [Finding(True, "every posture is the same: a calibration needs different ones")]
    if recording.kind in ("position", "pose"):
        measured_unit = entry.units.measurement if entry is not None else "m"
        found += _against_model(recording, model, unit, measured_unit)
    return found


class _Overlay(NamedTuple):
    """Measured points laid over the model's."""

    left: float  # RMS that remains, share of the points' spread
    scale: float  # measured over the model's


def _against_model(recording: PoseRecording, model: RobotModel, unit: str, measured: str) -> Iterator[Finding]:
    points = _points(recording)
    seen = np.asarray(np.isfinite(points).all(axis=1))
    if seen.sum() < FEWEST or np.ptp(points[seen], axis=0).max() == 0:
        return
    q, points = recording.position[seen], points[seen]

    def overlay(position: np.ndarray, points: np.ndarray = points) -> _Overlay:
        turned, origin = frame_poses(model, position, recording.tool_frame)
        base_turned, base = frame_poses(model, position, recording.base_frame)
        origin = np.einsum("nji,nj->ni", base_turned, origin - base)
        return _overlaid(points, np.einsum("nji,njk->nik", base_turned, turned), origin)

    own = overlay(q)
    if own.left > OFF:
        others = [(text, overlay(other)) for text, other in _readings(q, model, unit)]
        if recording.kind == "pose":
            turned = recording.values[seen][:, :3, :3]
            back = -np.einsum("nji,nj->ni", turned, points)
            if np.isfinite(back).all():
                text = "they would with every pose inverted: that of the marker in the device's frame is expected"
                others.append((text, overlay(q, back)))
        yield _odd(own, others)
    elif not 0.5 < own.scale < 2.0:
        thousand = 500 < own.scale < 2000
        advice = "they look like mm: add units: {measurement: mm}" if thousand else "what unit are they in?"
        if 500 < 1 / own.scale < 2000 and measured == "mm":
            advice = "they look like m: remove units: {measurement: mm}"
        yield Finding(True, f"the measured points spread {own.scale:.4g} times as far as the model's; {advice}")
    else:
        yield from _stated_frames(recording, model, seen)
    if recording.kind == "pose" and own.left <= OFF:
        yield from _orientations(recording, model, seen)


def _points(recording: PoseRecording) -> Float[np.ndarray, "postures 3"]:
    """What was measured of the marker's place, or of the first of several."""
    return recording.values[:, :3, 3] if recording.kind == "pose" else recording.values[:, 0]


def spread_of(recording: PoseRecording) -> float | None:
    """RMS distance of the measured points from their mean, m; None for devices that see no points in space."""
    if recording.kind not in ("pose", "position"):
        return None
    points = _points(recording)
    points = points[np.isfinite(points).all(axis=1)]
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(points) else None


def _stated_frames(recording: PoseRecording, model: RobotModel, seen: np.ndarray) -> Iterator[Finding]:
    """Frames taken for known (not in `unknown`) that are far from where the measurements have them."""
    known = [name for name in ("base_frame", "tool_frame") if name not in recording.unknown]
    if not known:
        return
    q, points = recording.position[seen], _points(recording)[seen]
    turned, origin = frame_poses(model, q, recording.tool_frame)
    base_turned, base = frame_poses(model, q, recording.base_frame)
    origin = np.einsum("nji,nj->ni", base_turned, origin - base)
    turned = np.einsum("nji,njk->nik", base_turned, turned)
    off = _off(points, turned, origin, recording.unknown)
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if off <= OFF * spread:
        return
    tried = [*((*recording.unknown, name) for name in known), ("base_frame", "tool_frame")]
    free = next((names for names in tried if _off(points, turned, origin, names) <= OFF * spread), tried[-1])
    stated = " and ".join(f"{name} '{getattr(recording, name)}'" for name in known)
    yield Finding(
        False,
        f"the measured points lie {1e3 * off:.3g} mm (RMS) from the model's with {stated} taken as exactly known; they"
        " follow the model where device or marker may stand elsewhere: measurement.unknown:"
        f" [{', '.join(sorted(free))}]",
    )


def _off(
    points: Float[np.ndarray, "n 3"],
    turned: Float[np.ndarray, "n 3 3"],
    origin: Float[np.ndarray, "n 3"],
    unknown: Sequence[str],
) -> float:
    """RMS distance of the measured points from the model's, m, where only frames in `unknown` may be moved."""
    if "base_frame" in unknown:
        spread = np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())
        return float(_overlaid(points, turned, origin, fixed="tool_frame" not in unknown).left * spread)
    rest = points - origin
    if "tool_frame" in unknown:
        rest = rest - turned @ np.linalg.lstsq(turned.reshape(-1, 3), rest.ravel(), rcond=1e-6)[0]
    return float(np.sqrt((rest**2).sum(axis=1).mean()))


def _odd(own: _Overlay, others: Sequence[tuple[str, _Overlay]]) -> Finding:
    text, best = min(others, key=lambda item: item[1].left)
    advice = "columns in another order, another robot, or another frame?"
    if best.left < 0.3 * own.left and best.left < OFF:
        advice = text
    return Finding(
        False,
        f"the measured points do not follow the model's postures ({own.left:.0%} of their spread is left after the best"
        f" placement of device and tool); {advice}",
    )


def _overlaid(points: np.ndarray, turned: np.ndarray, origin: np.ndarray, *, fixed: bool = False) -> _Overlay:
    """The best rotation, shift, scale (Umeyama 1991) and tool point, in turns; `fixed`: the tool point is known."""
    tool = np.zeros(3)
    middle = points - points.mean(axis=0)
    scale, rotation, mine = 1.0, np.eye(3), origin
    for _ in range(1 if fixed else 30):
        mine = origin + turned @ tool
        centred = mine - mine.mean(axis=0)
        u, s, vt = np.linalg.svd(middle.T @ centred)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation, scale = (u * sign) @ vt, float((s * sign).sum() / max((centred**2).sum(), 1e-300))
        wanted = middle @ rotation / max(scale, 1e-12) - (origin - origin.mean(axis=0))
        design = (turned - turned.mean(axis=0)).reshape(-1, 3)
        tool = tool if fixed else np.linalg.lstsq(design, wanted.ravel(), rcond=1e-6)[0]
    rest = middle - scale * (mine - mine.mean(axis=0)) @ rotation.T
    return _Overlay(float(np.sqrt((rest**2).sum() / (middle**2).sum())), scale)


def _readings(q: np.ndarray, model: RobotModel, unit: str) -> Iterator[tuple[str, np.ndarray]]:
    """The same columns in another unit, a pair swapped, a sign turned, a joint that counts the one before it."""
    turns, names = ~np.array(prismatic(model)), model.dof_names
    if unit == "rad":
        yield "they would in degrees: add units: {position: deg}", q * np.where(turns, DEGREE, 1e-3)
    else:
        yield f"they would in rad: remove units: {{position: {unit}}}", q * np.where(turns, 1 / DEGREE, 1e3)
    for i in range(len(names)):
        sign = np.ones(len(names))
        sign[i] = -1.0
        yield f"they would with the opposite sign of {names[i]}", q * sign
        for j in range(i + 1, len(names)):
            order = list(range(len(names)))
            order[i], order[j] = j, i
            yield f"they would with the columns of {names[i]} and {names[j]} swapped", q[:, order]
    for i in np.flatnonzero(turns[1:] & turns[:-1]):  # an arm whose forearm keeps its slope where the upper arm moves
        for sign in (1.0, -1.0):
            row = np.eye(len(names), dtype=int)[i + 1] - int(sign) * np.eye(len(names), dtype=int)[i]
            other = q.copy()
            other[:, i + 1] += sign * q[:, i]
            yield (
                f"they would with {names[i + 1]} {'+' if sign > 0 else '-'} {names[i]} as the angle of {names[i + 1]}:"
                f" the columns are no joint angles, as those of a Fanuc; the row of {names[i + 1]} in"
                f" transmission.position is {row.tolist()}",
                other,
            )


def _orientations(recording: PoseRecording, model: RobotModel, seen: np.ndarray) -> Iterator[Finding]:
    """Rotations between measured orientations against the model's: a quaternion in another order, or the inverse."""
    measured = recording.values[seen][:, :3, :3]
    whole = np.isfinite(measured).all(axis=(1, 2))
    if whole.sum() < FEWEST:
        return
    turned, _ = frame_poses(model, recording.position[seen][whole], recording.tool_frame)
    base, _ = frame_poses(model, recording.position[seen][whole], recording.base_frame)
    own = _turns(base.swapaxes(1, 2) @ turned)
    off = _unlike(own, _turns(measured[whole]))
    # w x y z read as x y z w is the inverse orientation between two other frames: a roll and a conjugation of the four
    # numbers make a rotation of their space, and such a one is a product with a quaternion on each side
    back = _unlike(own, _turns(measured[whole].swapaxes(1, 2)))
    if off < TURNED and (off < FAIR or back > CLEARLY * off):  # small turns are never far off, but clearly another way
        return
    inverse = back < TURNED
    advice = (
        "they do as w x y z, or transposed: quaternions are x y z w (name the columns in that order, or add"
        " `orientation: wxyz` to the measurement), and the orientation is that of the marker in the device's frame"
    )
    yield Finding(
        inverse,
        "the measured orientations do not turn as the model's do; "
        + (advice if inverse else "another order of columns, or another frame?"),
    )


def _turns(orientation: Float[np.ndarray, "rows 3 3"]) -> Float[np.ndarray, "_ 3"]:
    """Rotation from each orientation to the next, in the axes of the first of the two, rad."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(orientation[:-1].swapaxes(1, 2) @ orientation[1:]).as_rotvec()


def _unlike(one: Float[np.ndarray, "_ 3"], other: Float[np.ndarray, "_ 3"]) -> float:
    """Median distance of rotations from each other, rad, after the one rotation of the tool that fits best (Kabsch).

    Angles alone do not tell: that of two quaternions is the same in any order of their numbers.
    """
    near = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1)) < 2.5  # short of the turn of sign
    if near.sum() < FEWEST - 2:
        return 0.0
    u, _, vt = np.linalg.svd(one[near].T @ other[near])
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.median(np.linalg.norm(other[near] - one[near] @ rotation, axis=1)))
