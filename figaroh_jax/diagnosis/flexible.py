"""Smooth families of torque: they test, describe and stand in for what has no name yet; they are never a cause."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects.base import Motion, changed, smooth_sign
from ..estimation.noise import Spectrum
from ..recordings.stacked import filter_rows, filtered_rows
from ..results import Dependence, Name
from .bank import Columns
from .design import units
from .problem import Problem, without_factor
from .screening import Group, Null, family_p, screen
from .state import FRICTION_PRECISION, State, whitened
from .step import Step

__all__ = [
    "Smooth",
    "dependences",
    "families",
    "flexible_p",
    "friction_width",
    "products",
    "rich_families",
    "rough_functions",
    "smooth_functions",
    "table_of_places",
    "to_unit",
]

DEGREES = 6  # of the polynomials in a joint's position; of the cosines over time one less
PLACES = 37  # of a table over the range of a joint
FINEST = 24  # periods over the range of a joint: a finer ripple of its position is not looked for
WIDTHS = (0.0, 0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # rad/s or m/s
WIDTH_GAIN = 10.0  # whitened squares that a smooth reversal must take away


class Smooth(NamedTuple):
    """What smooth functions find in what a fit leaves; squares are those of whitened rows beyond what chance gives."""

    p: float  # of all families
    strongest: Name
    score: float  # squares of the strongest
    each: Float[np.ndarray, " nv"]  # squares of the best family of each joint


def flexible_p(
    problem: Problem,
    step: Step,
    groups: list[Group],
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    generator: np.random.Generator,
) -> Smooth:
    """What the smooth families of each joint, `groups` (`families`), say of what a fit leaves.

    They test and describe; they are never named as a cause.
    """
    rows, linear = step.rows, step.linear
    found = screen(rows, linear, groups)
    p = family_p(rows, linear, found, Null(problem, spectrum, whitening, generator), generator)
    best = int(np.argmax([result.z.max() for result in found.scores]))
    more = np.zeros(problem.model.nv)
    for group, score in zip(found.groups, found.scores, strict=True):
        (joint,) = group.columns.joints
        more[joint] = max(more[joint], float(score.Q.max() - score.rank.max()))
    score = found.scores[best]
    return Smooth(p, found.groups[best].name, float(score.Q.max() - score.rank.max()), more)


def friction_width(
    problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], joints: Sequence[int] | None = None
) -> Problem:
    """The problem with the half width of each joint's dry friction that fits best, from `WIDTHS`; of some `joints`.

    A simulator smooths Coulomb friction, a real gear rounds it: taken as a hard sign, the rest would be named Stribeck.
    A joint keeps a width of zero unless another lowers the squares by more than `WIDTH_GAIN`. Smooth functions of
    position and time stand beside, so that the width does not make up for a cause that is not in yet.
    """
    rows, smooth = whitened(problem, state, whitening), _smooth_rows(problem, state, whitening)
    (nv, _, P), k = rows.X.shape, smooth.shape[2]
    prior = state.prior.extended(nv * k)

    def columns(joint: int, z: Float[np.ndarray, "rows T"]) -> Float[np.ndarray, "rows P+"]:
        """Products with all columns of rows of one joint, where only its own smooth functions are not zero."""
        out = np.zeros((len(z), P + nv * k))
        own = rows.X.own[joint]
        out[:, own.place], out[:, P + joint * k : P + (joint + 1) * k] = z @ own.columns, z @ smooth[joint]
        return out

    G, b = np.diag(prior.precision), prior.precision * prior.mean
    G[:P, :P] += rows.X.squares()
    for joint, (S, y) in enumerate(zip(smooth, rows.y, strict=True)):
        own = slice(P + joint * k, P + (joint + 1) * k)
        G[own] += columns(joint, S.T)
        G[:P, own] = G[own, :P].T
        b += columns(joint, y[None])[0]
    width = np.array(problem.width)
    signs = [_with_width(problem, state, whitening, w) for w in WIDTHS]
    for joint in range(problem.model.nv) if joints is None else joints:
        column = _coulomb_column(problem, state, joint)
        if column is None:
            continue
        tried = [rows_of_width[joint] for rows_of_width in signs]
        crossed = columns(joint, np.stack(tried))
        costs = [_replaced(G, b, column, c, z @ z, z @ rows.y[joint])[0] for z, c in zip(tried, crossed, strict=True)]
        best = int(np.argmin(np.array(costs) - WIDTH_GAIN * (np.array(WIDTHS) == 0)))
        width[joint] = WIDTHS[best]
        z = tried[best]
        G, b = _replaced(G, b, column, crossed[best], z @ z, z @ rows.y[joint])[1:]
    return problem if np.array_equal(width, problem.width) else problem.with_width(width)


def _smooth_rows(
    problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T functions"]:
    """Position, time, offset and acceleration of each joint, each in its own rows."""
    motion, every = state.motion, slice(problem.model.nv)
    acceleration = np.asarray(motion.acceleration)[None]
    series = (_powers(motion, every), _cosines(motion)[..., None], acceleration, np.ones_like(acceleration[..., :1]))
    return np.moveaxis(np.concatenate([_rows(problem, one, whitening) for one in series]), 0, 2)


def _coulomb_column(problem: Problem, state: State, joint: int) -> int | None:
    """Column of the joint's Coulomb friction in the regressor, if the model has one."""
    column = 10 * len(problem.model.joints)
    for term in state.terms:
        amplitudes = len(term.amplitudes())
        for at in np.asarray(term.at):
            if term.name == "coulomb_friction" and at[0] == joint:
                return column
            column += amplitudes
    return None


