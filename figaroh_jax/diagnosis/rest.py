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

__all__ = ["Rest", "excess", "lines", "rest_of", "verdict", "wrong_law"]

CERTAIN = 0.01
LINE = 1e-3
REPEATED, REPEATED_SHARE = 0.08, 0.05  # excess that repeats: absolute, and as a share of the first excess
FITTED, FITTED_SHARE = 0.03, 0.03  # excess that a flexible model or the catalogue still scores on
UNREPEATED = 0.01  # the same where no recording repeats another
OWN_SHARE = 0.03  # of what a cause has removed: a rest at its own place that speaks against its law
EXPLAINED = 0.9  # share that causes must remove before they are named beside a rest


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
    repeats = p_repeat < CERTAIN and size > max(REPEATED, REPEATED_SHARE * first)
    # without repeats the noise was taken from a model that has fitted part of any misfit
    least = FITTED if p_repeat < 1 else UNREPEATED
    scored = min(flexible[0], p_catalogue) < CERTAIN and size > max(least, FITTED_SHARE * first)
    vibrates = line[0] < LINE
    worst = int(np.argmax(own))
    text = ""
    if repeats or scored:
        text = f"mostly at {joints[worst]} ({own[worst]:.2g} times the noise power)"
        if flexible[0] < CERTAIN:
            text += f"; strongest dependence: {flexible[1].effect} at {flexible[1].at[0]}"
    if vibrates:
        text += f"{'; ' if text else ''}a spectral line at {line[1]:.3g} Hz at {joints[line[2]]}"
    return Rest(bool(repeats or scored or vibrates), size, text)


def wrong_law(at: tuple[str, ...], drop: float, flexible: tuple[float, Name, float]) -> bool:
    """Whether a cause that acts at the joints `at` leaves a rest of its own there, beside the squares it removed.

    The right law leaves noise; one that only resembles it leaves a share of what it stands for.
    """
    p, (_, places), score = flexible
    return p < CERTAIN and (not at or places[0] in at) and score > OWN_SHARE * drop


def verdict(named: bool, rest: Rest, first: float, wrong: bool = False) -> Verdict:
    """The contract's four words from the causes and the rest; `wrong`: the first cause leaves a rest of its own."""
    if not named:
        return "unknown" if rest.significant else "nothing"
    if wrong:
        return "unknown"
    if not rest.significant:
        return "named"
    share = 1 - max(rest.excess, 0.0) / first if first > 0.02 else 0.0
    return "named+rest" if share > EXPLAINED else "unknown"


def lines(problem: Problem, residual: Float[np.ndarray, "nv T"]) -> tuple[float, float, int]:
    """The strongest spectral line of the whitened residual."""
    n, _, count, nv = problem.records.shape
    series = np.moveaxis(residual.reshape(nv, n, count), 0, 2)
    return noise.spectral_line(series, float(problem.records.rate), float(problem.records.cutoff))
