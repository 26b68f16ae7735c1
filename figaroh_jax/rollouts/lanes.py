"""Rollouts on a GPU: one window a lane, all steps in one kernel.

A step waits for the step before it, so that what counts on a GPU is how long one step takes, not how much it computes:
in kernels of JAX's own it takes a millisecond, most of it waiting. Here the state stays in a lane's registers from the
first step to the last. The rigid body is written out in scalars (`rigid.scalar_programs`), Triton compiles the kernel.
Fixed trees of turning and sliding joints with one drive or none at each, without joint limits; the robot's own numbers
belong to the program. Everything else takes the plain form. Derivatives need no kernel: given the states and what each
step has solved, all steps are linearised at once (`sensitivity`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array

from ..compiled.kernels import Number, in_a_round, usable
from ..rigid.scalar_programs import mass_entries, torques
from ..rigid.scalars import Robot, constants, known
from .loop import Loop, mobility
from .parameters import Table, put
from .simulation import delayed

if TYPE_CHECKING:
    from .sensitivity import Windows

__all__ = ["Rolled", "Step", "fits", "known_to_it", "program_of", "rolled"]

LANES = 32
_TURNS, _SEARCH = 60, 8  # Newton steps of the friction; evaluations of a search along one
_HARD = 1e-9
_JOINT = (
    "armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness", "rest", "play",
    "offset", "ripple_sine", "ripple_cosine", "ripple_order", "friction_rate", "friction_share",
)  # fmt: skip
_DRIVE = ("scale", "dead_band", "voltage")
_FEWEST, _SHORTEST = 256, 100  # windows, rows: less is not worth its compilation
_MOST = 10  # joints: the numbers of more are not held by a lane's registers


class Rolled(NamedTuple):
    """Of each step, (steps, nv, windows): the state before it, accelerations of friction and of integrator, slip."""

    q: Array
    v: Array
    a: Array
    whole: Array
    slip: Array


def fits(loop: Loop, table: Table, data: Windows) -> bool:
    """Whether the kernel knows everything of the loop, and there is a GPU for it."""
    many = data.reading.shape[2] >= _FEWEST and len(data.reading) >= _SHORTEST
    return many and usable(data.command) and known_to_it(loop, table)


def known_to_it(loop: Loop, table: Table) -> bool:
    """Whether the kernel knows everything of the loop."""
    robot, way = loop.robot, loop.drives.transmission
    if isinstance(way, Tracer) or isinstance(robot.inertia, Tracer):
        return False
    way = np.asarray(way)
    plain = all(j.kind in ("revolute", "prismatic") and not j.follows for j in robot.joints)
    plain &= len(robot.joints) == robot.nv <= _MOST and all(kind == "none" for kind in loop.drives.activation)
    plain &= loop.integrator in ("euler", "implicitfast") and not loop.limited
    plain &= loop.carried is None and loop.linear is None
    plain &= not loop.effects and loop.pairs is None
    single = bool(((way != 0).sum(1) <= 1).all() and ((way != 0).sum(0) <= 1).all())
    names = {*_JOINT[:13], *_DRIVE, "force_limit", "kp", "kd", "delay", "reading"}
    return plain and single and all(entry.name in names for entry in table)


class _Numbers(NamedTuple):
    """The numbers of the loop's joints and drives: literals, or places in the vector that the kernel is given."""

    literal: tuple[float, ...]
    place: tuple[int, ...]  # -1: the literal


def _numbers_of(loop: Loop, drives: tuple[int, ...]) -> Array:
    """All that the kernel takes of a loop, (numbers, joints), at most one drive at each joint; differentiable."""
    n, way, drive = loop.robot.nv, jnp.asarray(loop.drives.transmission), np.array(drives)
    has, at = drive >= 0, np.maximum(drive, 0)
    j, d = loop.joints, loop.drives
    rows = [jnp.broadcast_to(jnp.asarray(getattr(j, name), float), (n,)) for name in _JOINT]
    rows += [jnp.asarray(j.torque_range, float)[:, k] for k in range(2)]
    rows.append(jnp.where(has, way[at, np.arange(n)], 0.0))
    rows += [jnp.asarray(getattr(d, name), float)[at] for name in _DRIVE]
    rows += [jnp.asarray(x, float)[at, k] for x, c in ((d.gain, 3), (d.bias, 3)) for k in range(c)]
    rows += [jnp.asarray(x, float)[at, k] for x in (d.command_range, d.force_range) for k in range(2)]
    rows.append(mobility(loop)[:, 0])
    return jnp.stack(rows)


