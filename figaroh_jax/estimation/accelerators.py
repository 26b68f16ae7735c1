"""States condensed on devices: one accelerator or several, and batches of robots or trajectories in one program.

A QR factorisation of every chunk, which `regression.condense` makes on the host, is slow on an accelerator; products
are not, but they square the condition number. So the rows of each joint are first brought to coordinates in which they
are well conditioned, Z = X R^-1 with those of the joint's columns X that are independent in its own rows and R their
triangular factor at random states: the products of Z lose next to nothing (as the second pass of CholeskyQR2; Yamamoto
and others, 2015), and all columns of the joint are Z R B with the matrix B of its rows' base parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from ..compiled.batching import CPU_OPTIONS, program, reused
from ..compiled.machine_code import machine_code
from ..compiled.precision import in_float64
from ..effects.base import Effect
from ..errors import InputError
from ..rigid.model import RobotModel
from ..rigid.normal_equations import row_products
from ..rigid.regressor import BLOCK_FORM, block_codes, block_rows, coordinate_blocks, dense_rows
from .base_parameters import BaseParameters
from .columns import term_columns, term_places, term_rows
from .regression import FOLDS, Condensed
from .states import OwnFrame, States, check_piece

__all__ = ["BatchFit", "Coordinates", "condense_on_devices", "conditioned_rows", "coordinates", "fit_states"]

HOST_CHUNK = 128  # samples whose rows stay in the processor's cache
CODE_CHUNK = 512  # the same where machine code makes them
TERMS_CHUNK = 4096  # samples of which the columns of friction and the like are computed at once beside machine code
DEVICE_BYTES = 8e9  # of the rows of a chunk on an accelerator, at the most
BESIDE = 32  # columns to a multiple of which a joint's rows are filled up on a device, so that few products serve all
CLIPPED = 1e-13  # share of a joint's products that is rounding: what they say of smaller ones is left out


class Coordinates(NamedTuple):
    """Rows of all columns are `rows @ into` in the well-conditioned coordinates, and from there `z @ back` again."""

    into: Float[np.ndarray, "columns rank"]
    back: Float[np.ndarray, "rank columns"]


class _Group(NamedTuple):
    """Joints whose rows are filled up to equally many: where these stand among all rows, and their coordinates."""

    joints: Int[np.ndarray, " joints"]
    places: Int[np.ndarray, "joints k"]
    into: Float[np.ndarray, "joints k k"]


class _Sums(NamedTuple):
    """What is added up over the samples, for each fold and joint: products of [Z tau], by group; rows and torque."""

    products: tuple[Any, ...]
    rows: Any
    torque: Any


class BatchFit(NamedTuple):
    """Least squares on the kept columns."""

    parameters: Float[Array, " kept"]
    std: Float[Array, " kept"]  # for white residuals, each joint weighed by its own
    rms: Float[Array, " nv"]  # of the residual, N m or N


def coordinates(structure: Float[np.ndarray, "samples nv columns"], base: BaseParameters) -> Coordinates:
    """Coordinates in which the columns at the random states `structure` are orthonormal.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> base = fj.states.States(robot, lambda: [], ()).structural
    >>> fj.accelerators.coordinates(fj.columns.structural_columns(robot, ()), base).into.shape == (40, base.rank)
    True
    """
    kept = structure[:, :, base.independent].reshape(-1, base.rank)
    R = np.linalg.qr(kept, mode="r")
    into = np.zeros((structure.shape[2], base.rank))
    into[base.independent] = np.linalg.inv(R)
    return Coordinates(into, R @ base.matrix)


def condense_on_devices(
    states: States, devices: Sequence[Any] | None = None, folds: int = FOLDS, chunk: int | None = None
) -> Condensed:
    """`condense(states, states.used)`, the samples of every piece spread over `devices` (default: all of this host).

    Each device forms the rows of its own samples, `chunk` at a time, and sums their products; the sums of the devices
    are added at the end, on the host. Pieces of one length share a program; the source is read while the devices work.
    A single CPU takes machine code for the rows of long pieces, where there is some. A direction in which the rows are
    less than 3e-7 of the strongest one's is taken as not shown. Folds are whole chunks in turn. Raises `InputError`
    where a piece has a wrong shape or holds a number that is not finite. An accelerator is busy with pieces of 1e5
    samples and more.

    Where `jax.distributed` runs, each process takes the pieces that its own source gives, however many, on the devices
    of its host; the sums of all are added once at the end, and every process gets the same answer.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 300)
    >>> states = fj.states.States(robot, lambda: [(q, v, a, np.asarray(fj.inverse_dynamics(robot, q, v, a)))], ())
    >>> data = fj.accelerators.condense_on_devices(states)
    >>> found = fj.least_squares.solve(data, kept=states.structural.independent)
    >>> bool(found.rms.max() < 1e-3)  # N m
    True
    """
    mesh = Mesh(np.array(list(devices or jax.local_devices())), ("samples",))
    frames = states.frames
    on_one_cpu = mesh.size == 1 and mesh.devices.flat[0].platform == "cpu" and jax.default_backend() == "cpu"
    with jax.enable_x64(True):
        sums = _summed_by_code(states, frames, folds) if on_one_cpu and chunk is None else None
        sums = sums or _summed(states, frames, mesh, folds, chunk)
        sums = _of_all_processes(sums) if jax.process_count() > 1 else sums
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(sums)):
        for number, part in enumerate(states.source()):
            check_piece(states.model, part, number)
        raise InputError("the rows of the states are not finite: numbers too large, or a model that moves no mass")
    return _condensed(states, frames, sums)


def fit_states(
    model: RobotModel,
    terms: tuple[Effect, ...],
    into: Float[Array, "columns rank"],
    q: Float[Array, "samples nq"],
    v: Float[Array, "samples nv"],
    a: Float[Array, "samples nv"],
    tau: Float[Array, "samples nv"],
) -> BatchFit:
    """Base parameters weighed by joint, as one function of arrays: `jax.vmap` it over robots or over trajectories.

    `into` (of `coordinates`, for one robot of the batch) names the kept columns by its rows that are not zero, and
    keeps the products well conditioned; states in rad, m, N m, N. Two solves: the second with the inverse mean squared
    residual of each joint as its weight. To be called where 64-bit JAX is on.

    >>> import jax, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> base = fj.states.States(robot, lambda: [], ()).structural
    >>> into = fj.accelerators.coordinates(fj.columns.structural_columns(robot, ()), base).into
    >>> with jax.enable_x64(True):
    ...     q, v, a = map(jax.numpy.asarray, fj.columns.random_states(robot, 300))
    ...     found = fj.accelerators.fit_states(robot, (), into, q, v, a, fj.inverse_dynamics(robot, q, v, a))
    ...     bool(found.rms.max() < 1e-6)  # N m
    True
    """
    Z, y = conditioned_rows(model, terms, jnp.zeros(model.nv), into, q, v, a, tau)
    rows = Z.shape[-1]
    G, b = jnp.einsum("jks,jls->jkl", Z, Z), jnp.einsum("jks,js->jk", Z, y)
    theta = jnp.linalg.solve(G.sum(0), b.sum(0))
    weight = rows / jnp.maximum(jnp.sum((y - jnp.einsum("jks,k->js", Z, theta)) ** 2, axis=1), 1e-300)
    A = jnp.einsum("jkl,j->kl", G, weight)
    theta = jnp.linalg.solve(A, jnp.einsum("jk,j->k", b, weight))
    rms = jnp.sqrt(jnp.mean((y - jnp.einsum("jks,k->js", Z, theta)) ** 2, axis=1))
    variance = jnp.einsum("ck,ck->c", into @ jnp.linalg.inv(A), into)
    return BatchFit(into @ theta, jnp.sqrt(variance), rms)


def _places(model: RobotModel, terms: tuple[Effect, ...]) -> tuple[Int[np.ndarray, "nv columns"], int]:
    """Where the rows of each coordinate and column stand among all that can differ from zero, -1 elsewhere; how many.

    Those of the links are first, block by block, then those of `term_rows`.
    """
    blocks, beside = coordinate_blocks(model.joints)[0], term_places(model, terms)
    links = 10 * len(model.joints)
    out = np.full((model.nv, links + max(beside[:, 1], default=-1) + 1), -1)
    for k in range(10):
        out[blocks[:, 0], 10 * blocks[:, 1] + k] = 10 * np.arange(len(blocks)) + k
    out[beside[:, 0], links + beside[:, 1]] = 10 * len(blocks) + np.arange(len(beside))
    return out, 10 * len(blocks) + len(beside)


def _grouped(model: RobotModel, terms: tuple[Effect, ...], frames: Sequence[OwnFrame]) -> list[_Group]:
    """Joints by the number of their rows, filled up to a multiple; behind all rows stand the torques and one zero."""
    places, count = _places(model, terms)
    widths = [-(-(len(frame.kept) + 1) // BESIDE) * BESIDE for frame in frames]
    groups = []
    for width in sorted(set(widths)):
        joints = np.array([j for j, w in enumerate(widths) if w == width], int)
        index, into = np.full((len(joints), width), count + model.nv), np.zeros((len(joints), width, width))
        for n, j in enumerate(joints):
            rank = len(frames[j].kept)
            index[n, : rank + 1] = [*places[j, frames[j].kept], count + j]
            into[n, :rank, :rank], into[n, rank, rank] = frames[j].into, 1.0
        groups.append(_Group(joints, index, into))
    return groups


def _summed(states: States, frames: Sequence[OwnFrame], mesh: Mesh, folds: int, chunk: int | None) -> _Sums:
    """Sums of all pieces by programs of JAX, one for each device: none waits for another."""
    model, terms, nv = states.model, states.terms, states.model.nv
    groups, devices = _grouped(model, terms, frames), list(mesh.devices.flat)
    width = np.broadcast_to(np.asarray(states.width, float), (nv,))
    zero = (np.zeros((folds, len(g.joints), *2 * g.places.shape[1:])) for g in groups)
    start = (_Sums(tuple(zero), *np.zeros((2, folds, nv))), (model, terms, width, [group[1:] for group in groups]))
    totals, fixed = zip(*(jax.device_put(start, device) for device in devices), strict=True)
    numbers = _places(model, terms)[1] + sum(2 * g.places.size for g in groups)
    codes = block_codes(model) if devices[0].platform == "gpu" else None
    chunks, before, lengths = 0, None, set()
    with ThreadPoolExecutor(mesh.size) as threads:  # a call ends only when its device has taken nearly all the work
        for number, part in enumerate(states.source()):
            check_piece(model, part, number, values=False)
            chunk = chunk or _chunk(mesh, numbers, len(part[0]) // folds)
            add = in_float64(_program(chunk, folds, codes, devices[0].platform == "cpu"))
            own = -(-len(part[0]) // (chunk * mesh.size))
            firsts = [np.int32(chunks + own * k) for k in range(mesh.size)]
            share = own * chunk
            there = [np.int32(np.clip(len(part[0]) - k * share, 0, share)) for k in range(mesh.size)]
            beside = map if len(part[0]) not in lengths else threads.map  # compiled one after the other
            totals = tuple(beside(add, totals, fixed, _shares(part, chunk, mesh), there, firsts))
            lengths.add(len(part[0]))
            chunks += -(-len(part[0]) // chunk)
            jax.block_until_ready(before)  # one piece ahead: no more wait in memory
            before = [total.rows for total in totals]
    sums = jax.tree.map(lambda *own: sum(own), *jax.device_get(totals))
    products: list[Any] = [None] * nv
    for group, found in zip(groups, sums.products, strict=True):
        for n, j in enumerate(group.joints):
            size = len(frames[j].kept) + 1
            products[j] = found[:, n, :size, :size]
    return _Sums(tuple(products), sums.rows, sums.torque)


def _of_all_processes(sums: _Sums) -> _Sums:
    from jax.experimental.multihost_utils import process_allgather  # slow to import

    return jax.tree.map(lambda x: np.asarray(process_allgather(np.asarray(x))).sum(0), sums)


def _chunk(mesh: Mesh, rows: int, most: int) -> int:
    """Samples whose rows exist at once: on an accelerator many, but so few that a piece has chunks for all folds."""
    device = mesh.devices.flat[0]
    if device.platform == "cpu":
        return HOST_CHUNK
    memory = min(DEVICE_BYTES, (device.memory_stats() or {}).get("bytes_limit", DEVICE_BYTES) / 10)
    return 1 << max(8, min(int(np.log2(memory / 8 / rows)), int(np.ceil(np.log2(max(1, most / mesh.size))))))


def _shares(part: Sequence[Any], chunk: int, mesh: Mesh) -> list[tuple[Array, ...]]:
    """Each device's share of the arrays of a piece, filled up to whole chunks."""
    samples = len(part[0])
    missing = -samples % (chunk * mesh.size)
    sharding = NamedSharding(mesh, PartitionSpec("samples"))
    arrays = [x if isinstance(x, jax.Array) else np.asarray(x, float) for x in part]
    if missing:
        arrays = [np.concatenate([x, np.repeat(np.asarray(x[-1:]), missing, axis=0)]) for x in arrays]
    spread = (jax.device_put(x, sharding) for x in arrays)
    own = [{share.device: share.data for share in x.addressable_shards} for x in spread]
    return [tuple(x[device] for x in own) for device in mesh.devices.flat]