def _with_width(
    problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], width: float
) -> Float[np.ndarray, "nv T"]:
    """Whitened rows of every joint's dry friction with another width, as sensors that follow all torque read it."""
    motion = eqx.tree_at(lambda m: m.width, state.motion, np.full(problem.model.nv, width))
    direction, before = np.asarray(motion.direction), np.asarray(state.motion.direction)
    for term, (where, _) in ((term, term.about) for term in state.terms if term.about is not None):
        read = units({term.name: term}, changed(motion, total=direction - before), problem.records)[term.name]
        direction = direction + getattr(term, where)[0] * read.torque[0, 0].T
    response = whitening * state.response(problem.records.omega)[:, None]
    return filtered_rows(problem.records, direction, response)


def _replaced(G: np.ndarray, b: np.ndarray, column: int, cross: np.ndarray, square: float, right: float):
    """Penalised squares (less a constant) of the fit with one column replaced, and its normal equations."""
    old = G[column, column]
    G, b = G.copy(), b.copy()
    own = cross.copy()
    own[column] = square
    precision = FRICTION_PRECISION if old > 0 else 0.0
    G[column], G[:, column] = own, own
    G[column, column] += precision
    b[column] = right
    theta = np.linalg.solve(G + 1e-12 * np.diag(np.maximum(np.diag(G), 1e-12)), b)
    return -float(b @ theta), G, b


