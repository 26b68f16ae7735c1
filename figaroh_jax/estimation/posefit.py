r"""Least squares on poses: rows of all devices and their exact Jacobian, a block of postures at a time.

The unknowns stand in one vector y of scaled numbers: the coefficients of the twist columns, common to all groups, then
what each device leaves open. A row is predicted minus measured (m or rad).

The rows of a group depend on y through few numbers, linear in it: $\ell = T y$ with the steady twist of each joint of
its chain, the coefficients of the fields that change with the posture, and the device's own unknowns. The compiled
kernel differentiates by $\ell$: by the tool's motion and the device's unknowns in forward mode, through the chain in
closed form. Its program depends on the length of the chain and the number of fields, not on which columns are fitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple
from weakref import ref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiled.batching import DRAFT_OPTIONS, chunk_size, program, traced
from ..recordings.devices import Device
from ..rigid import lie
from ..rigid.chain import Chain, chain_pose, joint_response
from ..rigid.model import Leaf
from .posehost import HostRows, in_machine_code, written_out

__all__ = [
    "DRAFT",
    "DRAFT_OPTIONS",
    "Group",
    "Part",
    "Problem",
    "Rows",
    "block_rows",
    "group_of",
    "host_parts",
    "linearise",
    "on_host",
    "parts_of",
    "predict",
    "rows_of",
    "sizes",
    "ties",
]


class Group(eqx.Module):
    """Postures that one device measured."""

    chain: Chain
    device: Device
    position: Float[Leaf, "nv samples"]  # joint positions, rad or m
    steady: Float[Leaf, "n 6 columns"]  # twist of each joint of the chain for a unit of each column, in all postures
    fields: Float[Leaf, "pieces 6 samples"]  # the same where it changes with the posture, one piece after the other
    at: Int[Leaf, " pieces"]  # which joint of the chain
    column: Int[Leaf, " pieces"]  # which column
    datum: Any  # what the device measured, the samples on the first axis
    measured: Bool[Leaf, "samples rows"]  # which rows it measured


class Problem(eqx.Module):
    """Everything measured, and the size of each unknown."""

    groups: tuple[Group, ...]
    scale: Float[Leaf, " unknowns"]
    columns: int = eqx.field(static=True)


class Rows(NamedTuple):
    """What each row of the residual is: its group, posture within the group (-1: a constraint) and channel."""

    group: Int[np.ndarray, " rows"]
    sample: Int[np.ndarray, " rows"]
    channel: Int[np.ndarray, " rows"]
    measured: Bool[np.ndarray, " rows"]


def group_of(
    chain: Chain,
    device: Device,
    position: Float[np.ndarray, "nv samples"],
    columns: int,
    pieces: Iterable[tuple[int, int, Float[np.ndarray, "6 samples"]]],
    datum: Any,
    measured: Bool[np.ndarray, "samples rows"],
) -> Group:
    """A group from the pieces of its columns: column, joint of the chain, and twist of a unit in each posture."""
    steady, changing = np.zeros((len(chain.joints), 6, columns)), []
    for column, at, field in pieces:
        if (field == field[:, :1]).all():
            steady[at, :, column] += field[:, 0]
        else:
            changing.append((field, at, column))
    fields, at, column = zip(*changing, strict=True) if changing else ((), (), ())
    stacked = np.array(fields).reshape(len(fields), 6, position.shape[1])
    where = np.array(at, int), np.array(column, int)
    return Group(chain, device, position, steady, stacked, *where, datum, measured)


def rows_of(problem: Problem) -> Rows:
    """The rows of `linearise`, in its order."""
    parts = []
    for g, group in enumerate(problem.groups):
        samples, count = np.shape(group.measured)
        channel = np.repeat(group.device.channels(), samples)
        sample = np.tile(np.arange(samples), count)
        parts.append((np.full(len(sample), g), sample, channel, np.asarray(group.measured).T.reshape(-1)))
        rows = np.zeros(ties(group.device), int)
        parts.append((rows + g, rows - 1, rows, rows == 0))
    return Rows(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def ties(device: Device) -> int:
    """Number of the device's constraint rows."""
    if type(device).constraint is Device.constraint:
        return 0
    return jax.eval_shape(device.constraint, np.zeros(len(device.unknowns()))).shape[0]


class Part(eqx.Module):
    """A group as the kernel takes it: postures in blocks, the last one filled up with its first posture."""

    chain: Chain
    device: Device
    at: Int[Leaf, " pieces"]
    position: Float[Leaf, "blocks nv block"]
    fields: Float[Leaf, "blocks pieces 6 block"]
    datum: Any  # each array (blocks, block, ...)
    local: Float[Leaf, "local unknowns"]  # T


