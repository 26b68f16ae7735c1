"""The rows of `posefit` without a program of JAX's: in C (`pose_rows.c`), or for few postures in NumPy.

For devices that measure points or poses (`recordings.devices.Points`, `Poses`), whose derivatives are written out here;
others, and many postures where there is no C compiler, take the compiled rows. Samples stand first inside. Formulas:
`rigid.chain`, and for the derivative of exponentials the left Jacobians of SO(3) and SE(3) (Barfoot, State Estimation
for Robotics, 2017, 7.1).
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..compiled.machine_code import library
from ..recordings.devices import Points, Poses
from ..rigid.chain import Chain

__all__ = ["HostRows", "in_machine_code", "written_out"]

_SMALL = 1e-4  # rad^2; below it the series is exact to rounding, and the quotients lose digits
_EYE = np.eye(3)


def written_out(device: Any) -> bool:
    """Whether rows of the device have a form in NumPy."""
    return type(device) is Points or (type(device) is Poses and device.axes != "twist")


_MOST_JOINTS = 64  # of the code in C
_LONGS = ("samples", "joints", "moving", "poses", "body", "sight", "free_base", "free_tool", "markers")
_FIXED = ("start", "base", "origin", "centre", "tool", "arm", "first", "ahead", "beyond", "onward", "slide", "back",
          "seen", "marker")  # fmt: skip
_GIVEN = ("twists", "own", "residual", "response", "by_own")


class _Given(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in _LONGS]
    _fields_ += [(name, ctypes.c_void_p) for name in (*_FIXED, *_GIVEN)]


@lru_cache(maxsize=1)
def _code() -> Any:
    """The compiled rows, or None."""
    found = library((Path(__file__).parent / "pose_rows.c").read_text())
    if found is None:
        return None
    function = found["pose_rows"]
    function.restype, function.argtypes = None, [ctypes.c_void_p]
    return function


def in_machine_code(chain: Chain) -> bool:
    """Whether there is code in C for the chain: then more postures than a few are taken on the host too."""
    return len(chain.axis) <= _MOST_JOINTS and _code() is not None


class HostRows:
    """Rows of one group; what depends on the joint positions and on the measurement alone is computed once.

    `steady` and `pieces` are the group's columns as `posefit` takes them: for its use, at hand without a module.
    """

    def __init__(
        self,
        chain: Chain,
        device: Any,
        position: Float[np.ndarray, "nv samples"],
        datum: Any,
        steady: Float[np.ndarray, "n 6 columns"],
        pieces: list[tuple[int, int, Float[np.ndarray, "6 samples"]]],
    ) -> None:
        self.steady, self.pieces = np.reshape(steady, (-1, steady.shape[2])), pieces
        self.samples, self.unknowns = position.shape[1], len(device.unknowns())
        self.placement = np.asarray(chain.placement, float)
        self.first, self.last = np.asarray(chain.first, float), np.asarray(chain.last, float)
        axis, turns = np.asarray(chain.axis, float), np.asarray(chain.turns, float)[:, None] > 0.0
        q = np.asarray(chain.ratio)[:, None] * position[np.asarray(chain.column)] + np.asarray(chain.offset)[:, None]
        angle, across = np.where(turns, q, 0.0)[..., None, None], _skew(axis)[:, None]
        self.turn = _EYE + np.sin(angle) * across + (2.0 * np.sin(angle / 2.0) ** 2) * (across @ across)
        self.slide = None if turns.all() else np.where(turns, 0.0, q)[..., None] * axis[:, None]
        last = np.concatenate([self.placement[1:, :3, :3], self.last[None, :3, :3]])
        self.onward = self.turn @ last[:, None]  # from behind a joint's twist to before that of the next
        self.ahead = (np.swapaxes(self.placement[:, :3, :3], 1, 2) @ self.placement[:, :3, 3:])[:, None, :, 0]
        self.beyond = self.last[:3, :3].T @ self.last[:3, 3]
        self.base, self.centre = np.asarray(device.base, float), np.asarray(device.centre, float)
        self.poses = type(device) is Poses
        self.free_base, self.free_tool = (name in device.estimated for name in ("base_frame", "tool_frame"))
        datum = np.asarray(datum, float)
        if self.poses:
            self.tool = np.asarray(device.tool, float)
            self.body, self.sight = device.axes != "device", device.axes == "sight"
            self.back, self.seen = np.swapaxes(datum[:, :3, :3], 1, 2), datum[:, :3, 3]
        else:
            self.markers = np.asarray(device.markers, float)
            self.seen = datum.reshape(self.samples, len(self.markers), 3)
        self.code = _code() if in_machine_code(chain) else None
        if self.code is not None:
            self._hand_over()

    def rows(
        self, twists: Float[np.ndarray, "n 6 #samples"], own: Float[np.ndarray, " k"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (rows, samples), their derivatives by twists of joints (6n, rows, samples) and by `own` (k, ...)."""
        return self._plain(twists, own) if self.code is None else self._coded(twists, own)

    def _hand_over(self) -> None:
        """What stays from call to call, as the code in C takes it."""
        ahead = self.placement[0] if len(self.placement) else self.last
        none, poses = np.zeros(0), self.poses
        fixed = {
            "start": self.first[:3, :3] @ ahead[:3, :3], "base": self.base[:3, :3], "origin": self.base[:3, 3],
            "tool": self.tool[:3, :3] if poses else none, "arm": self.tool[:3, 3] if poses else none,
            "centre": self.centre, "first": self.first[:3, 3], "ahead": self.ahead, "beyond": self.beyond,
            "onward": self.onward, "back": self.back if poses else none, "seen": self.seen,
            "marker": none if poses else self.markers,
        }  # fmt: skip
        fixed |= {} if self.slide is None else {"slide": self.slide}
        self.fixed = {name: np.ascontiguousarray(x, float) for name, x in fixed.items()}
        markers, body, sight = (0, self.body, self.sight) if poses else (len(self.markers), False, False)
        longs = self.samples, len(self.turn), False, poses, body, sight, self.free_base, self.free_tool, markers
        self.given = _Given(*(int(x) for x in longs))
        for name, x in self.fixed.items():
            setattr(self.given, name, x.ctypes.data)

    def _coded(self, twists: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert self.code is not None
        count = 6 if self.poses else 3 * len(self.markers)
        rows = np.empty((1 + 6 * len(self.turn) + self.unknowns, count, self.samples))
        twists, own = np.ascontiguousarray(twists, float), np.ascontiguousarray(own, float)
        given, first, one = self.given, rows.ctypes.data, 8 * count * self.samples
        given.moving, given.twists, given.own = int(twists.shape[2] > 1), twists.ctypes.data, own.ctypes.data
        given.residual, given.response, given.by_own = first, first + one, first + (1 + 6 * len(self.turn)) * one
        self.code(ctypes.byref(given))
        return rows[0], rows[1 : 1 + 6 * len(self.turn)], rows[1 + 6 * len(self.turn) :]

    def _plain(self, twists: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        twists = np.moveaxis(twists, -1, 1)
        placed = own[: 6 * (self.free_base + (self.free_tool and self.poses))].reshape(-1, 6)
        turns = np.concatenate([twists[..., 3:].reshape(-1, 3), placed[:, 3:]])
        exponent, bend, more = _exponentials(turns)
        split, shape = len(turns) - len(placed), (*twists.shape[:2], 3, 3)
        R, p, before, turned, origin = self._poses(
            twists[..., :3], exponent[:split].reshape(shape), bend[:split].reshape(shape)
        )
        moved = _moved(placed, exponent[split:], bend[split:], [x[split:] for x in more])
        residual, by_motion, by_own = self._pose_rows(R, p, moved) if self.poses else self._points(R, p, own, moved)
        linear, angular = by_motion[..., :3], by_motion[..., 3:]
        of_turn = (angular - linear @ _skew(p - origin)) @ turned
        response = np.concatenate([linear @ before, of_turn], axis=-1)  # joint sample row twist
        response = response.transpose(0, 3, 2, 1).reshape(-1, residual.shape[1], self.samples)
        return residual.T, response, by_own.transpose(2, 1, 0)

    def _poses(self, shift: np.ndarray, exponent: np.ndarray, bend: np.ndarray) -> tuple[np.ndarray, ...]:
        """Tool's pose in the base, and of each joint the axes before its twist, turned by it, and its origin."""
        n = len(self.turn)
        axes, onward = np.empty((n + 1, self.samples, 3, 3)), exponent @ self.onward
        axes[0] = self.first[:3, :3] @ self.placement[0, :3, :3] if n else self.first[:3, :3] @ self.last[:3, :3]
        for j in range(n):
            np.matmul(axes[j], onward[j], out=axes[j + 1])
        before = axes[:-1]
        step = _times(before, self.ahead + shift)
        slid = None if self.slide is None else _times(before @ exponent, self.slide)
        if slid is not None:
            step[1:] += slid[:-1]
        origin = self.first[:3, 3] + np.cumsum(step, axis=0)
        p = (origin[-1] if n else self.first[:3, 3]) + _times(axes[-1], self.beyond)
        return axes[-1], p if slid is None else p + slid[-1], before, before @ bend, origin

    def _placed(self, moved: _Moved) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation and origin of the base in the device, and the left Jacobian of its unknowns, if it has any."""
        if not self.free_base:
            return self.base[:3, :3], self.base[:3, 3], np.zeros((6, 0))
        turn, shift, jacobian = (x[0] for x in moved)
        return turn @ self.base[:3, :3], self.centre + shift + turn @ (self.base[:3, 3] - self.centre), jacobian

    def _points(
        self, R: np.ndarray, p: np.ndarray, own: np.ndarray, moved: _Moved
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn, place, jacobian = self._placed(moved)
        base, markers = jacobian.shape[1], self.markers
        if self.free_tool:
            markers = markers + own[base:].reshape(-1, 3)
        arms = markers @ np.swapaxes(R, 1, 2)  # of the markers from the tool's origin, in base axes
        points = (arms + p[:, None]) @ turn.T + place
        by_turn = -turn @ _skew(arms)
        by_motion = np.concatenate([np.broadcast_to(turn, by_turn.shape), by_turn], axis=-1)
        by_own = np.zeros((*by_turn.shape[:3], self.unknowns))
        by_own[..., :base] = jacobian[:3] - _skew(points - self.centre) @ jacobian[3:]
        for k in range(len(markers) if self.free_tool else 0):
            by_own[:, k, :, base + 3 * k : base + 3 * k + 3] = turn @ R
        flat = self.samples, 3 * len(markers)
        return (points - self.seen).reshape(flat), by_motion.reshape(*flat, 6), by_own.reshape(*flat, -1)

    def _pose_rows(self, R: np.ndarray, p: np.ndarray, moved: _Moved) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turn, place, jacobian = self._placed(moved)
        tool_turn, arm = self.tool[:3, :3], self.tool[:3, 3]
        whole, base = turn @ R, jacobian.shape[1]  # of the tool in the device
        axes, by_tool = whole @ tool_turn, np.zeros((6, 0))
        if self.free_tool:
            motion, shift, by_tool = (x[-1] for x in moved)
            tool_turn, arm = tool_turn @ motion, arm + tool_turn @ shift
            by_tool = np.concatenate([by_tool[:3] - _skew(shift) @ by_tool[3:], by_tool[3:]])
        lever = R @ arm
        at = (p + lever) @ turn.T + place
        angle = _logarithm(self.back @ whole @ tool_turn)
        twist = _inverse_left_jacobian(angle) @ self.back  # a turning in the device's axes as a rate of the angle
        away, samples = at - self.seen, self.samples
        by_motion, by_own = np.zeros((samples, 6, 6)), np.empty((samples, 6, self.unknowns))
        by_motion[:, :3, :3], by_motion[:, :3, 3:], by_motion[:, 3:, 3:] = turn, -turn @ _skew(lever), twist @ turn
        by_own[:, :3, :base] = jacobian[:3] - _skew(at - self.centre) @ jacobian[3:]
        by_own[:, 3:, :base] = twist @ jacobian[3:]
        by_own[:, :3, base:] = axes @ by_tool[:3]
        by_own[:, 3:, base:] = twist @ axes @ by_tool[3:]
        if self.body:
            away = _times(self.back, away)
            by_motion[:, :3], by_own[:, :3] = self.back @ by_motion[:, :3], self.back @ by_own[:, :3]
        if self.sight:
            cross = _skew(_times(self.back, self.seen))  # the angle x where the device's origin is seen
            away = away + _times(cross, angle)
            by_motion[:, :3] += cross @ by_motion[:, 3:]
            by_own[:, :3] += cross @ by_own[:, 3:]
        return np.concatenate([away, angle], axis=1), by_motion, by_own


class _Moved(NamedTuple):
    """Exponentials of twists: rotations, translations and left Jacobians."""

    turn: Float[np.ndarray, "m 3 3"]
    shift: Float[np.ndarray, "m 3"]
    jacobian: Float[np.ndarray, "m 6 6"]


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]


def _skew(w: np.ndarray) -> np.ndarray:
    out = np.zeros((*w.shape, 3))
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _series(square: np.ndarray) -> tuple[np.ndarray, ...]:
    """sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3 and the two further ones of SE(3), of the squared angle."""
    small = square < _SMALL
    safe = np.where(small, 1.0, square)
    t = np.sqrt(safe)
    sine, cosine, versine = np.sin(t), np.cos(t), 2.0 * np.sin(t / 2.0) ** 2
    exact = (sine / t, versine / safe, (t - sine) / (safe * t))
    exact += ((0.5 * safe - versine) / safe**2, (2.0 * t - 3.0 * sine + t * cosine) / (2.0 * safe**2 * t))
    near = ((1.0, 6.0, 120.0), (0.5, 24.0, 720.0), (1 / 6.0, 120.0, 5040.0), (1 / 24.0, 720.0, 40320.0))
    terms = [a - square / b + square**2 / c for a, b, c in near] + [1 / 120.0 - square / 2520.0 + square**2 / 120960.0]
    return tuple(np.where(small, x, y) for x, y in zip(terms, exact, strict=True))


def _exponentials(w: Float[np.ndarray, "m 3"]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Rotations and left Jacobians of rotation vectors (rad), and what `_moved` takes beside them."""
    a, b, *more = (x[:, None, None] for x in _series(np.sum(w * w, axis=-1)))
    K = _skew(w)
    square = K @ K
    return _EYE + a * K + b * square, _EYE + b * K + more[0] * square, more


def _moved(twist: Float[np.ndarray, "m 6"], turn: np.ndarray, bend: np.ndarray, more: list[np.ndarray]) -> _Moved:
    c, d, e = more
    r, w = _skew(twist[:, :3]), _skew(twist[:, 3:])
    wr, rw = w @ r, r @ w
    wrw = wr @ w
    jacobian = np.zeros((len(twist), 6, 6))
    jacobian[:, :3, :3] = jacobian[:, 3:, 3:] = bend
    mixed = 0.5 * r + c * (wr + rw + wrw) + d * (w @ wr + rw @ w - 3.0 * wrw) + e * (wrw @ w + w @ wrw)
    jacobian[:, :3, 3:] = mixed
    return _Moved(turn, _times(bend, twist[:, :3]), jacobian)


def _logarithm(R: Float[np.ndarray, "samples 3 3"]) -> Float[np.ndarray, "samples 3"]:
    """Rotation vectors (rad) of the shorter way round, from the largest entry of the unit quaternion."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    a, b, c = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    d, e, f = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    if np.all(x + y + z > 0.0):  # less than a third of a turn: the scalar part is the largest
        row = np.stack([a, b, c, 1.0 + x + y + z], axis=1)
        return _angles(row / np.linalg.norm(row, axis=1, keepdims=True))
    each = [1 + x - y - z, d, e, a, d, 1 - x + y - z, f, b, e, f, 1 - x - y + z, c, a, b, c, 1 + x + y + z]
    rows = np.stack(each, axis=1).reshape(-1, 4, 4)
    row = rows[np.arange(len(R)), np.argmax(np.einsum("kii->ki", rows), axis=1)]
    return _angles(row / np.linalg.norm(row, axis=1, keepdims=True) * np.where(row[:, 3:] < 0.0, -1.0, 1.0))


def _angles(row: Float[np.ndarray, "samples 4"]) -> Float[np.ndarray, "samples 3"]:
    v, w = row[:, :3], row[:, 3]
    square = np.sum(v * v, axis=1)
    small = square < _SMALL
    norm, safe = np.sqrt(np.where(small, 1.0, square)), np.where(small, w, 1.0)
    series = 2.0 / safe * (1.0 - square / (3.0 * safe**2) + square**2 / (5.0 * safe**4))
    return v * np.where(small, series, 2.0 * np.arctan2(norm, np.where(small, 1.0, w)) / norm)[:, None]


def _inverse_left_jacobian(w: Float[np.ndarray, "samples 3"]) -> Float[np.ndarray, "samples 3 3"]:
    square = np.sum(w * w, axis=1)
    small = square < _SMALL
    half = 0.5 * np.sqrt(np.where(small, 1.0, square))
    exact = (1.0 - half * np.cos(half) / np.sin(half)) / (4.0 * half**2)
    d = np.where(small, 1.0 / 12.0 + square / 720.0 + square**2 / 30240.0, exact)[:, None, None]
    K = _skew(w)
    return _EYE - 0.5 * K + d * (K @ K)