def families(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"]) -> list[Group]:
    """Smooth functions in the rows of each joint: of its position; of its velocity and position, odd in the velocity;
    of all positions (second degree); a constant; and of time."""
    return _groups(problem, _smooth_series(state.motion), whitening)


def rich_families(
    problem: Problem,
    state: State,
    whitening: Float[np.ndarray, "F nv"],
    few: bool,
    titles: Collection[str] | None = None,
) -> list[Group]:
    """Smooth functions that stand in for what the catalogue lacks in a model of the noise: none of time, which would
    take slow noise, but even ones of the velocity, friction that drifts or follows the load, the acceleration, and
    friction and acceleration of the other joints. `few`: these alone, which have few columns; `titles`: of these alone.
    """
    series = _few_series(state.motion)
    if not few:
        smooth = _smooth_series(state.motion)
        del smooth["time"]
        series |= smooth
    if titles is not None:
        series = {title: columns for title, columns in series.items() if title in titles}
    return _groups(problem, series, whitening)


def _groups(
    problem: Problem, series: dict[str, Float[np.ndarray, "k nN _"]], whitening: Float[np.ndarray, "F nv"]
) -> list[Group]:
    groups = []
    for title, columns in series.items():
        rows = _rows(problem, columns, whitening)
        for joint, name in enumerate(problem.model.joint_names):
            groups.append(Group(Name(title, (name,)), None, Columns((joint,), rows[None, :, joint][:, :, None])))
    return groups


def _rows(
    problem: Problem, columns: Float[np.ndarray, "k nN _"], whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "k nv T"]:
    """Whitened rows of columns, each joint's own or (on an axis of one) the same at all joints."""
    n, samples, _, nv = problem.records.shape
    torque = np.moveaxis(columns, 2, 1).reshape(len(columns), -1, n, samples)
    response, factor = without_factor(whitening)
    if (response == 1).all():
        rows = filter_rows(problem.records, torque, fitted=True)
    else:
        every = np.broadcast_to(torque, (len(columns), nv, n, samples))
        rows = filter_rows(problem.records, every, response.T, fitted=True)
    weight = np.moveaxis(np.asarray(problem.records.weight), 2, 0) * factor[:, None, None]
    return (rows * weight).reshape(len(columns), nv, -1)


def _smooth_series(motion: Motion) -> dict[str, Float[np.ndarray, "k nN _"]]:
    every = slice(np.shape(motion.velocity)[1])
    powers = _powers(motion, every)
    return {
        "position": powers,
        "friction": _friction(motion, every, powers),
        "time": _cosines(motion)[..., None],
        "constant": np.ones((1, len(np.asarray(motion.time)), 1)),
        "posture": np.stack(_posture(motion))[..., None],
    }


def _few_series(motion: Motion) -> dict[str, Float[np.ndarray, "k nN nv"]]:
    v, s, a = np.asarray(motion.velocity), np.asarray(motion.direction), np.asarray(motion.acceleration)
    w, speed, load = to_unit(np.asarray(motion.time))[:, None], to_unit(np.abs(v)), to_unit(np.asarray(motion.load))
    series = {
        "speed": np.stack([np.abs(s), speed, 2 * speed**2 - 1]),
        "drift": np.stack([w * s, w**2 * s, w * v]),
        "load": np.stack([s * load, s * np.abs(load)]),
        "acceleration": a[None],
    }
    around = np.stack([s, v, a])
    return series | {f"neighbour {k}": np.roll(around, k, axis=2) for k in range(1, s.shape[1])}


def _posture(motion: Motion) -> list[Float[np.ndarray, " nN"]]:
    """First and second degree in all positions: near to any torque that follows the posture alone."""
    x = to_unit(np.asarray(motion.position)).T
    return [*x, *(x[i] * x[k] for i in range(len(x)) for k in range(i + 1))]


def smooth_functions(motion: Motion) -> list[Float[np.ndarray, "k nN"]]:
    """For each joint: smooth functions of its position, speed and load, and of its friction over position and speed."""
    out = []
    for joint in range(np.shape(motion.velocity)[1]):
        powers, s, load = _powers(motion, joint), _direction(motion, joint), to_unit(np.asarray(motion.load)[:, joint])
        speed = to_unit(np.abs(np.asarray(motion.velocity)[:, joint]))
        more = [speed, 2 * speed**2 - 1, load, 2 * load**2 - 1, s * load, s * (2 * load**2 - 1), np.ones_like(s)]
        out.append(np.concatenate([powers, _friction(motion, joint, powers), more]))
    return out


def rough_functions(motion: Motion, joint: int) -> list[Float[np.ndarray, "k nN"]]:
    """Functions of the motion that no smooth one follows, in groups: sines of the joint's own position, of each two
    successive numbers of periods over its range to `FINEST`; and direction, velocity and acceleration of the others."""
    q = np.asarray(motion.angle)[:, joint]
    turns = 2 * np.pi * np.arange(1, FINEST + 1)[:, None] * (q - q.min()) / max(float(np.ptp(q)), 1e-12)
    waves = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    others = [np.asarray(x).T for x in (motion.direction, motion.velocity, motion.acceleration)]
    beside = np.concatenate([np.delete(x, joint, axis=0) for x in others])
    return [*(waves[k : k + 2].reshape(4, -1) for k in range(FINEST - 1)), *([beside] if len(beside) else [])]


def table_of_places(motion: Motion, joint: int) -> tuple[Float[np.ndarray, "k nN"], Float[np.ndarray, " k"]]:
    """A table of a joint's position (rad or m), linear between its places, for motion forwards, then backwards; and the
    place of each column."""
    q, v = np.asarray(motion.angle)[:, joint], np.asarray(motion.velocity)[:, joint]
    knots = np.linspace(q.min(), q.max(), PLACES)
    near = np.maximum(1 - np.abs(q - knots[:, None]) / max(float(knots[1] - knots[0]), 1e-12), 0.0)
    return np.concatenate([near * (v > 0), near * (v < 0)]), np.tile(knots, 2)


def products(motion: Motion) -> tuple[Float[np.ndarray, "k nN"], list[tuple[int, int, int]]]:
    """All joints' positions and velocities, from -1 to 1, and the products of each two; and of each product where both
    factors and it stand."""
    x = to_unit(np.concatenate([np.asarray(motion.angle), np.asarray(motion.velocity)], axis=1)).T
    one, other = np.triu_indices(len(x))
    places = [(a, b, k) for k, (a, b) in enumerate(zip(one.tolist(), other.tolist(), strict=True), len(x))]
    return np.concatenate([x, x[one] * x[other]]), places


def dependences(motion: Motion, joint: int) -> dict[Dependence, Float[np.ndarray, "k nN"]]:
    """Smooth functions of what a rest of the joint may go with: position, velocity, load, time."""
    powers, load = _powers(motion, joint), to_unit(np.asarray(motion.load)[:, joint])
    s, speed = _direction(motion, joint), to_unit(np.abs(np.asarray(motion.velocity)[:, joint]))
    return {
        "position": powers,
        "velocity": np.stack([*_friction(motion, joint, powers)[:4], speed, 2 * speed**2 - 1]),
        "load": np.stack([load, 2 * load**2 - 1, s * load, s * (2 * load**2 - 1)]),
        "time": _cosines(motion),
    }


def _direction(motion: Motion, at: int | slice) -> Float[np.ndarray, "nN *joints"]:
    """`Motion.direction` of some joints."""
    given: list[Any] = [np.asarray(x)[..., at] for x in (motion.velocity, motion.acceleration, motion.width)]
    v, a, width = given
    return np.asarray(smooth_sign(v, a, motion.dt, width))


def _powers(motion: Motion, at: int | slice) -> Float[np.ndarray, "k nN *joints"]:
    """Polynomials in the position of some joints, of each degree from the first."""
    return _chebyshev(to_unit(np.asarray(motion.position)[:, at]), DEGREES)[1:]


def _friction(
    motion: Motion, at: int | slice, powers: Float[np.ndarray, "p nN *joints"]
) -> Float[np.ndarray, "k nN *joints"]:
    """Dry friction of some joints over their speed and position, of which `powers` are the polynomials."""
    s, speeds = _direction(motion, at), _chebyshev(to_unit(np.abs(np.asarray(motion.velocity)[:, at])), 3)
    return np.concatenate([s * speeds, s * powers[:3], np.abs(s) * powers[:1]])


def _cosines(motion: Motion) -> Float[np.ndarray, "k nN"]:
    """Cosines over the time."""
    return np.stack([np.cos(np.pi * k * (to_unit(np.asarray(motion.time)) + 1) / 2) for k in range(1, DEGREES)])


def _chebyshev(x: Float[np.ndarray, "*shape"], degree: int) -> Float[np.ndarray, "degree+1 *shape"]:
    """Chebyshev polynomials of each degree up to one."""
    return np.moveaxis(np.polynomial.chebyshev.chebvander(x, degree), -1, 0)


def to_unit(x: Float[np.ndarray, "nN *columns"]) -> Float[np.ndarray, "nN *columns"]:
    """The values of each column brought to between -1 and 1."""
    low, high = x.min(0), x.max(0)
    return 2 * (x - low) / np.maximum(high - low, 1e-9) - 1