@lru_cache(maxsize=16)
def _program(chunk: int, folds: int, codes: bytes | None, cpu: bool) -> Callable[..., _Sums]:
    """Adds a device's share of a piece, of which so many samples are there and which begins after so many chunks."""

    def program(total: _Sums, fixed: Any, part: tuple[Array, ...], count: Array, first: Array) -> _Sums:
        there = (jnp.arange(len(part[0]), dtype=jnp.int32) < count).astype(float)  # made here: it need not travel
        chunks = [x.reshape(-1, chunk, *x.shape[1:]) for x in (*part, there)]

        def step(total: _Sums, k: Array) -> tuple[_Sums, None]:
            new, fold = _sums(codes, fixed, *(x[k] for x in chunks)), (first + k) % folds
            return jax.tree.map(lambda x, y: x.at[fold].add(y), total, new), None

        return jax.lax.scan(step, total, jnp.arange(len(chunks[0]), dtype=jnp.int32))[0]

    return jax.jit(program, compiler_options=CPU_OPTIONS if cpu else None)


def _sums(codes: bytes | None, fixed: Any, q: Array, v: Array, a: Array, tau: Array, there: Array) -> _Sums:
    model, terms, width, groups = fixed
    rows = block_rows(model, q, v, a, codes)
    parts = [rows.reshape(-1, rows.shape[-1]), term_rows(model, terms, width, q, v, a), tau.T]
    whole = jnp.concatenate([*parts, jnp.zeros_like(parts[0][:1])])
    products = []
    for index, into in groups:
        Z = jnp.einsum("jkr,jks->jrs", into, whole[index] * there, precision=jax.lax.Precision.HIGHEST)
        products.append(row_products(Z))
    return _Sums(tuple(products), jnp.broadcast_to(there.sum(), tau.shape[1:]), tau.T @ there)


