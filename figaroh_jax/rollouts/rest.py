"""What the error that no cause explains goes with: rows at rest, the motion, the time, a recording, a frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float

from ..results import Dependence, Nearest, Part, Trace
from .found import Search

__all__ = ["nearest_of", "parts_of", "relative_rest"]

_STILL = 0.08  # of a joint's top speed: rows at and around rest
_LEAST = 0.05  # share from which a part is told
_BLOCKS, _FOLDS = 40, 4  # blocks of time of all recordings, parts that are left out in turn
_LINE = 12.0  # power of a line over the median around it
_WIDE = 50  # frequencies around a line that tell what is usual there
_CLOSE = 2  # bins that belong to a line
_MOVED = 0.01  # share of the motion's power from which a line is the motion's own

_Share = tuple[float, str, tuple[float, float] | None, str | None]


def relative_rest(
    left: Float[np.ndarray, " nv"], noise: Float[np.ndarray, " nv"], traces: Sequence[Trace]
) -> Float[np.ndarray, " nv"]:
    """RMS of the position's error beyond the noise over the RMS of each joint's motion about its mean."""
    own = [one.position for one in traces if one.role == "fit"]
    spread = np.concatenate([x - x.mean(0) for x in own]).std(0)
    return np.sqrt(np.maximum(left**2 - noise**2, 0.0)) / np.maximum(spread, 1e-12)


def parts_of(
    traces: Sequence[Trace], joints: Sequence[str], noise: Float[np.ndarray, " nv"], rest: Float[np.ndarray, " nv"]
) -> tuple[Part, ...]:
    """What the power beyond the noise goes with at each joint, on blocks of time that it was not fitted to."""
    own, out = [one for one in traces if one.role == "fit"], []
    for j, name in enumerate(joints):
        if rest[j] <= 0:
            continue
        error = np.concatenate([one.position[:, j] - one.after[:, j] for one in own])
        beyond = float((error**2).sum() - len(error) * noise[j] ** 2)
        if beyond <= 0.2 * len(error) * noise[j] ** 2:
            continue
        shares: list[_Share] = [(_still(own, j, error, noise[j], beyond), "standstill", None, None)]
        for kind, columns in _columns(own, j).items():
            gain, worst = _gain(columns, error, own)
            shares.append((gain / beyond, kind, None, own[worst].name if kind == "recording" else None))
        shares.append(_line(own, j, beyond))
        kept = sorted((s for s in shares if s[0] > _LEAST), reverse=True, key=lambda s: s[0])
        out += [Part(cast(Dependence, kind), (name,), min(share, 1.0), band, file) for share, kind, band, file in kept]
    return tuple(out)


def nearest_of(found: Search) -> tuple[Nearest, ...]:
    """Causes that are not named: those whose size may be none, then those that were looked at last."""
    named = {n.candidate.effect + str(n.candidate.at) for n in found.named}
    named |= {name.effect + str(name.at) for name, _, _ in found.doubtful}
    sought = [(name, gain, why) for name, gain, why in found.nearest if name.effect + str(name.at) not in named]
    best = [*found.doubtful, *sorted(sought, key=lambda one: -one[1])][:3]
    return tuple(Nearest(name, gain, why) for name, gain, why in best if gain > 0)


def _still(own: Sequence[Trace], j: int, error: np.ndarray, noise: float, beyond: float) -> float:
    speed = np.concatenate([np.abs(one.velocity[:, j]) for one in own])
    rest = speed < _STILL * np.quantile(speed, 0.99)
    return float((error[rest] ** 2 - noise**2).sum() / beyond)


def _columns(own: Sequence[Trace], j: int) -> dict[str, np.ndarray]:
    """Smooth functions of position, velocity and time, and a constant for each recording, (rows, columns) each."""
    q = _unit(np.concatenate([one.position[:, j] for one in own]))
    v = np.concatenate([one.velocity[:, j] for one in own])
    scale = max(float(np.quantile(np.abs(v), 0.99)), 1e-12)
    t = _unit(np.concatenate([one.time for one in own]))
    one = np.ones_like(q)
    found = {
        "position": [one, q, q**2, q**3, np.sin(3 * q), np.cos(3 * q)],
        "velocity": [one, v / scale, np.tanh(8 * v / scale), np.abs(v) / scale, (v / scale) ** 2],
        "time": [one, t, t**2, t**3],
    }
    if len(own) > 1:
        which = np.repeat(np.arange(len(own)), [len(one.time) for one in own])
        found["recording"] = [(which == k).astype(float) for k in range(len(own))]
    return {kind: np.stack(columns, 1) for kind, columns in found.items()}


def _unit(x: np.ndarray) -> np.ndarray:
    low, high = x.min(), x.max()
    return (2 * x - low - high) / max(high - low, 1e-12)


def _gain(columns: np.ndarray, error: np.ndarray, own: Sequence[Trace]) -> tuple[float, int]:
    """Squares that the columns predict of blocks that they were not fitted to, and the recording that gains most."""
    rows = len(error)
    block = np.arange(rows) * _BLOCKS // rows
    which = np.repeat(np.arange(len(own)), [len(one.time) for one in own])
    left = np.zeros(rows)
    for fold in range(_FOLDS):
        out = block % _FOLDS == fold
        scale = np.sqrt((columns[~out] ** 2).mean(0)) + 1e-12
        a = columns / scale
        matrix = a[~out].T @ a[~out] + 1e-6 * rows * np.eye(a.shape[1])
        left[out] = error[out] - a[out] @ np.linalg.solve(matrix, a[~out].T @ error[~out])
    gain = error**2 - left**2
    each = np.bincount(which, gain, minlength=len(own))
    return float(gain.sum()), int(each.argmax())


def _line(own: Sequence[Trace], j: int, beyond: float) -> _Share:
    """Share of the longest recording's strongest line, where it stands out and the motion itself has none there."""
    longest = max(own, key=lambda one: len(one.time))
    frequency, power = _spectrum(longest, longest.position[:, j] - longest.after[:, j])
    if len(power) < 2 * _WIDE:
        return 0.0, "frequency", None, None
    _, motion = _spectrum(longest, longest.position[:, j])
    k = int(power[_CLOSE:].argmax()) + _CLOSE
    near = slice(k - _CLOSE, k + _CLOSE + 1)
    around = np.median(power[max(k - _WIDE, 1) : k + _WIDE])
    if power[k] < _LINE * around or motion[near].sum() > _MOVED * motion.sum():
        return 0.0, "frequency", None, None
    band, squares = (float(0.9 * frequency[k]), float(1.1 * frequency[k])), 0.0
    for one in own:
        error = one.position[:, j] - one.after[:, j]
        found, power = _spectrum(one, error)
        inside = (found > band[0]) & (found < band[1])
        squares += power[inside].sum() / max(power.sum(), 1e-300) * (error**2).sum()
    return float(squares / beyond), "frequency", band, None


def _spectrum(one: Trace, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.signal import periodogram  # its distributions are slow to import

    rate = (len(one.time) - 1) / (one.time[-1] - one.time[0])
    return periodogram(values - values.mean(), rate)
