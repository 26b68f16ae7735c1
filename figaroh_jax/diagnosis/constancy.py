"""Whether a cause is the same in all recordings: a tool that only some carry, friction of a colder day."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..estimation.joint_rows import JointRows
from ..estimation.rows import block_sums, model_sums
from ..results import Name
from .estimates import amplitude_places
from .flexible import dependences
from .holdout import residual_rms
from .joint import Joint
from .layout import FOLDS
from .problem import Problem
from .repeats import CHANGED_SQUARES, foretold_by_others
from .rest import Follows, rows_at
from .state import plain_rows
from .step import Step

__all__ = [
    "fitted_recordings",
    "follows_own_motion",
    "of_one_recording",
    "recordings_that_differ",
    "shares_by_recording",
    "shown_of_many",
    "still_changed",
]

CHANGES = 0.5  # of a cause's size: recordings that differ by less are said to have the same
UNLIKE = 0.1  # of a body's size: by as much it differs in recordings that may show it at another link than its own
KEPT = 1e-12  # of the diagonal: a ridge for numbers that no row shows
MOST_TOLD = 8  # recordings: of more, those with the least and the most
NONE = 0.2  # of its size: a recording that surely has less of it has none to speak of
OF_ONE = 0.25  # of the squares left in a recording: links and friction of its own foretell that of no noise (.11 is)
RIDGE = 1e-4  # of a column's squares, of those that a recording alone is fitted with
SURE = 4.0  # standard deviations by which they differ


def recordings_that_differ(
    problem: Problem, joint: Joint, causes: Sequence[str], names: Sequence[str]
) -> tuple[list[str], dict[int, tuple[Name, ...]]]:
    """Notes on the `causes` of an answer that its recordings, `names`, do not have alike; and, of bodies of which that
    is sure however small it is, by their number, the same at the links next to theirs.

    One size for all recordings leaves a rest that goes with the body itself: at another link, more of it may be taken.
    """
    out, elsewhere = [], {}
    for k, cause in enumerate(causes):
        share, deviation, which = shares_by_recording(problem, joint, k)
        if len(share) < 2:
            continue
        low, high = int(np.argmin(share + deviation)), int(np.argmax(share - deviation))
        apart = share[high] - share[low]
        if apart <= SURE * np.hypot(deviation[low], deviation[high]):
            continue
        effect = joint.causes[k]
        if apart > UNLIKE and effect.inertial:
            elsewhere[k] = tuple(
                Name(effect.name, (link,)) for link in _next_links(problem, int(np.ravel(effect.at)[0]))
            )
        if apart > CHANGES:
            shown = shown_of_many(share)
            told = ", ".join(f"{share[r]:.2f} +- {1.96 * deviation[r]:.2f} in {names[which[r]]}" for r in shown)
            absent = share[low] + 1.96 * deviation[low] < NONE
            what = "only some recordings have it" if absent else "some recordings have more of it than others"
            out.append(f"{cause} is told as one size for all recordings, but {what}. Of that size there is {told}")
    return out, elsewhere


def shown_of_many(sizes: Float[np.ndarray, " k"]) -> list[int]:
    """Which of the sizes are told, from the least to the most; of many those at the ends."""
    order = [int(k) for k in np.argsort(sizes)]
    return order if len(order) <= MOST_TOLD else [*order[: MOST_TOLD // 2], *order[-MOST_TOLD // 2 :]]


def _next_links(problem: Problem, link: int) -> list[str]:
    """The links that a joint connects to a link."""
    joints, names = problem.model.joints, problem.model.link_names
    return [names[k] for k, joint in enumerate(joints) if k == joints[link].parent or joint.parent == link]


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
    torque, recordings = rows.X @ size, list(fitted_recordings(problem, rows.block))
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


def still_changed(problem: Problem, step: Step, tolerance: float) -> Follows | None:
    """The joint where recordings that move alike leave another torque, in a way that follows its motion; None without.

    What one robot and its drives make of a motion is the same each time but for noise, whatever the model lacks.
    """
    same, worst = problem.layout.changed, 0.0
    if same is None:
        return None
    found, names, size = None, problem.model.dof_names, np.sqrt(np.mean(problem.torque**2, axis=(0, 1)))
    rows, white = plain_rows(problem, step.state), np.ones((len(problem.records.omega), problem.model.nv))
    residual = rows.y - rows.X @ step.state.theta
    for joint in np.flatnonzero(size > 0).tolist():
        used = (same >= 0) & (rows.block >= 0) & (rows.y[joint] != 0) & (rows.y[joint, same] != 0)
        y = (residual[joint] - residual[joint, same])[used]
        if not len(y):
            continue
        slices, left = rows.block[used] % FOLDS, float(np.var(y))
        for functions in dependences(step.state.motion, joint).values():
            own = rows_at(problem, step.state, functions, white, joint)[:, used]
            own = np.vstack([np.ones(own.shape[1]), own]).T
            left = min(left, float(np.mean((y - foretold_by_others(y, own, slices)) ** 2)))
        followed = float(np.sqrt(max(np.var(y) - left, 0.0)))
        if left < (1 - CHANGED_SQUARES) * np.var(y) and followed / size[joint] > max(tolerance, worst):
            worst, most = followed / size[joint], np.full(len(size), np.inf)
            most[joint] = np.sqrt(left / 2)
            text = (
                f"the torque of {names[joint]} is another one in recordings that move alike, by {worst:.2g} of its RMS,"
                " most of which follows the motion: the robot, its load or a sensor changed between them"
            )
            found = Follows(text, most)
    return found


def of_one_recording(problem: Problem, step: Step, tolerance: float) -> Follows | None:
    """The joint of which some recording by itself foretells a part of what a fit of all leaves there; None without.

    What passes for noise, where no repeats tell it, may be a tool that only some recordings carry or friction that was
    another one: links at the end of the robot, friction and rotors fitted to some slices of a recording then foretell
    the others. Noise of slices does not, whatever its spectrum is. Constants say nothing, as torque sensors drift.
    """
    rows, size = plain_rows(problem, step.state), np.sqrt(np.mean(problem.torque**2, axis=(0, 1)))
    recordings = list(fitted_recordings(problem, rows.block))
    if len(recordings) < 2:
        return None
    scale = np.maximum(residual_rms(problem, step.state), 1e-9 * max(float(size.max()), 1e-300))[:, None]
    residual = (rows.y - rows.X @ step.state.theta) / scale
    columns = _of_ends(problem, rows.X) / scale[..., None]
    share, followed, noise = np.zeros((3, len(recordings), len(size)))
    for k, (_, used) in enumerate(recordings):
        there = rows.y[:, used] != 0
        e = residual[:, used] * there
        e -= there * (e.sum(1) / np.maximum(there.sum(1), 1))[:, None]
        foretold = _foretold_together(e, columns[:, used] * there[..., None], rows.block[used] % FOLDS)
        all_of_it, left = ((one**2).sum(1) / np.maximum(there.sum(1), 1) for one in (e, e - foretold))
        share[k] = 1 - left / np.maximum(all_of_it, 1e-300)
        followed[k] = scale[:, 0] * np.sqrt(np.maximum(all_of_it - left, 0.0)) / np.maximum(size, 1e-300)
        noise[k] = scale[:, 0] * np.sqrt(left)
    followed = np.where((share > OF_ONE) & (size > 0), followed, 0.0)
    k, joint = np.unravel_index(int(np.argmax(followed)), followed.shape)
    if followed[k, joint] <= tolerance:
        return None
    most = np.full(len(size), np.inf)
    most[joint] = noise[k, joint]
    at, where = problem.model.dof_names[joint], problem.names[recordings[k][0]]
    text = (
        f"{100 * share[k, joint]:.2g} % of what {at} leaves in {where}"
        f" ({followed[k, joint]:.2g} of its torque) goes with links and friction that this recording has for itself:"
        " the robot, its load or its temperature was not the same in all"
    )
    return Follows(text, most)


def follows_own_motion(problem: Problem, step: Step, joint: int) -> bool:
    """Whether smooth functions of a joint's motion, fitted to a recording alone, foretell a part of what is left there.

    The constant of a recording is none of that: beside it nothing follows the motion that others do not have as well.
    """
    rows, white = plain_rows(problem, step.state), np.ones((len(problem.records.omega), problem.model.nv))
    residual, given = rows.y[joint] - rows.X.dense(0)[joint] @ step.state.theta, dependences(step.state.motion, joint)
    own = {kind: rows_at(problem, step.state, functions, white, joint) for kind, functions in given.items()}
    for _, used in fitted_recordings(problem, rows.block):
        at = used & (rows.y[joint] != 0)
        y, slices = residual[at], rows.block[at] % FOLDS
        for functions in own.values():
            F = np.vstack([np.ones(len(y)), functions[:, at]]).T
            if np.mean((y - foretold_by_others(y, F, slices)) ** 2) < (1 - OF_ONE) * np.var(y):
                return True
    return False


def _of_ends(problem: Problem, X: JointRows) -> Float[np.ndarray, "nv T k"]:
    """Columns of the links that carry no other, and of all friction and rotors, of those of a state."""
    joints = problem.model.joints
    ends = [k for k in range(len(joints)) if not any(other.parent == k for other in joints)]
    return np.concatenate([*(X.dense(10 * k, 10 * k + 10) for k in ends), X.dense(10 * len(joints))], axis=2)


def _foretold_together(
    e: Float[np.ndarray, "nv rows"], Z: Float[np.ndarray, "nv rows k"], slices: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, "nv rows"]:
    """What columns that all joints share say of each slice, fitted to the others."""
    scale = np.sqrt(np.maximum((Z**2).sum((0, 1)), 1e-300))
    Z, out = Z / scale, np.zeros_like(e)
    for number in np.unique(slices):
        own = slices == number
        F = Z[:, ~own].reshape(-1, Z.shape[2])
        theta = np.linalg.solve(F.T @ F + RIDGE * np.eye(F.shape[1]), F.T @ e[:, ~own].reshape(-1))
        out[:, own] = Z[:, own] @ theta
    return out


def fitted_recordings(problem: Problem, block: Int[np.ndarray, " T"]) -> Iterator[tuple[int, Bool[np.ndarray, " T"]]]:
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
    out[list(at), len(rest) :] = own
    return out
