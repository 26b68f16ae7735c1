"""Answers of kernels in scalars: which programs make them, where their numbers stand, the plain kernel beside them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..compiled.batching import in_one_program
from ..compiled.kernels import Load, Number, Program, Read, Straight, Write
from .kinematics import ancestors
from .looped_kernels import Rows, looped_rows
from .model import Joint, RobotModel, dofs
from .regrouped import Kept
from .scalar_programs import accelerations, mass_entries, regressor_blocks, torques
from .scalars import Robot, constants, known, known_lengths, nothing_known

__all__ = [
    "ACCELERATIONS",
    "BLOCKS",
    "COLUMNS",
    "DENSE",
    "LIMB_TORQUES",
    "MASSES",
    "PACKED",
    "TORQUES",
    "in_limbs",
    "looped",
    "looped_blocks",
    "row_groups",
    "straight",
    "weighted_rows",
]


def columns(model: RobotModel) -> list[list[tuple[int, int]]]:
    """Columns of q, v and a (arrays 0, 1, 2) that belong to each joint, one after the other; none twice."""
    places, seen, out = model.dofs, set[tuple[int, int]](), []
    for i in range(len(model.joints)):
        moved = [int(k) for k in places.column[places.joint == i]]
        own = [(0, k) for k in range(places.positions[i].start, places.positions[i].stop)]
        own += [(array, k) for array in (1, 2) for k in moved]
        out.append([one for one in own if one not in seen])
        seen |= set(own)
    return [group for group in out if group]


def _torques(model: RobotModel, codes: bytes) -> list[Program]:
    def inverse_dynamics(load: Load, reads: list[Read], write: Write) -> None:
        q, v, a = reads[:3]
        torques(Robot(model.joints, codes, load), q, v, a, lambda row, number: write([((row,), number)]))

    return [inverse_dynamics]


LIMB = 10  # joints of which one kernel holds the torques: the numbers of more are not held by a lane's registers


@lru_cache(maxsize=64)
def _limbs(joints: tuple[Joint, ...]) -> tuple[int, ...]:
    """First joints of parts of the tree, so many joints at the most in each, those further out before others.

    None at all where the tree is one part, or where two parts share a coordinate.
    """
    size, cut = [1] * len(joints), list[int]()
    for i in reversed(range(len(joints))):
        hanging = sorted((k for k, joint in enumerate(joints) if joint.parent == i), key=lambda k: size[k])
        size[i] += sum(size[k] for k in hanging)
        while size[i] > LIMB and hanging:
            cut.append(hanging.pop())
            size[i] -= size[cut[-1]]
    cut += [i for i, joint in enumerate(joints) if joint.parent < 0]
    part = list[int]()
    for i, joint in enumerate(joints):
        part.append(i if i in cut else part[joint.parent])
    places = dofs(joints)
    shared = any(len({part[j] for j in places.joint[places.column == k]}) > 1 for k in set(places.column.tolist()))
    return () if len(cut) == 1 or shared or len(joints) <= LIMB else tuple(sorted(cut, reverse=True))


def _handed(model: RobotModel) -> dict[int, list[int]]:
    """Where the six numbers of each limb that hangs on another stand, behind the torques."""
    hanging = [i for i in _limbs(model.joints) if model.joints[i].parent >= 0]
    return {i: list(range(model.nv + 6 * n, model.nv + 6 * n + 6)) for n, i in enumerate(hanging)}


def _limb_torques(model: RobotModel, codes: bytes) -> list[Program]:
    limbs, handed = _limbs(model.joints), _handed(model)

    def of_limb(limb: int) -> Program:
        def inverse_dynamics(load: Load, reads: list[Any], write: Write) -> None:
            q, v, a, back = reads
            torques(
                Robot(model.joints, codes, load),
                *(q, v, a),
                put=lambda row, number: write([((row,), number)]),
                limbs=limbs,
                limb=limb,
                hand=lambda six: write([((k,), number) for k, number in zip(handed[limb], six, strict=True)]),
                taken=lambda child: back([(k,) for k in handed[child]]),
            )

        return inverse_dynamics

    return [of_limb(limb) for limb in limbs]


def _blocks(coordinates: bool, model: RobotModel, codes: bytes) -> list[Program]:
    """Of several kernels each holds the links of a piece of the tree, and goes to them from the world anew."""
    place = {tuple(block): k for k, block in enumerate(_rows(model, coordinates).tolist())}

    def of_links(links: list[int]) -> Program:
        def regressor(load: Load, reads: list[Read], write: Write) -> None:
            def put(row: int, link: int, ten: list[Number]) -> None:
                write([((place[row, link], k), number) for k, number in enumerate(ten)])

            q, v, a = reads[:3]
            regressor_blocks(Robot(model.joints, codes, load), q, v, a, put, links, coordinates)

        return regressor

    return [of_links(links) for links in _pieces(model)]


def _weighted_rows(side: int, kept: Kept | None, model: RobotModel, codes: bytes) -> list[Program]:
    """Of each coordinate the columns of a normal matrix: those of the links, then `side` given ones; weighed."""
    places = {key: (group, member, at) for group, member, key, at in _row_places(model.joints, kept)}
    where = {row: (group, member) for (row, _), (group, member, _) in places.items()}
    pieces, lengths = _pieces(model), _row_lengths(side, kept, model)

    def of_links(links: list[int]) -> Program:
        def weighted_rows(load: Load, reads: list[Read], write: Write) -> None:
            q, v, a, root, given = reads[:5]

            def put(row: int, link: int, own: list[Number]) -> None:
                *row_place, first = places[row, link]
                if own:
                    write([((*row_place, first + n), number * root(row)) for n, number in enumerate(own)])

            if links is pieces[0]:
                for row, (group, member) in where.items():
                    own, behind = range(row * side, (row + 1) * side), lengths[group][1] - side
                    write([((group, member, behind + n), given(k) * root(row)) for n, k in enumerate(own)])
            regressor_blocks(Robot(model.joints, codes, load), q, v, a, put, links, True, kept)

        return weighted_rows

    return [of_links(links) for links in pieces]


@lru_cache(maxsize=64)
def row_groups(joints: tuple[Joint, ...], kept: Kept | None = None) -> list[np.ndarray]:
    """Coordinates that move equally many links, of which equally many columns are `kept` (all, where not told)."""
    rows = sorted_rows(joints, True)
    width = np.full(len(joints), 10) if kept is None else np.array([len(columns) for columns in kept])
    counts = np.stack([np.bincount(rows[:, 0]), np.bincount(rows[:, 0], width[rows[:, 1]]).astype(int)], 1)
    return [np.flatnonzero((counts == one).all(1)) for one in np.unique(counts, axis=0)]


@lru_cache(maxsize=64)
def _row_places(joints: tuple[Joint, ...], kept: Kept | None) -> list[tuple[int, int, tuple[int, int], int]]:
    """Of each coordinate and link: group, place in the group, both, and where its columns begin in the row."""
    rows, out = sorted_rows(joints, True), []
    for group, members in enumerate(row_groups(joints, kept)):
        for member, row in enumerate(members.tolist()):
            at = 0
            for link in rows[rows[:, 0] == row, 1].tolist():
                out.append((group, member, (row, link), at))
                at += 10 if kept is None else len(kept[link])
    return out


def _row_lengths(side: int, kept: Kept | None, model: RobotModel) -> list[tuple[int, ...]]:
    links, rows = sorted_rows(model.joints, True), row_groups(model.joints, kept)
    own = (links[links[:, 0] == group[0], 1] for group in rows)
    width = [sum(10 if kept is None else len(kept[link]) for link in one.tolist()) for one in own]
    return [(len(group), columns + side) for group, columns in zip(rows, width, strict=True)]


def weighted_rows(side: int, kept: Kept | None, plain: Callable[..., list[Array]], piece: int = 0) -> Straight:
    """Rows (coordinates, columns, samples) of each of `row_groups`: of the links moved, then `side` given ones.

    In pieces of so many samples they are (coordinates, pieces, columns, samples), which are multiplied as they stand;
    what `plain` gives is so too.

    The arrays are q, v, a, the roots of the weights (samples, nv) and the given columns (samples, nv * side). Of the
    columns of each link those are written that are `kept`, all ten where this is not told.
    """
    name = f"rows beside {side}" + ("" if kept is None else f" of {kept}") + (f" in {piece}" if piece else "")
    form = _Form(name, partial(_weighted_rows, side, kept), partial(_row_lengths, side, kept), last=True)

    def read(model: RobotModel) -> list[list[tuple[int, int]]]:
        given = ([(4, row * side + n) for n in range(side)] for row in range(model.nv))
        return [*columns(model), *([(3, row)] for row in range(model.nv)), *(one for one in given if one)]

    whole = straight(form, plain)._replace(plain=plain, columns=read, piece=piece)
    looping = kept is None and not piece
    return whole._replace(looped=partial(_looped_weighted_rows, side)) if looping else whole


def looped(model: RobotModel) -> bool:
    """Whether rows may be written by one kernel that loops: of trees that are more than one kernel, written out.

    It is there in seconds where those take most of a minute. The public regressors stay written out, which are quicker
    once they are there (TALOS on an H100: 121 for 85 million samples a second). Rows of joints that share a coordinate
    add up, which a loop does not.
    """
    return len(_pieces(model)) > 1 and len(model.dofs.column) == model.nv


def _looped_weighted_rows(side: int, model: RobotModel, *arrays: Array) -> list[Array] | None:
    if not looped(model):
        return None
    lengths, (group, start) = _row_lengths(side, None, model), np.zeros((2, model.nv), int)
    for k, members in enumerate(row_groups(model.joints)):
        group[members], start[members] = k, lengths[k][1] * np.arange(len(members))
    column = model.dofs.column
    rows = Rows(tuple(n * length for n, length in lengths), group[column], start[column])
    found = looped_rows(model, arrays, rows, side=side)
    return [x.reshape(*shape, -1) for x, shape in zip(found, lengths, strict=True)]


def looped_blocks(model: RobotModel, *arrays: Array) -> Array | None:
    """The blocks of `BLOCKS` by a kernel that loops, of trees for which there is one."""
    if not looped(model):
        return None
    blocks, column = _rows(model, True), model.dofs.column
    start = 10 * np.searchsorted(blocks[:, 0], column)
    (found,) = looped_rows(model, arrays, Rows((10 * len(blocks),), np.zeros_like(start), start))
    return found.reshape(len(blocks), 10, -1)


def _pieces(model: RobotModel) -> list[list[int]]:
    """Links by depth first, cut where their blocks would be more than a kernel takes."""
    depth = ancestors(model.joints)[model.dofs.joint].sum(0)
    pieces, held = [[]], 0.0
    for link, blocks in enumerate(depth):
        if held and held + blocks > MOST:
            pieces, held = [*pieces, []], 0.0
        pieces[-1].append(link)
        held += blocks
    return pieces


MOST = 24  # blocks of the regressor, ten numbers each, that one kernel writes: more take long to compile


def _masses(model: RobotModel, codes: bytes) -> list[Program]:
    place = {(row, column): k for k, (row, column) in enumerate(_entries(model.joints).tolist())}

    def mass_matrix(load: Load, reads: list[Read], write: Write) -> None:
        def put(entries: dict[tuple[int, int], Number]) -> None:
            write([((place[row, column],), number) for (row, column), number in entries.items()])

        mass_entries(Robot(model.joints, codes, load), reads[0], put)

    return [mass_matrix]


def _accelerations(model: RobotModel, codes: bytes) -> list[Program]:
    def forward_dynamics(load: Load, reads: list[Read], write: Write) -> None:
        q, v, tau = reads[:3]
        accelerations(Robot(model.joints, codes, load), q, v, tau, lambda row, number: write([((row,), number)]))

    return [forward_dynamics]


def _whole_masses(model: RobotModel, entries: Array) -> Array:
    """From the entries on and below the diagonal that are not zero for every posture."""
    (row, column), nv = _entries(model.joints).T, model.nv
    source = np.full((nv, nv), len(row))  # zeros, where no entry is
    source[row, column] = source[column, row] = np.arange(len(row))
    return jnp.concatenate([entries, jnp.zeros_like(entries[:1])])[source]


@lru_cache(maxsize=64)
def _entries(joints: tuple[Joint, ...]) -> np.ndarray:
    """Row and column, not above it, of entries of the mass matrix whose coordinates move a link in common."""
    places = dofs(joints)
    moved = np.zeros((int(places.column.max(initial=-1)) + 1, len(joints)))
    np.add.at(moved, places.column, ancestors(joints)[places.joint])
    return np.argwhere(np.tril(moved @ moved.T) > 0)


def _rows(model: RobotModel, coordinates: bool) -> np.ndarray:
    """Degree of freedom, or coordinate, and link of the blocks of the regressor that can differ from zero, sorted."""
    return sorted_rows(model.joints, coordinates)


@lru_cache(maxsize=64)
def sorted_rows(joints: tuple[Joint, ...], coordinates: bool) -> np.ndarray:
    """As `_rows`, of a tree; kept, since kernels ask for it at every call."""
    places = dofs(joints)
    row = places.column if coordinates else np.arange(len(places.column))
    dof, link = np.nonzero(ancestors(joints)[places.joint] > 0)
    return np.unique(np.stack([row[dof], link], 1), axis=0)


def _dense(model: RobotModel, blocks: Array) -> Array:
    rows = _rows(model, True)
    source = np.full((model.nv, len(model.joints)), len(rows))  # zeros, where no block is
    source[tuple(rows.T)] = np.arange(len(rows))
    filled = jnp.concatenate([blocks, jnp.zeros_like(blocks[:1])])
    return filled[source].reshape(model.nv, 10 * len(model.joints), -1)


class _Form(NamedTuple):
    """Of an answer: its programs, the shape of what they write, what is made of it, whether the samples stand last.

    Without `finish` the answer is what they write. `answer` and `places` are its shape and where in it a number goes.
    """

    name: str
    programs: Callable[[RobotModel, bytes], list[Program]]
    shape: Callable[[RobotModel], Any]
    finish: Callable[[RobotModel, Array], Array] | None = None
    last: bool = False
    answer: Callable[[RobotModel], tuple[int, ...]] | None = None
    places: Callable[[RobotModel, tuple[int, ...]], list[int]] | None = None


def _dense_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    block, column = place
    row, link = sorted_rows(model.joints, True)[block]
    return [10 * (row * len(model.joints) + link) + column]


def _column_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    block, column = place
    row, link = sorted_rows(model.joints, True)[block]
    return [int((10 * link + column) * model.nv + row)]


def _mass_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    row, column = _entries(model.joints)[place[0]].tolist()
    return sorted({model.nv * row + column, model.nv * column + row})


_ANSWERS = {"rows": lambda model: (len(_rows(model, False)), 10), "blocks": lambda model: (len(_rows(model, True)), 10)}

ACCELERATIONS = _Form("accelerations", _accelerations, lambda model: (model.nv,))
TORQUES = _Form("torques", _torques, lambda model: (model.nv,))
LIMB_TORQUES = _Form(
    "torques of limbs",
    _limb_torques,
    lambda model: (model.nv + 6 * len(_handed(model)),),
    lambda model, whole: whole[: model.nv],
    answer=lambda model: (model.nv,),
)
PACKED = _Form("packed", partial(_blocks, False), _ANSWERS["rows"], last=True)
BLOCKS = _Form("blocks", partial(_blocks, True), _ANSWERS["blocks"], last=True)
DENSE = _Form(
    "dense",
    partial(_blocks, True),
    _ANSWERS["blocks"],
    _dense,
    answer=lambda model: (model.nv, 10 * len(model.joints)),
    places=_dense_places,
)
COLUMNS = _Form(
    "columns",
    partial(_blocks, True),
    _ANSWERS["blocks"],
    last=True,
    answer=lambda model: (10 * len(model.joints), model.nv),
    places=_column_places,
)
MASSES = _Form(
    "mass entries",
    _masses,
    lambda model: (len(_entries(model.joints)),),
    _whole_masses,
    answer=lambda model: (model.nv, model.nv),
    places=_mass_places,
)


def _in_order(shape: Callable[[RobotModel], tuple[int, ...]], model: RobotModel, place: tuple[int, ...]) -> list[int]:
    return [int(np.ravel_multi_index(place, shape(model)))]


def straight(
    form: _Form,
    kernel: Callable[..., Any],
    width: Callable[[RobotModel], int] = lambda model: 1,
    apart: Callable[[RobotModel], Straight | None] = lambda model: None,
) -> Straight:
    """A form beside the plain kernel with the same answers; `width` as `over_samples` takes it, `apart` as Straight."""

    def plain(model: RobotModel, *arrays: Any) -> Any:
        arrays = tuple(jnp.asarray(x) for x in arrays)
        answer = in_one_program(kernel, width(model), model, *arrays).astype(arrays[0].dtype)
        return answer if form.last else jnp.moveaxis(answer, -1, 0)

    read = columns if form is not MASSES else lambda model: [[x for x in g if x[0] == 0] for g in columns(model)]
    return Straight(
        name=form.name,
        structure=lambda model: model.joints,
        plain=plain,
        constants=constants,
        known=known,
        known_lengths=known_lengths,
        nothing_known=lambda model: nothing_known(model.joints),
        programs=form.programs,
        shape=form.shape,
        columns=read,
        last=form.last,
        finish=form.finish,
        answer=form.answer or form.shape,
        places=form.places or partial(_in_order, form.shape),
        apart=apart,
    )


def in_limbs(model: RobotModel) -> bool:
    """Whether the tree is too large for one kernel, and falls into limbs."""
    return bool(_limbs(model.joints))
