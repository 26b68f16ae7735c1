"""Rows of the regressor of large trees on a GPU, by one small kernel that loops over joints and links.

A large tree written out in scalars fills several kernels of thousands of operations, which take minutes to trace and
compile. Here one kernel goes from joint to joint, one sample a lane, and at each link over the dofs that
move it. Which joint comes next are numbers in a table, so that the kernel does not grow with the tree; what it does
with a joint are the scalars of `scalars.py`. Axes, and links where limbs begin, are remembered in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..compiled.kernels import Lanes, Number, lanes_of, launch_over
from .kinematics import ancestors
from .model import Joint, Kind, RobotModel, dofs
from .scalar_programs import Twist, ten_columns
from .scalars import (
    NONE,
    ONE,
    PER_JOINT,
    ZERO,
    Matrix,
    Motion,
    Robot,
    Vector,
    add,
    constants,
    cross,
    moved_by,
    nothing_known,
    pose_of,
    product,
    scaled,
    spin_of,
    turned,
    turned_back,
)

__all__ = ["Rows", "looped_rows"]

LINK, DOF = 21, 6  # numbers of a link: rotation, origin, w, al, ac; of a degree of freedom: axis, origin of its joint
JOINT, PAIR, SIDE = 9, 4, 2  # numbers in the tables


class Rows(NamedTuple):
    """Arrays to be written: how long they are, and of each degree of freedom in which one its row begins, and where."""

    lengths: tuple[int, ...]
    array: Int[np.ndarray, " nd"]
    start: Int[np.ndarray, " nd"]


class _Link(NamedTuple):
    """Pose in the world; motion in the link's own axes."""

    rotation: Matrix
    origin: Vector
    motion: Motion

    def numbers(self) -> list[Number]:
        """All of them, one after another."""
        return [x for part in (*self.rotation, self.origin, *self.motion) for x in part]


def _link(x: Sequence[Number]) -> _Link:
    three = [tuple(x[k : k + 3]) for k in range(0, LINK, 3)]
    return _Link(tuple(three[:3]), three[3], Motion(*three[4:]))


class _Tree(NamedTuple):
    """Of each joint: place of what carries it, or -1 for the joint before; its own place, or -1; first of q, of v, of
    the dofs, behind those; kind; first of its pairs, behind those. Of each pair: dof, whether it turns, array, row."""

    kinds: tuple[Kind, ...]
    places: int
    joints: Int[np.ndarray, "nj joint"]
    pairs: Int[np.ndarray, "pairs pair"]


def _kinds(joints: tuple[Joint, ...]) -> tuple[Kind, ...]:
    return tuple(sorted({joint.kind for joint in joints}))


def _tree(joints: tuple[Joint, ...], rows: Rows) -> _Tree:
    dof, kinds = dofs(joints), _kinds(joints)
    over = ancestors(joints)[dof.joint] > 0
    branching = sorted({-1, *(joint.parent for i, joint in enumerate(joints) if joint.parent != i - 1)})
    place = {link: k for k, link in enumerate(branching)}
    first = [*dof.first.tolist(), len(dof.joint)]
    table, pairs = [], []
    filled = np.array(rows.start)
    for i, joint in enumerate(joints):
        before = len(pairs)
        for k in np.flatnonzero(over[:, i]):
            pairs.append([k, dof.turns[k], rows.array[k], filled[k]])
            filled[k] += 10
        carried = -1 if joint.parent == i - 1 and i else place[joint.parent]
        own = [dof.positions[i].start, joint.coordinate, first[i], first[i + 1], kinds.index(joint.kind)]
        table.append([carried, place.get(i, -1), *own, before, len(pairs)])
    return _Tree(kinds, len(place), np.array(table, np.int32), np.array(pairs, np.int32))


def looped_rows(
    model: RobotModel,
    arrays: Sequence[Float[Array, "samples _"]],
    rows: Rows,
    side: int = 0,
) -> list[Float[Array, "length samples"]]:
    """The columns of the links that each degree of freedom moves, ten a link, the links in the order of the tree.

    Rows of mimic joints are times their ratio. The arrays are q, v, a and, for weighted rows, the roots of the weights
    and `side` columns a coordinate that follow those of the links, as `scalar_forms.weighted_rows` takes them.
    """
    tree, dtype, places = _tree(model.joints, rows), arrays[0].dtype, model.dofs
    ratio = jnp.asarray(model.ratio, dtype)[places.joint]
    behind = rows.start + 10 * ancestors(model.joints)[places.joint].sum(1).astype(int)
    beside = np.stack([rows.array, behind], 1)[np.argsort(places.column)] if side else np.zeros((0, SIDE))
    tables = [tree.joints, tree.pairs, beside, places.column[:, None]]
    kernel = _Kernel(len(model.joints), len(places.joint), tree, side, [x.size for x in tables])
    integers = np.concatenate([x.reshape(-1) for x in tables]).astype(np.int32)
    remembered = len(places.joint) * DOF + tree.places * LINK
    found = launch_over(
        kernel,
        [constants(model).astype(dtype), jnp.asarray(integers), ratio, *arrays],
        [(length, len(arrays[0])) for length in (*rows.lengths, remembered)],
    )
    return found[:-1]


