"""States condensed on devices: one program for one accelerator or several, and for batches of robots or trajectories.

A QR factorisation of every chunk, which `regression.condense` makes on the host, is slow on an accelerator; products
are not, but they square the condition number. So the rows are first brought to coordinates in which they are well
conditioned, Z = X_b R^-1 with the columns X_b of the structural base parameters and R their triangular factor at random
states: the products of Z lose next to nothing (as the second pass of CholeskyQR2; Yamamoto and others, 2015), and
X = Z R B with the matrix B of the base parameters. Each joint has coordinates of its own, of the columns that its rows
can show alone: on a tree these are few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from ..compiled.batching import CPU_OPTIONS
from ..effects.base import Effect
from ..errors import InputError
from ..rigid.model import RobotModel
from ..rigid.normal_equations import row_products
from ..rigid.regressor import block_codes, block_rows, coordinate_blocks, dense_rows
from .base_parameters import BaseParameters, base_parameters
from .columns import term_columns
from .regression import FOLDS, Condensed
from .states import States, check_piece

__all__ = ["BatchFit", "Coordinates", "condense_on_devices", "coordinates", "fit_states"]

HOST_CHUNK = 128  # samples whose rows stay in the processor's cache
DEVICE_BYTES = 2e9  # of the rows of a chunk on an accelerator
CLIPPED = 1e-13  # share of a joint's products that is rounding: what they say of smaller ones is left out
_SAMPLES = PartitionSpec("samples")


class Coordinates(NamedTuple):
    """Rows of all columns are `rows @ into` in the well-conditioned coordinates, and from there `z @ back` again."""

    into: Float[np.ndarray, "columns rank"]
    back: Float[np.ndarray, "rank columns"]


class _Sums(NamedTuple):
    """What is added up over the samples, for each fold: products of [Z tau] joint by joint, rows and torque of each."""

    products: tuple[Any, ...]
    rows: Any
    torque: Any


class BatchFit(NamedTuple):
    """Least squares on the kept columns."""

    parameters: Float[Array, " kept"]
    std: Float[Array, " kept"]  # for white residuals, each joint weighed by its own
    rms: Float[Array, " nv"]  # of the residual, N m or N


def coordinates(structure: Float[np.ndarray, "samples nv columns"], base: BaseParameters) -> Coordinates:
    """Coordinates in which the columns at the random states `structure` are orthonormal."""
    kept = structure[:, :, base.independent].reshape(-1, base.rank)
    R = np.linalg.qr(kept, mode="r")
    into = np.zeros((structure.shape[2], base.rank))
    into[base.independent] = np.linalg.inv(R)
    return Coordinates(into, R @ base.matrix)


class _Own(NamedTuple):
    """Of a joint: the columns that its rows can show, and its coordinates in these."""

    columns: Int[np.ndarray, " own"]
    frame: Coordinates


class _Shown(NamedTuple):
    """What a program is made for: the columns of each joint, and what is known of the model (`block_codes`)."""

    columns: tuple[tuple[int, ...], ...]
    codes: bytes | None


def _frames(states: States) -> list[_Own]:
    frames, names = [], states.names
    for j, used in enumerate(states.used):
        own = np.flatnonzero(used)
        rows = states.structure[:, j, own]
        base = base_parameters(np.asarray(np.linalg.qr(rows, mode="r")), [names[k] for k in own])
        frames.append(_Own(own, coordinates(rows[:, None], base)))
    return frames


def condense_on_devices(
    states: States, devices: Sequence[Any] | None = None, folds: int = FOLDS, chunk: int | None = None
) -> Condensed:
    """`condense(states, states.used)`, the samples of every piece spread over `devices` (default: all that JAX has).

    Each device forms the rows of its own samples, `chunk` at a time, and sums their products; the sums of the devices
    are added. Pieces of one length share a program; the source is read while the devices work. A direction in which the
    rows are less than 3e-7 of the strongest one's is taken as not shown. Folds are whole chunks in turn. Raises
    `InputError` where a piece has a wrong shape or holds a number that is not finite.
    """
    mesh = Mesh(np.array(list(devices or jax.devices())), ("samples",))
    frames, nv = _frames(states), states.model.nv
    sizes = [own.frame.into.shape[1] + 1 for own in frames]
    with jax.enable_x64(True):
        products = tuple(jnp.zeros((folds, size, size)) for size in sizes)
        total = _Sums(products, jnp.zeros((folds, nv)), jnp.zeros((folds, nv)))
        everywhere = NamedSharding(mesh, PartitionSpec())
        width = np.broadcast_to(np.asarray(states.width, float), (nv,))
        fixed = jax.device_put((states.model, states.terms, width, [own.frame.into for own in frames]), everywhere)
        total, before = jax.device_put(total, everywhere), None
        chunk = chunk or _chunk(mesh, sum(sum(own.frame.into.shape) + 1 for own in frames))
        shown = _Shown(tuple(tuple(own.columns.tolist()) for own in frames), block_codes(states.model))
        program = _program(mesh, chunk, folds, shown)
        chunks = 0
        for number, part in enumerate(states.source()):
            check_piece(states.model, part, number, values=False)
            total = program(total, fixed, _spread(part, chunk, mesh), chunks)
            chunks += -(-len(part[0]) // chunk)
            jax.block_until_ready(before)  # one piece ahead: no more wait in memory
            before = total.rows
        sums = jax.device_get(total)
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
    """
    Z, y = _rows(model, terms, jnp.zeros(model.nv), into, q, v, a, tau)
    rows = Z.shape[-1]
    G, b = jnp.einsum("jks,jls->jkl", Z, Z), jnp.einsum("jks,js->jk", Z, y)
    theta = jnp.linalg.solve(G.sum(0), b.sum(0))
    weight = rows / jnp.maximum(jnp.sum((y - jnp.einsum("jks,k->js", Z, theta)) ** 2, axis=1), 1e-300)
    A = jnp.einsum("jkl,j->kl", G, weight)
    theta = jnp.linalg.solve(A, jnp.einsum("jk,j->k", b, weight))
    rms = jnp.sqrt(jnp.mean((y - jnp.einsum("jks,k->js", Z, theta)) ** 2, axis=1))
    variance = jnp.einsum("ck,ck->c", into @ jnp.linalg.inv(A), into)
    return BatchFit(into @ theta, jnp.sqrt(variance), rms)


