"""What is wrong with recordings: other units or another order of commands, and rows that no loop explains.

These are of a joint that is held from outside, or of a clock that jumps under regular stamps. Both are looked for with
a model that fits roughly, before causes are: a fit would bend to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import nnls

from ..compiled.batching import program
from ..errors import InputError
from ..rigid.dynamics import joint_torques
from .alone import motion
from .data import Run, ahead_of_command, likeness, regular
from .loop import Loop

__all__ = ["Fault", "faults", "refuse_other_order", "refuse_other_units", "without"]

_SLOW, _LONG, _REACH = 0.02, 0.6, 2.0  # rad/s of a joint that stands, s, multiples of what friction holds
_BLOCK, _JUMP, _ALIKE = 2.0, 2.0, 0.5  # s of one lag, periods of a jump, share by which joints may differ
_MOST_LATE, _SHIFTED, _FEW = 0.3, 0.15, 3  # s, share of the power that a shift leaves, blocks on either side of a jump
_NEAR = 5  # blocks on either side that tell the size of a jump
_WRONG, _HOLDS = 6.0, 1.2  # multiples of the usual error and of the friction, of a joint that stands
_MOVING = 0.1  # rad/s
_OFF, _SEVERAL = 3.0, 3  # multiples of the usual error, joints that are off by so much at once
_FOLLOWS, _NEARER = 0.8, 0.25  # likeness of a joint to its command; how far it is from 1, of that of another's command
_TURN = 12.0  # a command that many times beyond what the joint did is in other units
_SAMPLES = 1024  # one program takes so many


class Fault(NamedTuple):
    """What is wrong with some rows of a recording."""

    kind: str  # contact: a joint is held by something that is not in the model; clock_error
    run: int
    first: float  # s
    last: float  # s
    joints: tuple[int, ...]
    size: float  # N m beyond what friction holds (of several joints: of the drive at most); s of a clock; N of a table
    table: float | None = None  # m, height over the base of the plane that the arm's end rests on

    def text(self, loop: Loop, runs: Sequence[Run]) -> str:
        """One line for people."""
        names, where = loop.robot.dof_names, f"{runs[self.run].name}, {self.first:.1f} to {self.last:.1f} s"
        if self.kind == "clock_error":
            return f"clock_error: {where}: all joints follow {1e3 * self.size:.0f} ms later than before, stamps regular"
        at = ", ".join(names[j] for j in self.joints)
        if self.table is not None:
            return (
                f"contact: {where}: the arm's end rests on a plane {1e3 * self.table:.0f} mm above the base's origin,"
                f" which pushes it up by {self.size:.2g} N (seen at {at})"
            )
        if len(self.joints) > 1:
            return (
                f"contact: {where}: {at} stand off the model's motion at once, the drives push by {self.size:.2g} N m"
            )
        return f"contact: {where}: {at} is held against {self.size:.2g} N m more than its friction can hold"


def refuse_other_units(loop: Loop, file: str, command: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Which drives (nu,) follow their command; `InputError` where one goes far beyond what its joint (rows, nv) did."""
    columns = np.abs(np.asarray(loop.drives.transmission)).argmax(1)
    gain, bias = np.asarray(loop.drives.gain), np.asarray(loop.drives.bias)
    follows = (gain[:, 0] != 0) & (bias[:, 1] != 0)
    for k, column in enumerate(columns):
        reach = max(np.abs(position[:, column]).max(), 0.3)
        if follows[k] and np.abs(command[:, k]).max() > _TURN * reach:
            row = int(np.abs(command[:, k]).argmax())
            raise InputError(
                f"{file}: the command of joint {loop.robot.dof_names[column]} reaches {command[row, k]:.4g}"
                f" rad in row {row} (from 0), but the joint never leaves +-{reach:.3g} rad: is it in degrees or counts?"
                " Say `units: {position: deg}`, or convert it to the unit of the position"
            )
    return follows


