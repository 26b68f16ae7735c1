"""What the task's baseline takes of an effect: its columns with their prior, fitted to the untouched recording.

Columns: ten parameters of each link (prior about the nominal ones, as wide as the task trusts them), viscous, Coulomb
and constant torque of each joint, and the declared coupling. Rows are low-passed as the task does and taken at twice
the cutoff, each joint weighted by the RMS of what a flexible model leaves of its torque (baseline and smooth functions
of position and speed): the noise that "left" and D are counted in, taken as white below the cutoff.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .laws import Law
from .motion import Scene
from .recordings import RealSet

Array = np.ndarray
WEAK = 1e-6  # precision of friction and constants, whose scale is set to 1
VISIBLE = (0.3, 5.0)  # least `left` and D of an effect that the data show
KNOTS = 7


class Baseline(NamedTuple):
    """Weighted rows of the fitted recordings and what is needed to project on them."""

    columns: Array  # (rows * joints, parameters), in sigmas
    mean: Array  # of the prior, by parameter
    precision: Array
    sigma: Array  # (joints,) N m
    parameters: Array


class Seen(NamedTuple):
    """How much of an effect the baseline leaves."""

    left: float  # share of its weighted power
    sigmas: float  # D: square root of what is left, in noise sigmas

    @property
    def visible(self) -> bool:
        return self.left >= VISIBLE[0] and self.sigmas >= VISIBLE[1]


def fit(real: RealSet, scenes: Sequence[Scene]) -> tuple[Baseline, list[Scene]]:
    """The baseline of the untouched recordings, and the scenes with the links that it finds."""
    fitted = [s.thin() for s in scenes if s.fitted]
    columns = np.concatenate([rows_of(s, columns_of(s)) for s in fitted])
    flexible = np.concatenate([rows_of(s, smooth_of(s, fitted)) for s in fitted])
    torque = np.concatenate([rows_of(s, s.torque[:, :, None]) for s in fitted])[:, :, 0]
    mean, precision = _prior(real, columns.shape[2])
    sigma = np.sqrt(np.mean(torque**2, 0)) / 10
    theta = mean
    for _ in range(3):
        theta = _solved(_tall(columns, sigma), _tall(torque[:, :, None], sigma)[:, 0], mean, precision)
        rest = torque - columns @ theta
        sigma = np.array([_scatter(flexible[:, j], rest[:, j]) for j in range(len(sigma))])
    inertial = theta[: 10 * len(real.joints)]
    return Baseline(_tall(columns, sigma), mean, precision, sigma, theta), [s.loaded(inertial) for s in scenes]


def seen(baseline: Baseline, scenes: Sequence[Scene], law: Law, strength: float) -> Seen:
    """Project the torque that an effect adds on the baseline's columns with their prior."""
    added = [rows_of(s, law.torque(s, strength)[:, :, None]) for s in scenes if s.fitted]
    z = _tall(np.concatenate(added), baseline.sigma)[:, 0]
    take = baseline.columns.T @ z
    gram = baseline.columns.T @ baseline.columns + np.diag(baseline.precision)
    left = float(z @ z - take @ np.linalg.solve(gram, take))
    return Seen(max(left, 0.0) / float(z @ z), float(np.sqrt(max(left, 0.0))))


def rows_of(scene: Scene, columns: Array) -> Array:
    """Columns (samples, joints, ...) low-passed, at twice the cutoff: (rows, joints, ...)."""
    samples = len(scene.time)
    low = scene.low(columns.reshape(samples, -1)).reshape(columns.shape)
    first, last = scene.time[scene.kept][[0, -1]]
    stamps = np.arange(first, last, 1 / (2 * scene.cutoff))
    return low[np.searchsorted(scene.time, stamps)]


def _tall(rows: Array, sigma: Array) -> Array:
    """(rows, joints, k) in sigmas, as (rows * joints, k)."""
    return (rows / sigma[:, None]).reshape(-1, rows.shape[2])


def columns_of(scene: Scene) -> Array:
    """(samples, joints, parameters) of the baseline."""
    nv = len(scene.joints)
    coarse = scene.regressor()
    parts = [scene.between(coarse.reshape(len(coarse), -1)).reshape(len(scene.time), nv, -1)]
    parts += [x[:, :, None] * np.eye(nv) for x in (scene.v, scene.sign, np.ones_like(scene.v))]
    if scene.baseline_pair:
        parts.append(_coupling(scene, *scene.baseline_pair))
    return np.concatenate(parts, 2)


def _coupling(scene: Scene, i: int, j: int) -> Array:
    out = np.zeros((len(scene.time), len(scene.joints), 3))
    out[:, i, 0], out[:, j, 0] = scene.a[:, j], scene.a[:, i]
    out[:, i, 1], out[:, j, 1] = scene.v[:, j], scene.v[:, i]
    out[:, [i, j], 2] = scene.sign_of(scene.v[:, i] + scene.v[:, j], (scene.width[i] + scene.width[j]) / 2)[:, None]
    return out


def smooth_of(scene: Scene, scenes: Sequence[Scene]) -> Array:
    """(samples, joints, k): hat functions of a joint's position and speed, even and odd in its direction."""
    out = []
    for j in range(len(scene.joints)):
        q, speed = (np.concatenate([x(s)[s.kept, j] for s in scenes]) for x in (lambda s: s.q, lambda s: np.abs(s.v)))
        of_q = _hats(scene.q[:, j], q)
        of_v = _hats(np.abs(scene.v[:, j]), speed)
        sign = scene.sign[:, j : j + 1]
        out.append(np.concatenate([of_q, of_v, sign * of_q, sign * of_v], 1))
    return np.stack(out, 1)


def _hats(x: Array, seen_values: Array) -> Array:
    knots = np.quantile(seen_values, np.linspace(0, 1, KNOTS))
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], 1)


def _scatter(columns: Array, y: Array) -> float:
    """Standard deviation that a ridge on smooth functions leaves, its degrees of freedom counted."""
    gram = columns.T @ columns
    inverse = np.linalg.inv(gram + 1e-3 * np.trace(gram) / len(gram) * np.eye(len(gram)))
    rest = y - columns @ (inverse @ (columns.T @ y))
    free = len(y) - float(np.trace(inverse @ gram))
    return float(np.sqrt(rest @ rest / max(free, 0.1 * len(y))))


def _prior(real: RealSet, count: int) -> tuple[Array, Array]:
    """Mean and precision by parameter: nominal links within `trust`; nothing is known of drives."""
    trust = float(real.task["robot"].get("trust", 0.10))
    mean, precision = np.zeros(count), np.full(count, WEAK)
    for j in range(len(real.joints)):
        body = real.model.inertias[j + 1]
        mass, lever = body.mass, float(np.linalg.norm(body.lever))
        length = max(0.05, lever)
        width = np.trace(body.inertia) / 3 + 0.3 * mass * length**2
        sigma = trust * np.array([mass, *[mass * length] * 3, *[width] * 6])
        here = slice(10 * j, 10 * j + 10)
        mean[here] = body.toDynamicParameters()
        precision[here] = 1 / np.maximum(sigma, 1e-6) ** 2
    return mean, precision


def _solved(X: Array, y: Array, mean: Array, precision: Array) -> Array:
    return mean + np.linalg.solve(X.T @ X + np.diag(precision), X.T @ (y - X @ mean))