_own_term_rows = program(term_rows, CPU_OPTIONS, kept=True)


def _summed_by_code(states: States, frames: Sequence[OwnFrame], folds: int) -> _Sums | None:
    """Sums of all pieces on one CPU, the rows by machine code; None where there is none for one of the pieces."""
    nv, (places, _) = states.model.nv, _places(states.model, states.terms)
    first = 10 * len(coordinate_blocks(states.model.joints)[0])
    index = [places[j, frame.kept] for j, frame in enumerate(frames)]
    parts = [(k[k < first], k[k >= first] - first) for k in index]
    products = tuple(np.zeros((folds, len(k) + 1, len(k) + 1)) for k in index)
    rows, torque = np.zeros((2, folds, nv))
    chunks = 0
    for number, part in enumerate(states.source()):
        check_piece(states.model, part, number, values=False)
        state = [np.asarray(x, float) for x in part]
        code = machine_code(BLOCK_FORM, states.model, *state[:3])
        if code is None:
            return None
        for blocks, side, tau in _coded(states, code, *state):
            fold = chunks % folds
            for j, (links, terms) in enumerate(parts):
                Z = np.empty((len(index[j]) + 1, tau.shape[1]))
                np.matmul(frames[j].into.T, np.concatenate([blocks[links], side[terms]]), out=Z[:-1])
                Z[-1] = tau[j]
                products[j][fold] += Z @ Z.T
            rows[fold] += tau.shape[1]
            torque[fold] += tau.sum(1)
            chunks += 1
    return _Sums(products, rows, torque)