_values = jax.jit(_numbers_of, static_argnums=1)  # one by one its operations take a second

_ROWS = (*_JOINT, "least", "most", "way", *_DRIVE, "gain0", "gain1", "gain2", "bias0", "bias1", "bias2",
         "from", "to", "weakest", "strongest", "weight")  # fmt: skip


class _Program(NamedTuple):
    """What one kernel is compiled for."""

    robot: Any  # joints, codes, constants
    numbers: _Numbers
    drives: tuple[int, ...]  # of each joint, -1: none
    late: bool  # the command is late by numbers of the table
    hard: bool
    implicit: bool
    loaded: bool  # friction follows the load
    dt: float
    substeps: int


def _zero(x: Any) -> bool:
    return isinstance(x, float) and x == 0.0


class Step:
    """One step of a loop in numbers of lanes."""

    def __init__(self, program: _Program, number: Callable[[int], Any]):
        self.p, self.n = program, len(program.drives)
        joints, codes, table = program.robot
        self.body = Robot(joints, codes, lambda k: table[k])
        self.number = number

    def get(self, name: str, j: int) -> Any:
        """A number of a joint or of its drive."""
        return self.number(_ROWS.index(name) * self.n + j)

    def inverse(self, q: list, v: list, a: list) -> list:
        """Torques of the rigid body."""
        out: dict[int, Any] = {}
        reads = [lambda k, x=x: Number(x[k]) for x in (q, v, a)]
        torques(self.body, *reads, put=lambda k, number: out.update({k: number.x}))
        return [out[k] for k in range(self.n)]

    def masses(self, q: list) -> dict[tuple[int, int], Any]:
        """Lower entries that are not zero by structure."""
        found: dict[tuple[int, int], Number] = {}
        mass_entries(self.body, lambda k: Number(q[k]), found.update)
        return {place: number.x for place, number in found.items()}

    def joint(self, j: int, q: Any, v: Any, u: Any, bias: Any) -> tuple[Any, ...]:
        """Torque of drive and passive elements, friction's level, pull and softness, and the step's damping."""
        get = lambda name: self.get(name, j)  # noqa: E731
        motor, damping = 0.0 * v, get("damping") + 0.0 * v
        if self.p.drives[j] >= 0:
            way = get("way")
            length, rate = way * q, way * v
            u = jnp.clip(u, get("from"), get("to"))
            force = get("bias0") + get("scale") * ((get("gain0") + get("gain1") * length) * u + get("bias1") * length)
            if not _zero(get("dead_band")):
                idle = jnp.abs(get("gain0") * get("scale") * get("dead_band") + 0.0 * force)
                force = force - jnp.clip(force, -idle, idle)
            if not _infinite(get("voltage")):
                force = jnp.clip(force, -get("voltage"), get("voltage"))
            slope = get("bias2") + get("gain2") * u
            force = force + slope * rate
            weakest, strongest = get("weakest"), get("strongest")
            if not (_infinite(weakest) and _infinite(strongest)):
                free = (force > weakest) & (force < strongest)
                force, slope = jnp.clip(force, weakest, strongest), jnp.where(free, slope, 0.0)
            motor = way * force
            if not (_infinite(get("least")) and _infinite(get("most"))):
                slope = jnp.where((motor < get("least")) | (motor > get("most")), 0.0, slope)
                motor = jnp.clip(motor, get("least"), get("most"))
            if self.p.implicit:
                damping = damping - way * way * slope
        passive = get("damping") * v + get("offset")
        if not _zero(get("stiffness")):
            stretch = q - get("rest")
            if not _zero(get("play")):
                half = 0.5 * get("play") + 0.0 * q
                stretch = stretch - jnp.clip(stretch, -half, half)
            passive = passive + get("stiffness") * stretch
        if not (_zero(get("ripple_sine")) and _zero(get("ripple_cosine"))):
            turn = get("ripple_order") * q
            passive = passive + get("ripple_sine") * jnp.sin(turn) + get("ripple_cosine") * jnp.cos(turn)
        level = get("friction") + 0.0 * v
        if not _zero(get("stribeck_force")):
            level = level + get("stribeck_force") * jnp.exp(-((v / get("stribeck_speed")) ** 2))
        if self.p.loaded:
            level = level + get("load_ratio") * jnp.abs(motor + bias)
        level = jnp.maximum(level, 0.0)
        pull = -v / self.p.dt if self.p.hard else -(get("friction_rate") * v)
        soft = get("weight") * (_HARD if self.p.hard else get("friction_share")) + 0.0 * v
        return motor - passive, level, pull, soft, damping

    def bias(self, q: list, v: list) -> list:
        """Torques of gravity and rates."""
        return self.inverse(q, v, [0.0] * self.n)

    def solved(self, q: list, v: list, u: list, a: list, slip: list) -> tuple[list, list, list]:
        """Accelerations of the friction and of the integrator, and which joints slip."""
        n = self.n
        bias = self.bias(q, v)
        M = self.masses(q)
        for j in range(n):
            M[j, j] = M[j, j] + self.get("armature", j)
        rows = [self.joint(j, q[j], v[j], u[j], bias[j]) for j in range(n)]
        right = [rows[j][0] - bias[j] for j in range(n)]
        a, slip = _Friction(M, right, rows).settled(a, slip)
        whole = _solved(M, [self.p.dt * row[4] for row in rows], _times(M, a))
        return a, whole, slip


