"""Rows that no loop explains: a joint that is held from outside, a clock that jumps under regular stamps.

Both are looked for with a model that fits roughly, before causes are: a fit would bend to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .alone import carried_by
from .data import Run, regular
from .loop import Loop

__all__ = ["Fault", "faults", "without"]

_SLOW, _LONG, _REACH = 0.02, 0.6, 2.0  # rad/s of a joint that stands, s, multiples of what friction holds
_BLOCK, _JUMP, _ALIKE = 4.0, 1.5, 0.5  # s of one lag, periods of a jump, share by which joints may differ
_MOVING = 0.1  # rad/s


class Fault(NamedTuple):
    """What is wrong with some rows of a recording."""

    kind: str  # contact: a joint is held by something that is not in the model; clock_error
    run: int
    first: float  # s
    last: float  # s
    joints: tuple[int, ...]
    size: float  # N m beyond what friction holds; s of a clock

    def text(self, loop: Loop, runs: Sequence[Run]) -> str:
        """One line for people."""
        names, where = loop.robot.dof_names, f"{runs[self.run].name}, {self.first:.1f} to {self.last:.1f} s"
        if self.kind == "clock_error":
            return f"clock_error: {where}: all joints follow {1e3 * self.size:.0f} ms later than before, stamps regular"
        at = ", ".join(names[j] for j in self.joints)
        return f"contact: {where}: {at} stands against {self.size:.2g} N m more than its friction holds"


def faults(loop: Loop, runs: Sequence[Run], simulated: Sequence[np.ndarray]) -> list[Fault]:
    """The faults of the recordings; `simulated` (rows, joints) is what a fitted loop does with their commands."""
    found = []
    for k, (run, read, held) in enumerate(zip(runs, simulated, _held(loop, runs), strict=True)):
        jump = _jump(run, read)
        if jump is not None:
            time, late = jump
            found.append(Fault("clock_error", k, time, float(run.time[-1]), tuple(range(read.shape[1])), late))
        for j in range(held.shape[1]):
            for first, last in _stretches(held[:, j] > 0):
                if run.time[last] - run.time[first] >= _LONG:
                    size = float(np.median(held[first : last + 1, j]))
                    found.append(Fault("contact", k, float(run.time[first]), float(run.time[last]), (j,), size))
    return found


def without(runs: Sequence[Run], found: Sequence[Fault], margin: float = 0.5) -> tuple[Run, ...]:
    """The recordings with faulty rows counting for nothing, at all joints."""
    kept = []
    for k, run in enumerate(runs):
        trusted = np.ones(len(run.time), bool) if run.trusted is None else run.trusted.copy()
        for one in found:
            if one.run == k:
                inside = (run.time >= one.first - margin) & (run.time <= one.last + margin)
                trusted[inside] = False
        kept.append(run._replace(trusted=trusted) if not trusted.all() else run)
    return tuple(kept)


def _held(loop: Loop, runs: Sequence[Run]) -> list[np.ndarray]:
    """Torque (rows, joints) by which standing joints exceed what friction holds, 0 elsewhere."""
    nets, rates = [], []
    drives, places = loop.drives, np.array(loop.measured)
    way = np.asarray(drives.transmission)
    low, high = np.asarray(drives.force_range).T
    for run, carried in zip(runs, carried_by(loop, runs), strict=True):
        period = regular(run.name, run.time)
        v, a = np.zeros((len(run.time), loop.robot.nv)), np.zeros((len(run.time), loop.robot.nv))
        q = np.zeros_like(v)
        q[:, places] = run.position
        v[:-1] = np.diff(q, axis=0) / period
        a[:-1] = np.diff(v, axis=0) / period
        gain, bias = np.asarray(drives.gain), np.asarray(drives.bias)
        scale = np.asarray(drives.scale)
        force = bias[:, 0] + scale * (gain[:, 0] * run.command + bias[:, 1] * (q @ way.T)) + bias[:, 2] * (v @ way.T)
        net = np.clip(force, low, high) @ way - carried[..., 1]
        nets.append(net)
        rows = max(1, round(_LONG / 2 / period))
        kernel = np.ones(rows) / rows
        rates.append(np.stack([np.convolve(np.abs(x), kernel, mode="same") for x in v.T], 1))
    moving = [np.where(r > _MOVING, np.abs(n), np.nan) for n, r in zip(nets, rates, strict=True)]
    usual = np.array([_level(np.concatenate([m[:, j] for m in moving])) for j in range(loop.robot.nv)])
    return [
        np.where((r < _SLOW) & (np.abs(n) > _REACH * usual), np.abs(n) - usual, 0.0)
        for n, r in zip(nets, rates, strict=True)
    ]


def _level(values: np.ndarray) -> float:
    """What moving joints resist at most, as a rule; infinite where too few rows tell."""
    told = values[np.isfinite(values)]
    return float(np.quantile(told, 0.9)) if len(told) > 50 else np.inf


def _stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last rows of what is true; gaps of less than ten rows are closed."""
    rows = np.flatnonzero(mask)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows) > 10)
    return list(zip(rows[np.append(0, cuts + 1)], rows[np.append(cuts, len(rows) - 1)], strict=True))


def _jump(run: Run, read: np.ndarray) -> tuple[float, float] | None:
    """When all joints begin to follow later than before, and by how much (s)."""
    period = regular(run.name, run.time)
    rate = np.gradient(read, period, axis=0)
    rows = max(8, round(_BLOCK / period))
    blocks = len(read) // rows
    if blocks < 6:
        return None
    shape = (blocks, rows, read.shape[1])
    error = (run.position - read)[: blocks * rows].reshape(shape)
    speed = rate[: blocks * rows].reshape(shape)
    speed = speed - speed.mean(1, keepdims=True)
    power = (speed**2).sum(1)
    lag = -((error - error.mean(1, keepdims=True)) * speed).sum(1) / np.maximum(power, 1e-12)
    told = power / rows > _MOVING**2 / 4
    best: tuple[float, float, float] | None = None
    for cut in range(3, blocks - 1):
        steps = []
        for j in range(read.shape[1]):
            before, after = lag[:cut, j][told[:cut, j]][-4:], lag[cut:, j][told[cut:, j]][:4]
            if len(before) >= 2 and len(after) >= 1:
                steps.append(np.median(after) - np.median(before))
        if len(steps) >= 2:
            middle = float(np.median(steps))
            spread = float(np.max(np.abs(np.array(steps) - middle)))
            if abs(middle) > _JUMP * period and spread < _ALIKE * abs(middle):
                if best is None or abs(middle) - spread > best[2]:
                    best = float(run.time[cut * rows]), middle, abs(middle) - spread
    return None if best is None else best[:2]
