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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import lie
from ..chunks import CPU_OPTIONS, chunk_size
from ..model import Leaf
from .chain import Chain, chain_pose, joint_response
from .devices import Device

__all__ = [
    "Group",
    "Part",
    "Problem",
    "Rows",
    "block_rows",
    "group_of",
    "linearise",
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


def block_rows(part: Part, local: Array, position: Array, fields: Array, datum: Any) -> tuple[Array, Array]:
    """Rows of a block (rows, block) at the numbers `local`, and their derivatives by these (local, rows, block)."""
    n, pieces = len(part.chain.axis), len(part.at)
    coefficients, own = local[6 * n : 6 * n + pieces], local[6 * n + pieces :]
    pose = chain_pose(part.chain, position, _twists(part, local[: 6 * n].reshape(n, 6, 1), coefficients, fields))

    def one(R: Array, p: Array, datum: Any) -> tuple[Array, ...]:
        def residual(motion: Array, own: Array) -> Array:
            moved = lie.pose(R + lie.skew(motion[3:]) @ R, p + motion[:3])  # to first order, which is all that is asked
            return part.device.residual(moved, own, datum)

        zero = jnp.zeros(6)
        return residual(zero, own), *jax.jacfwd(residual, argnums=(0, 1))(zero, own)

    residual, by_motion, by_own = jax.vmap(one, in_axes=(-1, -1, 0), out_axes=-1)(pose.R, pose.p, datum)
    response = jnp.swapaxes(joint_response(pose, by_motion), 1, 2)  # joint twist row sample
    columns = [response.reshape(6 * n, *residual.shape), jnp.swapaxes(by_own, 0, 1)]
    if pieces:
        columns.insert(1, jnp.sum(response[jnp.asarray(part.at)] * fields[:, :, None], axis=1))
    return residual, jnp.concatenate(columns)


def _twists(part: Part, steady: Array, coefficients: Array, fields: Array) -> Array:
    if not len(part.at):
        return steady
    place = (jnp.arange(len(steady))[:, None] == jnp.asarray(part.at)).astype(fields.dtype)
    return steady + jnp.tensordot(place, coefficients[:, None, None] * fields, axes=1)


def _tied(device: Device, own: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Constraint rows of a device and their derivatives by its unknowns."""
    if not ties(device):
        return np.zeros(0), np.zeros((0, len(own)))
    tied = jax.jit(lambda device, own: (device.constraint(own), jax.jacfwd(device.constraint)(own)))(device, own)
    return np.asarray(tied[0]), np.asarray(tied[1])


@partial(jax.jit, compiler_options=CPU_OPTIONS)
def _whole(part: Part, local: Array) -> tuple[Array, Array]:
    blocks = (part.position, part.fields, part.datum)
    return jax.lax.map(lambda block: block_rows(part, local, *block), blocks)


def linearise(
    problem: Problem, unknowns: Float[Any, " unknowns"]
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows unknowns"]]:
    """Residual in m and rad at the scaled unknowns, and its exact Jacobian."""
    residuals, jacobians = [], []
    for group, part in zip(problem.groups, parts_of(problem), strict=True):
        local, samples = part.local @ np.asarray(unknowns), np.shape(group.position)[1]
        residual, by_local = (np.asarray(x) for x in _whole(part, local))
        rows = residual.shape[1]
        residuals.append(np.swapaxes(residual, 0, 1).reshape(rows, -1)[:, :samples].reshape(-1))
        each = by_local.transpose(2, 0, 3, 1).reshape(rows, -1, len(local))[:, :samples]
        jacobians.append(each.reshape(-1, len(local)) @ part.local)
        count = len(group.device.unknowns())
        tied, by_own = _tied(group.device, local[len(local) - count :])
        residuals.append(tied)
        jacobians.append(by_own @ part.local[len(local) - count :])
    return np.concatenate(residuals), np.concatenate(jacobians)


def predict(problem: Problem, unknowns: Float[Any, " unknowns"]) -> Float[np.ndarray, " rows"]:
    """Residual in m and rad at the scaled unknowns."""
    return linearise(problem, unknowns)[0]


def sizes(groups: Sequence[Group], columns: Sequence[float]) -> Float[np.ndarray, " unknowns"]:
    """Typical size of every unknown: of the columns' coefficients, then of the devices' own unknowns."""
    return np.array([*columns, *(size for group in groups for _, _, size in group.device.unknowns())])