class _Friction:
    """Dry friction of one step: who slips, and the accelerations under it, by Newton's method with a search."""

    def __init__(self, M: dict, right: list, rows: list):
        self.M, self.right, self.n = M, right, len(right)
        self.level, self.pull = ([row[k] for row in rows] for k in (1, 2))
        self.stiff = [1.0 / row[3] for row in rows]  # once: a division takes as long as thirty products

    def settled(self, a: list, slip: list) -> tuple[list, list]:
        """Accelerations under friction, and which joints slip (-1, 1) or hold (0), from those of the step before."""
        full = self.under(slip)
        done = _same(self.acting(full), slip)
        a = [jnp.where(done, x, y) for x, y in zip(full, a, strict=True)]
        slip = [jnp.where(done, x, y) for x, y in zip(slip, self.acting(a), strict=True)]

        def unfinished(state: tuple) -> Any:
            return (jnp.max(jnp.where(state[2], 0, 1)) > 0) & (state[3] < _TURNS)

        a, slip, done, _ = lax.while_loop(unfinished, self.newton, (a, slip, done, jnp.int32(0)))
        return [jnp.where(done, x, jnp.nan) for x in a], slip

    def acting(self, a: Sequence[Any]) -> list:
        """Which joints slip at these accelerations."""
        raw = [(self.pull[j] - a[j]) * self.stiff[j] for j in range(self.n)]
        level = self.level
        return [jnp.where(raw[j] >= level[j], 1.0, jnp.where(raw[j] <= -level[j], -1.0, 0.0)) for j in range(self.n)]

    def under(self, slip: Sequence[Any]) -> list:
        """Accelerations where these joints slip and the others hold."""
        pull, stiff, level = self.pull, self.stiff, self.level
        more = [jnp.where(slip[j] == 0.0, stiff[j], 0.0) for j in range(self.n)]
        held = [jnp.where(slip[j] == 0.0, pull[j] * stiff[j], slip[j] * level[j]) for j in range(self.n)]
        return _solved(self.M, more, [r + h for r, h in zip(self.right, held, strict=True)])

    def newton(self, state: tuple) -> tuple:
        """One step of the lanes that are not done, each as far as its energy falls."""
        a, slip, done, turn = state
        full = self.under(slip)
        same = _same(self.acting(full), slip)
        way = [x - y for x, y in zip(full, a, strict=True)]
        s = self.lowest(a, way, same)
        after = [jnp.where(done, x, x + s * w) for x, w in zip(a, way, strict=True)]
        slip = [jnp.where(done | same, x, y) for x, y in zip(slip, self.acting(after), strict=True)]
        return after, slip, done | same, turn + 1

    def lowest(self, a: list, way: list, same: Any) -> Any:
        """The share of a step at which its energy is lowest: the root of its slope, by the Illinois rule."""
        moved = _times(self.M, way)
        begin = _sum([w * (m - x) for w, m, x in zip(way, _times(self.M, a), self.right, strict=True)])
        curve = _sum([w * m for w, m in zip(way, moved, strict=True)])

        def slope(s: Any) -> Any:
            at = [(self.pull[j] - (a[j] + s * way[j])) * self.stiff[j] for j in range(self.n)]
            force = [jnp.clip(x, -level, level) for x, level in zip(at, self.level, strict=True)]
            return begin + s * curve - _sum([w * f for w, f in zip(way, force, strict=True)])

        def narrower(_: Any, bracket: tuple) -> tuple:
            low, high, below, above = bracket
            s = low - below * (high - low) / jnp.where(above > below, above - below, 1.0)
            at = slope(s)
            left = at <= 0
            below, above = jnp.where(left, at, 0.5 * below), jnp.where(left, 0.5 * above, at)
            return jnp.where(left, s, low), jnp.where(left, high, s), below, above

        zero = 0.0 * a[0]
        first = (zero, zero + 1.0, slope(zero), slope(zero + 1.0))
        low, high, below, above = lax.fori_loop(0, _SEARCH, narrower, first)
        s = low - below * (high - low) / jnp.where(above > below, above - below, 1.0)
        return jnp.where(same | (slope(zero + 1.0) <= 0), 1.0, s)


