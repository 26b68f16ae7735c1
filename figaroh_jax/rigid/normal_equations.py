"""The regressor condensed while it is formed: memory that does not grow with the number of samples.

All rows of a recording go into the normal matrix of `[W extra tau]`, or into its triangular factor where the condition
number may not be squared. Both add up over pieces of the data: the answer for earlier pieces goes in as `total`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.batching import BLOCK, CPU_OPTIONS, chunk_size, in_chunks, on_host, reused, traced, two_axes
from ..compiled.executable_cache import Program
from ..compiled.kernels import Straight, kept_here, known_codes, rounded, straight_answers, usable
from ..compiled.machine_code import machine_code
from ..compiled.precision import in_float64
from ..errors import InputError, check_real
from .kinematics import check_shapes
from .model import Joint, RobotModel
from .regressor import BLOCK_FORM, coordinate_blocks, coordinate_rows, dense_rows
from .regrouped import Kept, kept_columns, orderly, regrouping
from .scalar_forms import looped, row_groups, weighted_rows

__all__ = ["NormalMatrix", "normal_matrix", "triangular_factor"]

SMALL = 160  # columns of a normal matrix
PANEL = 16  # columns that a QR factorisation takes together
AT_ONCE = 512  # samples of a product on a CPU, by machine code
TOGETHER = 1024  # samples of a product on a GPU
WORTH_WRITING = 1 << 16  # samples from which rows of a large tree are written out by kernels of their own
DEVICE_BYTES = 2e9  # of the blocks of a chunk on a GPU


class NormalMatrix(NamedTuple):
    """Sums over all rows of the regressor, `[W extra]' weight [W extra tau]` and tau' weight tau."""

    matrix: Float[Array, "columns columns"]
    moment: Float[Array, " columns"]
    square: Float[Array, ""]


@in_float64
def normal_matrix(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
    tau: Float[ArrayLike, "*batch nv"],
    weight: Float[ArrayLike, "..."] | None = None,
    extra: Float[ArrayLike, "*batch nv k"] | None = None,
    total: NormalMatrix | None = None,
) -> NormalMatrix:
    """Normal matrix G = W' weight W, b = W' weight tau and tau' weight tau, in float64.

    `weight` is an inverse variance (`(nv,)` or `(*batch, nv)`, not negative, 1 where left out); `extra` are columns
    that follow those of `joint_torque_regressor`, for friction and the like; `total` is the answer for earlier pieces
    of the data. Each coordinate's rows enter with the columns of the links that it moves alone, in batches of equally
    many. Raises `InputError` where the shapes do not fit.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a, tau = np.random.default_rng(0).normal(size=(4, 50, robot.nv))
    >>> fj.normal_matrix(robot, q, v, a, tau)[0].shape
    (40, 40)
    """
    rows = _rows(model, q, v, a, tau, weight, extra)
    beside = (0 if extra is None else np.shape(extra)[-1]) + 1
    columns, on_gpu = 10 * len(model.joints) + beside, usable(*rows) and len(rows.q) > 0
    kept = _kept(model, len(rows.q)) if on_gpu else None
    groups = _groups(model, columns) if not on_gpu else _kept_groups(model.joints, kept, beside)
    columns = columns if kept is None else sum(map(len, kept)) + beside
    parts = _by_machine_code(model, groups, rows) if on_host(model, rows) else None
    if on_gpu:
        parts = _by_kernels(_with_products, model, kept, rows)
    if parts is None:
        library: Any = np if on_host(model, rows) else jnp
        start = tuple(library.zeros((len(g.blocks), g.columns.shape[1], g.columns.shape[1])) for g in groups)
        # a small matrix is added to from the innermost cache; a large one costs more to add to than its rows to make
        chunk = 32 if on_host() and columns <= SMALL else chunk_size()
        parts = _fold(_add_products, chunk, start, model, rows)
    if kept is not None and on_gpu and kept_here(*parts) and not traced(model, parts):
        new = NormalMatrix(*_kept_whole(model.joints, kept, beside)(regrouping(model, kept), parts))
    else:
        new = _scattered(columns, np.concatenate([_flat(group, columns).ravel() for group in groups]), parts)
        new = new if kept is None else _regrouped(regrouping(model, kept), new)
    return new if total is None else NormalMatrix(*(x + y for x, y in zip(total, new, strict=True)))


