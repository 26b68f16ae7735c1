"""Rows of the regressor of large trees on a GPU, by two small kernels that loop over joints and links.

A large tree written out in scalars fills several kernels of thousands of operations, which take minutes to trace and
compile. Here a first kernel goes from joint to joint, one sample a lane, and leaves the pose and motion of every link
in memory; a second one takes them from there and writes the columns of all links that a degree of freedom moves. Which
joint comes next are numbers in a table, so that neither grows with the tree; what one of them does with a joint are the
scalars of `scalars.py`. Joints are numbered depth first: the links that one moves stand side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
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


class Rows(NamedTuple):
    """Rows to be written one after another: of which degree of freedom, where each begins, and how many there are."""

    dof: Int[np.ndarray, " rows"]
    start: Int[np.ndarray, " rows"]
    length: int


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
    kinds: tuple[Kind, ...]
    joints: Int[np.ndarray, "nj 6"]  # carried by (0: world), first of q, of v, of the dofs, behind those, which kind
    dofs: Int[np.ndarray, "nd 4"]  # joint, whether it turns, links moved, column of v


@lru_cache(maxsize=64)
def _tree(joints: tuple[Joint, ...]) -> _Tree:
    places = dofs(joints)
    kinds = tuple(sorted({joint.kind for joint in joints}))
    first = [*places.first.tolist(), len(places.joint)]
    table = [
        [joint.parent + 1, places.positions[i].start, joint.coordinate, first[i], first[i + 1], kinds.index(joint.kind)]
        for i, joint in enumerate(joints)
    ]
    moved = ancestors(joints)[places.joint].sum(1)
    beside = np.stack([places.joint, places.turns, moved, places.column], 1)
    return _Tree(kinds, np.array(table, np.int32), beside.astype(np.int32))


def looped_rows(
    model: RobotModel,
    arrays: Sequence[Float[Array, "samples _"]],
    rows: Sequence[Rows],
    by_ratio: bool = False,
    side: int = 0,
    interpret: bool = False,
) -> list[Float[Array, "length samples"]]:
    """The columns of the links that each row's degree of freedom moves, ten a link; for each of `rows` an array.

    With `by_ratio` rows of mimic joints are times their ratio. The arrays are q, v, a and, for weighted rows,
    the roots of the weights and `side` columns a coordinate that follow those of the links, as
    `scalar_forms.weighted_rows` takes them.
    """
    tree, dtype = _tree(model.joints), arrays[0].dtype
    state = _states(model, tree, arrays, interpret)
    ratio = jnp.asarray(model.ratio, dtype)[model.dofs.joint] if by_ratio else jnp.ones(len(tree.dofs), dtype)
    out = []
    for one in rows:
        table = np.concatenate([tree.dofs[one.dof], one.dof[:, None], one.start[:, None]], axis=1).astype(np.int32)
        kernel = partial(_write_rows, len(model.joints), side)
        found = launch_over(
            kernel,
            [jnp.asarray(table.reshape(-1)), ratio[one.dof], state, *arrays[3:]],
            (one.length, len(arrays[0])),
            rounds=len(one.dof),
            interpret=interpret,
        )
        out.append(found)
    return out


def _states(
    model: RobotModel, tree: _Tree, arrays: Sequence[Array], interpret: bool
) -> Float[Array, "numbers samples"]:
    """Of the world and every link, then of every degree of freedom."""
    nj, nd = tree.joints.shape[0], len(tree.dofs)
    return launch_over(
        partial(_write_states, nj, nd, tree.kinds),
        [constants(model).astype(arrays[0].dtype), jnp.asarray(tree.joints.reshape(-1)), *arrays[:3]],
        ((nj + 1) * LINK + nd * DOF, len(arrays[0])),
        interpret=interpret,
    )


def _write_states(nj: int, nd: int, kinds: Sequence[Kind], lanes: Lanes, table: Any, tree: Any, *reads: Any) -> None:
    def of_joint(i: Any, above: list[Array]) -> list[Array]:
        parent, q, v, first, last, kind = (tree[6 * i + k] for k in range(6))
        fresh = lanes.full(parent != i)  # else it is carried by the joint before, whose numbers are at hand
        there = [lanes.back(parent * LINK + k, fresh) for k in range(LINK)]
        above = [jnp.where(fresh, x, y) for x, y in zip(there, above, strict=True)]
        load = partial(_load_of_one, table, nj, i, first)
        starts = (q, v, v)
        branches = [partial(_advance, one, lanes, load, starts, reads) for one in kinds]
        new = branches[0](above) if len(kinds) == 1 else lax.switch(kind, branches, above)
        lanes.put((i + 1) * LINK, new)
        link = _link([Number(x) for x in new])

        def of_dof(k: Any, count: Any) -> Any:
            axis = tuple(Number(table[nj * PER_JOINT + 6 * k + n]) for n in range(3))
            both = [*turned(link.rotation, axis), *link.origin]
            lanes.put((nj + 1) * LINK + k * DOF, [lanes_of(x, lanes) for x in both])
            return count + 1

        lax.fori_loop(first, last, of_dof, jnp.int32(0))
        return new

    gravity = [Number(table[nj * PER_JOINT + 6 * nd + k]) for k in range(3)]
    rest = _Link(
        ((ONE, ZERO, ZERO), (ZERO, ONE, ZERO), (ZERO, ZERO, ONE)), NONE, Motion(NONE, NONE, tuple(-x for x in gravity))
    )
    world = [lanes_of(x, lanes) for x in rest.numbers()]
    lanes.put(0, world)
    lax.fori_loop(0, nj, of_joint, world)


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


def _write_rows(nj: int, side: int, lanes: Lanes, table: Any, ratio: Any, state: Any, *given: Any) -> None:
    joint, turns, links, column, dof, start = (table[6 * lanes.round + k] for k in range(6))
    weight = Number(ratio[lanes.round])
    if given:
        weight = weight * lanes.read(given[0], column, 0)
    first = (nj + 1) * LINK + dof * DOF
    six = [Number(lanes.at(state, first + k)) for k in range(DOF)]
    turning = Number(turns.astype(lanes.dtype))
    axis, origin = scaled(tuple(six[:3]), weight), tuple(six[3:])
    about, along = scaled(axis, turning), scaled(axis, ONE - turning)

    def of_link(k: Any, row: Any) -> Any:
        link = _link([Number(lanes.at(state, (joint + 1 + k) * LINK + n)) for n in range(LINK)])
        arm = tuple(x - y for x, y in zip(link.origin, origin, strict=True))
        linear = turned_back(link.rotation, add(cross(about, arm), along))
        twist = Twist(0, linear, turned_back(link.rotation, about))
        ten = ten_columns(twist, link.motion, spin_of(link.motion))
        lanes.put(row, [lanes_of(x, lanes) for x in ten])
        return row + 10

    row = lax.fori_loop(0, links, of_link, start)
    if side:
        root = lanes.read(given[0], column, 0)
        lanes.put(row, [lanes_of(lanes.read(given[1], column * side, k) * root, lanes) for k in range(side)])