def _same(one: Sequence[Any], two: Sequence[Any]) -> Any:
    same = one[0] == two[0]
    for x, y in zip(one[1:], two[1:], strict=True):
        same = same & (x == y)
    return same


def _infinite(x: Any) -> bool:
    return isinstance(x, float) and np.isinf(x)


def _sum(parts: Sequence[Any]) -> Any:
    total = parts[0]
    for x in parts[1:]:
        total = total + x
    return total


def _times(M: dict, x: Sequence[Any]) -> list:
    n = len(x)
    return [_sum([M[max(i, j), min(i, j)] * x[j] for j in range(n) if (max(i, j), min(i, j)) in M]) for i in range(n)]


def _solved(M: dict, more: Sequence[Any], right: Sequence[Any]) -> list:
    """(M + diag(more))^-1 right, by L D L' without pivots."""
    n, x = len(right), list(right)
    L: dict[tuple[int, int], Any] = {}
    size: list[Any] = []
    one: list[Any] = []
    for j in range(n):
        d = M[j, j] + more[j]
        for k in range(j):
            if (j, k) in L:
                d = d - L[j, k] * L[j, k] * size[k]
                x[j] = x[j] - L[j, k] * x[k]
        size.append(d)
        one.append(1.0 / d)
        for i in range(j + 1, n):
            value = M.get((i, j))
            for k in range(j):
                if (i, k) in L and (j, k) in L:
                    part = L[i, k] * (L[j, k] * size[k])
                    value = -part if value is None else value - part
            if value is not None:
                L[i, j] = value * one[j]
    x = [one[j] * x[j] for j in range(n)]
    for j in reversed(range(n)):
        for i in range(j + 1, n):
            if (i, j) in L:
                x[j] = x[j] - L[i, j] * x[i]
    return x


def program_of(loop: Loop, table: Table) -> tuple[_Program, np.ndarray]:
    """The program, and the places of the numbers that it is given."""
    robot, n = loop.robot, loop.robot.nv
    way = np.asarray(loop.drives.transmission)
    drives = tuple(int(np.flatnonzero(way[:, j])[0]) if way[:, j].any() else -1 for j in range(n))
    with jax.enable_x64(True):
        values = np.asarray(_values(loop, drives), float).ravel()
    changed = np.zeros((len(_ROWS), n), bool)
    for entry in table:
        at = list(entry.at)
        if entry.name in _JOINT:
            changed[_ROWS.index(entry.name), at] = True
            continue
        mine = [j for j in range(n) if drives[j] in at]
        rows = {"force_limit": ("weakest", "strongest"), "kp": ("gain0", "bias1"), "kd": ("bias2",)}
        for row in rows.get(entry.name, (entry.name,)):
            if row in _ROWS:
                changed[_ROWS.index(row), mine] = True
    if any(entry.name == "armature" for entry in table):
        changed[_ROWS.index("weight")] = True
    given = np.flatnonzero(changed.ravel())
    place = np.full(len(values), -1)
    place[given] = np.arange(len(given))
    late = any(entry.name == "delay" for entry in table) or bool(np.any(np.asarray(loop.drives.delay) > 0))
    ratio = _ROWS.index("load_ratio")
    loaded = bool(changed[ratio].any() or values.reshape(-1, n)[ratio].any())
    numbers = _Numbers(tuple(map(float, values)), tuple(map(int, place)))
    body = (robot.joints, known(robot), tuple(map(float, constants(robot, float, np))))
    return _Program(body, numbers, drives, late, loop.law == "hard", loop.integrator == "implicitfast", loaded,
                    float(loop.dt), 1), given  # fmt: skip


def rolled(loop: Loop, table: Table, theta: Any, data: Windows, start: Any, *, interpret: bool = False) -> Rolled:
    """States before each step and what each step has solved, of numbers (entries,) and starts (2 nv, windows)."""
    program, given = program_of(loop, table)
    with jax.enable_x64(True):
        run = _jitted(program, tuple(map(int, given)), table, interpret)
        return Rolled(*run(loop, jnp.asarray(theta), data, jnp.asarray(start)))