@in_float64
def triangular_factor(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
    tau: Float[ArrayLike, "*batch nv"] | None = None,
    weight: Float[ArrayLike, "..."] | None = None,
    extra: Float[ArrayLike, "*batch nv k"] | None = None,
    total: Float[Array, "columns columns"] | None = None,
) -> Float[Array, "columns columns"]:
    """Upper triangular R, diagonal not negative, with R'R = A' weight A for A = [W extra tau], in float64.

    Rank, conditioning and least squares follow from R as from A, without the squared condition number of
    `normal_matrix`, whose arguments these are. One small QR factorisation a chunk, on top of the R so far (TSQR;
    Demmel, Grigori, Hoemmen and Langou, 2012); on a GPU from products, twice (`_with_factor`). Without `tau` its column
    is left out.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a, tau = np.random.default_rng(0).normal(size=(4, 50, robot.nv))
    >>> fj.triangular_factor(robot, q, v, a, tau).shape
    (41, 41)
    """
    rows = _rows(model, q, v, a, tau, weight, extra)
    columns = 10 * len(model.joints) + sum(np.shape(x)[-1] for x in (extra,) if x is not None) + (tau is not None)
    start = jnp.zeros((columns, columns)) if total is None else jnp.asarray(total, jnp.float64)
    if on_host(model, rows, start) and (own := _factor_by_machine_code(model, columns, rows)) is not None:
        whole = np.concatenate([np.asarray(start), own])
        return _upright(jnp.asarray(np.linalg.qr(whole, mode="r")))
    if usable(*rows) and len(rows.q) > 0:
        return _upright(_joined(start, _factor_by_kernels(model, columns, rows)))
    return _upright(_fold(_add_rows, 2 * chunk_size(), start, model, rows))


@jax.jit
def _upright(factor: Float[Array, "columns columns"]) -> Float[Array, "columns columns"]:
    return factor * jnp.where(jnp.diagonal(factor) < 0.0, -1.0, 1.0)[:, None]


class _Rows(NamedTuple):
    """What the rows are made of, as (samples, nv) or, for `extra`, (samples, nv * k); `root` is sqrt(weight)."""

    q: Any
    v: Any
    a: Any
    root: Any
    tau: Any | None
    extra: Any | None


def _rows(
    model: RobotModel,
    q: ArrayLike,
    v: ArrayLike,
    a: ArrayLike,
    tau: ArrayLike | None,
    weight: ArrayLike | None,
    extra: ArrayLike | None,
) -> _Rows:
    given = {"q": q, "v": v, "a": a} | ({} if tau is None else {"tau": tau})
    check_shapes(model, **given)
    for name, x in (("weight", weight), ("extra", extra)):
        if x is not None:
            check_real(name, x)
    shape = (*np.shape(q)[:-1], model.nv)
    if extra is not None and np.shape(extra)[:-1] != shape:
        raise InputError(f"extra has shape {np.shape(extra)}; expected {(*shape, 'columns')}, a row for each torque")
    if weight is not None and np.shape(weight) not in ((), shape[-1:], shape):
        raise InputError(f"weight has shape {np.shape(weight)}; expected {shape[-1:]} or {shape}")
    host = on_host(model, q, v, a, tau, weight, extra)
    library: Any = np if host else jnp
    root = library.broadcast_to(library.sqrt(library.asarray(1.0 if weight is None else weight, float)), shape)
    if extra is not None:
        extra = library.reshape(library.asarray(extra, float), (*shape[:-1], -1))
    given = (q, v, a, root, tau, extra)
    return _Rows(*(None if x is None else two_axes(x, host=host)[0] for x in given))


