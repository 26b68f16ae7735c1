"""Candidates of the kinematic catalogue at every place where they can act, and their columns on the rows of a problem.

A coefficient is counted in the size that moves its joint by 1 mrad or 1 mm RMS over the postures. An effect that does
nothing in these postures (no payload, a vertical axis under gravity) is no candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..model import RobotModel
from . import posefit
from .kinematic_effects import CATALOGUE, HISTORY, Column, KinematicEffect, Postures, columns_of
from .levels import Effects
from .posegroups import Measured, assemble
from .poserecords import PoseRecording

__all__ = ["Block", "GEOMETRY", "blocks_of", "effects_on", "geometry_columns", "sizes_of"]

GEOMETRY = ("joint_offset", "link_geometry")
_STEP = 1e-3  # rad or m
_STILL = 1e-9  # rad or m per unit: the effect does nothing


class Block(NamedTuple):
    """An effect at a place with one value of its shape parameter."""

    effect: KinematicEffect
    columns: tuple[Column, ...]
    sizes: tuple[float, ...]
    shape: float


def geometry_columns(model: RobotModel, chain: Sequence[int]) -> tuple[Column, ...]:
    """Offsets of all joints of the chain, then the geometry of their links."""
    return tuple(c for name in GEOMETRY for j in chain for c in columns_of(CATALOGUE[name], model, (j,)))


def blocks_of(
    model: RobotModel, chain: Sequence[int], postures: Sequence[Postures], forbid: Sequence[str] = ()
) -> tuple[Block, ...]:
    """Every candidate beyond geometry that does something in these postures."""
    found = []
    for effect in (*CATALOGUE.values(), HISTORY):
        if effect.name in GEOMETRY or effect.name in forbid:
            continue
        for at in _places(effect, model, chain):
            for shape in effect.shape[1]:
                columns = columns_of(effect, model, at, shape)
                sizes = sizes_of(columns, postures)
                if effect is HISTORY:  # of joints that move
                    columns = tuple(c for c, size in zip(columns, sizes, strict=True) if np.isfinite(size))
                    sizes = sizes[np.isfinite(sizes)]
                if len(columns) and np.isfinite(sizes).all():
                    found.append(Block(effect, columns, tuple(sizes), shape))
    return tuple(found)


def sizes_of(columns: Sequence[Column], postures: Sequence[Postures]) -> Float[np.ndarray, " columns"]:
    """Coefficient of each column that moves its joints by 1 mrad or 1 mm RMS; infinite where none does."""
    sizes = []
    for column in columns:
        fields = np.concatenate([np.concatenate([f(p) for p in postures], axis=1) for _, f in column.pieces], axis=1)
        size = np.sqrt(np.mean(np.sum(fields**2, axis=0)))
        sizes.append(_STEP / size if size > _STILL else np.inf)
    return np.array(sizes)


def _places(effect: KinematicEffect, model: RobotModel, chain: Sequence[int]) -> list[tuple[int, ...]]:
    if effect.acts_on == "robot":
        return [()]
    if effect.acts_on == "joint":
        return [(j,) for j in chain]
    pairs = [(a, b) for a, b in zip(chain[:-1], chain[1:], strict=True)]
    return pairs + [(b, a) for a, b in pairs]


def effects_on(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    postures: Sequence[Postures],
    measured: Measured,
    blocks: Sequence[Block],
) -> Effects:
    """The candidates with their exact columns at any fit of `measured`."""
    extra = [column for block in blocks for column in block.columns]
    sizes = np.array([size for block in blocks for size in block.sizes])
    own = np.asarray(measured.problem.scale)[: len(measured.columns)]
    wide = assemble(model, recordings, postures, [*measured.columns, *extra], [*own, *sizes])
    first, last = len(measured.columns), len(measured.columns) + len(extra)

    def jacobian(at: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, "rows all"]:
        whole = np.concatenate([at[:first], np.zeros(len(extra)), at[first:]])
        return posefit.linearise(wide.problem, whole)[1][:, first:last]

    handicap = [0.01 * (len(b.columns) - 1) + 0.005 * np.log(len(b.effect.shape[1])) for b in blocks]
    return Effects(tuple(block.columns for block in blocks), jacobian, sizes, np.array(handicap))
