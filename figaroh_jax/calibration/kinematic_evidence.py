r"""Which corrections of the geometry the postures tell apart, by the evidence for each set of them.

The unknowns of a robot are normal about the nominal ones. A set S of corrections says: those in S as far off as it
takes, every other offset within its stated tolerance, every other link as far off as the links of this robot are,
which is no less than the tolerance. The evidence of S is the marginal likelihood of the rows at the best such widths
(type II maximum likelihood). A robot that is built worse than stated everywhere can hence not be told by one link.

Rows of a posture may err together (markers on one body, a pose whose position and orientation come from one picture).
The likelihood is raised to the power $c = \mathrm{tr}(\Sigma H) / \mathrm{tr}(\Sigma J)$, at most 1: H the information
that the rows say they have, J the covariance of their score summed over postures, as composite likelihoods are
(Varin, Reid and Firth 2011); residuals of a posture are taken with $(I - H_i)^{-1/2}$.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..estimation import marginal
from ..estimation.marginal import Linear
from . import thresholds

__all__ = ["Evidence", "Weighed", "weigh"]

_OFF = 1e-10  # precision of what has no prior
_FACTOR = 2.0**0.5  # between the widths that are tried
_FREE = (10.0**0.5, 100.0)  # widths of a correction that is said to be off, in its tolerance
_PASSES = 3  # over the set: what stands for another may change what is told
_LINKS = (1, 2)  # prior groups of the links: translations and rotations

Array = np.ndarray


class Weighed(NamedTuple):
    """A set of corrections, the logarithm of its evidence, and the widths at which it has that."""

    chosen: tuple[int, ...]
    value: float
    growth: tuple[float, float]  # of the widths of the links' translations and rotations, in tolerances
    width: Float[Array, " unknowns"]


class Evidence:
    """Evidence of sets of corrections, each a place among the unknowns of `linear`, with the stated `width`."""

    def __init__(
        self,
        linear: Linear,
        noise: Float[Array, " rows"],
        used: Bool[Array, " rows"],
        width: Float[Array, " unknowns"],
        places: Sequence[Array],
        named: Sequence[int],
    ) -> None:
        rows = np.flatnonzero(used)
        G = linear.jacobian[rows] / noise[rows, None]
        r = (linear.residual[rows] - linear.jacobian[rows] @ linear.at) / noise[rows]
        self.stated, self.places, self.group = width, places, linear.prior
        self.flat = linear.prior == marginal.FLAT
        self.normal, self.pull, self.square = G.T @ G, G.T @ r, float(r @ r)
        self.power = 1.0
        self.power = self._power(G, r, linear.posture[rows], self.of(named).width)

    def _power(self, G: Array, r: Array, posture: Array, width: Array) -> float:
        """Power of the likelihood that counts in how the rows of a posture go together."""
        covariance = np.linalg.inv(self.normal + np.diag(self._precision(width)))
        left = r - G @ (covariance @ self.pull)
        scores = []
        for k in np.unique(posture[posture >= 0]):
            mine = posture == k
            value, vector = np.linalg.eigh(np.eye(mine.sum()) - G[mine] @ covariance @ G[mine].T)
            unshrunk = vector @ ((vector.T @ left[mine]) / np.sqrt(np.maximum(value, 1e-3)))
            scores.append(G[mine].T @ unshrunk)
        score = np.array(scores)
        spread = float(np.sum((score @ covariance) * score))
        return min(1.0, float(np.sum(covariance * self.normal)) / max(spread, 1e-300))

    def _precision(self, width: Array) -> Array:
        return np.where(self.flat, _OFF, width**-2.0)

    def _log(self, width: Array) -> float:
        """Logarithm of the evidence at given widths, up to what is the same for all."""
        precision = self._precision(width)
        root, size = _root(self.power * self.normal + np.diag(precision))
        half = np.linalg.solve(root, self.power * self.pull)
        fit = half @ half - self.power * self.square
        return float(0.5 * fit - size + 0.5 * np.log(precision).sum())

    def of(self, chosen: Sequence[int], start: tuple[float, float] = (1.0, 1.0)) -> Weighed:
        """The set `chosen` at its best widths, climbed from links that are `start` tolerances wide."""
        scales = {("link", g): s for g, s in zip(_LINKS, start, strict=True)} | {("own", k): 10.0 for k in chosen}

        def width() -> Array:
            found = self.stated.copy()
            for (kind, g), scale in scales.items():
                if kind == "link":
                    found[self.group == g] *= scale
            for k in chosen:
                found[self.places[k]] = self.stated[self.places[k]] * scales["own", k]
            return found

        best = self._log(width())
        moved = True
        while moved:
            moved = False
            for key, before in list(scales.items()):
                least, most = (1.0, 1e3) if key[0] == "link" else _FREE
                for factor in (_FACTOR, 1.0 / _FACTOR):
                    scales[key] = float(np.clip(scales[key] * factor, least, most))
                    value = self._log(width())
                    if value > best + 1e-6:
                        best, moved = value, True
                        break
                    scales[key] = before
        a, b = (scales["link", g] for g in _LINKS)
        return Weighed(tuple(chosen), best, (a, b), width())


def weigh(
    evidence: Evidence, named: Sequence[int], columns: Sequence[int]
) -> tuple[Weighed, dict[int, tuple[int, ...]], list[int]]:
    """Of the corrections `named` those that the postures tell, what each is not told from, and what was left out.

    Where links far beyond their tolerance explain as well what stays, any correction with `columns` might have been
    named, each as likely beforehand: the best of so many must be told by the logarithm of their number more. Beside
    links within their tolerance the scores have counted that. Of what is not told apart the one with the fewest
    columns takes the name: an offset rather than a link.
    """
    now, dropped, same = evidence.of(named), [], {}
    many = float(np.log(max(np.count_nonzero(columns), 1)))
    for _ in range(_PASSES):
        now = _told(evidence, now, many, dropped)
        before, same = now.chosen, {}
        for k in before:
            now, name, others = _instead(evidence, now, k, columns)
            same[name] = others
        if set(now.chosen) == set(before):
            break
    return now, same, [j for j in dropped if j not in now.chosen]


def _told(evidence: Evidence, now: Weighed, many: float, dropped: list[int]) -> Weighed:
    """The set without those that the postures do not tell, which are appended to `dropped`."""
    while now.chosen:
        fewer = [evidence.of([j for j in now.chosen if j != k], now.growth) for k in now.chosen]
        least = max(range(len(fewer)), key=lambda i: fewer[i].value)
        far = max(fewer[least].growth) > thresholds.FAR_OFF
        if now.value - fewer[least].value >= thresholds.TOLD + (many if far else 0.0):
            break
        dropped.append(now.chosen[least])
        now = fewer[least]
    return now


def _instead(evidence: Evidence, now: Weighed, k: int, columns: Sequence[int]) -> tuple[Weighed, int, tuple[int, ...]]:
    """The set with the simplest of what can stand in the place of `k`, that, and what else can."""
    others = [j for j in now.chosen if j != k]
    without = evidence.of(others, now.growth)
    trials = {k: now}
    for j in range(len(evidence.places)):
        if j not in now.chosen and columns[j]:
            trials[j] = evidence.of([*others, j], now.growth)
    best = max(trial.value for trial in trials.values())
    least = max(best - thresholds.TOLD, 0.5 * (best + without.value))
    close = sorted((j for j in trials if trials[j].value >= least), key=lambda j: -trials[j].value)
    name = min(close, key=lambda j: columns[j])  # of equals the likeliest
    return trials[name], name, tuple(j for j in close if j != name)


def _root(matrix: Array) -> tuple[Array, float]:
    """R with R R' the matrix, and log |det R|; what rounding makes negative, where rows tell little, is none."""
    try:
        root = np.linalg.cholesky(matrix)
        return root, float(np.log(np.diag(root)).sum())
    except np.linalg.LinAlgError:
        scale = np.sqrt(np.diag(matrix))
        values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
        values = np.maximum(values, len(values) * np.finfo(float).eps)
        return scale[:, None] * vectors * np.sqrt(values), float(np.log(scale).sum() + 0.5 * np.log(values).sum())
