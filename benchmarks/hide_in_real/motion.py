"""The motion of a recording as effects see it, and the rigid body on it: Pinocchio and numpy alone.

Positions are low-passed at twice the task's cutoff before velocities and accelerations are taken. The load is that of
links fitted to the recording itself (`baseline.fit`), so that effects of the load have the size the real robot gives.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from .recordings import RealSet, Recording, links_of

Array = np.ndarray
WIDTH = 0.005  # of a joint's top speed: half width of the reversal of dry friction
ROWS = 16  # times the cutoff: rate at which the regressor is evaluated, cubic between


@dataclass(frozen=True)
class Scene:
    """One recording: motion (samples, joints) at its own stamps, measured torque, torque of the fitted links."""

    joints: tuple[str, ...]
    links: tuple[tuple[str, ...], ...]  # by joint
    model: pin.Model
    time: Array
    q: Array
    v: Array
    a: Array
    torque: Array
    width: Array  # rad/s, of the reversal, by joint
    kept: Array  # rows that the task keeps and that no edge touches
    cutoff: float
    fitted: bool
    baseline_pair: tuple[int, int] | None
    began: float = 0.0  # stamp at which the robot began to move: of the recording that this one continues, or its own
    coarse: Array = field(default_factory=lambda: np.empty(0, int))  # rows at which the regressor is evaluated
    inertial: Array = field(default_factory=lambda: np.empty(0))  # fitted ten parameters of each link, in a row
    load: Array = field(default_factory=lambda: np.empty(0))

    @property
    def gravity(self) -> Array:
        return self.model.gravity.linear

    @property
    def sign(self) -> Array:
        """Direction of each velocity, straight through its reversal."""
        return self.sign_of(self.v, self.width)

    def sign_of(self, speed: Array, width: Array | float) -> Array:
        return np.tanh(speed / width)

    def low(self, x: Array) -> Array:
        """What the task's own low pass leaves of columns."""
        return low_pass(self.time, x, self.cutoff)

    def regressor(self, gravity: Array | None = None) -> Array:
        """(coarse rows, joints, 10 joints) of Pinocchio."""
        model = self.model.copy()
        if gravity is not None:
            model.gravity.linear = gravity
        data = model.createData()
        rows = zip(self.q[self.coarse], self.v[self.coarse], self.a[self.coarse], strict=True)
        found = np.array([pin.computeJointTorqueRegressor(model, data, *row).copy() for row in rows])
        return found.reshape(len(found), len(self.joints), -1)  # Pinocchio flattens that of one joint

    def between(self, coarse: Array) -> Array:
        """Columns given at the coarse rows, at all rows."""
        return CubicSpline(self.time[self.coarse], coarse)(self.time)

    def with_gravity(self, gravity: Array) -> Array:
        """Torque of the fitted links under another gravity."""
        return self.between(self.regressor(gravity) @ self.inertial)

    def of_body(self, joint: int, ten: Array) -> Array:
        """Torque of a body with ten parameters `ten` fixed to the link of a joint."""
        return self.between(self.regressor()[:, :, 10 * joint : 10 * joint + 10] @ ten)

    def thin(self) -> Scene:
        """The scene at its coarse rows alone."""
        rows = self.coarse
        parts = {key: getattr(self, key)[rows] for key in ("time", "q", "v", "a", "torque", "kept")}
        return replace(self, **parts, coarse=np.arange(len(rows)))

    def loaded(self, inertial: Array) -> Scene:
        """The scene with links of fitted parameters."""
        known = replace(self, inertial=inertial)
        return replace(known, load=known.between(known.regressor() @ inertial))


def low_pass(time: Array, x: Array, cutoff: float) -> Array:
    """Zero-phase Butterworth of order 4 (forward and backward) of columns with stamps that jitter."""
    step = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1] + step / 2, step)
    sos = butter(4, min(2 * cutoff * step, 0.95), output="sos")
    smooth = sosfiltfilt(sos, _at(even, time, x), axis=0, padlen=min(len(even) - 1, int(2 / cutoff / step)))
    return _at(time, even, smooth)


def _at(new: Array, time: Array, x: Array) -> Array:
    return np.stack([np.interp(new, time, column) for column in x.T], 1)


def scene_of(real: RealSet, recording: Recording) -> Scene:
    """The scene of a recording, its links not fitted yet."""
    time = recording.time
    step = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1] + step / 2, step)
    smooth = low_pass(even, _at(even, time, recording.position), 2 * real.cutoff)
    v = np.gradient(smooth, step, axis=0)
    a = np.gradient(v, step, axis=0)
    q, v, a = (CubicSpline(even, x)(np.clip(time, even[0], even[-1])) for x in (smooth, v, a))
    edge = 0.5 if time[-1] - time[0] > 10 else 0.1
    low, high = max(real.window[0], time[0]) + edge, min(real.window[1], time[-1]) - edge
    kept = (time > low) & (time < high)
    top = np.quantile(np.abs(v[kept]), 0.98, axis=0)
    stride = max(1, int(1 / (ROWS * real.cutoff) / step))
    coarse = np.unique(np.append(np.arange(0, len(time), stride), len(time) - 1))
    links = tuple(links_of(real.model, j) for j in range(real.model.nv))
    width = np.maximum(WIDTH * top, 1e-4)
    return Scene(
        real.joints,
        links,
        real.model,
        time,
        q,
        v,
        a,
        recording.torque,
        width,
        kept,
        real.cutoff,
        recording.fitted,
        real.baseline_pair,
        _began(real, recording),
        coarse,
    )


def _began(real: RealSet, recording: Recording) -> float:
    """First stamp of the recording, or of the one whose clock it takes up within a second."""
    start = float(recording.time[0])
    for other in real.recordings:
        if other is not recording and 0 <= start - other.time[-1] < 1:
            return _began(real, other)
    return start