def refuse_other_order(loop: Loop, file: str, run: Run, follows: np.ndarray) -> None:
    """Refuse commands that are not those of the joints in their order, or that come after the motion.

    MuJoCo's `ctrl` is in the order of the actuators. A position is like the command that it follows; the command of a
    drive without a position is like the torque that the motion takes, with friction and a rotor of any size.
    """
    columns, period = np.abs(np.asarray(loop.drives.transmission)).argmax(1), regular(file, run.time)
    _refuse_order_of_drives(loop, file, run, follows)
    pairs = zip(run.command[:, follows].T, columns[follows], strict=True)
    moved = [(u, j) for u, j in pairs if np.ptp(u) and np.ptp(run.position[:, j])]
    ahead = {loop.robot.dof_names[j]: ahead_of_command(u, run.position[:, j], period) for u, j in moved}
    early = [name for name, rows in ahead.items() if rows]
    if 2 * len(early) > len(moved):
        raise InputError(
            f"{file}: the position moves before its command at {', '.join(early)} (by {ahead[early[0]]} rows"
            f" at {early[0]}): are `command` and `position` swapped, or is the command stamped late?"
        )


def _refuse_order_of_drives(loop: Loop, file: str, run: Run, follows: np.ndarray) -> None:
    columns, period = np.abs(np.asarray(loop.drives.transmission)).argmax(1), regular(file, run.time)
    swapped = np.flatnonzero(columns != np.arange(len(columns)))
    if not len(swapped) or sorted(columns) != list(range(loop.robot.nq)):
        return
    given = run.command[:, np.argsort(columns)]  # as the file has them
    way, moved = np.sign(np.asarray(loop.drives.transmission).sum(0)), motion(loop, run)
    load = np.zeros_like(moved[0]) if follows.all() else _carried(loop, run)

    def like(u: np.ndarray, k: int) -> float:
        j = columns[k]
        if follows[k]:
            return likeness(u, run.position[:, j], 1.0, period)
        _, v, a = (x[:, j] for x in moved)
        taken = way[j] * np.stack([load[:, j], a, v, np.sign(v)], 1)
        centred = taken - taken.mean(0), u - u.mean()
        return float(np.sqrt(max(0.0, 1 - nnls(*centred)[1] ** 2 / max(centred[1] @ centred[1], 1e-300))))

    right, wrong = (np.array([like(some[:, k], int(k)) for k in swapped]) for some in (given, run.command))
    if right.min() > _FOLLOWS and (1 - right < _NEARER * (1 - wrong)).all():
        joints, at = (", ".join(loop.robot.dof_names[k] for k in some) for some in (range(len(columns)), columns))
        raise InputError(
            f"{file}: the columns of `command` are read in the order of the joints ({joints}), but these follow them in"
            f" the order of the model's actuators, which act at {at}: put them in the order of the joints"
        )


def faults(loop: Loop, runs: Sequence[Run], simulated: Sequence[np.ndarray]) -> list[Fault]:
    """The faults of the recordings; `simulated` (rows, joints) is what a fitted loop does with their commands."""
    found = []
    usual = np.median(
        np.abs(np.concatenate([run.position - x for run, x in zip(runs, simulated, strict=True)])), axis=0
    )
    for k, (run, read, held) in enumerate(zip(runs, simulated, _held(loop, runs, simulated), strict=True)):
        jump = _jump(run, read)
        if jump is not None:
            time, late = jump
            found.append(Fault("clock_error", k, time, float(run.time[-1]), tuple(range(read.shape[1])), late))
        together = _together(loop, run, read, usual)
        found += [fault._replace(run=k) for fault in together]
        for j in range(held.shape[1]):
            for first, last in _stretches(held[:, j] > 0):
                told = any(x.first <= run.time[last] and run.time[first] <= x.last and j in x.joints for x in together)
                if run.time[last] - run.time[first] >= _LONG and not told:
                    size = float(np.median(held[first : last + 1, j]))
                    found.append(Fault("contact", k, float(run.time[first]), float(run.time[last]), (j,), size))
    return found


