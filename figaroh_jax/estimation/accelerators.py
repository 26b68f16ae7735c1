"""States condensed on devices: one program for one accelerator or several, and for batches of robots or trajectories.

A QR factorisation of every chunk, which `regression.condense` makes on the host, is slow on an accelerator; products
are not, but they square the condition number. So the rows are first brought to coordinates in which they are well
conditioned, Z = X_b R^-1 with the columns X_b of the structural base parameters and R their triangular factor at random
states: the products of Z lose next to nothing (as the second pass of CholeskyQR2; Yamamoto and others, 2015), and
X = Z R B with the matrix B of the base parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from ..compiled.batching import CPU_OPTIONS
from ..effects.base import Effect
from ..errors import InputError
from ..rigid.model import RobotModel
from ..rigid.regressor import dense_rows
from .base_parameters import BaseParameters
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
    """What is added up over the samples, for each fold and joint: products of [Z tau], rows and torque."""

    products: Any
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
    frame = coordinates(states.structure, states.structural)
    nv, size = states.model.nv, frame.into.shape[1] + 1
    with jax.enable_x64(True):
        total = _Sums(jnp.zeros((folds, nv, size, size)), jnp.zeros((folds, nv)), jnp.zeros((folds, nv)))
        everywhere = NamedSharding(mesh, PartitionSpec())
        width = np.broadcast_to(np.asarray(states.width, float), (nv,))
        fixed = jax.device_put((states.model, states.terms, width, frame.into), everywhere)
        total, before = jax.device_put(total, everywhere), None
        chunk = chunk or _chunk(mesh, nv, sum(frame.into.shape) + 1)
        program = _program(mesh, chunk, folds)
        chunks = 0
        for number, part in enumerate(states.source()):
            check_piece(states.model, part, number, values=False)
            total = program(total, fixed, _spread(part, chunk, mesh), chunks)
            chunks += -(-len(part[0]) // chunk)
            jax.block_until_ready(before)  # one piece ahead: no more wait in memory
            before = total.rows
        sums = jax.device_get(total)
    if not all(np.isfinite(x).all() for x in sums):
        for number, part in enumerate(states.source()):
            check_piece(states.model, part, number)
        raise InputError("the rows of the states are not finite: numbers too large, or a model that moves no mass")
    return _condensed(states, frame, sums)


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


def _chunk(mesh: Mesh, nv: int, width: int) -> int:
    if mesh.devices.flat[0].platform == "cpu":
        return HOST_CHUNK
    return 1 << max(8, int(np.log2(DEVICE_BYTES / 8 / nv / width)))


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
def _program(mesh: Mesh, chunk: int, folds: int) -> Callable[..., _Sums]:
    def local(fixed: Any, part: tuple[Array, ...], before: Array) -> _Sums:
        """Sums over this device's share of a piece, which begins after so many chunks."""
        chunks = [x.reshape(-1, chunk, *x.shape[1:]) for x in part]
        first = before + jax.lax.axis_index("samples") * len(chunks[0])

        def step(total: _Sums, k: Array) -> tuple[_Sums, None]:
            new, fold = _sums(fixed, *(x[k] for x in chunks)), (first + k) % folds
            return _Sums(*(x.at[fold].add(y) for x, y in zip(total, new, strict=True))), None

        shapes = jax.eval_shape(lambda *x: _sums(fixed, *x), *(x[0] for x in chunks))
        zero = jax.tree.map(lambda x: jnp.zeros((folds, *x.shape), x.dtype), shapes)
        return jax.lax.psum(jax.lax.scan(step, zero, jnp.arange(len(chunks[0])))[0], "samples")

    specs = {"in_specs": (PartitionSpec(), _SAMPLES, PartitionSpec()), "out_specs": PartitionSpec()}
    spread = jax.shard_map(local, mesh=mesh, check_vma=False, **specs)
    options = CPU_OPTIONS if mesh.devices.flat[0].platform == "cpu" else None

    def program(total: _Sums, fixed: Any, part: tuple[Array, ...], before: Any) -> _Sums:
        return jax.tree.map(jnp.add, total, spread(fixed, part, before))

    return jax.jit(program, compiler_options=options)


def _sums(fixed: Any, q: Array, v: Array, a: Array, tau: Array, there: Array) -> _Sums:
    model, terms, width, into = fixed
    Z, y = _rows(model, terms, width, into, q, v, a, tau)
    both = jnp.concatenate([Z, y[:, None]], axis=1) * there
    products = jnp.einsum("jks,jls->jkl", both, both, precision=jax.lax.Precision.HIGHEST)
    return _Sums(products, jnp.broadcast_to(there.sum(), y.shape[:1]), y @ there)


def _rows(
    model: RobotModel, terms: tuple[Effect, ...], width: Array, into: Array, q: Array, v: Array, a: Array, tau: Array
) -> tuple[Float[Array, "nv rank samples"], Float[Array, "nv samples"]]:
    """Rows in the coordinates `into` and the torque, the samples last."""
    blocks = [dense_rows(model, *(jnp.asarray(x).T for x in (q, v, a)))]
    blocks += [jnp.moveaxis(x, 0, -1) for x in term_columns(model, terms, width, q, v, a)]
    columns = jnp.concatenate(blocks, axis=1)
    return jnp.einsum("kr,jks->jrs", into, columns, precision=jax.lax.Precision.HIGHEST), jnp.asarray(tau).T


def _condensed(states: States, frame: Coordinates, sums: _Sums) -> Condensed:
    back = np.zeros((len(frame.back) + 1, len(states.names) + 1))
    back[:-1, :-1], back[-1, -1] = frame.back, 1.0
    own = tuple(np.flatnonzero(row) for row in states.used)
    factors = tuple(
        tuple(_root(G) @ back[:, [*mine, -1]] for G, mine in zip(fold, own, strict=True)) for fold in sums.products
    )
    return Condensed(states.names, own, factors, sums.rows, sums.torque)


def _root(products: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """F with F'F the products, without what is rounding in them."""
    length = np.sqrt(np.maximum(np.diag(products), 0.0))
    length = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(products / np.outer(length, length))
    values = np.where(values > CLIPPED * max(values.max(initial=0.0), 0.0), values, 0.0)
    return np.sqrt(values)[:, None] * vectors.T * length