def _fold(step: Callable[..., Any], chunk: int, total: Any, model: RobotModel, rows: _Rows) -> Any:
    """All rows, a chunk at a time, by `total = step(model, total, chunk of rows)`; filled-up rows have weight zero."""
    if traced(model, total, rows):
        return _fold_chunks(step, total, model, _cut(rows, chunk))
    program = _host_program if on_host() else _device_program
    samples = len(rows.q)
    chunks = 1 if samples <= chunk else max(8, BLOCK // chunk)
    for start in range(0, samples, chunk * chunks):
        piece = jax.tree.map(lambda x: x[start : start + chunk * chunks], rows)  # noqa: B023
        total = program(step, total, model, _cut(piece, chunk, chunks))
    return total


def _cut(rows: _Rows, chunk: int, chunks: int = 0) -> _Rows:
    """Rows in chunks, the samples last in each; what fills the last one up weighs nothing."""
    cut = jax.tree.map(lambda x: in_chunks(x, chunk, chunks), rows)
    there = np.arange(cut.root.shape[0] * chunk).reshape(-1, 1, chunk) < len(rows.q)
    return cut._replace(root=cut.root * there)


def _fold_chunks(step: Callable[..., Any], total: Any, model: RobotModel, rows: _Rows) -> Any:
    return jax.lax.scan(lambda total, rows: (step(model, total, rows), None), total, rows)[0]


_device_program = jax.jit(_fold_chunks, static_argnums=0)
_host_program = Program(_fold_chunks, static=1, options=CPU_OPTIONS)


class _Group(NamedTuple):
    """Coordinates that move equally many links: their blocks (n, links), their columns of [W extra tau] (n, ...)."""

    coordinates: np.ndarray
    blocks: np.ndarray
    columns: np.ndarray


def _groups(model: RobotModel, columns: int) -> list[_Group]:
    blocks, _ = coordinate_blocks(model.joints)
    members = [np.flatnonzero(blocks[:, 0] == coordinate) for coordinate in range(model.nv)]
    groups = []
    for which in row_groups(model.joints):
        index = np.stack([members[k] for k in which])
        # the columns of mass and first moments of all links before those of their inertia, as the kernel gives them
        first = 10 * blocks[index, 1][..., None]
        own = np.concatenate([(first + np.arange(*ends)).reshape(len(which), -1) for ends in ((0, 4), (4, 10))], axis=1)
        shared = np.broadcast_to(
            np.arange(10 * len(model.joints), columns), (len(which), columns - 10 * len(model.joints))
        )
        groups.append(_Group(which, index, np.concatenate([own, shared], axis=1)))
    return groups


@lru_cache(maxsize=64)
def _kept_groups(joints: tuple[Joint, ...], kept: Kept | None, beside: int) -> list[_Group]:
    """As kernels of a GPU write them: the kept columns in the order of the regressor, then those beside."""
    blocks, _ = coordinate_blocks(joints)
    ends = np.cumsum([0, *([10] * len(joints) if kept is None else map(len, kept))]).tolist()
    groups = []
    for which in row_groups(joints, kept):
        index = np.stack([np.flatnonzero(blocks[:, 0] == k) for k in which])
        own = [
            np.concatenate([*(np.arange(ends[link], ends[link + 1]) for link in links), ends[-1] + np.arange(beside)])
            for links in blocks[index, 1].tolist()
        ]
        groups.append(_Group(which, index, np.stack(own)))
    return groups


def _kept(model: RobotModel, samples: int) -> Kept | None:
    """Columns that are computed on a GPU, where the robot is known and its kernels leave much out; None for all.

    Of a large tree few samples are taken by the one kernel that loops, which is compiled in a third of the time.
    """
    codes = known_codes(_row_form(0, None), model)
    if traced(model) or (looped(model) and (samples < WORTH_WRITING or not orderly(model.joints, codes))):
        return None
    return kept_columns(model.joints, codes)


@jax.jit
def _regrouped(whole: Float[Array, "kept columns"], found: NormalMatrix) -> NormalMatrix:
    """Of all columns from those that were kept; those beside them follow."""
    matrix, moment, n = found.matrix, found.moment, whole.shape[0]
    times = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    rows = jnp.concatenate([times(whole.T, matrix[:n]), matrix[n:]])
    rows = jnp.concatenate([times(rows[:, :n], whole), rows[:, n:]], axis=1)
    return NormalMatrix(rows, jnp.concatenate([times(whole.T, moment[:n]), moment[n:]]), found.square)


def _flat(group: _Group, columns: int) -> np.ndarray:
    """Places of the group's products in the flattened normal matrix."""
    return columns * group.columns[:, :, None] + group.columns[:, None, :]


@partial(jax.jit, static_argnums=0)
def _scattered(columns: int, index: Array, parts: tuple[Array, ...]) -> NormalMatrix:
    values = jnp.concatenate([part.reshape(-1) for part in parts])
    whole = jnp.zeros(columns * columns).at[index].add(values).reshape(columns, columns)
    return NormalMatrix(whole[:-1, :-1], whole[:-1, -1], whole[-1, -1])


@lru_cache(maxsize=64)
def _kept_whole(joints: tuple[Joint, ...], kept: Kept, beside: int) -> Program:
    def whole_matrix(links: Float[Array, "kept links"], parts: tuple[Array, ...]) -> tuple[Array, ...]:
        columns = sum(map(len, kept)) + beside
        index = np.concatenate([_flat(group, columns).ravel() for group in _kept_groups(joints, kept, beside)])
        return tuple(_regrouped(links, _scattered(columns, index, parts)))

    return Program(whole_matrix, key=f"{joints} {kept} {beside}", tuning=0)  # two small products: not worth a search


def _add_products(model: RobotModel, totals: tuple[Array, ...], rows: _Rows) -> tuple[Array, ...]:
    samples = rows.q.shape[-1]
    pieces = coordinate_rows(model, rows.q, rows.v, rows.a)
    side = _beside(model, rows)
    columns = 10 * len(model.joints) + side.shape[1]
    new = []
    for total, group in zip(totals, _groups(model, columns), strict=True):
        own = [x[group.blocks].reshape(len(group.coordinates), -1, samples) for x in pieces]
        both = jnp.concatenate([*own, side[group.coordinates]], axis=1) * rows.root[group.coordinates, None]
        new.append(total + row_products(both))
    return tuple(new)


Add = Callable[[Array, Array], Array]  # of a sum or factor so far (c, k, k) and more rows of each coordinate


def _by_kernels(add: Add, model: RobotModel, kept: Kept | None, rows: _Rows) -> tuple[Array, ...]:
    """The products, or factors, of each coordinate on a GPU, from rows that a kernel writes as they are multiplied."""
    samples, nv = len(rows.q), model.nv
    # no empty array of so many rows: XLA takes seconds to make its program, and as long to read it again
    given = [jnp.asarray(x).reshape(samples, nv, -1) for x in (rows.extra, rows.tau) if x is not None]
    side = jnp.concatenate(given, axis=2).reshape(samples, -1)
    whole = rounded(samples)
    arrays = [jnp.asarray(x) for x in (rows.q, rows.v, rows.a, rows.root, side)]
    if whole > samples:
        modes = ("edge", "edge", "edge", "constant", "edge")
        arrays = [jnp.pad(x, ((0, whole - samples), (0, 0)), mode=m) for x, m in zip(arrays, modes, strict=True)]
    told = add, kept, known_codes(_row_form(0, kept), model), min(whole, _rows_at_once(model))
    if traced(model, arrays):
        return _sums_of_rows(*told, model, *arrays)
    return (_kept_sums(*told) if kept_here(*arrays) else partial(_program_of_sums, *told))(model, *arrays)


@lru_cache(maxsize=64)
def _kept_sums(add: Add, kept: Kept | None, codes: bytes, chunk: int) -> Program:
    def sums_of_rows(model: RobotModel, *arrays: Array) -> tuple[Array, ...]:
        return _sums_of_rows(add, kept, codes, chunk, model, *arrays)

    key = f"{add.__name__} {kept} {chunk} {codes.hex()}"
    # the best ways to products save half of a call's time; of few samples they are not worth the seconds of a search,
    # and for factors solves decide
    searched = add is _with_products and chunk >= WORTH_WRITING
    return Program(sums_of_rows, key=key, tuning=None if searched else 0)


def _sums_of_rows(
    add: Add,
    kept: Kept | None,
    codes: bytes,
    chunk: int,
    model: RobotModel,
    *arrays: Float[Array, "samples _"],
) -> tuple[Array, ...]:
    # XLA would copy the rows of several coordinates, the samples last, before it multiplies them in pieces
    piece = 0 if kept is None else min(TOGETHER, chunk & -chunk)
    beside = arrays[4].shape[1] // model.nv
    form = _row_form(beside, kept, piece)
    groups = _kept_groups(model.joints, kept, beside)
    start = tuple(jnp.zeros((len(g.blocks), g.columns.shape[1], g.columns.shape[1])) for g in groups)
    chunks = [x.reshape(-1, chunk, x.shape[1]) for x in arrays]

    def step(total: tuple[Array, ...], arrays: list[Array]) -> tuple[tuple[Array, ...], None]:
        rows = straight_answers(form, model, *arrays, codes=codes)
        return tuple(add(x, one) for x, one in zip(total, rows, strict=True)), None

    return jax.lax.scan(step, start, chunks)[0] if len(arrays[0]) else start


_program_of_sums = jax.jit(_sums_of_rows, static_argnums=(0, 1, 2, 3))


@lru_cache(maxsize=16)
def _row_form(side: int, kept: Kept | None, piece: int = 0) -> Straight:
    return weighted_rows(side, kept, partial(_plain_rows, side, kept, piece), piece)


def _plain_rows(
    side: int, kept: Kept | None, piece: int, model: RobotModel, q: Any, v: Any, a: Any, root: Any, given: Any
) -> list[Array]:
    blocks, samples = jnp.concatenate(coordinate_rows(model, q.T, v.T, a.T), axis=1).reshape(-1, len(q)), len(q)
    order = coordinate_blocks(model.joints)[0]
    beside = given.T.reshape(model.nv, side, samples)
    parts = []
    for row in range(model.nv):
        own = ((k, order[k, 1]) for k in np.flatnonzero(order[:, 0] == row).tolist())
        index = [10 * k + c for k, link in own for c in (range(10) if kept is None else kept[link])]
        parts.append(jnp.concatenate([blocks[np.array(index, int)], beside[row]]))
    groups = [jnp.stack([parts[row] * root[:, row] for row in group]) for group in row_groups(model.joints, kept)]
    return [jnp.moveaxis(x.reshape(*x.shape[:2], -1, piece), 2, 1) for x in groups] if piece else groups


def _with_products(total: Float[Array, "c k k"], rows: Float[Array, "c *pieces k samples"]) -> Float[Array, "c k k"]:
    return total + _products(rows)


def _with_factor(total: Float[Array, "c k k"], rows: Float[Array, "c *pieces k samples"]) -> Float[Array, "c k k"]:
    """R of [R so far; rows], samples last, by Cholesky factors of the products, twice (CholeskyQR2).

    The first factor makes the columns nearly orthogonal, and products of what it leaves do not lose what is small:
    shifted by a little where columns depend on others (Fukaya, Kannan, Nakatsukasa, Yamamoto and Yanagisawa, 2020).
    """
    before = jnp.swapaxes(total, 1, 2)  # rows so far, as the others
    first = _shifted_factor(row_products(before) + _products(rows), SHIFTS[0])
    before, rows = _divided(before, first), _divided(rows, first)
    second = _shifted_factor(row_products(before) + _products(rows), SHIFTS[1])
    return jnp.matmul(second, first, precision=jax.lax.Precision.HIGHEST)


SHIFTS = (4e-15, 4e-16)  # times the number of columns, of products of columns of length one


def _shifted_factor(products: Float[Array, "c k k"], shift: float) -> Float[Array, "c k k"]:
    """R of R'R = products, and a little more on the diagonal."""
    length = jnp.sqrt(jnp.maximum(jnp.diagonal(products, axis1=1, axis2=2), 1e-200))
    count = products.shape[1]
    unit = products / (length[:, :, None] * length[:, None, :]) + shift * count * jnp.eye(count)
    return jnp.swapaxes(jnp.linalg.cholesky(unit), 1, 2) * length[:, None, :]


def _divided(rows: Float[Array, "c *pieces k samples"], factor: Float[Array, "c k k"]) -> Array:
    """R'^-1 rows: the columns divided by R."""
    wide = jnp.broadcast_to(factor[:, None] if rows.ndim > 3 else factor, (*rows.shape[:-1], rows.shape[-2]))
    return jax.lax.linalg.triangular_solve(wide, rows, left_side=True, lower=False, transpose_a=True)


def _factor_by_kernels(model: RobotModel, columns: int, rows: _Rows) -> Float[Array, "rows columns"]:
    """Rows with the same products as those of the regressor: a triangular factor of each coordinate's own columns."""
    kept, beside = _kept(model, len(rows.q)), columns - 10 * len(model.joints)
    if not beside:  # kernels write at least one column beside those of the links
        return _factor_by_kernels(model, columns + 1, rows._replace(tau=jnp.zeros_like(rows.v)))[:, :-1]
    groups = _kept_groups(model.joints, kept, beside)
    parts = _by_kernels(_with_factor, model, kept, rows)
    few = columns if kept is None else sum(map(len, kept)) + beside
    links = None if kept is None else regrouping(model, kept)
    return _spread(few, links, tuple(g.columns for g in groups), parts)


@partial(jax.jit, static_argnums=0)
def _spread(
    columns: int, links: Float[Array, "kept links"] | None, places: tuple[Array, ...], parts: tuple[Array, ...]
) -> Float[Array, "rows _"]:
    """Each factor in its own columns of all, one below the other; of all links from those that were kept."""
    rows = []
    for place, own in zip(places, parts, strict=True):
        one, row = np.arange(own.shape[0])[:, None, None], np.arange(own.shape[1])[:, None]
        rows.append(jnp.zeros((*own.shape[:2], columns)).at[one, row, place[:, None]].set(own).reshape(-1, columns))
    whole = jnp.concatenate(rows)
    if links is None:
        return whole
    ours = jnp.matmul(whole[:, : len(links)], links, precision=jax.lax.Precision.HIGHEST)
    return jnp.concatenate([ours, whole[:, len(links) :]], axis=1)


@jax.jit
def _joined(one: Float[Array, "m columns"], other: Float[Array, "n columns"]) -> Float[Array, "columns columns"]:
    return jnp.linalg.qr(jnp.concatenate([one, other]), mode="r")


def _products(rows: Float[Array, "c *pieces k samples"]) -> Float[Array, "c k k"]:
    return piece_products(rows) if rows.ndim > 3 else row_products(rows)


def piece_products(rows: Float[Array, "c pieces k samples"]) -> Float[Array, "c k k"]:
    """rows rows', for each c."""
    return jnp.einsum("cpks,cpls->cpkl", rows, rows, precision=jax.lax.Precision.HIGHEST).sum(1)


def row_products(rows: Float[Array, "c k samples"]) -> Float[Array, "c k k"]:
    """rows rows', for each c; on a GPU of pieces side by side, as one long product leaves most of it idle."""
    pieces = max(1, rows.shape[-1] // TOGETHER) if usable() and rows.shape[-1] % TOGETHER == 0 else 1
    cut = rows.reshape(*rows.shape[:-1], pieces, -1)
    return jnp.einsum("ckps,clps->pckl", cut, cut, precision=jax.lax.Precision.HIGHEST).sum(0)


def _rows_at_once(model: RobotModel) -> int:
    """Samples to a chunk on a GPU, whose products are the quicker the more rows they sum."""
    blocks, _ = coordinate_blocks(model.joints)
    return 1 << min(20, int(np.log2(DEVICE_BYTES / 80 / len(blocks))))


def _by_machine_code(model: RobotModel, groups: Sequence[_Group], rows: _Rows) -> tuple[np.ndarray, ...] | None:
    """The groups' products from blocks that machine code makes; None where there is none for these rows."""
    code = machine_code(BLOCK_FORM, model, rows.q, rows.v, rows.a)
    if code is None:
        return None
    totals = [np.zeros((len(g.coordinates), g.columns.shape[1], g.columns.shape[1])) for g in groups]
    for group, k, both in _coded_rows(code, model, groups, rows):
        totals[group][k] += both @ both.T
    return tuple(totals)


def _factor_by_machine_code(model: RobotModel, columns: int, rows: _Rows) -> Float[np.ndarray, "rows columns"] | None:
    """Rows with the same products as those of the regressor, from a triangular factor of each coordinate's own columns.

    A piece goes onto a factor by a QR factorisation that knows of its zeros (LAPACK's tpqrt).
    """
    code = machine_code(BLOCK_FORM, model, rows.q, rows.v, rows.a)
    if code is None:
        return None
    from scipy.linalg.lapack import dtpqrt  # pyright: ignore[reportAttributeAccessIssue]  (scipy is slow to import)

    groups = _groups(model, columns)
    factors = [[np.zeros((g.columns.shape[1],) * 2, order="F") for _ in g.coordinates] for g in groups]
    for group, k, both in _coded_rows(code, model, groups, rows):
        factors[group][k] = dtpqrt(0, min(PANEL, len(both)), factors[group][k], both.T, overwrite_a=1, overwrite_b=1)[0]
    parts = []
    for group, own in zip(groups, factors, strict=True):
        for place, factor in zip(group.columns, own, strict=True):
            parts.append(np.zeros((len(factor), columns)))
            parts[-1][:, place] = factor
    return np.concatenate(parts)


def _coded_rows(
    code: Callable[..., np.ndarray], model: RobotModel, groups: Sequence[_Group], rows: _Rows
) -> Iterator[tuple[int, int, Float[np.ndarray, "columns samples"]]]:
    """Weighted rows of each coordinate, a piece of the samples at a time: group, place in it, and columns by samples.

    The next one may overwrite them.
    """
    samples, room = len(rows.q), reused()
    given = [x for x in (rows.extra, rows.tau) if x is not None]
    side = np.concatenate([np.zeros((model.nv, 0, samples)), *(_by_coordinate(x, model.nv) for x in given)], axis=1)
    for start in range(0, samples, AT_ONCE):
        piece = slice(max(0, min(start, samples - AT_ONCE)), min(start + AT_ONCE, samples))
        blocks = code(room, *(x[piece] for x in (rows.q, rows.v, rows.a)))
        root = np.array(rows.root[piece].T)
        root[:, : start - piece.start] = 0.0  # what the piece before has had
        for number, group in enumerate(groups):
            both = np.empty((group.columns.shape[1], blocks.shape[2]))
            for k, (coordinate, links) in enumerate(zip(group.coordinates, group.blocks, strict=True)):
                own, first = blocks[links[0] : links[0] + len(links)], 4 * len(links)  # they stand side by side
                np.multiply(own[:, :4], root[coordinate], out=both[:first].reshape(*own[:, :4].shape))
                np.multiply(own[:, 4:], root[coordinate], out=both[first : 10 * len(links)].reshape(*own[:, 4:].shape))
                np.multiply(side[coordinate, :, piece], root[coordinate], out=both[10 * len(links) :])
                yield number, k, both


def _by_coordinate(x: np.ndarray, coordinates: int) -> Float[np.ndarray, "nv k samples"]:
    return np.moveaxis(np.asarray(x).reshape(len(x), coordinates, -1), 0, -1)


def _add_rows(model: RobotModel, total: Array, rows: _Rows) -> Array:
    """R of [R so far; rows]."""
    dense = dense_rows(model, rows.q, rows.v, rows.a)
    both = jnp.concatenate([dense, _beside(model, rows)], axis=1) * rows.root[:, None]
    return jnp.linalg.qr(jnp.concatenate([total, jnp.moveaxis(both, 1, 2).reshape(-1, both.shape[1])]), mode="r")


def _beside(model: RobotModel, rows: _Rows) -> Float[Array, "nv k samples"]:
    """Columns of [extra tau]."""
    samples = rows.q.shape[-1]
    parts = [x.reshape(model.nv, -1, samples) for x in (rows.extra, rows.tau) if x is not None]
    return jnp.concatenate([jnp.zeros((model.nv, 0, samples), rows.q.dtype), *parts], axis=1)