def _together(loop: Loop, run: Run, read: np.ndarray, usual: np.ndarray) -> list[Fault]:
    """Stretches in which three joints or more stand, or nearly so, far from where the model has them, all at once.

    Friction alone may hold each of them there, but not by chance all at the same time: something pushes the arm. A
    joint whose command has moved by less than it is off stands where it stood at first: that it is off says nothing.
    """
    period = regular(run.name, run.time)
    rows = max(1, round(_LONG / period))
    mean = lambda x: np.stack([np.convolve(c, np.ones(rows) / rows, mode="same") for c in x.T], 1)  # noqa: E731
    error = mean(run.position - read)
    slow = mean(np.abs(np.gradient(run.position, period, axis=0))) < _MOVING
    drives, places = loop.drives, list(loop.measured)
    asked = _asked(loop, run)[:, places]
    far = slow & (np.abs(error) > _OFF * np.maximum(usual, 1e-12)) & (asked > np.abs(error))
    stiff = np.abs((np.asarray(drives.scale) * np.asarray(drives.bias)[:, 1]) @ np.asarray(drives.transmission) ** 2)
    found = []
    for first, last in _stretches(far.sum(1) >= _SEVERAL):
        if run.time[last] - run.time[first] >= _LONG:
            part = slice(first, last + 1)
            joints = tuple(places[c] for c in np.flatnonzero(far[part].mean(0) > 0.5))
            size = float(np.median((np.abs(error[part]) * stiff[places]).max(1)))
            found.append(Fault("contact", 0, float(run.time[first]), float(run.time[last]), joints, size))
    return found


def _asked(loop: Loop, run: Run) -> np.ndarray:
    """By how much the commands of each joint's drives have moved so far, (rows, nv); not that of drives of a torque."""
    drives = loop.drives
    follows = np.asarray(drives.bias)[:, 1] != 0
    reach = np.maximum.accumulate(run.command) - np.minimum.accumulate(run.command)
    ratio = np.asarray(drives.gain)[:, 0] / np.where(follows, -np.asarray(drives.bias)[:, 1], 1.0)
    moved = np.where(follows, np.abs(ratio) * reach, np.inf)
    way = np.abs(np.asarray(drives.transmission))
    each = np.where(way > 0, moved[:, :, None] / np.where(way > 0, way, 1.0), 0.0)
    return np.where((way > 0).any(0), each.max(1), np.inf)


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