def parts_of(problem: Problem) -> tuple[Part, ...]:
    """Every group cut into blocks, with its matrix from the scaled unknowns to what its rows depend on."""
    parts, first = [], problem.columns
    for group in problem.groups:
        n, count, pieces = len(group.chain.joints), len(group.device.unknowns()), len(group.at)
        local = np.zeros((6 * n + pieces + count, len(problem.scale)))
        local[: 6 * n, : problem.columns] = np.reshape(group.steady, (6 * n, -1))
        local[6 * n + np.arange(pieces), group.column] = 1.0
        local[6 * n + pieces + np.arange(count), first + np.arange(count)] = 1.0
        first += count
        size = block_size(np.shape(group.position)[1])
        cut = partial(_cut, size=size)
        parts.append(
            Part(
                replace(group.chain, joints=()),  # one program for all chains of a length
                group.device,
                group.at,
                np.moveaxis(cut(np.swapaxes(group.position, 0, 1)), 1, -1),
                np.moveaxis(cut(np.moveaxis(np.asarray(group.fields), -1, 0)), 1, -1),
                jax.tree.map(cut, group.datum),
                local * np.asarray(problem.scale),
            )
        )
    return tuple(parts)


def block_size(samples: int) -> int:
    """Postures in a block: as few as keep its arrays in a processor's cache, and not many more than there are."""
    blocks = max(1, -(-samples // chunk_size()))
    return 8 * max(1, -(-samples // (8 * blocks)))


def _cut(x: Any, size: int) -> np.ndarray:
    """The first axis as blocks; what is missing at the end is filled with the first sample."""
    x = np.asarray(x)
    missing = -len(x) % size
    filled = np.concatenate([x, np.broadcast_to(x[:1], (missing, *x.shape[1:]))]) if missing else x
    return filled.reshape(len(filled) // size, size, *x.shape[1:])


def block_rows(
    chain: Chain, device: Device, twists: Array, own: Float[Array, " k"], position: Array, datum: Any
) -> tuple[Array, Array, Array]:
    """Rows of a block (rows, block), their derivatives by the twists of the joints (joints * 6, rows, block) and by the
    device's unknowns (k, rows, block)."""
    pose = chain_pose(chain, position, twists)

    def one(R: Array, p: Array, datum: Any) -> tuple[Array, ...]:
        def residual(motion: Array, own: Array) -> Array:
            moved = lie.pose(R + lie.skew(motion[3:]) @ R, p + motion[:3])  # to first order, which is all that is asked
            return device.residual(moved, own, datum)

        zero = jnp.zeros(6)
        return residual(zero, own), *jax.jacfwd(residual, argnums=(0, 1))(zero, own)

    residual, by_motion, by_own = jax.vmap(one, in_axes=(-1, -1, 0), out_axes=-1)(pose.R, pose.p, datum)
    response = jnp.swapaxes(joint_response(pose, by_motion), 1, 2)  # joint twist row sample
    return residual, response.reshape(-1, *residual.shape), jnp.swapaxes(by_own, 0, 1)


def _blocks_rows(chain: Chain, device: Device, own: Array, *blocks: Any) -> tuple[Array, Array, Array]:
    return jax.lax.map(lambda block: block_rows(chain, device, block[0], own, *block[1:]), blocks)


DRAFT = 256  # postures; for fewer the compiler takes longer to optimise than that saves later
MANY = 16384  # postures of a group whose rows, in machine code, are held all at once

_rows_quick = program(_blocks_rows, cpu=DRAFT_OPTIONS, kept=True)
_rows_fast = program(_blocks_rows, kept=True)


@jax.jit
def _tied(device: Device, own: Array) -> tuple[Array, Array]:
    return device.constraint(own), jax.jacfwd(device.constraint)(own)


def host_parts(problem: Problem) -> tuple[Part | HostRows, ...]:
    """For `linearise`: groups whose device has one in a form that compiles no program, where they are not too many.

    Those of the last problem are kept: it is solved with other weights, folds and columns.
    """
    if _last and _last[0]() is problem:
        return _last[1]
    by_hand = [_by_hand(group) for group in problem.groups]
    parts = (None,) * len(by_hand) if all(by_hand) else parts_of(problem)
    found = tuple(
        HostRows(g.chain, g.device, np.asarray(g.position), g.datum, np.asarray(g.steady), _pieces(g))
        if part is None or own
        else part
        for g, own, part in zip(problem.groups, by_hand, parts, strict=True)
    )
    if not traced(problem):
        _last[:] = [ref(problem), found]
    return found


_last: list[Any] = []


def _pieces(group: Group) -> list[tuple[int, int, Float[np.ndarray, "6 samples"]]]:
    """Column, joint of the chain and twists of each piece that changes with the posture."""
    column, at = (np.asarray(x).tolist() for x in (group.column, group.at))
    return list(zip(column, at, np.asarray(group.fields), strict=True))


def _by_hand(group: Group) -> bool:
    if not written_out(group.device) or jax.default_backend() != "cpu" or traced(group):
        return False
    postures = np.shape(group.position)[1]
    return postures <= DRAFT or (postures <= MANY and in_machine_code(group.chain))


def on_host(problem: Problem) -> bool:
    """Whether a solve's algebra is best done by NumPy: the rows are few, or made on the host."""
    few = max(np.shape(group.position)[1] for group in problem.groups) <= DRAFT and jax.default_backend() == "cpu"
    return few or all(_by_hand(group) for group in problem.groups)


def linearise(
    problem: Problem, unknowns: Float[Any, " unknowns"], parts: tuple[Part | HostRows, ...] | None = None
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows unknowns"]]:
    """Residual in m and rad at the scaled unknowns, and its exact Jacobian; `parts` are those of the problem."""
    scale, count = np.asarray(problem.scale), problem.columns
    values, first = np.asarray(unknowns) * scale, count
    residuals, jacobians = [], []
    for k, part in enumerate(parts or host_parts(problem)):
        group = None if isinstance(part, HostRows) else problem.groups[k]
        if isinstance(part, HostRows):
            own, steady, pieces = slice(first, first + part.unknowns), part.steady, part.pieces
            residual, response, by_own = part.rows(_twists(steady, pieces, part.samples, values[:count]), values[own])
        else:
            assert group is not None
            own, pieces = slice(first, first + len(group.device.unknowns())), _pieces(group)
            steady = np.reshape(group.steady, (-1, count))
            twists = _twists(steady, pieces, np.shape(group.position)[1], values[:count])
            residual, response, by_own = _compiled_rows(part, twists, values[own], np.shape(group.position)[1])
        columns = np.zeros((len(values), residual.size))  # the Jacobian's columns, each in one piece
        columns[:count] = steady.T @ response.reshape(-1, residual.size)
        for column, at, field in pieces:
            columns[column] += np.sum(response[6 * at : 6 * at + 6] * field[:, None], axis=0).reshape(-1)
        columns[own] = by_own.reshape(-1, residual.size)
        residuals.append(residual.reshape(-1))
        jacobians.append(columns.T)
        if group is not None and ties(group.device):
            tied, by_own = _tied(group.device, values[own])
            residuals.append(np.asarray(tied))
            jacobians.append(np.zeros((len(tied), len(values))))
            jacobians[-1][:, own] = by_own
        first = own.stop
    whole = jacobians[0] if len(jacobians) == 1 else np.concatenate(jacobians)
    whole *= scale
    return residuals[0] if len(residuals) == 1 else np.concatenate(residuals), whole


def _twists(
    steady: Float[np.ndarray, "n6 columns"],
    pieces: list[tuple[int, int, Float[np.ndarray, "6 samples"]]],
    samples: int,
    coefficients: Float[np.ndarray, " columns"],
) -> Float[np.ndarray, "n 6 #samples"]:
    """Twist of each joint, one for all postures where no piece changes with them."""
    twists = (steady @ coefficients).reshape(-1, 6, 1)
    if not pieces:
        return twists
    twists = np.repeat(twists, samples, axis=2)
    for column, at, field in pieces:
        twists[at] += coefficients[column] * field
    return twists


def _compiled_rows(
    part: Part, twists: np.ndarray, own: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (rows, samples) of a group and their derivatives by joint twists and by the device's unknowns."""
    twists, block = np.broadcast_to(twists, (*twists.shape[:2], samples)), part.position.shape[2]
    cut = np.moveaxis(_cut(np.moveaxis(twists, -1, 0), block), 1, -1)
    rows = _rows_quick if samples <= DRAFT else _rows_fast
    found = rows(part.chain, part.device, own, cut, part.position, part.datum)
    residual, response, by_own = (_samples_last(x, samples) for x in found)
    return residual, response, by_own


def _samples_last(blocks: Array, samples: int) -> np.ndarray:
    """(blocks, ..., block) as (..., samples)."""
    beside = np.moveaxis(np.asarray(blocks), 0, -2)
    blocks, block = beside.shape[-2:]
    return beside.reshape(*beside.shape[:-2], blocks * block)[..., :samples]


def predict(problem: Problem, unknowns: Float[Any, " unknowns"]) -> Float[np.ndarray, " rows"]:
    """Residual in m and rad at the scaled unknowns."""
    return linearise(problem, unknowns)[0]


def sizes(groups: Sequence[Group], columns: Sequence[float]) -> Float[np.ndarray, " unknowns"]:
    """Typical size of every unknown: of the columns' coefficients, then of the devices' own unknowns."""
    return np.array([*columns, *(size for group in groups for _, _, size in group.device.unknowns())])
