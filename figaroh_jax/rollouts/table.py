"""Where an arm's end rests on a table: one height, one point of the last link, a force that only pushes up.

A table that is touched lightly leaves no joint and no torque further off than friction does elsewhere. What tells it
is that one force explains all joints at once: F acts as J' F at them, only upwards, only while the point is as low as
the table, and the same height explains every place where it is touched. The arm is simulated with it: what J' F is at
the joints is added to what their drives are commanded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..compiled.batching import program
from ..rigid.kinematics import placements
from .data import Run, Stretch, noise_of, regular, windows
from .loop import Loop
from .sensitivity import predicted

__all__ = ["Resting", "Table", "on_table"]

_LONG, _GAP = 0.6, 0.3  # s of a stretch, s that does not end one
_SLOW = 0.3  # rad/s of the fastest joint where it may rest
_SEEN = 3.0  # usual errors by which a push up must explain what is seen, for a table to be looked for
_LOW = 0.25  # of the range of heights
_LOSES, _LEFT = (
    0.25,
    0.5,
)  # of the squares of a recording that a table must take, of those of a stretch that it may leave
_BENEATH = 0.004  # m below the table that the end may be seen, for more than a moment: the plane is not that flat
_STIFF = 5.0  # of the table, times the arm's own
_STEPS, _FIRST = 8, 40  # iterations of the force, from that of another table and from none
_TRIES = 60  # tables that are tried from each start
_REACH = 0.03  # m, of the point about the frame's own place
_TOUCHES = 0.05  # N
_FAR = 10.0  # rad or m, of a simulation that leads nowhere
_AROUND = 4.0  # s before and after a stretch that may touch, simulated to find the table
_MOST = 1.5  # times what is off where it may touch, as a rule: a law that is far off is as wrong as one farther off
_SAMPLES = 1024  # one program takes so many


class Resting(NamedTuple):
    """A stretch in which the end rests on the table."""

    run: int
    first: float  # s
    last: float  # s
    force: float  # N, median
    joints: tuple[int, ...]  # that it moves


class Table(NamedTuple):
    """A plane that holds a point of the last link."""

    height: float  # m above the base
    point: np.ndarray  # (3,) m in the last link's frame
    stretches: tuple[Resting, ...]
    gain: float  # of the squares of the recordings in which it is touched


class _Way(NamedTuple):
    """Height of a point c of the last link, h + H c, and its derivative by the coordinates, A + B c, at each row."""

    h: np.ndarray  # (rows,)
    H: np.ndarray  # (rows, 3)
    A: np.ndarray  # (rows, nv)
    B: np.ndarray  # (rows, nv, 3)


def on_table(loop: Loop, runs: Sequence[Run]) -> Table | None:
    """The table that the arm's end rests on in these recordings, or None; the loop with the friction that it has."""
    per_torque = _command_of_torque(loop)
    if per_torque is None:
        return None
    link, point = _end(loop)
    ways = [_way(loop, link, run) for run in runs]
    all_of = [_Part(loop, run, way, per_torque) for run, way in zip(runs, ways, strict=True)]
    errors = [one.error for one in all_of]
    if not all((np.abs(e) < _FAR).all() for e in errors):
        return None
    usual = np.maximum(np.median(np.abs(np.concatenate(errors)), axis=0), 1e-6)
    free = [_height(way, point) for way in ways]
    low = np.quantile(np.concatenate(free), [0.001, 0.999]) @ [1 - _LOW, _LOW]
    stiff = 1 / np.abs(per_torque)  # N m/rad of each servo
    hints = [
        _hints(run, e, way, point, stiff, usual, z < low)
        for run, e, way, z in zip(runs, errors, ways, free, strict=True)
    ]
    touched = [k for k, x in enumerate(hints) if x]
    if not touched:
        return None
    seen = [np.linalg.norm(errors[k][a:b], axis=1).mean() for k in touched for a, b in hints[k]]
    scale = float(np.median(seen))
    parts = [
        _Part(loop, _cut(runs[k], a, b), _Way(*(x[a:b] for x in ways[k])), per_torque, scale)
        for k in touched
        for a, b in _around(hints[k], runs[k])
    ]
    starts = sorted({round(float(np.median(free[k][a:b])), 3) for k in touched for a, b in hints[k]})
    starts = [starts[i] for i in np.unique(np.linspace(0, len(starts) - 1, 2).astype(int))]
    best: tuple[float, np.ndarray] | None = None
    for height in starts:
        found = _least(lambda x: sum(one.squares(x[0], point + x[1:]) for one in parts), height)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None
    height, place = float(best[1][0]), point + best[1][1:]
    for one in all_of:
        one.scale = scale
    return _judged(runs, ways, [all_of[k] for k in touched], touched, height, place)