def _chunk(mesh: Mesh, width: int) -> int:
    if mesh.devices.flat[0].platform == "cpu":
        return HOST_CHUNK
    return 1 << max(8, int(np.log2(DEVICE_BYTES / 8 / width)))


def _spread(part: Sequence[Any], chunk: int, mesh: Mesh) -> tuple[Any, ...]:
    """Arrays of a piece and the weight of its rows, filled up to whole chunks; a share on each device."""
    samples = len(part[0])
    missing = -samples % (chunk * mesh.size)
    sharding = NamedSharding(mesh, _SAMPLES)
    arrays = [x if isinstance(x, jax.Array) else np.asarray(x, float) for x in part]
    if missing:
        arrays = [np.concatenate([x, np.repeat(np.asarray(x[-1:]), missing, axis=0)]) for x in arrays]
    there = (np.arange(samples + missing) < samples).astype(float)
    return tuple(jax.device_put(x, sharding) for x in (*arrays, there))


@lru_cache(maxsize=16)
def _program(mesh: Mesh, chunk: int, folds: int, shown: _Shown) -> Callable[..., _Sums]:
    def local(fixed: Any, part: tuple[Array, ...], before: Array) -> _Sums:
        """Sums over this device's share of a piece, which begins after so many chunks."""
        chunks = [x.reshape(-1, chunk, *x.shape[1:]) for x in part]
        first = before + jax.lax.axis_index("samples") * len(chunks[0])

        def step(total: _Sums, k: Array) -> tuple[_Sums, None]:
            new, fold = _sums(shown, fixed, *(x[k] for x in chunks)), (first + k) % folds
            return jax.tree.map(lambda x, y: x.at[fold].add(y), total, new), None

        shapes = jax.eval_shape(lambda *x: _sums(shown, fixed, *x), *(x[0] for x in chunks))
        zero = jax.tree.map(lambda x: jnp.zeros((folds, *x.shape), x.dtype), shapes)
        return jax.lax.psum(jax.lax.scan(step, zero, jnp.arange(len(chunks[0])))[0], "samples")

    specs = {"in_specs": (PartitionSpec(), _SAMPLES, PartitionSpec()), "out_specs": PartitionSpec()}
    spread = jax.shard_map(local, mesh=mesh, check_vma=False, **specs)
    options = CPU_OPTIONS if mesh.devices.flat[0].platform == "cpu" else None

    def program(total: _Sums, fixed: Any, part: tuple[Array, ...], before: Any) -> _Sums:
        return jax.tree.map(jnp.add, total, spread(fixed, part, before))

    return jax.jit(program, compiler_options=options)


