r"""Distances of sockets: what the postures in them say, against what is stated.

A socket stands where its postures put the tool point on average, $c_s = \frac1n \sum_i (R_i m + p_i)$; of a recording
that is held out nothing but its own postures shows it, so the distance tests the robot.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ..estimation.marginal import Linear
from ..estimation.posegroups import Measured
from ..recordings.devices import Sockets
from ..recordings.poses import PoseRecording
from .calibrated import SocketDistance

__all__ = ["socket_distances"]


def socket_distances(
    recordings: Sequence[PoseRecording], before: tuple[Measured, Linear], after: tuple[Measured, Linear]
) -> tuple[SocketDistance, ...]:
    """Distances (m) in each recording that states one: with the fit `before` (frames alone) and the one `after`."""
    found = []
    for k, recording in enumerate(recordings):
        if recording.kind == "socket" and recording.distance is not None:
            both = (_distance(measured, linear, k) for measured, linear in (before, after))
            found.append(SocketDistance(recording.name, recording.role, recording.distance, *both))
    return tuple(found)


def _distance(measured: Measured, linear: Linear, recording: int) -> float:
    rows = measured.measured & (measured.socket >= 0) & (measured.posture >= 0)
    rows[rows] = measured.recording[measured.posture[rows]] == recording
    place = _places(measured, linear.at)
    first, second = (
        place[number] + linear.residual[rows & (measured.socket == number)].reshape(3, -1).mean(axis=1)
        for number in np.unique(measured.socket[rows])
    )
    return float(np.linalg.norm(first - second))


def _places(measured: Measured, at: np.ndarray) -> dict[int, np.ndarray]:
    """Where the fit has each socket, m, by its number over all groups."""
    values, start = at * np.asarray(measured.problem.scale), len(measured.columns)
    found = {}
    for g, group in enumerate(measured.problem.groups):
        count = len(group.device.unknowns())
        if isinstance(group.device, Sockets):
            centres = np.asarray(group.device.centres(jnp.asarray(values[start : start + count])))
            found |= {1000 * g + s: centre for s, centre in enumerate(centres)}
        start += count
    return found
