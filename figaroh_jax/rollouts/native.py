"""Rollouts and their derivatives as machine code (`rollout.c`), where the machine has a C compiler.

It gives what `sensitivity` gives, to rounding, for fixed trees of turning and sliding joints and for one joint carried
by a measured arm: no program of JAX's is compiled, and a step costs a fraction of a microsecond for a joint. Everything
else (activations, RK4, free and ball joints, mimics, transformations of JAX, other devices) takes the plain form.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from ..compiled.batching import on_host
from ..compiled.machine_code import is_gnu, library
from .loop import Loop
from .own import is_own, silent
from .parameters import TEN, TILT, Table, tilt_slope, tilted, unit_payload

if TYPE_CHECKING:
    from .sensitivity import Windows

__all__ = ["Answers", "native"]

_JOINT = (
    "armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness", "rest", "play",
    "offset", "ripple_sine", "ripple_cosine", "ripple_order", "reading", "friction_rate", "friction_share",
)  # fmt: skip
_PLAIN = _JOINT[:14]  # what a table may name
_DRIVE = ("scale", "delay", "dead_band", "voltage")
_KINDS = {name: k for k, name in enumerate(_PLAIN)} | {name: 100 + k for k, name in enumerate(_DRIVE)}
_KINDS |= {"force_limit": 110, "kp": 111, "kd": 112, "payload": 200} | dict.fromkeys(TILT, 201)
_KINDS |= dict.fromkeys(TEN, 200)
_PAIR = ("pair_inertia", "pair_damping", "pair_friction")
_KINDS |= {name: 120 + k for k, name in enumerate(_PAIR)}
_CARRIED_PAYLOAD = 202
_GAIN, _BIAS, _COMMAND, _FORCE = 4, 7, 10, 12  # rows of a drive's numbers
_LONGS = ("n", "nu", "links", "ny", "rates", "carried", "hard", "limited", "implicit", "drag", "windows", "rows",
          "lead", "substeps", "block", "many", "columns", "pairs")  # fmt: skip
_ARRAYS = (
    "measured", "parent", "coordinate", "slides", "placement", "axis", "inertia", "gravity", "start", "joint",
    "drive", "way", "payload", "resting", "kind", "place", "column", "ten", "pair", "joined", "command", "reading",
    "weight", "load", "begin", "pole", "cost", "gradient", "matrix", "read",
)  # fmt: skip
_MOST, _MOST_COLUMNS, _MOST_PAIRS = 32, 500, 64
_KNOWN = 8  # coordinates up to which each count has code of its own: an arm of seven joints with a spring


class _Given(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in _LONGS] + [("dt", ctypes.c_double)]
    _fields_ += [(name, ctypes.c_void_p) for name in _ARRAYS]


class Answers(NamedTuple):
    """What one lane gives: sums by blocks and windows, or what is read."""

    cost: np.ndarray
    gradient: np.ndarray
    matrix: np.ndarray


class native:
    """`native(loop, table, data)`: the loop as machine code; `usable` says whether it can be."""

    def __init__(self, loop: Loop, table: Table, data: Windows):
        self.usable = on_host(loop, data.command) and _fits(loop, table, data)
        self.code = _code(_size(loop), loop.carried is not None) if self.usable else None
        self.usable = self.code is not None
        if self.usable:
            self.table, self.loop, self.data = table, loop, data
            self.numbers = _numbers(loop)
            self.arrays = _fixed(loop, data)
            weighed = any(entry.name == "payload" for entry in table) and loop.carried is None
            self.unit_payload = _unit_payloads(loop) if weighed else np.zeros((0, 10))

    def knows(self, thetas: Sequence[np.ndarray], frees: Sequence[np.ndarray] = ()) -> bool:
        """Whether it gives these lanes: no effect of a user's acts in any of them, and no number of one is free."""
        return self.usable and all(self.knows_one(x) for x in thetas) and not any(self._theirs(x) for x in frees)

    def knows_one(self, theta: np.ndarray, free: np.ndarray | None = None) -> bool:
        """The same of one lane."""
        if not self.usable or (free is not None and self._theirs(free)):
            return False
        own = {(one.name, one.at[0]): float(theta[k]) for k, one in enumerate(self.table) if is_own(one.name)}
        return silent(self.loop.effects, own)

    def _theirs(self, free: np.ndarray) -> bool:
        return bool(self.loop.effects) and any(k >= 0 and is_own(self.table[int(k)].name) for k in free)

    def sums(self, theta: np.ndarray, free: np.ndarray, start: np.ndarray) -> Answers:
        """Sums of one lane: `free` (columns,) entries that are differentiated, -1 for a column of zeros."""
        kept = np.flatnonzero(np.asarray(free) >= 0)
        n, windows = self.loop.robot.nv, start.shape[1]
        blocks, wide = self.data.reading.shape[0] // self.data.block, self.data.reading.shape[1]
        total = len(kept) + 2 * n
        out = {
            "cost": np.empty((blocks, windows, wide)),
            "gradient": np.empty((blocks, windows, total)),
            "matrix": np.empty((blocks, windows, total, total)),
        }
        self._run(theta, [int(free[k]) for k in kept], start, out)
        if len(kept) == len(free):
            return Answers(**out)
        at = np.concatenate([kept, len(free) + np.arange(2 * n)])
        gradient = np.zeros((blocks, windows, len(free) + 2 * n))
        matrix = np.zeros((blocks, windows, len(free) + 2 * n, len(free) + 2 * n))
        gradient[..., at] = out["gradient"]
        matrix[..., at[:, None], at[None]] = out["matrix"]
        return Answers(out["cost"], gradient, matrix)

    def read(self, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
        """What is read, (rows, ny, windows)."""
        out = {"read": np.empty(self.data.reading.shape)}
        self._run(theta, [], start, out)
        return out["read"]

    def _run(self, theta: np.ndarray, free: list[int], start: np.ndarray, out: dict[str, np.ndarray]) -> None:
        loop, data = self.loop, self.data
        theta = np.asarray(theta, float)
        given, arrays = _Given(), self.arrays | self._numbers_at(theta) | self._unknowns(theta, free)
        arrays |= {"begin": np.ascontiguousarray(start, float)} | out
        longs = {
            "n": loop.robot.nv, "nu": len(loop.drives.names), "ny": len(loop.measured),
            "links": 0 if loop.carried is None else len(loop.carried.payload),
            "rates": data.reading.shape[1] > len(loop.measured), "carried": loop.carried is not None,
            "hard": loop.law == "hard", "limited": loop.limited, "implicit": loop.integrator == "implicitfast",
            "drag": loop.integrator != "explicit",
            "windows": start.shape[1], "rows": data.reading.shape[0] // data.block * data.block, "lead": data.lead,
            "substeps": data.substeps, "block": data.block, "many": len(arrays["kind"]), "columns": len(free),
            "pairs": arrays["pair"].shape[1],
        }  # fmt: skip
        for name, value in longs.items():
            setattr(given, name, int(value))
        given.dt = float(loop.dt)
        for name in _ARRAYS:
            setattr(given, name, arrays[name].ctypes.data if name in arrays else None)
        assert self.code is not None
        self.code(ctypes.byref(given))

    def _numbers_at(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """The loop's numbers with the table's in them (`parameters.put` in NumPy)."""
        own = {name: x.copy() for name, x in self.numbers.items()}
        for entry, value in zip(self.table, theta, strict=True):
            at = list(entry.at)
            if is_own(entry.name) or entry.name in TILT:
                continue
            if entry.name in _PLAIN:
                own["joint"][_PLAIN.index(entry.name), at] = value
            elif entry.name in _DRIVE:
                own["drive"][_DRIVE.index(entry.name), at] = value
            elif entry.name == "force_limit":
                own["drive"][_FORCE, at], own["drive"][_FORCE + 1, at] = -value, value
            elif entry.name == "kp":
                own["drive"][_GAIN, at], own["drive"][_BIAS + 1, at] = value, -value
            elif entry.name == "kd":
                own["drive"][_BIAS + 2, at] = -value
            elif entry.name in _PAIR:
                own["pair"][_PAIR.index(entry.name), at] = value
            elif entry.name == "payload" and self.loop.carried is not None:
                own["payload"][at] = value
            elif entry.name == "payload":
                own["inertia"][at] += value * self.unit_payload[at]
            else:
                own["inertia"][at, TEN.index(entry.name)] += value
        if any(self._leans(theta)):
            with jax.enable_x64(True):
                own["gravity"] = np.array(tilted(self.loop.robot.gravity, *self._leans(theta)))
        return own

    def _leans(self, theta: np.ndarray) -> list[float]:
        """How far gravity leans, m/s2 along both axes across it."""
        told = {entry.name: float(theta[k]) for k, entry in enumerate(self.table)}
        return [told.get(name, 0.0) for name in TILT]

    def _unknowns(self, theta: np.ndarray, free: Sequence[int]) -> dict[str, np.ndarray]:
        kind, place, column, ten, pulls = [], [], [], [], np.zeros((3, 2))
        if any(self.table[k].name in TILT for k in free):
            with jax.enable_x64(True):
                pulls = np.asarray(tilt_slope(self.loop.robot.gravity, *self._leans(theta)))
        for c, k in enumerate(free):
            entry = self.table[k]
            carried = entry.name == "payload" and self.loop.carried is not None
            for at in entry.at:
                kind.append(_CARRIED_PAYLOAD if carried else _KINDS[entry.name])
                place.append(at)
                column.append(c)
                unit = np.zeros(10)
                if entry.name in TEN:
                    unit[TEN.index(entry.name)] = 1.0
                elif entry.name in TILT:
                    unit[:3] = pulls[:, TILT.index(entry.name)]
                elif entry.name == "payload" and not carried:
                    unit = self.unit_payload[at]
                ten.append(unit)
        longs = {"kind": kind, "place": place, "column": column}
        return {name: np.array(x, ctypes.c_long) for name, x in longs.items()} | {"ten": np.array(ten).reshape(-1, 10)}


def _unit_payloads(loop: Loop) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(unit_payload(loop, np.arange(len(loop.robot.joints))))


def _size(loop: Loop) -> int:
    """How many coordinates the compiler is told: all loops then have a known length, a quarter off an arm's seconds."""
    return loop.robot.nv if loop.robot.nv <= _KNOWN else 0


def _fits(loop: Loop, table: Table, data: Windows) -> bool:
    """Whether the code knows everything of the loop."""
    robot = loop.robot
    plain = all(joint.kind in ("revolute", "prismatic") and not joint.follows for joint in robot.joints)
    simple = len(robot.joints) == robot.nv and all(kind == "none" for kind in loop.drives.activation)
    simple &= not loop.drives.across
    small = (
        max(robot.nv, len(loop.drives.names), 2 * len(loop.measured)) <= _MOST
        and len(table) + 2 * robot.nv <= _MOST_COLUMNS
    )
    if not plain or not simple or not small or loop.integrator == "rk4" or loop.linear is not None:
        return False
    if loop.carried is not None and (robot.nv > 2 or data.carried is None):
        return False
    places = {"reading": loop.measured}
    if loop.pairs is not None and (len(loop.pairs.at) > _MOST_PAIRS or robot.nv < 2):
        return False
    told = all(set(entry.at) <= set(places.get(entry.name, entry.at)) for entry in table)
    return told and all(entry.name in _KINDS or is_own(entry.name) for entry in table)


def _numbers(loop: Loop) -> dict[str, np.ndarray]:
    """What a table may change, as the code takes it."""
    joints, drives, f = loop.joints, loop.drives, lambda x: np.asarray(x, float)
    n, nu = loop.robot.nv, len(drives.names)
    rows = [np.broadcast_to(f(getattr(joints, name)), n) for name in _JOINT]
    rows += [*f(joints.torque_range).T, *f(joints.limit).T, np.broadcast_to(f(joints.limit_margin), n)]
    rows += [*f(joints.limit_solref).T, *f(joints.limit_solimp).T]
    own = [np.broadcast_to(f(getattr(drives, name)), nu) for name in _DRIVE]
    own += [*f(drives.gain).T, *f(drives.bias).T, *f(drives.command_range).T, *f(drives.force_range).T]
    carried = loop.carried
    return {
        "joint": np.array(rows).reshape(-1, n),
        "drive": np.array(own).reshape(-1, nu),
        "inertia": np.array(loop.robot.inertia, float),
        "gravity": np.array(loop.robot.gravity, float),
        "pair": np.zeros((3, 0))
        if loop.pairs is None
        else np.stack([f(getattr(loop.pairs, name)) for name in ("inertia", "damping", "friction")]),
        "payload": np.zeros(1) if carried is None else np.array(carried.payload, float),
    }


def _fixed(loop: Loop, data: Windows) -> dict[str, np.ndarray]:
    """What no table changes."""
    robot, f = loop.robot, lambda x: np.ascontiguousarray(x, float)
    longs = {
        "measured": loop.measured,
        "parent": [joint.parent for joint in robot.joints],
        "coordinate": [joint.coordinate for joint in robot.joints],
        "joined": [] if loop.pairs is None else np.array(loop.pairs.at).ravel(),
        "slides": [joint.kind == "prismatic" for joint in robot.joints],
    }
    carried = loop.carried
    resting = (
        np.zeros(2) if carried is None else np.array([float(np.ravel(x)[0]) for x in (carried.mass, carried.share)])
    )
    found = {name: np.array(x, ctypes.c_long) for name, x in longs.items()} | {
        "placement": f(robot.placement), "axis": f(robot.axis), "start": f(loop.start), "resting": resting,
        "way": f(loop.drives.transmission), "command": f(data.command), "reading": f(data.reading),
        "weight": f(data.weight),
    }  # fmt: skip
    more = {"load": data.carried, "pole": data.pole}
    return found | {name: f(x) for name, x in more.items() if x is not None}


_NARROW = ("-mprefer-vector-width=256",) if platform.machine() in ("x86_64", "AMD64") else ()  # 8 % faster


@lru_cache
def _code(size: int, one: bool) -> Any:
    """The compiled function, or None."""
    source = (Path(__file__).parent / "rollout.c").read_text()
    level = ["-O2", "-fvect-cost-model=dynamic"] if size else ["-O1"]  # functions that take the time say -O3
    level = level if is_gnu() else ["-O3"]
    found = library(source, f"-DSIZE={size}", f"-DONE={int(one)}", *level, *_NARROW)
    if found is None:
        return None
    function = found["rolled"]
    function.restype, function.argtypes = None, [ctypes.c_void_p]
    return function