def _sums(shown: _Shown, fixed: Any, q: Array, v: Array, a: Array, tau: Array, there: Array) -> _Sums:
    """Rows of a joint hold its own columns alone: blocks of the regressor, then those of the effects."""
    model, terms, width, frames = fixed
    blocks, _ = coordinate_blocks(model)
    inertial = block_rows(model, q, v, a, shown.codes).reshape(10 * len(blocks), -1)
    place = {(int(row), 10 * int(link) + k): 10 * n + k for n, (row, link) in enumerate(blocks) for k in range(10)}
    beside = [jnp.moveaxis(x, 0, -1) for x in term_columns(model, terms, width, q, v, a)]
    beside = jnp.concatenate([jnp.zeros((model.nv, 0, len(q))), *beside], axis=1)
    products, first = [], 10 * len(model.joints)
    for j, (columns, into) in enumerate(zip(shown.columns, frames, strict=True)):
        parts = [inertial[np.array([place[j, k] for k in columns if k < first], int)]]
        parts += [beside[j, np.array([k - first for k in columns if k >= first], int)]]
        Z = jnp.einsum("kr,ks->rs", into, jnp.concatenate(parts), precision=jax.lax.Precision.HIGHEST)
        products.append(row_products((jnp.concatenate([Z, tau[:, j][None]]) * there)[None])[0])
    return _Sums(tuple(products), jnp.broadcast_to(there.sum(), tau.shape[1:]), there @ tau)


def _rows(
    model: RobotModel, terms: tuple[Effect, ...], width: Array, into: Array, q: Array, v: Array, a: Array, tau: Array
) -> tuple[Float[Array, "nv rank samples"], Float[Array, "nv samples"]]:
    """Rows in the coordinates `into` and the torque, the samples last."""
    blocks = [dense_rows(model, *(jnp.asarray(x).T for x in (q, v, a)))]
    blocks += [jnp.moveaxis(x, 0, -1) for x in term_columns(model, terms, width, q, v, a)]
    columns = jnp.concatenate(blocks, axis=1)
    return jnp.einsum("kr,jks->jrs", into, columns, precision=jax.lax.Precision.HIGHEST), jnp.asarray(tau).T


def _condensed(states: States, frames: Sequence[_Own], sums: _Sums) -> Condensed:
    backs = []
    for own in frames:
        back = np.zeros((len(own.frame.back) + 1, len(own.columns) + 1))
        back[:-1, :-1], back[-1, -1] = own.frame.back, 1.0
        backs.append(back)
    folds = range(len(sums.rows))
    factors = tuple(
        tuple(_root(G[fold]) @ back for G, back in zip(sums.products, backs, strict=True)) for fold in folds
    )
    return Condensed(states.names, tuple(own.columns for own in frames), factors, sums.rows, sums.torque)


def _root(products: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """F with F'F the products, without what is rounding in them."""
    length = np.sqrt(np.maximum(np.diag(products), 0.0))
    length = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(products / np.outer(length, length))
    values = np.where(values > CLIPPED * max(values.max(initial=0.0), 0.0), values, 0.0)
    return np.sqrt(values)[:, None] * vectors.T * length