def _held(loop: Loop, runs: Sequence[Run], simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Torque (rows, joints) by which standing joints exceed what friction holds, 0 elsewhere."""
    nets, rates = [], []
    drives, places = loop.drives, np.array(loop.measured)
    way = np.asarray(drives.transmission)
    low, high = np.asarray(drives.force_range).T
    for run in runs:
        period = regular(run.name, run.time)
        v, a = np.zeros((len(run.time), loop.robot.nv)), np.zeros((len(run.time), loop.robot.nv))
        q = np.zeros_like(v)
        q[:, places] = run.position
        v[:-1] = np.diff(q, axis=0) / period
        a[:-1] = np.diff(v, axis=0) / period
        gain, bias = np.asarray(drives.gain), np.asarray(drives.bias)
        scale = np.asarray(drives.scale)
        force = bias[:, 0] + scale * (gain[:, 0] * run.command + bias[:, 1] * (q @ way.T)) + bias[:, 2] * (v @ way.T)
        net = np.clip(force, low, high) @ way - _carried(loop, run)
        nets.append(net)
        rows = max(1, round(_LONG / 2 / period))
        kernel = np.ones(rows) / rows
        rates.append(np.stack([np.convolve(np.abs(x), kernel, mode="same") for x in v.T], 1))
    moving = [np.where(r > _MOVING, np.abs(n), np.nan) for n, r in zip(nets, rates, strict=True)]
    usual = np.array([_level(np.concatenate([m[:, j] for m in moving])) for j in range(loop.robot.nv)])
    errors = [np.abs(run.position - read) for run, read in zip(runs, simulated, strict=True)]
    typical = np.median(np.concatenate(errors), axis=0)
    found = []
    for net, rate, error in zip(nets, rates, errors, strict=True):
        far = np.zeros_like(net)
        far[:, places] = error / np.maximum(typical, 1e-12)
        beyond = (np.abs(net) > _REACH * usual) | ((np.abs(net) > _HOLDS * usual) & (far > _WRONG))
        found.append(np.where((rate < _SLOW) & beyond, np.abs(net) - usual, 0.0))
    return found


def _carried(loop: Loop, run: Run) -> np.ndarray:
    """Torque that the measured motion takes without friction, (rows, nv)."""
    q, v, a = motion(loop, run)
    found = np.zeros_like(q)
    with jax.enable_x64(True):
        for first in range(0, len(q), _SAMPLES):
            part = np.clip(np.arange(first, first + _SAMPLES), 0, len(q) - 1)
            torque = np.asarray(_torques(loop.robot, q[part].T, v[part].T, a[part].T)).T
            found[first : first + _SAMPLES] = torque[: len(q) - first]
    return found


_torques = program(joint_torques)


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
    rows = max(8, round(_BLOCK / period))
    lag = _lags(run.position, read, rows, max(2, round(_MOST_LATE / period)), _MOVING * period)
    told = np.isfinite(lag).sum(1) >= 2
    place, middle = np.flatnonzero(told), np.nanmedian(np.where(told[:, None], lag, 0.0), axis=1)
    best: tuple[float, int, float] | None = None
    for k in range(_FEW, len(place) - _FEW + 1):
        before, after = np.median(middle[place[:k]]), np.median(middle[place[k:]])
        left = np.abs(middle[place[:k]] - before).sum() + np.abs(middle[place[k:]] - after).sum()
        if best is None or left < best[0]:
            best = float(left), k, float(after - before)
    if best is None or abs(best[2]) < _JUMP:
        return None
    k = best[1]
    last, first = place[max(k - _NEAR, 0) : k], place[k : k + _NEAR]  # a model's own lag drifts, a clock's jumps
    step = float(np.median(middle[first]) - np.median(middle[last]))
    if abs(step) < _JUMP:
        return None
    each = [_step(lag[last, j], lag[first, j]) for j in range(lag.shape[1])]
    each = np.array([x for x in each if np.isfinite(x)])
    if len(each) < 2 or np.mean(np.abs(each - step) <= _ALIKE * abs(step)) < 0.75:
        return None
    return float(run.time[place[k] * rows]), step * period


def _step(before: np.ndarray, after: np.ndarray) -> float:
    before, after = (x[np.isfinite(x)] for x in (before, after))
    return float(np.median(after) - np.median(before)) if len(before) > 1 and len(after) > 1 else float("nan")


def _lags(truth: np.ndarray, read: np.ndarray, rows: int, most: int, slow: float) -> np.ndarray:
    """Rows (blocks, joints) by which what was measured is later than the model, NaN where a shift explains little."""
    blocks = len(truth) // rows
    found = np.full((blocks, truth.shape[1]), np.nan)
    for b in range(1, blocks):
        here = np.arange(b * rows, (b + 1) * rows)
        y = truth[here] - truth[here].mean(0)
        costs = []
        for shift in range(-most // 2, most + 1):
            s = read[np.clip(here - shift, 0, len(read) - 1)]
            costs.append(((y - (s - s.mean(0))) ** 2).sum(0))
        power, best = (y**2).sum(0), np.min(costs, axis=0)
        moving = np.sqrt(np.mean(np.diff(truth[here], axis=0) ** 2, axis=0)) > slow
        told = moving & (best < _SHIFTED * power)
        found[b] = np.where(told, np.argmin(costs, axis=0) - most // 2, np.nan)
    return found