@lru_cache(maxsize=16)
def _jitted(program: _Program, given: tuple[int, ...], table: Table, interpret: bool) -> Any:
    at = np.array(given, int)

    def run(loop: Loop, theta: Array, data: Windows, start: Array) -> list[Array]:
        here = put(loop, table, theta)
        own = _numbers_of(here, program.drives).ravel()[at]
        fine = jnp.repeat(jnp.asarray(data.command), data.substeps, axis=0)
        seen = delayed(fine, jnp.asarray(here.drives.delay), loop.dt)[data.lead * data.substeps :]
        return _launched(program, own, seen, start, interpret)

    return jax.jit(run)


def _launched(program: _Program, own: Array, seen: Array, start: Array, interpret: bool) -> list[Array]:
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    n, windows = len(program.drives), seen.shape[2]
    rounds = -(-windows // LANES)
    missing = rounds * LANES - windows
    if missing:
        seen, start = (jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, missing)], mode="edge") for x in (seen, start))
    anywhere, given = pl.BlockSpec(memory_space=pl.ANY), any(k >= 0 for k in program.numbers.place)
    steps, width = seen.shape[0], rounds * LANES
    found = pl.pallas_call(
        _kernel(program, steps, seen.shape[1], width, seen.dtype),
        out_shape=[jax.ShapeDtypeStruct((steps * n * width,), seen.dtype)] * len(Rolled._fields),
        grid=(rounds,),
        in_specs=[anywhere] * 4,
        out_specs=[anywhere] * len(Rolled._fields),
        compiler_params=None if interpret else triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="rolled",
    )(own if given else jnp.zeros(1), seen.ravel(), start.ravel(), jnp.ones(1, jnp.int32))
    return [x.reshape(steps, n, width)[..., :windows] for x in found]


def _kernel(program: _Program, steps: int, commands: int, width: int, dtype: Any) -> Callable[..., None]:
    """All steps of `LANES` windows of `width`, of numbers, commands (steps, drives, windows), starts (2 nv, windows).

    Each array is one row; a place in it is the one before and a number more.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    n, given = len(program.drives), sum(k >= 0 for k in program.numbers.place)
    long = jnp.int64 if steps * max(n, commands) * width >= 1 << 31 else jnp.int32

    def kernel(own_ref: Any, seen_ref: Any, start_ref: Any, once_ref: Any, *outs: Any) -> None:
        at = (pl.program_id(0) * LANES + lax.iota(jnp.int32, LANES)).astype(long)
        zero = jnp.zeros(LANES, dtype)

        def read(ref: Any, first: Any, by: int, count: int) -> list:
            def loaded(place: Any, _: list) -> list:
                return [triton.load(ref.at[x]) for x in _along(place, count)]

            return in_a_round(once_ref[0], (first, jnp.asarray(by, long)), loaded, [zero] * count) if count else []

        values = read(own_ref, jnp.zeros(LANES, long), 1, given)
        both = read(start_ref, at, width, 2 * n)

        def number(k: int) -> Any:
            place = program.numbers.place[k]
            return program.numbers.literal[k] if place < 0 else values[place]

        def one(k: Any, carry: tuple) -> tuple:
            q, v, a, slip = carry
            k = k.astype(long)
            loaded = read(seen_ref, at + k * (commands * width), width, commands)
            u = [loaded[d] if d >= 0 else zero for d in program.drives]
            a, whole, slip = Step(program, number).solved(q, v, u, a, slip)

            def kept(place: Any, values: list) -> list:
                for c, x in enumerate(_along(place, n)):
                    for number, out in enumerate(outs):
                        triton.store(out.at[x], values[number * n + c])
                return [*values[1:], -values[0]]

            place = at + k * (n * width), jnp.asarray(width, long)
            in_a_round(once_ref[0], place, kept, [*q, *v, *a, *whole, *slip])
            v = [x + program.dt * y for x, y in zip(v, whole, strict=True)]
            q = [x + program.dt * y for x, y in zip(q, v, strict=True)]
            return q, v, a, slip

        lax.fori_loop(0, steps, one, (both[:n], both[n:], [zero] * n, [zero] * n))

    return kernel


def _along(place: Any, count: int) -> Iterator[Any]:
    """A place, and those that lie behind it, each as far from the one before."""
    first, more = place
    for k in range(count):
        yield first
        first = first + more if k < count - 1 else first
