"""Whether what is kept out of the fit bears an effect out at all: its exact torque, of which only the size is open.

Its column stands beside a full baseline: links with their prior, friction, constants and the declared coupling of
`baseline`, alone and with smooth functions of each joint's position and speed, each expected to be as large as what the
baseline leaves. All are fitted to the recordings that the task fits; then the effect must surely lower the error of
those that it keeps out (quarters of the others where it keeps none), at the joints where it acts. Rows weigh as rows of
that speed err. A tool that is asked the same of a law whose place and shape it must find cannot do better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .baseline import Baseline, columns_of, rows_of, smooth_of
from .motion import Scene

Array = np.ndarray
SURELY = 0.05  # p-value of the fall of the error
BLOCK, FEWEST = 1.0, 8  # s; blocks of a recording
QUARTERS = 4
EDGES = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35)  # of a joint's top speed
FAST = 0.12  # from which rows have the weight one
EXACT, DRAWS = 12, 4000  # blocks up to which every choice of signs is made; choices beyond


class Borne(NamedTuple):
    """What the effect takes of the squared error of data kept out, at its joints."""

    share: float
    chance: float  # p-value of the fall: of the blocks' differences with signs at random

    @property
    def sure(self) -> bool:
        return self.share > 0 and self.chance < SURELY


class Part(NamedTuple):
    """One fit and what it is to predict: which rows are fitted, the blocks of the others (-1: neither)."""

    fitted: Array  # (rows,) bool
    block: Array  # (rows,) int


class Oracle:
    """Rows of all recordings of a robot, in sigmas, and the baselines that an effect is put beside."""

    def __init__(self, baseline: Baseline, scenes: Sequence[Scene]) -> None:
        thin = [s.thin() for s in scenes]
        fitted = [s for s in thin if s.fitted]
        self.thin, self.coarse, self.sigma = thin, [s.coarse for s in scenes], baseline.sigma
        X = np.concatenate([rows_of(s, columns_of(s)) for s in thin]) / self.sigma[:, None]
        smooth = np.concatenate([rows_of(s, smooth_of(s, fitted)) for s in thin])
        self.y = np.concatenate([rows_of(s, s.torque[:, :, None])[:, :, 0] for s in thin]) / self.sigma
        self.parts = _parts(thin)
        used = np.any([p.fitted for p in self.parts], axis=0)
        rest = self.y - X @ baseline.parameters
        speed = np.concatenate([rows_of(s, np.abs(s.v)[:, :, None])[:, :, 0] for s in thin])
        self.weight = _by_speed(speed, rest, used)
        rms = np.sqrt(np.mean(rest[used] ** 2, 0))
        nv, k = smooth.shape[1:]
        S = (smooth[:, :, None, :] * np.eye(nv)[:, :, None]).reshape(len(smooth), nv, nv * k) / self.sigma[:, None]
        prior = np.repeat((rms * self.sigma) ** -2.0, k)
        self.mean = baseline.mean
        self.bases = [(X, baseline.precision), (np.concatenate([X, S], 2), np.append(baseline.precision, prior))]

    def borne_out(self, added: Sequence[Array], joints: Sequence[int]) -> Borne:
        """Of the torque (samples, joints) that an effect adds to each recording; `joints`: where it acts, none: all."""
        each = zip(self.thin, self.coarse, added, strict=True)
        z = np.concatenate([rows_of(s, x[rows, :, None])[:, :, 0] for s, rows, x in each]) / self.sigma
        where = list(joints) or list(range(z.shape[1]))
        return min((self._beside(X, precision, z, where) for X, precision in self.bases), key=lambda one: one.chance)

    def _beside(self, X: Array, precision: Array, z: Array, joints: list[int]) -> Borne:
        before, after = [], []
        for part in self.parts:
            errors = (self._error(X, precision, part, z, known) for known in (False, True))
            kept = part.block >= 0
            for found, error in zip((before, after), errors, strict=True):
                squares = ((error * self.weight)[:, joints] ** 2).sum(1)
                found.append(np.bincount(part.block[kept], squares[kept]))
        worse, better = np.concatenate(before), np.concatenate(after)
        return Borne(float(1 - better.sum() / worse.sum()), _by_chance(worse - better))

    def _error(self, X: Array, precision: Array, part: Part, z: Array, known: bool) -> Array:
        """(rows, joints) of the fit to a part's rows of the torque with `z` added; whether the fit has that column."""
        mean, y = np.append(self.mean, np.zeros(X.shape[2] - len(self.mean))), self.y + z
        if known:
            X, mean = np.concatenate([X, z[:, :, None]], 2), np.append(mean, 0.0)
            precision = np.append(precision, 1e-6)
        w = (self.weight * part.fitted[:, None])[:, :, None]
        tall, right = (X * w).reshape(-1, X.shape[2]), (y * w[:, :, 0]).reshape(-1)
        gram = tall.T @ tall + np.diag(precision)
        theta = mean + np.linalg.solve(gram, tall.T @ (right - tall @ mean))
        return y - X @ theta


def _parts(scenes: Sequence[Scene]) -> list[Part]:
    """The fitted recordings and the others; without others, the quarters of each, one left out in turn."""
    count = [len(rows_of(s, s.v[:, :, None])) for s in scenes]
    fitted = np.repeat([s.fitted for s in scenes], count)
    block, first = [], 0
    for scene, rows in zip(scenes, count, strict=True):
        width = max(1.0, min(BLOCK * 2 * scene.cutoff, rows / FEWEST))
        block.append(first + (np.arange(rows) // width).astype(int))
        first = int(block[-1][-1]) + 1
    blocks = np.concatenate(block)
    if not fitted.all():
        return [Part(fitted, np.where(fitted, -1, blocks))]
    quarter = np.concatenate([np.arange(n) * QUARTERS // n for n in count])
    return [Part(quarter != k, np.where(quarter == k, blocks, -1)) for k in range(QUARTERS)]


def _by_speed(speed: Array, rest: Array, used: Array) -> Array:
    """(rows, joints): RMS that fast rows leave, over that of rows of that speed; never more for slower ones."""
    relative = speed / speed[used].max(0)
    out = np.ones(speed.shape)
    for j in range(speed.shape[1]):
        number = np.searchsorted(EDGES, relative[:, j], "right") - 1
        fast = np.mean(rest[used & (relative[:, j] >= FAST), j] ** 2)
        factor = 1.0
        for k in reversed(range(EDGES.index(FAST))):
            own = rest[used & (number == k), j]
            if len(own):
                factor = max(factor, float(np.mean(own**2) / fast))
            out[number == k, j] = factor**-0.5
    return out


def _by_chance(gain: Array) -> float:
    """How often the blocks' differences with signs at random sum to as much: exact for few blocks."""
    gain = gain[gain != 0]
    if len(gain) <= EXACT:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(gain))[:, None] >> np.arange(len(gain))) & 1)
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (DRAWS, len(gain)))
        signs[0] = 1.0
    return float(np.mean(signs @ gain >= gain.sum() - 1e-12 * np.abs(gain).sum()))