def _coded(
    states: States, code: Callable[..., np.ndarray], q: np.ndarray, v: np.ndarray, a: np.ndarray, tau: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rows of the links and of the terms, and torques, samples last, a chunk at a time; the next overwrites them."""
    room, width = reused(), np.broadcast_to(np.asarray(states.width, float), (states.model.nv,))

    side, samples = np.empty((0, 0)), len(q)
    for start in range(0, samples, CODE_CHUNK):
        if start % TERMS_CHUNK == 0:
            filled = np.minimum(start + np.arange(TERMS_CHUNK), samples - 1)
            side = np.asarray(_own_term_rows(states.model, states.terms, width, q[filled], v[filled], a[filled]))
        end = min(start + CODE_CHUNK, samples)
        piece = slice(max(0, end - CODE_CHUNK), end)  # the last one reaches back, for whole vectors
        blocks = code(room, q[piece], v[piece], a[piece])
        own = slice(start % TERMS_CHUNK, start % TERMS_CHUNK + end - start)
        yield blocks.reshape(-1, blocks.shape[-1])[:, start - piece.start :], side[:, own], tau[start:end].T


def conditioned_rows(
    model: RobotModel, terms: tuple[Effect, ...], width: Array, into: Array, q: Array, v: Array, a: Array, tau: Array
) -> tuple[Float[Array, "nv rank samples"], Float[Array, "nv samples"]]:
    """Rows in the coordinates `into` and the torque, the samples last."""
    blocks = [dense_rows(model, *(jnp.asarray(x).T for x in (q, v, a)))]
    blocks += [jnp.moveaxis(x, 0, -1) for x in term_columns(model, terms, width, q, v, a)]
    columns = jnp.concatenate(blocks, axis=1)
    return jnp.einsum("kr,jks->jrs", into, columns, precision=jax.lax.Precision.HIGHEST), jnp.asarray(tau).T


def _condensed(states: States, frames: Sequence[OwnFrame], sums: _Sums) -> Condensed:
    factors = []
    for fold in range(len(sums.rows)):
        own = []
        for frame, products in zip(frames, sums.products, strict=True):
            back = np.zeros((len(frame.back) + 1, len(frame.columns) + 1))
            back[:-1, :-1], back[-1, -1] = frame.back, 1.0
            own.append(_root(products[fold]) @ back)
        factors.append(tuple(own))
    return Condensed(states.names, tuple(f.columns for f in frames), tuple(factors), sums.rows, sums.torque)


def _root(products: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """F with F'F the products, without what is rounding in them."""
    length = np.sqrt(np.maximum(np.diag(products), 0.0))
    length = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(products / np.outer(length, length))
    values = np.where(values > CLIPPED * max(values.max(initial=0.0), 0.0), values, 0.0)
    return np.sqrt(values)[:, None] * vectors.T * length
