"""Candidates of the kinematic catalogue at every place where they can act, and their columns on the rows of a problem.

A coefficient is counted in the size that moves its joint by 1 mrad or 1 mm RMS over the postures. An effect that does
nothing in these postures (no payload, a vertical axis under gravity) is no candidate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..effects.kinematic import CATALOGUE, HISTORY, Column, Postures, axis_twist, columns_of, moving_with, shape_of
from ..estimation import posefit
from ..estimation.posegroups import Measured
from ..recordings.poses import PoseRecording
from ..results import Name
from ..rigid.model import RobotModel, dofs
from .kinematic_scores import Waves
from .levels import Effects

__all__ = [
    "GEOMETRY",
    "Block",
    "Moves",
    "blocks_of",
    "effects_on",
    "empty_columns",
    "geometry_columns",
    "known_frames",
    "moved_rows",
    "moves",
    "sizes_of",
    "twist_rows",
]

GEOMETRY = ("joint_offset", "link_geometry")
_STEP = 1e-3  # rad or m
_STILL = 1e-9  # rad or m per unit: the effect does nothing
_HIGHEST = 400.0  # order of a gear error that is looked for: two periods a turn of a motor behind 200 : 1
_NARROW = 0.2  # rad: a joint that moves less shows no order
_RESOLVED = 8  # orders of a joint for each posture, that are looked for at the most
_WAVES_KEPT = 1_000_000  # numbers of a joint's waves that are held from fit to fit
_SLOTS = 6, 12  # columns and pieces of effects for which a fit has room


Moves = list[tuple[int, Float[np.ndarray, "6 samples"]]]


class Block(NamedTuple):
    """An effect at a place with one value of its shape parameter."""

    effect: type[Effect]
    columns: tuple[Column, ...]
    sizes: tuple[float, ...]
    shape: float
    shape_std: float = float("nan")
    reach: float = 0.0  # how far the shape may be from the truth; 0: as far as the next value of the catalogue's grid

    def near(self, other: Block) -> bool:
        """Whether both are one effect at one place, with shapes that the postures do not tell apart."""
        reach = 2.0 * max(self.reach, other.reach)
        return self.name == other.name and (not reach or abs(self.shape - other.shape) <= reach)

    @property
    def name(self) -> Name:
        """Effect and place."""
        return Name(self.effect.name, self.columns[0].at)


def geometry_columns(model: RobotModel, chain: Sequence[int]) -> tuple[Column, ...]:
    """Offsets of all joints of the chain, then the geometry of their links."""
    return tuple(c for name in GEOMETRY for j in chain for c in columns_of(CATALOGUE[name], model, (j,)))


def empty_columns(joint: int, effects: Sequence[Column]) -> list[Column]:
    """Columns that do nothing, so that fits with other `effects` have the same shape and share a compiled program."""
    columns, pieces = -len(effects) % _SLOTS[0], -sum(len(c.pieces) for c in effects) % _SLOTS[1]
    if not effects:
        columns, pieces = _SLOTS
    if not columns:
        columns, pieces = _SLOTS[0], pieces or _SLOTS[1]
    still = (joint, lambda postures: np.zeros((6, len(postures.q))))
    return [Column("", (), "", "", (still,) * (pieces * (k == 0))) for k in range(columns)]


def blocks_of(
    model: RobotModel,
    chain: Sequence[int],
    postures: Sequence[Postures],
    forbid: Sequence[str] = (),
    frames: Mapping[str, tuple[int, int]] = MappingProxyType({}),
) -> tuple[Block, ...]:
    """Every candidate beyond geometry that does something in these postures.

    `frames` are those of base and tool that are said to be known: the joint beside each, and the frame's index.
    """
    found = []
    for effect in (*CATALOGUE.values(), HISTORY):
        if effect.name in GEOMETRY or effect.name in forbid:
            continue
        for at in _places(effect, chain, frames):
            for shape in shape_of(effect)[1]:
                columns = columns_of(effect, model, at, shape)
                sizes = sizes_of(columns, postures)
                if effect is HISTORY:  # of joints that move
                    columns = tuple(c for c, size in zip(columns, sizes, strict=True) if np.isfinite(size))
                    sizes = sizes[np.isfinite(sizes)]
                if len(columns) and np.isfinite(sizes).all():
                    found.append(Block(effect, columns, tuple(sizes), shape))
    high = () if "gear_transmission_error" in forbid else _high_orders(model, chain, postures)
    return (*found, *high)


def _high_orders(model: RobotModel, chain: Sequence[int], postures: Sequence[Postures]) -> list[Block]:
    """Gear errors of orders beyond the catalogue's grid, half as far apart as the range of the joint resolves.

    Two waves over a range R are told apart where their orders differ by 2 pi / R.
    """
    effect, found = CATALOGUE["gear_transmission_error"], []
    for j in (j for j in chain if model.joints[j].kind == "revolute"):
        q = positions_of(model, postures, j)
        if np.ptp(q) < _NARROW:
            continue
        step, lowest = np.pi / np.ptp(q), shape_of(effect)[1][-1]
        count = min(int((_HIGHEST - lowest) / step), _RESOLVED * len(q))
        orders = lowest + step * np.arange(1, count + 1)
        waves = np.stack([wave(np.outer(orders, q)) for wave in (np.sin, np.cos)], axis=1)
        sizes = _STEP / np.maximum(np.sqrt(np.mean(waves**2, axis=2)), 0.1)
        for order, size in zip(orders.tolist(), sizes.tolist(), strict=True):
            found.append(Block(effect, columns_of(effect, model, (j,), order), tuple(size), order, reach=step))
    return found


def positions_of(model: RobotModel, postures: Sequence[Postures], joint: int) -> Float[np.ndarray, " samples"]:
    """Position of one joint in all postures."""
    return np.concatenate([p.q[:, dofs(model.joints).positions[joint].start] for p in postures])


def sizes_of(columns: Sequence[Column], postures: Sequence[Postures]) -> Float[np.ndarray, " columns"]:
    """Coefficient of each column that moves its joints by 1 mrad or 1 mm RMS; infinite where none does."""
    sizes = []
    for column in columns:
        fields = np.concatenate([np.concatenate([f(p) for p in postures], axis=1) for _, f in column.pieces], axis=1)
        size = np.sqrt(np.mean(np.sum(fields**2, axis=0)))
        sizes.append(_STEP / size if size > _STILL else np.inf)
    return np.array(sizes)


def known_frames(
    model: RobotModel, chain: Sequence[int], recordings: Sequence[PoseRecording]
) -> dict[str, tuple[int, int]]:
    """Base and tool frame where all recordings see one, and say that it is known: the joint beside it, its index."""
    found = {}
    for name, joint in (("base_frame", chain[0]), ("tool_frame", chain[-1])):
        frames = {getattr(r, name) for r in recordings}
        seen = all(name not in r.unknown and r.kind in ("pose", "position") for r in recordings)
        if seen and len(frames) == 1:
            found[name] = joint, model.frame_index(frames.pop())
    return found


def _places(effect: type[Effect], chain: Sequence[int], frames: Mapping[str, tuple[int, int]]) -> list[tuple[int, ...]]:
    if effect.acts_on == "robot":
        return [()]
    if effect.acts_on == "frame":
        return [frames[effect.name]] if effect.name in frames else []
    if effect.acts_on == "joint":
        return [(j,) for j in chain]
    pairs = [(a, b) for a, b in zip(chain[:-1], chain[1:], strict=True)]
    return pairs + [(b, a) for a, b in pairs]


def effects_on(model: RobotModel, postures: Sequence[Postures], measured: Measured, blocks: Sequence[Block]) -> Effects:
    """The candidates with their exact columns at any fit of `measured`, which has all twists of every joint."""
    grid = sum(not block.reach for block in blocks)
    high: dict[int, list[int]] = {}  # joint: its orders beyond the grid
    for k in range(grid, len(blocks)):
        high.setdefault(blocks[k].columns[0].pieces[0][0], []).append(k)
    kept: dict[int, list[Moves]] = {}  # of the grid all are needed again and again, of the many high orders a few

    def jacobian(unknowns: Float[np.ndarray, " unknowns"], which: Sequence[int]) -> Float[np.ndarray, "rows some"]:
        if not len(which):
            return np.zeros((len(measured.posture), 0))
        for k in set(which) - kept.keys():
            kept[k] = [moves(column, postures) for column in blocks[k].columns]
        sizes = np.array([size for k in which for size in blocks[k].sizes])
        return moved_rows(measured, twist_rows(measured, unknowns), [m for k in which for m in kept[k]]) * sizes

    def waves(unknowns: Float[np.ndarray, " unknowns"]) -> Iterator[Waves]:
        by_twist = twist_rows(measured, unknowns) if high else {}
        for joint, which in high.items():
            moved = [(k, factor) for k, factor in moving_with(model, joint) if k in by_twist]
            rows = sum((f * by_twist[k] @ axis_twist(model, k) for k, f in moved), np.zeros(len(measured.posture)))
            sine, cosine = turned.get(joint) or of_angle(joint, which)
            if sine.size <= _WAVES_KEPT:
                turned[joint] = sine, cosine
            yield Waves(np.array(which), np.where(measured.posture >= 0, rows, 0.0), sine, cosine)

    turned: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def of_angle(joint: int, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        phase = np.outer(positions_of(model, postures, joint), [blocks[k].shape for k in which])
        return np.sin(phase), np.cos(phase)

    count = np.array([len(shape_of(b.effect)[1]) if not b.reach else len(blocks) - grid for b in blocks])
    handicap = 0.01 * (np.array([len(b.columns) for b in blocks]) - 1) + 0.005 * np.log(count)
    return Effects(tuple(block.columns for block in blocks), jacobian, np.array(handicap), grid, waves)


def moves(column: Column, postures: Sequence[Postures]) -> Moves:
    """The joints that a column moves, each with the twist of a unit of it in all postures."""
    return [(joint, np.concatenate([f(p) for p in postures], axis=1)) for joint, f in column.pieces]


def twist_rows(measured: Measured, unknowns: Float[np.ndarray, " unknowns"]) -> dict[int, Float[np.ndarray, "rows 6"]]:
    """Derivative of the rows (m, rad) by a twist of each joint, from those by its offset and its geometry.

    They are an orthonormal basis of the joint's twists, so `measured` must have them all.
    """
    jacobian = posefit.linearise(measured.problem, unknowns)[1] / np.asarray(measured.problem.scale)
    none = np.zeros((1, 0))
    still = Postures(none, none, none, none, none, np.zeros(1), 1.0)
    found: dict[int, np.ndarray] = {}
    for k, column in enumerate(measured.columns):
        if column.effect in GEOMETRY:
            ((joint, field),) = column.pieces
            found[joint] = found.get(joint, 0.0) + np.outer(jacobian[:, k], field(still)[:, 0])
    return found


def moved_rows(
    measured: Measured, by_twist: Mapping[int, Float[np.ndarray, "rows 6"]], moved: Sequence[Moves]
) -> Float[np.ndarray, "rows columns"]:
    """Derivative of the rows by columns that move joints by twists, other ones in each posture."""
    inside = measured.posture >= 0
    posture = measured.posture[inside]
    found = np.zeros((len(inside), len(moved)))
    for k, pieces in enumerate(moved):
        for joint, twist in pieces:
            if joint in by_twist:
                found[inside, k] += np.einsum("nt,tn->n", by_twist[joint][inside], twist[:, posture])
    return found
