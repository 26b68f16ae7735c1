r"""Whether robot and device were the same in all recordings: a joint that lost its zero, a marker that was moved.

Of every recording the rows alone are scored beside a fit of them all: its own frames of the device, its own zero of
each joint, each effect as if it had it alone. What all recordings may have alike competes: a payload that only one
carries, warming, compliance. A change is told where chance seldom brings such a score and nothing that is alike in all
recordings explains it as well, for its number of columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..effects.kinematic import Column, Postures
from ..estimation import marginal
from ..estimation.marginal import Linear
from ..estimation.posegroups import Measured, shared
from ..recordings.poses import PoseRecording
from ..results import Name
from . import levels, thresholds
from .kinematic_scores import Tested, row_noise, score_blocks

__all__ = ["ZERO", "Change", "find_change", "frames_told", "own_zero", "with_own_frames"]

ZERO = "zero_change"  # of the columns of a joint that one recording reads with another zero

Array = np.ndarray


class Change(NamedTuple):
    """What one recording has for itself: its frames (no name), the zero of a joint, or an effect."""

    recording: int
    name: Name | None = None


def find_change(
    measured: Measured,
    recordings: Sequence[PoseRecording],
    linear: Linear,
    used: Bool[Array, " rows"],
    effects: Sequence[tuple[Name, Float[Array, "rows _"]]],
    chance: float,
) -> Change | None:
    """The change that explains most for its number of columns, beside a fit of the rows `used` with all links free.

    `linear` has the columns of the effects that were chosen behind the others; `effects` are all that there are.
    """
    compared = _comparable(measured, recordings, used)
    if not compared:
        return None
    free = levels.free_at("full", linear.prior)
    posterior = marginal.fit(linear, used, free)
    fit = Tested(linear, row_noise(linear, posterior), used, posterior.precision, free)
    both = [pair for r in compared for pair in _own(measured, recordings, linear, effects, r)]
    scores = score_blocks(fit, [Z for _, Z in both])
    if scores.p_value > chance:
        return None
    merit = _merit(scores.q, scores.size)
    alike = score_blocks(fit, [Z for _, Z in effects])
    rival = _merit(alike.q, alike.size).max(initial=-np.inf)
    best = int(np.argmax(merit))
    return both[best][0] if merit[best] > rival + 2.0 * thresholds.TOLD else None


def _merit(q: Array, size: Array) -> Array:
    """Squares that a block explains beyond those that its number of columns is worth."""
    return np.where(size > 0, q - thresholds.WORTH * size, -np.inf)


def _comparable(measured: Measured, recordings: Sequence[PoseRecording], used: Array) -> list[int]:
    """The fitted recordings that may differ from the others, of two the second; each has postures as the others have.

    What the model lacks in one part of the workspace would look like a change in a recording that was made there alone.
    """
    postures = np.unique(measured.posture[used & (measured.posture >= 0)])
    count = np.bincount(measured.recording[postures], minlength=len(recordings))
    free = [k for k, r in enumerate(recordings) if r.kind in ("pose", "position")]
    fitted = [k for k in free if count[k] >= thresholds.OWN_POSTURES]
    alike = [k for k in fitted if _among(recordings[k], [recordings[j] for j in fitted if j != k])]
    return alike if len(fitted) > 2 else [k for k in alike if k != fitted[0]]


def _among(one: PoseRecording, others: Sequence[PoseRecording]) -> bool:
    """Whether the postures of a recording lie where those of the others do, joint by joint."""
    if not others:
        return False
    q, rest = one.position, np.concatenate([other.position for other in others])
    spread, wide = q.std(axis=0), rest.std(axis=0)
    apart = np.abs(q.mean(axis=0) - rest.mean(axis=0))
    near = apart <= thresholds.AMONG * np.minimum(spread, wide) + 1e-9
    return bool(np.all(near & (spread <= 2.0 * wide + 1e-9) & (wide <= 2.0 * spread + 1e-9)))


def _own(
    measured: Measured,
    recordings: Sequence[PoseRecording],
    linear: Linear,
    effects: Sequence[tuple[Name, Array]],
    recording: int,
) -> Iterator[tuple[Change, Array]]:
    """Everything that a recording may have for itself, with its columns."""
    mine = (measured.posture >= 0) & (measured.recording[np.maximum(measured.posture, 0)] == recording)
    alone = lambda Z: np.where(mine[:, None], Z, 0.0)  # noqa: E731
    frames = _frames(measured, recordings, linear, recording)
    if len(frames):
        yield Change(recording), alone(linear.jacobian[:, frames])
    for k, column in enumerate(measured.columns):
        if column.effect == "joint_offset" and column.parameter == "offset":
            yield Change(recording, Name(column.effect, column.at)), alone(linear.jacobian[:, [k]])
    for name, Z in effects:
        yield Change(recording, name), alone(Z)


def _frames(measured: Measured, recordings: Sequence[PoseRecording], linear: Linear, recording: int) -> Array:
    """Columns of the unknown frames of the device that a recording shares with others."""
    if recordings[recording].kind not in ("pose", "position") or not recordings[recording].unknown:
        return np.zeros(0, int)
    first = len(measured.columns)
    for group, members in zip(measured.problem.groups, shared(recordings), strict=True):
        count = len(group.device.unknowns())
        if recording in members:
            return np.arange(first, first + count if len(members) > 1 else first)
        first += count
    return np.zeros(0, int)


def with_own_frames(recordings: Sequence[PoseRecording], recording: int) -> tuple[PoseRecording, ...]:
    """The recordings, one of them with a device of its own."""
    return tuple(replace(r, apart=True) if k == recording else r for k, r in enumerate(recordings))


def own_zero(column: Column, postures: Postures, name: str) -> Column:
    """The offset of a joint that only the recording with the given `postures` has, beside that of all."""

    def alone(field):
        return lambda p: field(p) if p is postures else np.zeros((6, len(p.q)))

    pieces = tuple((joint, alone(field)) for joint, field in column.pieces)
    return column._replace(effect=ZERO, parameter=f"change in {name}", pieces=pieces)


def frames_told(recordings: Sequence[PoseRecording], changed: int, frames: Mapping[str, Array]) -> str:
    """How far the frames of a recording are from those of the others, from the `frames` of a calibration by name."""
    groups = shared(recordings)
    own = next(g for g, members in enumerate(groups) if changed in members)
    key = replace(recordings[changed], apart=False)
    others = [g for g, members in enumerate(groups) if g != own and _same_device(recordings[members[0]], key)]
    told = []
    for name, value in frames.items():
        kind, _, group = name.rpartition(" ")
        before = frames.get(f"{kind} {others[0] + 1}") if others and group == str(own + 1) else None
        if before is not None and np.shape(before) == np.shape(value):
            told.append(f"{kind} by {_apart(before, value)}")
    where = f": {', '.join(told)}" if told else ""
    return (
        f"the recordings differ: in {recordings[changed].name} the device or its marker is not where it is in the"
        f" others{where}; frames of its own were estimated for it"
    )


def _same_device(one: PoseRecording, other: PoseRecording) -> bool:
    return (one.kind, one.base_frame, one.tool_frame, one.unknown) == (
        other.kind,
        other.base_frame,
        other.tool_frame,
        other.unknown,
    )


def _apart(one: Array, other: Array) -> str:
    """Distance of two points, or of two poses in the frame of the first."""
    if np.shape(one) != (4, 4):
        return f"{1e3 * np.linalg.norm(np.asarray(other) - one):.2g} mm"
    moved = np.linalg.solve(one, other)
    turn = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return f"{1e3 * np.linalg.norm(moved[:3, 3]):.2g} mm and {1e3 * turn:.2g} mrad"
