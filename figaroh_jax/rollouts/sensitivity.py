"""What a loop predicts of recordings, and its exact derivatives by parameters and by the state at each start.

Forward mode in three passes over each stretch of time: a plain rollout; all steps of it linearised at once, batched
over time and windows; a cheap scan of x' = A x + B. Residuals are whitened; sums over each stretch and window are kept,
for held-out data and for tests by blocks. Several parameter vectors (lanes) are taken side by side, each with its own
set of free parameters, by one compiled program.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..compiled.batching import program, traced
from ..rigid.dynamics import joint_masses, joint_torques
from ..rigid.model import RobotModel
from ..rigid.slopes import Slopes, slopes, within_reach
from . import lanes, own
from .friction import Solution
from .loop import Linear, Loop, State, Step, advance, integrated, mobility, observe
from .native import native
from .parameters import TEN, TILT, Table, put, tilt_slope, unit_payload
from .simulation import delayed

__all__ = ["Sums", "Windows", "began", "by_kernel", "linear_sums", "predicted", "read_of", "state_size"]


class Windows(eqx.Module):
    """Stretches of recordings, side by side, on a grid of `substeps` loop steps a row.

    Row k of `reading` is what was measured at the instant at which row `lead + k` of `command` was written.
    """

    command: Any  # (lead + rows, nu, windows), rad; `lead` rows of history
    reading: Any  # (rows, ny, windows): positions of the encoders, then their rates where these were recorded
    weight: Any  # (rows, ny, windows): 1 / standard deviation, 0 where nothing counts
    start: Any  # (2 nv, windows): position and velocity at the first row, as measured
    precision: Any  # (2 nv, windows): 1 / standard deviation of that state
    carried: Any  # (rows, 4 + 3 links, windows): what one joint carries (`alone.carried_by`), or None
    substeps: int = eqx.field(static=True)
    lead: int = eqx.field(static=True)
    block: int = eqx.field(static=True)  # rows that one sum covers; divides the rows
    pole: Any = None  # (ny, windows) of noise that is a first-order low pass of white noise; None: it is white
    weighed: bool = eqx.field(static=True, default=False)  # whether the weights hold the roots of the shares
    share: Any = None  # (rows, ny, windows): how much of a reading a row tells (`data.told_by`), 0 if nothing


class Sums(NamedTuple):
    """Sums of whitened residuals over each block of rows and window, a leading axis of lanes.

    Columns are the free parameters, then the state at the window's start.
    """

    cost: Array  # (lanes, blocks, windows, ny) squares
    gradient: Array  # (lanes, blocks, windows, columns) J' e, e what was read minus what is predicted
    matrix: Array  # (lanes, blocks, windows, columns, columns) J' J


def state_size(loop: Loop) -> int:
    """Numbers of the state that is carried: positions, velocities, activations, and the states of effects."""
    active, more = any(kind != "none" for kind in loop.drives.activation), own.memories(loop.effects)
    return 2 * loop.robot.nv + (len(loop.drives.names) + more if active or more else 0)


def began(loop: Loop, data: Windows, start: Array) -> State:
    """The states (2 nv, windows) with the activations of the drives."""
    n = loop.robot.nv
    q, v = start[:n], start[n:]
    kinds = np.array(loop.drives.activation)[:, None]
    first = jnp.asarray(data.command)[data.lead]
    length = jnp.asarray(loop.drives.transmission) @ q
    active = jnp.where(kinds == "integrator", length, jnp.where(kinds == "none", 0.0, first))
    return State(q, v, jnp.concatenate([active, own.begun_memory(loop.effects, v)]) if loop.effects else active)


def _seen(loop: Loop, data: Windows, block: Array) -> Array:
    """Command that the drives see at each step of a block of rows, (steps, nu, windows)."""
    rows = data.block + data.lead
    part = jax.lax.dynamic_slice_in_dim(jnp.asarray(data.command), block * data.block, rows)
    fine = jnp.repeat(part, data.substeps, axis=0)
    return delayed(fine, jnp.asarray(loop.drives.delay), loop.dt)[data.lead * data.substeps :]


def _carried(data: Windows, block: Array) -> Array | None:
    """What the joint carries at each step of a block of rows, (steps, 4 + 3 links, windows): held from row to row."""
    if data.carried is None:
        return None
    rows = jax.lax.dynamic_slice_in_dim(jnp.asarray(data.carried), block * data.block, data.block)
    return jnp.repeat(rows, data.substeps, axis=0)


def carrying(loop: Loop, carried: Array | None) -> Loop:
    """The loop at instants at which its joint carries that, (4 + 3 links, samples)."""
    if carried is None or loop.carried is None:
        return loop
    more = carried[4:].reshape(-1, 3, carried.shape[1])
    mass, bias, slope = carried[:3] + jnp.sum(jnp.asarray(loop.carried.payload)[:, None, None] * more, 0)
    where = lambda m: (m.carried.mass, m.carried.bias, m.carried.slope, m.carried.place)  # noqa: E731
    return eqx.tree_at(where, loop, (mass, bias, slope, carried[3]))


def read_of(loop: Loop, state: State, rates: bool) -> Array:
    """What the encoders read, then their rates."""
    read = observe(loop, state)
    if not rates:
        return read
    turned = eqx.tree_at(lambda m: m.joints.reading, loop, jnp.zeros(loop.robot.nv))
    return jnp.concatenate([read, observe(turned, State(state.v, state.v, state.act))])


def _rollout(loop: Loop, data: Windows, state: State, warm: Array, weight: Array, block: Array) -> Any:
    def one(carry: tuple[State, Array], given: tuple[Array, Array | None]) -> Any:
        after, step = advance(carrying(loop, given[1]), carry[0], given[0], weight, carry[1])
        return (after, step.a), (carry[0], step)

    return jax.lax.scan(one, (state, warm), (_seen(loop, data, block), _carried(data, block)))


def _predicted(loop: Loop, table: Table, theta: Array, data: Windows, start: Array) -> Array:
    """Readings (lanes, rows, ny, windows) of the parameters (lanes, entries) and starts (lanes, 2 nv, windows)."""
    rates = data.reading.shape[1] > len(loop.measured)

    def lane(theta: Array, start: Array) -> Array:
        here = put(loop, table, theta)
        weight = mobility(here)

        def chunk(carry: tuple[State, Array], block: Array) -> Any:
            carry, (states, _) = _rollout(here, data, *carry, weight, block)
            rows = jax.tree.map(lambda x: x[:: data.substeps], states)
            return carry, jax.vmap(lambda q, v, act: read_of(here, State(q, v, act), rates))(*rows)

        state = began(here, data, start)
        read = jax.lax.scan(chunk, (state, jnp.zeros_like(state.v)), jnp.arange(len(data.reading) // data.block))[1]
        return read.reshape(-1, *read.shape[2:])

    return jax.vmap(lane)(theta, start)


def _linear_sums(loop: Loop, table: Table, theta: Array, free: Array, data: Windows, start: Array) -> Sums:
    """Sums of squares, gradients and normal matrices of each lane.

    `theta` (lanes, entries) are all numbers of the table, `free` (lanes, columns) which of them each lane
    differentiates, `start` (lanes, 2 nv, windows) the states at the windows' starts.
    """
    if len(theta) == 1:  # branches that are not taken are then not computed
        return Sums(*(x[None] for x in _lane(loop, table, theta[0], free[0], data, start[0])))
    return Sums(*jax.vmap(lambda t, f, s: _lane(loop, table, t, f, data, s))(theta, free, start))


_predicted_program = program(_predicted, static_argnums=1)
_sums_program = program(_linear_sums, static_argnums=1)


def predicted(loop: Loop, table: Table, theta: Any, data: Windows, start: Any) -> Any:
    """Readings (lanes, rows, ny, windows) of the parameters (lanes, entries) and starts (lanes, 2 nv, windows)."""
    code = None if traced(loop, theta, data, start) else native(loop, table, data)
    if code is None or not code.usable or not code.knows(theta):
        return _predicted_program(loop, table, theta, data, start)
    return np.stack([code.read(np.asarray(one), np.asarray(x)) for one, x in zip(theta, start, strict=True)])


def linear_sums(loop: Loop, table: Table, theta: Any, free: Any, data: Windows, start: Any) -> Sums:
    """Sums of squares, gradients and normal matrices of each lane, by machine code where it can be.

    `theta` (lanes, entries) are all numbers of the table, `free` (lanes, columns) which of them each lane
    differentiates (-1: none, a column that means nothing), `start` (lanes, 2 nv, windows) the states at the windows'
    starts.
    """
    code = None if traced(loop, theta, free, data, start) else native(loop, table, data)
    if code is not None and not code.usable and lanes.fits(loop, table, data):
        return by_kernel(loop, table, np.asarray(theta), np.maximum(np.asarray(free), 0), data, start)
    if code is None or not code.usable or not code.knows(theta, free):
        at = np.maximum(free, 0) if isinstance(free, np.ndarray) else free
        return _sums_program(loop, table, theta, at, data, start)
    each = zip(theta, free, start, strict=True)
    found = [code.sums(np.asarray(one), np.asarray(f), np.asarray(x)) for one, f, x in each]
    return Sums(*(np.stack(parts) for parts in zip(*found, strict=True)))  # pyright: ignore[reportArgumentType]


def by_kernel(
    loop: Loop, table: Table, theta: np.ndarray, free: np.ndarray, data: Windows, start: Any, *, interpret: bool = False
) -> Sums:
    """`linear_sums` where one kernel of a GPU rolls all windows out (`lanes`), lane after lane."""
    found = []
    for one, columns, begin in zip(theta, free, start, strict=True):
        motion = lanes.rolled(loop, table, one, data, begin, interpret=interpret)
        found.append(_given_program(loop, table, jnp.asarray(one), jnp.asarray(columns), data, begin, motion))
    return Sums(*(jnp.stack(parts) for parts in zip(*found, strict=True)))  # pyright: ignore[reportArgumentType]


def _lane(
    loop: Loop, table: Table, theta: Array, free: Array, data: Windows, start: Array, motion: lanes.Rolled | None = None
) -> tuple[Array, ...]:
    """Sums of one lane; the `motion` where it is known before."""
    size, n, windows = state_size(loop), loop.robot.nv, start.shape[1]
    rates = data.reading.shape[1] > len(loop.measured)
    here = put(loop, table, theta)
    weight = mobility(here)
    state = began(here, data, start)
    spread = jnp.concatenate([jnp.zeros((size, len(free))), jnp.eye(size)[:, : 2 * n]], 1)
    spread = jnp.broadcast_to(spread[..., None], (*spread.shape, windows))
    if size > 2 * n:  # activations start with the command; an integrator's with the position
        kinds = np.array(loop.drives.activation) == "integrator"
        begin = jnp.where(kinds[:, None], jnp.asarray(loop.drives.transmission), 0.0)
        spread = spread.at[2 * n : 2 * n + len(kinds), len(free) : len(free) + n].set(begin[..., None])
    look = _looking(loop, size, rates)
    direct = _direct(loop, table, look.shape[0])[:, free]
    wide, columns = look.shape[0], spread.shape[1]
    nothing = () if data.pole is None else _Before.none(wide, columns, windows)

    def chunk(carry: tuple[State, Array, Array, Any], block: Array) -> Any:
        state, warm, spread, before = carry
        if motion is None:
            (state, warm), (states, steps) = _rollout(here, data, state, warm, weight, block)
        else:
            states, steps = _piece(motion, block, data.block * data.substeps, state.act)
        a, b = _linearised(loop, table, theta, free, data, states, steps, block)
        spread, rows = _spread(a, b, spread, data.substeps)
        first = data.block * block
        truth, precise = (jax.lax.dynamic_slice_in_dim(x, first, data.block) for x in (data.reading, data.weight))
        at_rows = jax.tree.map(lambda x: x[:: data.substeps], states)
        read = jax.vmap(lambda q, v, act: read_of(here, State(q, v, act), rates))(*at_rows)
        slope = jnp.sum(look[None, :, :, None, None] * rows[:, None], 2)
        slope = slope.at[:, :, : len(free)].add(direct[None, :, :, None]) * precise[:, :, None]
        error = (truth - read) * precise
        if data.pole is not None:
            error, slope, before = before.beyond(jnp.asarray(data.pole), error, slope, precise > 0)
        cost, gradient = jnp.sum(error**2, 0).T, jnp.einsum("typw,tyw->wp", slope, error)
        return (state, warm, spread, before), (cost, gradient, jnp.einsum("typw,tyrw->wpr", slope, slope))

    blocks = jnp.arange(data.reading.shape[0] // data.block)
    return jax.lax.scan(chunk, (state, jnp.zeros_like(state.v), spread, nothing), blocks)[1]


_given_program = program(_lane, static_argnums=1)


def _piece(motion: lanes.Rolled, block: Array, steps: int, act: Array) -> tuple[State, Step]:
    """States and solved steps of a block of a motion."""
    q, v, a, whole, slip = (jax.lax.dynamic_slice_in_dim(x, block * steps, steps) for x in motion)
    still = jnp.zeros_like(a)
    return State(q, v, jnp.broadcast_to(act, (steps, *act.shape))), Step(Solution(a, slip, still, still), whole)


class _Before(NamedTuple):
    """The row before a block: its weighed errors, their sensitivities, and which of them count."""

    error: Array  # (ny, windows)
    slope: Array  # (ny, columns, windows)
    counted: Array  # (ny, windows)

    @staticmethod
    def none(outputs: int, columns: int, windows: int) -> _Before:
        return _Before(
            jnp.zeros((outputs, windows)), jnp.zeros((outputs, columns, windows)), jnp.zeros((outputs, windows), bool)
        )

    def beyond(self, pole: Array, error: Array, slope: Array, counted: Array) -> tuple[Array, Array, _Before]:
        """What each row tells beyond the row before it, where the noise is a first-order low pass."""
        last = _Before(error[-1], slope[-1], counted[-1])
        past = [jnp.concatenate([old[None], x[:-1]]) for old, x in zip(self, (error, slope, counted), strict=True)]
        had, alone = past[2], jnp.sqrt(1 - pole**2)
        error = jnp.where(had, error - pole * past[0], alone * error) * counted
        wide, thin = pole[:, None], alone[:, None]
        slope = jnp.where(had[:, :, None], slope - wide * past[1], thin * slope) * counted[:, :, None]
        return error, slope, last


def _looking(loop: Loop, size: int, rates: bool) -> np.ndarray:
    """Rows of what is read by the state, (ny, size)."""
    n, count = loop.robot.nv, len(loop.measured)
    look = np.zeros((count * (2 if rates else 1), size))
    for k, coordinate in enumerate(loop.measured):
        look[k, coordinate] = 1.0
        if rates:
            look[count + k, n + coordinate] = 1.0
    return look


def _direct(loop: Loop, table: Table, outputs: int) -> Array:
    """How the readings follow the parameters beside the state: what the encoders read more."""
    direct = np.zeros((outputs, len(table)))
    for k, entry in enumerate(table):
        if entry.name == "reading":
            for place in entry.at:
                direct[loop.measured.index(place), k] = 1.0
    return jnp.asarray(direct)


def _linearised(
    loop: Loop, table: Table, theta: Array, free: Array, data: Windows, states: State, steps: Any, block: Array
) -> tuple[Array, Array]:
    """A (steps, size, size, windows) and B (steps, size, columns, windows) of every step of a block at once."""
    count, windows, size = states.q.shape[0], states.q.shape[2], state_size(loop)
    active = size > 2 * loop.robot.nv

    def flat(x: Array) -> Array:
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * windows)

    if loop.integrator == "rk4":  # its stages stand behind the steps
        steps = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0) if x.ndim == 4 else x, steps)
        fixed = jax.tree.map(lambda x: jax.vmap(flat)(x) if x.ndim == 4 else flat(x), steps)
    else:
        fixed = jax.tree.map(flat, steps)
    here = State(*(flat(x) for x in states))
    carried = _carried(data, block)
    carried = None if carried is None else flat(carried)
    rigid = _RigidBody(loop, table, theta, free, here, fixed) if _one_body(loop) else None

    def move(q: Array, v: Array, act: Array, theta: Array) -> Array:
        at = put(loop, table, theta)
        seen, weight = flat(_seen(at, data, block)), mobility(at)
        at = at if rigid is None else rigid.put(at, theta)
        after = integrated(carrying(at, carried), State(q, v, act), seen, weight, fixed)
        return jnp.concatenate([after.q, after.v, after.act] if active else [after.q, after.v])

    _, pushed = jax.linearize(move, *here, theta)

    def one(state: Array, k: Array) -> Array:
        parts = jnp.split(state, [loop.robot.nv, 2 * loop.robot.nv])
        moved = [jnp.broadcast_to(p[:, None], x.shape) for p, x in zip(parts, here, strict=False) if p.size]
        own = jnp.where(k < 0, 0.0, jax.nn.one_hot(k, len(theta), dtype=theta.dtype))
        return pushed(*moved, *([] if active else [jnp.zeros_like(here.act)]), own)

    tangents = jnp.concatenate([jnp.eye(size), jnp.zeros((len(free), size))])
    entries = jnp.concatenate([jnp.full(size, -1), free])
    both = jax.vmap(one)(tangents, entries)  # (size + columns, size, steps windows)
    both = jnp.moveaxis(both.reshape(*both.shape[:2], count, windows), (0, 1, 2), (2, 1, 0))
    return both[:, :, :size], both[:, :, size:]


def _one_body(loop: Loop) -> bool:
    """Whether the rigid body can be linearised by itself."""
    return loop.carried is None and loop.integrator != "rk4" and loop.robot.nq == loop.robot.nv


class _RigidBody:
    """The rigid body of a loop at the samples of a block, differentiated once by positions and rates.

    Most parameters do not touch it: a direction of theirs costs a few sums, no inverse dynamics.
    """

    def __init__(self, loop: Loop, table: Table, theta: Array, free: Array, state: State, step: Any):
        q, v = state.q, state.v
        robot = put(loop, table, theta).robot
        a = jnp.stack([jnp.zeros_like(v), step.solution.a, step.a])
        self.table, self.theta = table, theta
        found = slopes(robot, q, v, a) if within_reach(robot) else _by_directions(robot, q, v, a)
        self.linear = Linear(q=q, v=v, a=a, more=jnp.zeros_like(a), **found._asdict())
        self.which = [k for k, entry in enumerate(table) if entry.name in _OF_BODY]
        if self.which:
            mine = jnp.any(jnp.isin(free, jnp.array(self.which)))
            empty = jnp.zeros((len(self.which), *a.shape))
            self.columns = jax.lax.cond(mine, lambda: self._columns(loop, robot, a), lambda: empty)

    def _columns(self, loop: Loop, robot: RobotModel, a: Array) -> Array:
        """What a unit of each number of the rigid body adds to the torques, (numbers, 3, nv, samples)."""
        q, v, zero = self.linear.q, self.linear.v, jnp.zeros_like(self.linear.v)
        found, told = [], {entry.name: self.theta[k] for k, entry in enumerate(self.table)}
        leaning = tilt_slope(loop.robot.gravity, *(told.get(name, 0.0) for name in TILT))
        for entry in (self.table[k] for k in self.which):
            if entry.name not in TILT:
                at, ten = np.array(entry.at), jnp.zeros_like(jnp.asarray(robot.inertia))
                unit = unit_payload(loop, at) if entry.name == "payload" else np.eye(10)[TEN.index(entry.name)]
                ten = ten.at[at].set(unit)
                body = eqx.tree_at(lambda r: r.inertia, robot, ten)
                found.append(jnp.stack([joint_torques(body, q, v, one) for one in a]))
            else:
                pulled = eqx.tree_at(lambda r: r.gravity, robot, leaning[:, TILT.index(entry.name)])
                found.append(jnp.broadcast_to(joint_torques(pulled, q, zero, zero), a.shape))
        return jnp.stack(found)

    def put(self, loop: Loop, theta: Array) -> Loop:
        """The loop with its rigid body to first order about the samples and about the present numbers."""
        linear = self.linear
        if self.which:
            change = (theta - self.theta)[np.array(self.which)]
            linear = eqx.tree_at(lambda x: x.more, linear, jnp.einsum("k,kans->ans", change, self.columns))
        return eqx.tree_at(lambda m: m.linear, loop, linear, is_leaf=lambda x: x is None)


def _by_directions(robot: RobotModel, q: Array, v: Array, a: Array) -> Slopes:
    """`slopes` of any tree whose positions are as many as its rates, one direction after the other."""
    n, samples = v.shape
    three = lambda x: jnp.concatenate([x] * 3, 1)  # noqa: E731
    wide = jnp.concatenate(list(a), 1)
    torque, by_q = jax.linearize(lambda q: joint_torques(robot, q, three(v), wide), three(q))
    _, by_v = jax.linearize(lambda v: joint_torques(robot, q, v, jnp.zeros_like(v)), v)
    each = jnp.eye(n)[:, :, None]
    columns = jax.vmap(by_q)(jnp.broadcast_to(each, (n, n, 3 * samples)))  # (direction, torque, samples)
    return Slopes(
        jnp.stack(jnp.split(torque, 3, axis=1)),
        jnp.stack(jnp.split(columns.swapaxes(0, 1), 3, axis=2)),
        jax.vmap(by_v)(jnp.broadcast_to(each, (n, n, samples))).swapaxes(0, 1),
        joint_masses(robot, q),
    )


_OF_BODY = ("payload", *TEN, *TILT)


def _spread(a: Array, b: Array, spread: Array, substeps: int) -> tuple[Array, Array]:
    """The sensitivities after the block, and at each of its rows: (rows, size, columns, windows)."""
    columns = b.shape[2]

    def one(spread: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        after = jnp.sum(step[0][:, :, None] * spread[None], 1)
        return after.at[:, :columns].add(step[1]), spread

    last, rows = jax.lax.scan(one, spread, (a, b))
    return last, rows[::substeps]
