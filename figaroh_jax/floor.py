"""The noise floor: what is left of the torque rows that no repeatable model can explain, as a spectrum per joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from . import noise
from .evidence import Columns, Rows, fit, score
from .noise import Spectrum
from .problem import Problem, State, solved, whitened
from .screening import Group, catalogue

__all__ = ["noise_floor"]

ROUNDS = 2
RICH_CUT = 1e-9  # of the unit-diagonal Gram of the rich model
MOST_OF_ROWS = 0.5  # columns of the rich model, at most this share of a joint's rows


def noise_floor(problem: Problem, state: State) -> tuple[Spectrum, Float[np.ndarray, "F nv"]]:
    """Spectrum of the noise, and the whitening response that follows from it.

    From the differences of repeats where there are some, else from the residual of the richest model. The baseline
    is fitted in between, so that its weights are right; a few rounds settle.
    """
    scale = np.sqrt((problem.torque**2).mean((0, 1))) * 0.05 + 1e-9
    response = np.ones((len(np.asarray(problem.records.omega)), 1)) / scale
    for _ in range(ROUNDS):
        rows = whitened(problem, state, response)
        if problem.layout.repeats:
            state = solved(problem, state, fit(rows, state.prior).theta)
            spectrum = _from_repeats(problem, state)
        else:
            spectrum = _from_rich_model(problem, state, rows, response)
        response = _whitening(problem, spectrum)
    return spectrum, response


def _whitening(problem: Problem, spectrum: Spectrum) -> Float[np.ndarray, "F nv"]:
    frequency = np.asarray(problem.records.omega) / (2 * np.pi)
    return noise.whitening(spectrum, frequency, problem.gain, float(problem.records.cutoff))


def plain_rows(problem: Problem, state: State) -> Rows:
    """Rows as they are, N m or N."""
    return whitened(problem, state, np.ones((len(np.asarray(problem.records.omega)), problem.records.shape[3])))


def _from_repeats(problem: Problem, state: State) -> Spectrum:
    rows = plain_rows(problem, state)
    residual = rows.y - rows.X @ state.theta
    other = rows.instrument(residual, 0) if len(rows.partner) == 1 else _mean_of_partners(rows, residual)
    partners = np.maximum((rows.partner >= 0).sum(0), 1)
    difference = (residual - other) / np.sqrt(1 + 1 / partners)
    return _fit(problem, np.where(rows.paired > 0, difference, 0.0), None)


def _mean_of_partners(rows: Rows, residual: Float[np.ndarray, "nv T"]) -> Float[np.ndarray, "nv T"]:
    return np.stack([rows.instrument(residual[j], j) for j in range(len(residual))])


def _from_rich_model(
    problem: Problem, state: State, rows: Rows, response: Float[np.ndarray, "F nv"]
) -> Spectrum:
    """Residual of the baseline with every group of the catalogue at its best grid point."""
    state = solved(problem, state, fit(rows, state.prior).theta)
    groups = catalogue(problem, state, rows, response, ())
    linear = fit(rows, state.prior)
    best = []
    for group in groups:
        result = score(rows, linear, group.columns)
        point = int(np.argmax(result.Q))
        best.append((float(result.Q[point]), group, point))
    basis = _orthonormal(rows, sorted(best, key=lambda item: -item[0]))
    y = rows.y.reshape(-1)
    residual = (y - basis @ (basis.T @ y)).reshape(rows.y.shape)
    nv, (n, _, count, _) = len(rows.y), problem.records.shape
    taken = basis.reshape(nv, n, count, -1)
    return _fit(problem, residual / np.asarray(response).mean(0)[:, None], np.moveaxis(taken, 0, 2))


def _orthonormal(rows: Rows, best: list[tuple[float, Group, int]]) -> Float[np.ndarray, "nvT columns"]:
    blocks = [rows.X]
    for _, group, point in best:
        if sum(b.shape[-1] for b in blocks) > MOST_OF_ROWS * rows.count / len(rows.y):
            break
        full = np.zeros((*rows.y.shape, group.columns.Z.shape[1]))
        full[list(group.columns.joints)] = np.moveaxis(group.columns.Z[point], 0, 2)
        blocks.append(full)
    tall = np.concatenate(blocks, axis=2).reshape(rows.y.size, -1)
    scale = np.sqrt((tall**2).sum(0))
    tall = tall[:, scale > 0] / scale[scale > 0]
    values, vectors = np.linalg.eigh(tall.T @ tall)
    keep = values > RICH_CUT
    return tall @ (vectors[:, keep] / np.sqrt(values[keep]))


def _fit(problem: Problem, rows: Float[np.ndarray, "nv T"], taken: np.ndarray | None) -> Spectrum:
    """Spectrum of unwhitened noise rows; `taken` is an orthonormal basis of what a model has removed from them."""
    records = problem.records
    n, _, count, nv = records.shape
    rate = float(records.rate)
    frequency = np.fft.rfftfreq(count, 1 / rate)[1:]
    power, share = np.zeros((len(frequency), nv)), np.zeros((len(frequency), nv))
    weights = 0
    for k in range(n):
        series = rows.reshape(nv, n, count)[:, k].T
        used = np.flatnonzero(np.abs(series).max(1) > 0)
        if len(used) < 20:
            continue
        own, p = noise.periodogram(series[used[0] : used[-1] + 1], rate)
        power += len(used) * _onto(frequency, own, p)
        if taken is not None:
            basis = taken[k][used[0] : used[-1] + 1]
            share += len(used) * _onto(frequency, own, noise.leverage(basis))
        weights += len(used)
    power, share = power / weights, share / weights
    left = np.maximum(1 - share, 0.1)
    gain = np.interp(frequency, np.asarray(records.omega) / (2 * np.pi), problem.gain)
    degrees = np.full(len(frequency), max(1.0, weights / count)) * left.mean(1)
    return noise.fit_spectrum(frequency, power / left, gain, degrees, rate / 2)


def _onto(wanted: np.ndarray, own: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(wanted, own, column) for column in values.T], axis=1)
