"""How far estimates may be trusted where the residuals are coloured.

Neighbouring rows share filtered noise, so the textbook covariance is too small. Each joint's residual gives its
autocovariance, and the estimator's covariance follows from that exactly (a sandwich whose middle is X' C X).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from .regression import Piece, Regression

__all__ = ["coloured_covariance"]

LAGS = 0.5  # s: the memory of the noise that is looked at, twice a period of the cutoff at least
PERIODS = 8.0


def coloured_covariance(
    regression: Regression,
    theta: Float[np.ndarray, " columns"],
    kept: Sequence[int] | Int[np.ndarray, " kept"],
    weight: Float[np.ndarray, " nv"],
) -> Float[np.ndarray, "kept kept"]:
    """Covariance of the weighted least squares estimate `theta` of the columns `kept`, under coloured residuals.

    `A^-1 (sum_j w_j^2 X_j' C_j X_j) A^-1` with A = X' w X and C_j the Toeplitz matrix of the residual's autocovariance
    under a Parzen window; noise of different joints is taken as independent. The variance of each joint is freed of
    what the fit has taken away (its expectation under C, not rows less parameters).
    """
    lags = _lags(regression)
    covariance, overlap = np.zeros((lags, len(weight))), np.zeros((lags, len(weight)))
    for piece in regression.pieces():
        error, mask = _masked(piece.y - piece.X @ theta, piece), _masked(np.ones_like(piece.y), piece)
        covariance += _correlation(error, lags)
        overlap += _correlation(mask, lags)
    window = _parzen(lags)
    C = np.where(overlap > 0, covariance / np.maximum(overlap, 1.0), 0.0) * window[:, None]
    A, M = _sums(regression, kept, weight, C)
    size = np.sqrt(np.maximum(np.diagonal(A.sum(axis=0)), 1e-300))
    total, middle = A.sum(axis=0) / np.outer(size, size), M / np.outer(size, size)
    inverse = np.linalg.pinv(total, hermitian=True)
    middle = (middle * _freed(A / np.outer(size, size), middle, inverse, weight, C, overlap)[:, None, None]).sum(axis=0)
    values, vectors = np.linalg.eigh(inverse @ middle @ inverse)
    # rounding may leave a variance below zero where hardly anything moved
    return (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(size, size)


def _freed(A, M, inverse, weight, C, rows) -> Float[np.ndarray, " nv"]:
    """Factor of each joint's variance: its mean square residual is smaller than that of the noise by the fit."""
    square = weight * C[0] * rows[0]  # what the residual shows
    middle = M.sum(axis=0)
    out = np.ones(len(weight))
    for j in range(len(weight)):
        taken = 2 * np.trace(inverse @ M[j]) - np.trace(inverse @ A[j] @ inverse @ middle)
        # the squares shown are those of the noise less `taken`, which grows with the noise itself
        out[j] = 1 / max(1 - taken / square[j], 0.1) if square[j] > 0 else 1.0
    return np.minimum(out, 10.0)


def _sums(regression: Regression, kept: Sequence[int] | Int[np.ndarray, " kept"], weight: np.ndarray, C: np.ndarray):
    """X' w X and w^2 X' C X of each joint."""
    nv, columns = len(weight), len(kept)
    A, M = np.zeros((nv, columns, columns)), np.zeros((nv, columns, columns))
    for piece in regression.pieces():
        for j in range(nv):
            X = piece.X[:, j][:, list(kept)] * (piece.weight[:, j] > 0)[:, None]
            own = X.any(axis=0)
            X = X[:, own]
            if not X.size:
                continue
            grid = np.ix_(own, own)
            A[j][grid] += weight[j] * (X.T @ X)
            M[j][grid] += weight[j] ** 2 * _under(C[:, j], X)
    return A, M


def _under(C: Float[np.ndarray, " lags"], X: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "k k"]:
    """X' T X for the symmetric Toeplitz matrix T of the autocovariance C."""
    length = 1 << int(np.ceil(np.log2(len(X) + len(C))))
    circular = np.zeros(length)
    circular[: len(C)] = C
    circular[-len(C) + 1 :] += C[:0:-1]
    power = np.maximum(np.fft.rfft(circular).real, 0.0)
    return X.T @ np.fft.irfft(np.fft.rfft(X, length, axis=0) * power[:, None], length, axis=0)[: len(X)]


def _lags(regression: Regression) -> int:
    one = regression.signals[0]
    period = one.dt * one.rows.step
    fewest = min(s.rows.kept for s in regression.signals)
    return max(2, min(int(max(LAGS, PERIODS / one.cutoff) / period), fewest // 4))


def _parzen(lags: int) -> Float[np.ndarray, " lags"]:
    u = np.arange(lags) / lags
    return np.where(u < 0.5, 1 - 6 * u**2 * (1 - u), 2 * (1 - u) ** 3)


def _masked(signal: np.ndarray, piece: Piece) -> np.ndarray:
    return np.where(piece.weight > 0, signal, 0.0)


def _correlation(x: Float[np.ndarray, "rows nv"], lags: int) -> Float[np.ndarray, "lags nv"]:
    """Sum of products of every lag, within one piece."""
    length = 1 << int(np.ceil(np.log2(len(x) + lags)))
    spectrum = np.fft.rfft(x, length, axis=0)
    return np.fft.irfft(np.abs(spectrum) ** 2, length, axis=0)[:lags]