def _judged(
    runs: Sequence[Run],
    ways: Sequence[_Way],
    parts: Sequence[_Part],
    touched: Sequence[int],
    height: float,
    place: np.ndarray,
) -> Table | None:
    """The table with the stretches that it explains; None where the arm is seen beneath it or it explains little."""
    for one in parts:
        one.squares(height, place, _FIRST)
    deep = {k: one.force / one.stiff(place) for k, one in zip(touched, parts, strict=True)}
    for k, (run, way) in enumerate(zip(runs, ways, strict=True)):
        beneath = _height(way, place) < height - _BENEATH - deep.get(k, 0.0)
        if any(run.time[b - 1] - run.time[a] > _LONG for a, b in _stretches(beneath, 1)):
            return None
    stretches, before, after = [], 0.0, 0.0
    for k, one in zip(touched, parts, strict=True):
        gap = round(_GAP / regular(one.run.name, one.run.time))
        mine = []
        for a, b in _stretches(one.force > _TOUCHES, gap):
            old, new = (one.worth(x[a:b]) for x in (one.error, one.left))
            if one.run.time[b - 1] - one.run.time[a] >= _LONG and new < _LEFT * old:
                mine.append(
                    Resting(
                        k,
                        float(one.run.time[a]),
                        float(one.run.time[b - 1]),
                        float(np.median(one.force[a:b])),
                        one.joints(place),
                    )
                )
        own = one.worth(one.error), one.worth(one.left)
        if mine and own[1] < (1 - _LOSES) * own[0]:
            stretches += mine
        before, after = before + own[0], after + own[1]
    gain = 1 - after / max(before, 1e-300)
    return Table(height, place, tuple(stretches), gain) if stretches and gain > _LOSES else None


class _Part:
    """A recording that may touch the table: its simulation with a force at the end."""

    def __init__(self, loop: Loop, run: Run, way: _Way, per_torque: np.ndarray, scale: float = 1.0):
        self.loop, self.run, self.way, self.per_torque, self.scale = loop, run, way, per_torque, scale
        self.trusted = (
            np.ones(len(run.time), bool) if run.trusted is None else run.trusted.reshape(len(run.time), -1).all(1)
        )
        noise = [np.maximum(noise_of(run.position), 1e-9)]
        self.data = windows(loop, [run], [Stretch(0, 0, len(run.time))], noise, 0.3, smooth=True)
        self.force = np.zeros(len(run.time))
        self.moved = self._moved(np.zeros_like(run.position))
        self.error = self.left = -self.moved

    def _moved(self, more: np.ndarray) -> np.ndarray:
        """How far the arm is from where it was measured, with so much more of command at each row."""
        command, lead = np.array(self.data.command), self.data.lead
        command[lead : lead + len(more), :, 0] += more
        data = eqx.tree_at(lambda d: d.command, self.data, command)
        with jax.enable_x64(True):
            read = predicted(self.loop, (), np.zeros((1, 0)), data, np.asarray(data.start)[None])
        return np.asarray(read)[0, : len(more), :, 0] - self.run.position

    def worth(self, error: np.ndarray) -> float:
        """Squares of errors over what is off where it may touch; more than `_MOST` times that counts no more."""
        return float((np.minimum(np.abs(error) / self.scale, _MOST) ** 2).sum())

    def joints(self, point: np.ndarray) -> tuple[int, ...]:
        """Those that a push up turns, by more than a fifth of what it does to the first of them."""
        size = np.median(np.abs((self.way.A + self.way.B @ point) * self.per_torque), axis=0)
        return tuple(int(j) for j in np.flatnonzero(size > 0.2 * size.max()))

    def stiff(self, point: np.ndarray) -> float:
        """Of the table with what gives way between it and the encoders, N/m."""
        arm = self.way.A + self.way.B @ point
        return _STIFF / max(float(np.median((arm**2 * np.abs(self.per_torque)).sum(1))), 1e-9)

    def squares(self, height: float, point: np.ndarray, steps: int = _STEPS) -> float:
        """Of the motion with the table, from the force of the table before."""
        arm, here = self.way.A + self.way.B @ point, _height(self.way, point)
        stiff, share = self.stiff(point), 1 / (1 + _STIFF)
        for _ in range(steps):
            deep = height - here - (arm * self.moved).sum(1)
            self.force = self.force + share * (stiff * np.maximum(deep, 0.0) - self.force)
            self.moved = self._moved(arm * self.per_torque * self.force[:, None])
        self.left = -self.moved
        return self.worth(self.left[self.trusted])


