"""Which experiment would tell apart what these recordings cannot: a few that can be done, tried on the model.

For each of them the rows that it would add are predicted with the model and the noise of this diagnosis. What counts
is how much of the named cause's torque would be left once the model and the other cause were fitted to all rows, old
and new, in standard deviations of the noise: t = |z - X dtheta - Z_B b| in whitened rows, minimised over dtheta, b and
the shape of the other cause. Squares of t add up over recordings, and noise is less white than it is taken to be: an
experiment is told by the number of recordings of the present motion that would do as much.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..effects.catalogue import find
from ..recordings.stacked import Records, Span
from ..results import Experiment, Name
from ..rigid.inertia import from_com
from .design import candidates, kind, shapes, unit_rows, with_shape
from .problem import Layout, Problem
from .screening import place_names
from .search import Found
from .shifts import difference
from .state import State, batched, on_motion, unit_torques, whitened
from .step import with_causes

__all__ = ["next_experiment"]

SPEEDS = (0.02, 0.05, 0.1, 0.2, 0.3)  # rad/s or m/s, of slow sweeps
FASTER, SLOWER = 1.5, 0.5  # times the speed of the recordings' motion
ROUNDED = 0.2  # s: how long a sweep takes to turn
MASS, ARM = 0.1, 0.1  # of the robot's; m from the last joint: of a known load
ENOUGH = 3.0  # standard deviations that an experiment must add
AGAIN = "the same motion again"
TINY = 1e-10  # of the diagonal


def next_experiment(
    word: str,
    found: Sequence[Found],
    problem: Problem,
    start: State,
    causes: Sequence[Effect],
    whitening: Float[np.ndarray, "F nv"],
) -> Experiment | None:
    """The experiment for the first cause that is not alone in its set, or for a misfit without a name.

    `causes` are the found ones with their fitted values.
    """
    unsure = next(((one, effect) for one, effect in zip(found, causes, strict=True) if one.ambiguous), None)
    if unsure is None:
        text = "the same motion repeated, then each joint alone at several constant speeds"
        return Experiment(text) if word == "unknown" else None
    one, effect = unsure
    pairs = tuple((one.name.effect, other.effect) for other in one.ambiguous)
    state = with_causes(problem, start, [e for e in causes if e is not effect], whitening).state
    now, again, tried = _predicted(problem, state, effect, one.ambiguous, whitening)
    best = max(tried, key=lambda text: tried[text])
    if tried[best] - now < ENOUGH**2:
        wording = find(one.name.effect).separated_by.format(at=" and ".join(one.name.at) or "the robot")
        said = f"{wording} (none of the motions simulated on the model distinguishes them){_designed(one)}"
        return Experiment(said, pairs)
    worth = (tried[best] - now) / max(again - now, TINY)
    said = f"{best}: as informative as {worth:.2g} more recordings of the current motion{_designed(one)}"
    return Experiment(said, pairs)


def _designed(one: Found) -> str:
    """The command that designs a motion for the pair, where such a design knows both causes."""
    for name in (one.name, *one.ambiguous):
        effect = find(name.effect)
        shaped = len(effect.parameters()) - len(effect.amplitudes())
        known = any(effect.has(form) for form in ("torque", "torque_error", "change", "torque_response"))
        if shaped > 1 or not known:
            return ""
    return "; figaroh-jax excite --from RUN_DIR (this run's directory) designs a motion that distinguishes them"


class _Idea(NamedTuple):
    """An experiment: what is done, and the motion of all joints; rows after `until` (share of the samples) are none."""

    text: str
    position: Float[np.ndarray, "N nv"]
    velocity: Float[np.ndarray, "N nv"]
    acceleration: Float[np.ndarray, "N nv"]
    until: float = 1.0
    carried: Float[np.ndarray, "links 10"] | None = None


def _predicted(
    problem: Problem, state: State, effect: Effect, others: Sequence[Name], whitening: Float[np.ndarray, "F nv"]
) -> tuple[float, float, dict[str, float]]:
    """t squared between an effect and the nearest of the others: of these recordings, with one more, with each idea."""
    rivals = [_everywhere(problem, name) for name in others]
    known = _products(problem, state, effect, rivals, whitening).sum(0)
    sizes = [_columns(rival) for rival in rivals]
    count, out, ideas = len(problem.records.position), {}, list(_menu(problem, effect))
    for first in range(0, len(ideas), count):
        some = ideas[first : first + count]
        imagined = _imagined(problem, some)
        products = _products(imagined, on_motion(imagined, state), effect, rivals, whitening)
        for idea, own in zip(some, products, strict=False):
            out[idea.text] = _apart(known + own, state, sizes)
    return _apart(known, state, sizes), out.pop(AGAIN), out


def _menu(problem: Problem, effect: Effect) -> Iterator[_Idea]:
    """The recorded motion again, faster, slower, with a known load; sweeps of the joints of the effect."""
    records, longest = problem.records, _longest(problem.records)
    q, v, a = (np.asarray(x)[longest] for x in (records.position, records.velocity, records.acceleration))
    yield _Idea(AGAIN, q, v, a)
    tip = len(problem.model.joints) - 1
    mass = float(f"{MASS * float(np.asarray(problem.model.inertia)[:, 0].sum()):.1g}")
    body = np.zeros((tip + 1, 10))
    body[tip] = np.asarray(from_com(np.float64(mass), np.array([ARM, 0.0, 0.0]), np.zeros((3, 3))))
    carried = body if records.carried is None else np.asarray(records.carried)[longest] + body
    text = f"the same motion with a known mass of {mass:g} kg on {problem.model.link_names[tip]}"
    yield _Idea(text, q, v, a, carried=carried)
    for pace in (FASTER, SLOWER):
        if (np.abs(v).max(0) * pace <= np.asarray(problem.model.velocity_limit)).all():
            yield _Idea(f"the same motion {pace:g} times as fast", *_paced(q, v, a, pace), min(1.0, 1 / pace))
    if effect.acts_on in ("joint", "pair"):
        yield from _sweeps(problem, np.asarray(effect.at).tolist(), q, v)


def _sweeps(problem: Problem, joints: list[int], q: np.ndarray, v: np.ndarray) -> Iterator[_Idea]:
    """The joints to and fro at constant speeds, the others still: slowly, and up to the speed of the recording."""
    where = " and ".join(problem.model.joint_names[j] for j in joints)
    fastest = float(np.abs(v[:, joints]).max())
    for speeds in (SPEEDS, tuple(fastest * share for share in (0.2, 0.4, 0.6, 0.8, 1.0))):
        text = f"sweeps of {where} at constant speeds from {speeds[0]:.2g} to {speeds[-1]:.2g}"
        unit = "rad/s" if all(joint.kind != "prismatic" for joint in problem.model.joints) else "rad/s (m/s)"
        yield _Idea(f"{text} {unit}", *_swept(q, joints, speeds, float(problem.records.dt)))


def _swept(
    q: np.ndarray, joints: list[int], speeds: Sequence[float], dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each speed for an equal time, half of it forth and half back, turning where the recorded range ends."""
    count, low, high = len(q), q.min(0), q.max(0)
    position = np.tile((low + high) / 2, (count, 1))
    velocity = np.zeros_like(position)
    window = np.hanning(max(3, int(ROUNDED / dt)))
    for joint in joints:
        phase = np.arange(count) * 2 * len(speeds) // count
        wanted, here, side = np.array(speeds)[phase // 2], position[0, joint], 1.0
        for k in range(count):
            side = -side if k and phase[k] != phase[k - 1] else side
            if not low[joint] <= here + side * wanted[k] * dt <= high[joint]:
                side = -side
            velocity[k, joint] = side * wanted[k]
            here += velocity[k, joint] * dt
        velocity[:, joint] = np.convolve(velocity[:, joint], window / window.sum(), mode="same")
        position[:, joint] += np.cumsum(velocity[:, joint]) * dt
    return position, velocity, difference(velocity.T, dt).T


def _paced(q: np.ndarray, v: np.ndarray, a: np.ndarray, pace: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion at another pace; where it has ended, it stands still."""
    at = np.minimum(np.arange(len(q)) * pace, len(q) - 1)
    moving = (at < len(q) - 1)[:, None]
    each = (np.stack([np.interp(at, np.arange(len(x)), column) for column in x.T], 1) for x in (q, v, a))
    position, velocity, acceleration = each
    return position, pace * velocity * moving, pace**2 * acceleration * moving


def _imagined(problem: Problem, ideas: Sequence[_Idea]) -> Problem:
    """The problem with the motions of experiments in place of the recordings (as many, so that programs fit)."""
    records = problem.records
    n, _, count, _ = records.shape
    longest, some = _longest(records), [ideas[k % len(ideas)] for k in range(n)]
    weight = np.zeros_like(np.asarray(records.weight))
    for own, idea in zip(weight, some, strict=True):
        used = np.asarray(records.weight)[longest].any(1) & (np.arange(count) < idea.until * count)
        own[used] = 1.0
    ten = [np.zeros((len(problem.model.joints), 10)) if i.carried is None else i.carried for i in some]
    changed = replace(
        records,
        position=np.stack([i.position for i in some]),
        velocity=np.stack([i.velocity for i in some]),
        acceleration=np.stack([i.acceleration for i in some]),
        torque=np.zeros_like(records.torque),
        source=np.repeat(records.source[longest : longest + 1], n, axis=0),
        kept=np.repeat(records.kept[longest : longest + 1], n, axis=0),
        weight=weight,
        carried=np.stack(ten) if np.any(ten) else None,
        spans=tuple(Span(k, 0, records.shape[1], 0, count) for k in range(n)),
    )
    same = np.zeros(n * count, int)
    alone = Layout(np.zeros((0, n * count), int), np.ones((weight.shape[2], n * count)), same, same, same, False)
    imagined = replace(problem, records=changed, layout=alone, held=np.zeros_like(weight))
    imagined.__dict__["families"] = problem.families  # no candidate is looked for in it
    return imagined


def _longest(records: Records) -> int:
    """The slot of one recording that says most."""
    rows = np.asarray(records.weight).sum((1, 2))
    rows[[slot for slot, _ in records.joins]] = -1.0
    return int(np.argmax(rows))


def _products(
    problem: Problem, state: State, effect: Effect, rivals: Sequence[Effect], whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "n columns columns"]:
    """Products of all columns in each recording: of the model, the effect's torque, the rivals at all their shapes."""
    n, _, count, nv = problem.records.shape
    X = whitened(problem, state, whitening).X.dense().reshape(nv, n, count, -1)
    sizes = [float(getattr(effect, name)) for name in effect.amplitudes() or effect.parameters()]
    z = _rows(problem, state, batched(effect), whitening)[0]
    blocks = [X, np.tensordot(sizes, z, 1)[..., None]]
    for rival in rivals:
        rows = _rows(problem, state, rival, whitening)
        blocks.append(np.moveaxis(rows.reshape(-1, *rows.shape[2:]), 0, -1))
    tall = np.concatenate(blocks, axis=-1).swapaxes(0, 1).reshape(n, nv * count, -1)
    return np.swapaxes(tall, 1, 2) @ tall


def _rows(
    problem: Problem, state: State, batch: Effect, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "effects k nv n M"]:
    """Whitened rows of a unit of each amplitude, in the rows of all joints."""
    given = unit_torques(problem, state, batch)
    rows = unit_rows(given, problem.records, whitening * state.response(problem.records.omega)[:, None])
    full = np.zeros((*rows.shape[:2], problem.model.nv, *rows.shape[3:]))
    for one, joints in enumerate(given.joints):
        full[one][:, joints] = rows[one]
    return full


def _apart(products: Float[np.ndarray, "columns columns"], state: State, sizes: Sequence[tuple[int, int]]) -> float:
    """t^2 of the effect's torque (the column behind the model's) with the model and the nearest rival fitted."""
    P, first, squares = len(state.theta), len(state.theta) + 1, []
    for grid, k in sizes:
        for point in range(grid):
            fitted = [*range(P), *range(first + point * k, first + (point + 1) * k)]
            A = products[np.ix_(fitted, fitted)] + np.diag([*state.prior.precision, *[0.0] * k])
            A += TINY * np.diag(np.maximum(np.diag(A), TINY))
            c = products[fitted, P]
            squares.append(products[P, P] - c @ np.linalg.solve(A, c))
        first += grid * k
    return float(max(min(squares), 0.0))


def _everywhere(problem: Problem, name: Name) -> Effect:
    """The named effect with a leading axis of its shapes, between the points of its grid too."""
    effect = find(name.effect)
    batch = candidates(effect, problem.model)
    titles = [place_names(problem.model, effect, tuple(at)) for at in np.asarray(batch.at)[:, 0].tolist()]
    one = jax.tree.map(lambda x: np.asarray(x)[titles.index(name.at)], batch)
    names = shapes(effect)
    if len(names) != 1:
        return one
    grid = np.sort(np.asarray(getattr(one, names[0])))
    grid = np.sort(np.concatenate([grid, (grid[1:] + grid[:-1]) / 2]))
    grid = grid[np.abs(grid) > TINY]  # between a grid's two signs lies no effect at all
    many = jax.tree.map(lambda x: np.repeat(x[:1], len(grid), axis=0), one)
    return with_shape(many, names, [grid])


def _columns(batch: Effect) -> tuple[int, int]:
    """Shapes of a batch, and columns of each."""
    own = len(batch.amplitudes()) if kind(batch) == "columns" else 1
    return len(batch.at), own
