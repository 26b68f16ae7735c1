"""Whether a cause is the same in all recordings: a tool that only some carry, friction of a colder day."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..estimation.rows import block_sums, model_sums
from .estimates import amplitude_places
from .joint import Joint
from .problem import Problem

__all__ = ["recordings_that_differ", "shares_by_recording"]

CHANGES = 0.5  # of a cause's size: recordings that differ by less are said to have the same
KEPT = 1e-12  # of the diagonal: a ridge for numbers that no row shows
MOST_TOLD = 8  # recordings: of more, those with the least and the most
NONE = 0.2  # of its size: a recording that surely has less of it has none to speak of
SURE = 4.0  # standard deviations by which they differ


def recordings_that_differ(problem: Problem, joint: Joint, causes: Sequence[str], names: Sequence[str]) -> list[str]:
    """Notes on the `causes` of an answer that its recordings, `names`, do not have alike."""
    out = []
    for k, cause in enumerate(causes):
        share, deviation, which = shares_by_recording(problem, joint, k)
        if len(share) < 2:
            continue
        low, high = int(np.argmin(share + deviation)), int(np.argmax(share - deviation))
        apart = share[high] - share[low]
        if apart > CHANGES and apart > SURE * np.hypot(deviation[low], deviation[high]):
            order = np.argsort(share).tolist()
            shown = order if len(order) <= MOST_TOLD else [*order[: MOST_TOLD // 2], *order[-MOST_TOLD // 2 :]]
            told = ", ".join(f"{share[r]:.2f} +- {1.96 * deviation[r]:.2f} in {names[which[r]]}" for r in shown)
            absent = share[low] + 1.96 * deviation[low] < NONE
            what = "only some recordings have it" if absent else "some recordings have more of it than others"
            out.append(f"{cause} is told as one size for all recordings, but {what}. Of that size there is {told}")
    return out


def shares_by_recording(
    problem: Problem, joint: Joint, which: int
) -> tuple[Float[np.ndarray, " fitted"], Float[np.ndarray, " fitted"], Int[np.ndarray, " fitted"]]:
    """What share of a cause's size each recording has that is fitted, its standard deviation, and the recording.

    The torque of the cause, cut into that of each recording, stands in place of its size in the fit of all columns.
    Deviations are those of the blocks' scores, right for coloured residuals too; none is less than that of rows which
    are independent. A cause without columns has none.
    """
    step = joint.step
    rows, linear, theta = step.rows, step.linear, step.state.theta
    at = amplitude_places(step.state, joint.causes)[which]
    size = np.zeros_like(theta)
    size[at] = theta[at]
    torque, recordings = rows.X @ size, list(_fitted(problem, rows.block))
    if not at or not torque.any() or len(recordings) < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0, int)
    own = [np.where(used, torque, 0.0) for _, used in recordings]
    beside = _all_but(theta, at)
    crossed = np.stack([rows.X.pulled(one) for one in own], axis=1)
    among = beside.T @ (step.folded.gram.sum(0) + np.diag(step.state.prior.precision)) @ beside
    across = beside.T @ crossed
    H = np.block([[among, across], [across.T, np.diag([(one**2).sum() for one in own])]])
    inverse = np.linalg.inv(H + KEPT * np.diag(np.maximum(np.diag(H), KEPT)))
    without = linear.residual + torque
    pull = [beside.T @ (rows.X.pulled(without) - linear.pull), [(one * without).sum() for one in own]]
    value = inverse @ np.concatenate(pull)
    count = beside.shape[1]
    residual = without - rows.X @ (beside @ value[:count]) - np.einsum("r,rjt->jt", value[count:], np.stack(own))
    scores = [beside.T @ model_sums(rows, rows.X, residual)]
    scores += [sum(block_sums(rows, residual[j], one[j][None]) for j in range(len(one))) for one in own]
    pulls = np.concatenate(scores)
    scatter = np.sqrt(np.maximum(np.diag(inverse @ pulls @ pulls.T @ inverse), 0.0))
    level = max(1.0, float((residual**2).sum()) / max(rows.size - len(H), rows.size / 2))
    deviation = np.maximum(scatter, np.sqrt(level * np.maximum(np.diag(inverse), 0.0)))
    return value[count:], deviation[count:], np.array([number for number, _ in recordings])


def _fitted(problem: Problem, block: Int[np.ndarray, " T"]) -> Iterator[tuple[int, Bool[np.ndarray, " T"]]]:
    """Number and rows of each recording that is fitted."""
    n, _, count, _ = problem.records.shape
    for number, at in enumerate(problem.records.spans):
        used = np.zeros((n, count), bool)
        used[at.slot, at.row : at.row + at.rows] = True
        used = used.reshape(-1) & (block >= 0)
        if used.any():
            yield number, used


def _all_but(theta: Float[np.ndarray, " P"], at: Sequence[int]) -> Float[np.ndarray, "P P-1"]:
    """All directions of the coefficients but that of those `at` some places as they are."""
    own = np.linalg.qr(np.column_stack([theta[at], np.eye(len(at))]))[0][:, 1 : len(at)]
    rest = np.setdiff1d(np.arange(len(theta)), at)
    out = np.zeros((len(theta), len(theta) - 1))
    out[rest, np.arange(len(rest))] = 1.0
    out[np.ix_(at, np.arange(len(rest), len(theta) - 1))] = own
    return out
