"""Which of the ten numbers of a link data tell, and links that bodies can have with these numbers.

A motion seldom tells all ten, and two links that turn about one axis share some. What is not told to a share of the
link's own size stays as the model file has it, so that the others can be read as what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.inertia import from_com
from ..rigid.model import RobotModel
from .conic import Constraints, NotConverged, constrained
from .consistency import bodies, inconsistencies
from .priors import rigid_prior

__all__ = ["ABOUT_JOINT", "beside", "bodies_with", "inertia_about_joint", "possible", "sizes", "told_numbers"]

TOLD = 0.3  # of a link's own size: standard deviation up to which a number is told
FAR, DEVIATIONS = 1e-3, 3.0  # of its size, what a number that is not told weighs; of one that is, how far it may be
STEINER = 0.15  # of what moving an inertia adds: what a number may differ from it by
ABOUT_JOINT = (
    "the file has too much of just what moving the inertia from the centre of mass to the joint adds (m c2): it may"
    " state it about the joint, where it is to stand about the centre of mass"
)


def sizes(robot: RobotModel) -> Float[np.ndarray, "links 10"]:
    """Sizes of the ten numbers of each link, in Pinocchio's order: kg, kg m, kg m2."""
    return 1 / np.sqrt(rigid_prior(robot, 1.0)[1]).reshape(-1, 10)


def beside(
    matrix: Float[np.ndarray, "columns columns"],
    right: Float[np.ndarray, " columns"],
    own: Sequence[int],
    others: Sequence[int],
) -> tuple[Float[np.ndarray, "own own"], Float[np.ndarray, " own"]]:
    """Information and score of some columns of normal equations, the others being solved for."""
    others = [k for k in others if matrix[k, k] > 0]
    size = np.sqrt(np.diag(matrix)[others])
    inner = matrix[np.ix_(others, others)] / np.outer(size, size) + 1e-12 * np.eye(len(others))
    both = np.column_stack([matrix[np.ix_(others, own)], right[others]]) / size[:, None]
    solved = np.linalg.lstsq(inner, both, rcond=1e-12)[0]
    cross = matrix[np.ix_(others, own)] / size[:, None]
    return matrix[np.ix_(own, own)] - cross.T @ solved[:, :-1], right[own] - cross.T @ solved[:, -1]


def _told_to_size(
    information: Float[np.ndarray, "own own"], scale: Float[np.ndarray, " own"], level: float, most: float = TOLD
) -> list[int]:
    """Numbers that are told to the share `most` of their size `scale`, where a row's square is `level`.

    The worst told are left out one after another, of two that are told alike the first.
    """
    sized = information * np.outer(scale, scale)
    left = [k for k in range(len(scale)) if sized[k, k] > 0]
    while left:
        own = sized[np.ix_(left, left)]
        spread = np.sqrt(level * np.diag(np.linalg.inv(own + 1e-12 * np.trace(own) * np.eye(len(left)))))
        if spread.max() <= most:
            break
        worst = max(range(len(left)), key=lambda k: (min(spread[k], 1e3 * most), -left[k]))
        del left[worst]
    return left


def told_numbers(
    matrix: Float[np.ndarray, "columns columns"],
    right: Float[np.ndarray, " columns"],
    tens: Sequence[Sequence[int]],
    others: Sequence[int],
    scale: Float[np.ndarray, "links 10"],
    level: float,
) -> list[tuple[list[int], float]]:
    """Of each link the numbers (0 to 9) that normal equations tell to a share of its size `scale`, and the squares that
    they promise to take away.

    `tens` are the columns of the links' ten numbers, `others` those that are fitted beside. A link's numbers are asked
    beside these and those of the links before it; what is not told stays as it is. Masses come last: where a link turns
    about what moves, its mass is as good as a moment of what carries it. A row of the equations counts with the square
    `level`, which is as large as all that is left.
    """
    found, beside_these = [([], 0.0) for _ in tens], list(others)
    for numbers in (range(1, 10), (0,)):
        for k, ten in enumerate(tens):
            own = [ten[i] for i in numbers]
            information, score = beside(matrix, right, own, beside_these)
            told = _told_to_size(information, scale[k][list(numbers)], level)
            step = np.linalg.solve(information[np.ix_(told, told)], score[told])
            before, promise = found[k]
            found[k] = [*before, *(numbers[i] for i in told)], promise + float(score[told] @ step)
            beside_these += [own[i] for i in told]
    return found


def bodies_with(
    robot: RobotModel, places: Sequence[int], ten: Float[np.ndarray, "places 10"], told: Sequence[int]
) -> Float[np.ndarray, "places 10"] | None:
    """The links `places` with the numbers `told` (of all tens in a row) as in `ten`, the others nearest to it.

    None where no bodies have these.
    """
    scale, every = sizes(robot)[list(places)].ravel(), bodies(robot)
    mine = [replace(every[i], columns=tuple(range(10 * k, 10 * k + 10))) for k, i in enumerate(places)]
    own = np.diag(1 / scale)
    rows = np.eye(len(own))[list(told)]
    try:
        found = constrained(
            np.column_stack([own, own @ ten.ravel()]), Constraints(mine, equal=(rows, ten.ravel()[list(told)])), scale
        )
    except (InputError, NotConverged):
        return None
    found[list(told)] = ten.ravel()[list(told)]
    found = found.reshape(-1, 10)
    return None if inconsistencies(found, [body.name for body in mine]) else found


def possible(
    robot: RobotModel,
    places: Sequence[int],
    ten: Float[np.ndarray, "places 10"],
    told: Sequence[int],
    std: Float[np.ndarray, " told"],
) -> bool:
    """Whether bodies can have the links `places` with the numbers `told` within three of their standard deviations.

    `told` and the others are as in `bodies_with`.
    """
    scale, every = sizes(robot)[list(places)].ravel(), bodies(robot)
    mine = [replace(every[i], columns=tuple(range(10 * k, 10 * k + 10))) for k, i in enumerate(places)]
    weight = FAR / scale
    weight[list(told)] = 1 / np.maximum(std, FAR * scale[list(told)])
    rows, wanted = np.diag(weight), ten.ravel()
    try:
        found = constrained(np.column_stack([rows, rows @ wanted]), Constraints(mine), scale)
    except (InputError, NotConverged):
        return False
    return bool(np.all((np.abs(found - wanted) * weight)[list(told)] <= DEVIATIONS))


def inertia_about_joint(ten: Float[np.ndarray, "10"], change: Float[np.ndarray, "10"], told: Sequence[int]) -> bool:
    """Whether a link has too much of just what moving its inertia from its centre of mass to its joint adds.

    `change` is what is to be added to the ten numbers, of which `told` are known. Steiner's theorem:
    m (|c|^2 E - c c'). A file that states the inertia about the joint has it twice.
    """
    moved = from_com(ten[0], ten[1:4] / max(ten[0], 1e-12), np.zeros((3, 3)))
    numbers = [k for k in told if k >= 4]
    expected = -np.asarray(moved)[numbers]
    if not len(numbers) or not np.abs(expected).max() > STEINER * np.abs(moved[4:]).max():
        return False
    return bool(np.abs(np.asarray(change)[numbers] - expected).max() <= STEINER * np.abs(expected).max())