def _cut(run: Run, first: int, after: int) -> Run:
    """Some rows of a recording."""
    part = slice(first, after)
    velocity, trusted = (None if x is None else x[part] for x in (run.velocity, run.trusted))
    return run._replace(time=run.time[part] - run.time[first], command=run.command[part], position=run.position[part],
                        velocity=velocity, trusted=trusted)  # fmt: skip


def _around(hints: Sequence[tuple[int, int]], run: Run) -> list[tuple[int, int]]:
    """Rows around stretches, those that meet taken together."""
    more, mask = round(_AROUND / regular(run.name, run.time)), np.zeros(len(run.time), bool)
    for a, b in hints:
        mask[max(a - more, 0) : b + more] = True
    return _stretches(mask, 0)


def _command_of_torque(loop: Loop) -> np.ndarray | None:
    """Command that adds a torque of 1 at each coordinate (nv,), where each has a drive that follows a position."""
    drives, n = loop.drives, loop.robot.nv
    way, gain = np.asarray(drives.transmission), np.asarray(drives.gain) * np.asarray(drives.scale)[:, None]
    revolute = all(j.kind in ("revolute", "prismatic") and not j.follows for j in loop.robot.joints)
    up = np.linalg.norm(np.asarray(loop.robot.gravity)) > 0
    square = way.shape == (n, n) and (way == np.diag(np.diag(way))).all() and (np.diag(way) != 0).all()
    if n < 3 or not (revolute and up and square) or tuple(loop.measured) != tuple(range(n)) or loop.carried is not None:
        return None
    if any(kind != "none" for kind in drives.activation) or (gain[:, 0] == 0).any() or gain[:, 1:].any():
        return None
    if (np.asarray(drives.bias)[:, 1] >= 0).any():  # torques: no command holds a place
        return None
    return 1 / (gain[:, 0] * np.diag(way))


def _end(loop: Loop) -> tuple[int, np.ndarray]:
    """The link that most joints move and that carries a frame of its own, with that frame's place; else its mass's."""
    robot = loop.robot
    joints = robot.joints

    def depth(i: int) -> int:
        return 0 if i < 0 else 1 + depth(joints[i].parent)

    frames = [(depth(f.parent), k) for k, f in enumerate(robot.frames) if f.parent >= 0]
    frames = [(d, k) for d, k in frames if np.linalg.norm(np.asarray(robot.frame_placement)[k][:3, 3]) > 0.01]
    if frames:
        _, k = max(frames)
        return robot.frames[k].parent, np.asarray(robot.frame_placement)[k][:3, 3]
    i = max(range(len(joints)), key=depth)
    ten = np.asarray(robot.inertia)[i]
    return i, ten[1:4] / max(ten[0], 1e-9) if len(ten) == 10 else np.zeros(3)