class _Kernel:
    """What is done for a block of samples."""

    def __init__(self, joints: int, dofs: int, tree: _Tree, side: int, sizes: Sequence[int]) -> None:
        self.joints, self.dofs, self.tree, self.side = joints, dofs, tree, side
        self.pairs_at, self.side_at, self.column_at = np.cumsum(sizes)[:3].tolist()
        self.coordinates = sizes[2] // SIDE

    def __call__(self, lanes: Lanes, table: Any, integers: Any, ratio: Any, *arrays: Any) -> None:
        """Write the rows."""
        rest = tuple(-Number(table[self.joints * PER_JOINT + 6 * self.dofs + k]) for k in range(3))
        world = [lanes_of(x, lanes) for x in _Link(_UNTURNED, NONE, Motion(NONE, NONE, rest)).numbers()]
        memory = lanes.outs[-1]
        lanes.put(memory, self.dofs * DOF, world)

        def of_joint(i: Any, above: list[Array]) -> list[Array]:
            carried, own, q, v, first, last, kind, begin, end = (integers[JOINT * i + k] for k in range(JOINT))
            elsewhere = lanes.full(carried >= 0)
            there = [lanes.at(memory, self.dofs * DOF + carried * LINK + k, elsewhere) for k in range(LINK)]
            above = [jnp.where(elsewhere, x, y) for x, y in zip(there, above, strict=True)]
            load = partial(_load_of_one, table, self.joints, i, first)
            branches = [partial(_advance, one, lanes, load, (q, v, v), arrays[:3]) for one in self.tree.kinds]
            new = branches[0](above) if len(branches) == 1 else lax.switch(kind, branches, above)
            lanes.put(memory, self.dofs * DOF + own * LINK, new, lanes.full(own >= 0))
            link = _link([Number(x) for x in new])
            lax.fori_loop(first, last, partial(self._axis, lanes, table, integers, ratio, arrays[3:4], link), first)
            lax.fori_loop(begin, end, partial(self._columns, lanes, integers, link), begin)
            return new

        lax.fori_loop(0, self.joints, of_joint, world)
        if self.side:
            lax.fori_loop(0, self.coordinates, partial(self._beside, lanes, integers, *arrays[3:]), jnp.int32(0))

    def _axis(
        self, lanes: Lanes, table: Any, integers: Any, ratio: Any, root: Sequence[Any], link: _Link, k: Any, count: Any
    ) -> Any:
        """Remember the axis of degree of freedom k in the world, times the weight of its row, and its origin."""
        axis = tuple(Number(table[self.joints * PER_JOINT + 6 * k + n]) for n in range(3))
        weight = Number(ratio[k])
        for one in root:
            weight = weight * lanes.read(one, integers[self.column_at + k], 0)
        numbers = [*scaled(turned(link.rotation, axis), weight), *link.origin]
        lanes.put(lanes.outs[-1], k * DOF, [lanes_of(x, lanes) for x in numbers])
        return count + 1

    def _columns(self, lanes: Lanes, integers: Any, link: _Link, k: Any, count: Any) -> Any:
        """Write the ten columns of the link in the row of a degree of freedom."""
        dof, turns, array, row = (integers[self.pairs_at + PAIR * k + n] for n in range(PAIR))
        six = [Number(lanes.at(lanes.outs[-1], dof * DOF + n)) for n in range(DOF)]
        turning, axis, origin = Number(turns.astype(lanes.dtype)), tuple(six[:3]), tuple(six[3:])
        about, along = scaled(axis, turning), scaled(axis, ONE - turning)
        arm = tuple(x - y for x, y in zip(link.origin, origin, strict=True))
        linear = turned_back(link.rotation, add(cross(about, arm), along))
        twist = Twist(0, linear, turned_back(link.rotation, about))
        ten = [lanes_of(x, lanes) for x in ten_columns(twist, link.motion, spin_of(link.motion))]
        self._put(lanes, array, row, ten)
        return count + 1

    def _beside(self, lanes: Lanes, integers: Any, root: Any, given: Any, k: Any, count: Any) -> Any:
        """Write the weighed columns of coordinate k that follow those of the links."""
        array, row = (integers[self.side_at + SIDE * k + n] for n in range(SIDE))
        weight = lanes.read(root, k, 0)
        own = [lanes_of(lanes.read(given, k * self.side, n) * weight, lanes) for n in range(self.side)]
        self._put(lanes, array, row, own)
        return count + 1

    def _put(self, lanes: Lanes, array: Any, row: Any, numbers: list[Array]) -> None:
        outs = lanes.outs[:-1]
        if len(outs) == 1:
            lanes.put(outs[0], row, numbers)
            return

        def write(out: Any, row: Any, *numbers: Array) -> Any:
            lanes.put(out, row, numbers)
            return row

        lax.switch(array, [partial(write, out) for out in outs], row, *numbers)


_UNTURNED: Matrix = ((ONE, ZERO, ZERO), (ZERO, ONE, ZERO), (ZERO, ZERO, ONE))


def _load_of_one(table: Any, nj: int, joint: Any, dof: Any, k: int) -> Any:
    """The k-th constant of a robot that has this joint alone."""
    return table[joint * PER_JOINT + k] if k < PER_JOINT else table[nj * PER_JOINT + 6 * dof + k - PER_JOINT]


def _advance(
    kind: Kind,
    lanes: Lanes,
    load: Callable[[int], Any],
    starts: Sequence[Any],
    reads: Sequence[Any],
    above: list[Array],
) -> list[Array]:
    """The numbers of a link from those of the link that carries it."""
    joints = (Joint("", kind, -1, 0, ""),)
    robot, before = Robot(joints, nothing_known(joints), load), _link([Number(x) for x in above])
    q, v, a = (partial(lanes.read, ref, first) for ref, first in zip(reads, starts, strict=True))
    pose = pose_of(robot, 0, q)
    motion = moved_by(robot, 0, pose, before.motion, spin_of(before.motion), v, a)
    origin = add(before.origin, turned(before.rotation, pose.origin))
    return [lanes_of(x, lanes) for x in _Link(product(before.rotation, pose.matrix()), origin, motion).numbers()]
