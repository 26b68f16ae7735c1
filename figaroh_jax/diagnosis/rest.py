"""What is left when the causes are in: noise, or a misfit that has no name."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..estimation import noise
from ..estimation.noise import Spectrum
from ..estimation.rows import Rows
from ..results import Name, Verdict
from .problem import Problem
from .screening import draw_noise
from .thresholds import FITTED, FITTED_SHARE, LINE_P, OWN_SHARE, REPEATED, REPEATED_SHARE, REST_P, UNREPEATED

__all__ = ["Rest", "excess", "lines", "rest_of", "verdict", "wrong_law"]


class Rest(NamedTuple):
    """Significance and size of what is left: excess is power over the noise's, as a share of it."""

    significant: bool
    excess: float
    text: str


def excess(
    problem: Problem, rows: Rows, residual: Float[np.ndarray, "nv T"], spectrum: Spectrum, whitening: np.ndarray
) -> tuple[float, float, Float[np.ndarray, " nv"]]:
    """Excess of the residual over the noise, its one-sided p-value, and the excess of each joint.

    With repeats the power that repeats (products of the two residuals; p from blocks); else the mean square less that
    of noise with the estimated spectrum (no p of its own: 1).
    """
    level = (draw_noise(problem, spectrum, whitening, 20, np.random.default_rng(1)) ** 2).sum(2).mean(0)
    if not problem.layout.repeats:
        own = (residual**2).sum(1) - level
        return float(own.sum() / level.sum()), 1.0, own / level
    other = np.stack([rows.instrument(residual[j], j) for j in range(len(residual))])
    products = residual * other
    blocks = np.bincount(rows.block[rows.block >= 0], products.sum(0)[rows.block >= 0])
    z = blocks.sum() / np.sqrt((blocks**2).sum() + 1e-300)
    share = rows.paired.mean(1) * level
    from scipy.special import ndtr  # scipy is slow to import

    return float(products.sum() / share.sum()), float(ndtr(-z)), products.sum(1) / share


def rest_of(
    now: tuple[float, float, Float[np.ndarray, " nv"]],
    first: float,
    p_catalogue: float,
    flexible: tuple[float, Name, float],
    line: tuple[float, float, int],
    joints: tuple[str, ...],
) -> Rest:
    """Whether the rest is significant, and a description without a cause's name."""
    size, p_repeat, own = now
    repeats = p_repeat < REST_P and size > max(REPEATED, REPEATED_SHARE * first)
    # without repeats the noise was taken from a model that has fitted part of any misfit
    least = FITTED if p_repeat < 1 else UNREPEATED
    scored = min(flexible[0], p_catalogue) < REST_P and size > max(least, FITTED_SHARE * first)
    vibrates = line[0] < LINE_P
    worst = int(np.argmax(own))
    text = ""
    if repeats or scored:
        text = f"most of it at {joints[worst]} ({own[worst]:.2g} times the noise power)"
        if flexible[0] < REST_P:
            text += f"; strongest dependence: {flexible[1].effect} at {flexible[1].at[0]}"
    if vibrates:
        text += f"{'; ' if text else ''}a line at {line[1]:.3g} Hz in time at {joints[line[2]]}"
    return Rest(bool(repeats or scored or vibrates), size, text)


def wrong_law(at: tuple[str, ...], drop: float, flexible: tuple[float, Name, float]) -> bool:
    """Whether a cause that acts at the joints `at` leaves a rest of its own there, beside the squares it removed.

    The right law leaves noise; one that only resembles it leaves a share of what it stands for.
    """
    p, (_, places), score = flexible
    return p < REST_P and (not at or places[0] in at) and score > OWN_SHARE * drop


def verdict(named: bool, rest: bool) -> Verdict:
    """The contract's four words: whether a cause is named, and whether something is left that is not noise."""
    if named:
        return "named+rest" if rest else "named"
    return "unknown" if rest else "nothing"


def lines(problem: Problem, residual: Float[np.ndarray, "nv T"]) -> tuple[float, float, int]:
    """The strongest spectral line of the whitened residual."""
    n, _, count, nv = problem.records.shape
    series = np.moveaxis(residual.reshape(nv, n, count), 0, 2)
    return noise.spectral_line(series, float(problem.records.rate), float(problem.records.cutoff))
