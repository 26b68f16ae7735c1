"""Effects that join a level one by one: each the one that gains most on postures left out, as sets of a joint too."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..effects.kinematic import Column
from ..estimation.marginal import Posterior
from . import thresholds
from .kinematic_scores import Waves

__all__ = ["Effects", "Inner", "joined", "rms"]

_EFFECT_WIDTH = 3.0  # of an effect's coefficient, in sizes that move its joint by 1 mrad or 1 mm RMS

Array = np.ndarray


class Effects(NamedTuple):
    """Candidate effects, each a block of columns, linear at the nominal robot with its frames."""

    blocks: tuple[tuple[Column, ...], ...]
    jacobian: Callable[[Float[Array, " unknowns"], Sequence[int]], Float[Array, "rows some"]]  # of blocks, side by side
    handicap: Float[Array, " blocks"]  # share of the error by which a more flexible effect must do better
    grid: int  # so many blocks come before the gear errors of high order, of which `waves` tells which to look at
    waves: Callable[[Float[Array, " unknowns"]], Iterator[Waves]]  # joint by joint, at a fit

    def slices(self, which: Sequence[int]) -> dict[int, slice]:
        """Columns of each of the blocks `which` when they stand side by side."""
        ends = np.cumsum([0, *(len(self.blocks[k]) for k in which)])
        return {k: slice(a, b) for k, a, b in zip(which, ends[:-1], ends[1:], strict=True)}


class _Set(NamedTuple):
    """Effects that joined one by one, what gains nearly as much as each, and the errors on the inner folds."""

    chosen: tuple[int, ...]
    rivals: tuple[tuple[int, ...], ...]
    scores: dict[str, float]
    last: float  # error with all of them

    def cost(self, effects: Effects) -> float:
        """Its error, where each effect must be worth itself and its flexibility."""
        each = (1.0 + effects.handicap[k] for k in self.chosen)
        return self.last * float(np.prod([*each])) / (1.0 - thresholds.EFFECT_GAIN) ** len(self.chosen)


def joined(
    folds: Sequence[Inner], effects: Effects, which: Sequence[int], level: str, room: float
) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...], dict[str, float]]:
    """Of the blocks `which`, those that join, what gains nearly as much as each, and the errors on the inner folds.

    There is `room` for so many columns. Two effects of one joint may be taken for two others when they join one by
    one: each other effect of the joint starts the search again, and a set that predicts better by as much as an effect
    must gain takes their place.
    """
    slices = effects.slices(which)
    best = _grown(folds, effects, slices, level, room, ())
    places, found = [_at(effects, k) for k in best.chosen], [best]
    for place in dict.fromkeys(place for place in places if places.count(place) > 1):
        others = tuple(k for k in best.chosen if _at(effects, k) != place)
        for start in _alternatives(folds, effects, slices, others, place, [_label(effects, k) for k in best.chosen]):
            found.append(_grown(folds, effects, slices, level, room, (*others, start)))
    other = min(found, key=lambda one: one.cost(effects))
    if other.cost(effects) < (1.0 - thresholds.EFFECT_GAIN) * best.cost(effects):
        best = other
    rivals = [
        (*own, *_in_place(folds, effects, slices, best, k, [one for one in found if one is not best]))
        for k, own in zip(best.chosen, best.rivals, strict=True)
    ]
    return best.chosen, tuple(rivals), best.scores


def _in_place(
    folds: Sequence[Inner],
    effects: Effects,
    slices: Mapping[int, slice],
    best: _Set,
    block: int,
    found: Sequence[_Set],
) -> tuple[int, ...]:
    """What stands in the place of a block in other sets, which are else alike, and gains nearly as much."""
    labels = [_label(effects, k) for k in best.chosen]
    stand_ins = []
    for one in found:
        own = [_label(effects, k) for k in one.chosen]
        new = [k for k, label in zip(one.chosen, own, strict=True) if label not in labels]
        if len(new) == 1 and [label for label in labels if label not in own] == [_label(effects, block)]:
            stand_ins.append((new[0], one.last))
    if not stand_ins:
        return ()
    fewer = [inner.copy() for inner in folds]
    for k in best.chosen:
        for inner in fewer if k != block else ():
            inner.take(np.r_[slices[k]])
    without = _score_of(fewer)
    close = without - thresholds.RIVAL * (without - best.last)
    return tuple(k for k, last in stand_ins if last < close)


def _at(effects: Effects, block: int) -> tuple[str, ...]:
    return effects.blocks[block][0].at


def _label(effects: Effects, block: int) -> tuple[str, tuple[str, ...]]:
    return effects.blocks[block][0].effect, _at(effects, block)


def _alternatives(
    folds: Sequence[Inner],
    effects: Effects,
    slices: Mapping[int, slice],
    others: Sequence[int],
    place: tuple[str, ...],
    known: Sequence[tuple[str, tuple[str, ...]]],
) -> list[int]:
    """The best block of every effect at a joint, beside the `others`, that is not `known` already."""
    fresh = [inner.copy() for inner in folds]
    for k in others:
        for inner in fresh:
            inner.take(np.r_[slices[k]])
    found = dict[tuple[str, tuple[str, ...]], int]()
    for k in _screen(fresh, slices, others):
        label = _label(effects, k)
        if label[1] == place and label not in known:
            found.setdefault(label, k)
    return list(found.values())[: thresholds.STARTS]


def _grown(
    whole: Sequence[Inner],
    effects: Effects,
    slices: Mapping[int, slice],
    level: str,
    room: float,
    start: Sequence[int],
) -> _Set:
    """The blocks `start` and those that join them one by one, each the one that gains most on the inner folds."""
    folds, chosen, scores = [inner.copy() for inner in whole], [*start], dict[str, float]()
    rivals: list[tuple[int, ...]] = [() for _ in start]
    for inner in folds if start else ():
        inner.take(np.concatenate([np.r_[slices[k]] for k in start]))
    current = _score_of(folds)
    while len(chosen) < thresholds.MOST_EFFECTS:
        left = room - sum(len(effects.blocks[k]) for k in chosen)
        ranked = [k for k in _screen(folds, slices, chosen) if len(effects.blocks[k]) <= left]
        trials = {k: _score_of(folds, np.r_[slices[k]]) for k in ranked[:12]}
        best = min(trials, key=lambda k: trials[k] * (1.0 + effects.handicap[k]), default=None)
        if best is None or trials[best] > (1.0 - thresholds.EFFECT_GAIN) * current:
            break
        for inner in folds:
            inner.take(np.r_[slices[best]])
        close = current - thresholds.RIVAL * (current - trials[best])
        rivals.append(tuple(k for k in trials if k != best and trials[k] < close))
        current = trials[best]
        chosen.append(best)
        scores[f"{level} + " + " + ".join(_name(effects.blocks[k]) for k in chosen)] = current
    return _Set(tuple(chosen), tuple(rivals), scores, current)


def _name(block: tuple[Column, ...]) -> str:
    return " ".join([block[0].effect, *block[0].at])


class Inner(NamedTuple):
    """An inner fold whitened by its own fit: what candidates are regressed on, and what they must predict."""

    residual: list[Array]  # [whitened, to fit; in m and rad, left out]
    columns: list[Array]  # candidates, projected off what is fitted already: [to fit; left out]
    shape: tuple[Array, Array, int]  # channel and item of the rows left out; how many items

    @classmethod
    def make(cls, measured, linear, inner: Posterior, rows, fold, free, Z) -> Inner:
        """The fold of which the postures `fold` are left out, of the fit `inner` to `rows`; `Z` are the candidates."""
        weight = np.where(linear.posture >= 0, inner.weight[linear.posture], 1.0)
        scale = np.sqrt(weight) / inner.noise[linear.channel]
        fit, out = np.flatnonzero(rows), np.flatnonzero(measured.measured & np.isin(measured.posture, fold))
        residual = linear.residual + linear.jacobian @ (inner.unknowns - linear.at)
        J = linear.jacobian[:, free]
        G = J[fit] * scale[fit, None]
        inverse = inner.covariance[np.ix_(free, free)]
        Z_fit = Z[fit] * scale[fit, None]
        pull = inverse @ (G.T @ Z_fit)  # how the fitted unknowns give way to a candidate
        _, item = np.unique(measured.item[out], return_inverse=True)
        # prior rows belong to the fit: they too see the unknowns give way
        prior = np.sqrt(inner.precision[free])[:, None]
        r_fit = np.concatenate([residual[fit] * scale[fit], prior[:, 0] * inner.unknowns[free]])
        c_fit = np.concatenate([Z_fit - G @ pull, -prior * pull])
        return cls(
            [r_fit, residual[out]], [c_fit, Z[out] - J[out] @ pull], (measured.channel[out], item, item.max() + 1)
        )

    def copy(self) -> Inner:
        """The fold, whose candidates can be fitted for good without a trace here."""
        return self._replace(residual=[*self.residual], columns=[*self.columns])

    def solve(self, which: Array) -> tuple[Array, Array]:
        """Coefficients of the candidates `which` and their normal matrix, each with a wide prior."""
        C = self.columns[0][:, which]
        normal = C.T @ C + np.eye(len(which)) / _EFFECT_WIDTH**2
        return -np.linalg.solve(normal, C.T @ self.residual[0]), normal

    def drops(self, which: Int[Array, "blocks width"]) -> Float[Array, " blocks"]:
        """What each block of candidates, by itself, takes from the squares of the fitted rows."""
        C = self.columns[0][:, which]
        normal = np.einsum("rbi,rbj->bij", C, C, optimize=True) + np.eye(which.shape[1]) / _EFFECT_WIDTH**2
        pull = np.tensordot(self.residual[0], C, axes=1)
        return np.sum(pull * np.linalg.solve(normal, pull[..., None])[..., 0], axis=1)

    def error(self, which: Array) -> list[Array]:
        """Errors of what is left out, with the candidates `which` fitted: of points (m), then of orientations (rad)."""
        residual = self.residual[1] + (self.columns[1][:, which] @ self.solve(which)[0] if len(which) else 0.0)
        channel, item, count = self.shape
        parts = []
        for c in (0, 1):
            mine = channel == c
            square = np.bincount(item[mine], residual[mine] ** 2, minlength=count)
            parts.append(np.sqrt(square[np.bincount(item[mine], minlength=count) > 0]))
        return parts

    def take(self, which: Array) -> None:
        """Fit the candidates `which` for good: project them out of all the others."""
        beta, normal = self.solve(which)
        C, D = self.columns[0][:, which], self.columns[1][:, which]
        pull = np.linalg.solve(normal, C.T @ self.columns[0])
        self.residual[0] = self.residual[0] + C @ beta
        self.residual[1] = self.residual[1] + D @ beta
        self.columns[0] = self.columns[0] - C @ pull
        self.columns[1] = self.columns[1] - D @ pull


def _score_of(folds: Sequence[Inner], which: Array | None = None) -> float:
    parts = [inner.error(np.zeros(0, int) if which is None else which) for inner in folds]
    return _score([np.concatenate([part[c] for part in parts]) for c in (0, 1)])


def _screen(folds: Sequence[Inner], slices: Mapping[int, slice], taken: Sequence[int]) -> list[int]:
    """Blocks by how much of the fitted rows they explain, for their number of columns; not those taken already."""
    merit, by_width = {}, {}
    for k, block in slices.items():
        if k not in taken:
            by_width.setdefault(block.stop - block.start, []).append(k)
    for width, mine in by_width.items():  # blocks of one width at once
        columns = np.array([np.r_[slices[k]] for k in mine])
        drops = np.mean([inner.drops(columns) for inner in folds], axis=0)
        merit |= zip(mine, drops - width * np.log(len(folds[0].residual[0])) / 2, strict=True)
    return sorted(merit, key=lambda k: -merit[k])


def _score(parts: Sequence[Array]) -> float:
    return float(np.exp(np.mean([np.log(rms(part) + 1e-15) for part in parts if len(part)])))


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