def _way(loop: Loop, link: int, run: Run) -> _Way:
    robot = loop.robot
    q, found = np.zeros((len(run.time), robot.nv)), []
    q[:, list(loop.measured)] = run.position
    with jax.enable_x64(True):
        for first in range(0, len(q), _SAMPLES):
            part = np.clip(np.arange(first, first + _SAMPLES), 0, len(q) - 1)
            found.append(np.asarray(_placements(robot, q[part].T))[..., : len(q) - first])
    frames = np.moveaxis(np.concatenate(found, -1), -1, 0)  # (rows, nj, 4, 4)
    gravity = np.asarray(robot.gravity)[:3]
    up = -gravity / np.linalg.norm(gravity)
    turn, origin = frames[:, link, :3, :3], frames[:, link, :3, 3]
    A, B = np.zeros((len(q), robot.nv)), np.zeros((len(q), robot.nv, 3))
    i = link
    while i >= 0:
        joint = robot.joints[i]
        axis = frames[:, i, :3, :3] @ np.asarray(robot.axis)[i]
        if joint.kind == "prismatic":
            A[:, joint.coordinate] = axis @ up
        else:
            lever = np.cross(up, axis)
            A[:, joint.coordinate] = (lever * (origin - frames[:, i, :3, 3])).sum(1)
            B[:, joint.coordinate] = np.einsum("rij,ri->rj", turn, lever)
        i = joint.parent
    return _Way(origin @ up, np.einsum("rij,i->rj", turn, up), A, B)


_placements = program(placements)


def _height(way: _Way, point: np.ndarray) -> np.ndarray:
    return way.h + way.H @ point


def _hints(
    run: Run, error: np.ndarray, way: _Way, point: np.ndarray, stiff: np.ndarray, usual: np.ndarray, low: np.ndarray
) -> list[tuple[int, int]]:
    """Rows, first and after last, where a push up at the end explains much of what is seen, low and slowly moving."""
    period = regular(run.name, run.time)
    rows = max(1, round(_LONG / period))
    mean = lambda x: np.stack([np.convolve(c, np.ones(rows) / rows, mode="same") for c in x.T], 1)  # noqa: E731
    push = (way.A + way.B @ point) / stiff / usual  # usual errors that a newton makes
    seen = mean(error) / usual
    size = np.linalg.norm(push, axis=1)
    share = (push * seen).sum(1) / np.maximum(size, 1e-12)
    slow = mean(np.abs(np.gradient(run.position, period, axis=0))).max(1) < _SLOW
    found = _stretches(low & slow & (share > _SEEN), round(_GAP / period))
    return [(a, b) for a, b in found if run.time[b - 1] - run.time[a] >= _LONG]


def _least(squares, height: float) -> tuple[float, np.ndarray]:
    from scipy.optimize import minimize  # scipy is slow to import

    first = np.zeros((5, 4))
    first[:, 0] = height
    first[1, 0] += 0.005
    first[2:, 1:] = 0.5 * _REACH * np.eye(3)

    def worth(x: np.ndarray) -> float:
        return squares(x) * (1 + 0.01 * float(((x[1:] / _REACH) ** 2).sum()))

    found = minimize(worth, first[0], method="Nelder-Mead", options={"maxfev": _TRIES, "initial_simplex": first})
    return float(found.fun), np.asarray(found.x)


def _stretches(mask: np.ndarray, gap: int) -> list[tuple[int, int]]:
    """First rows of what is true and the rows after its last ones; gaps of no more than `gap` rows are closed."""
    rows = np.flatnonzero(mask)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows) > gap + 1)
    return list(zip(rows[np.append(0, cuts + 1)], rows[np.append(cuts, len(rows) - 1)] + 1, strict=True))
