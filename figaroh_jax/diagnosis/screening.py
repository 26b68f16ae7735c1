"""Which of all candidates the residual points to: scores of the whole catalogue and one family-wise p-value.

Naming starts here and never ends here: columns that are right to first order find, exact models decide.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..effects.catalogue import CATALOGUE, one_more, related
from ..estimation.noise import Spectrum
from ..estimation.rows import Linear, Rows
from ..results import Name
from ..rigid.model import RobotModel
from .bank import Bank, Columns, bank
from .design import Units, as_kind, flattened, kind, local, unit_rows, units
from .evidence import Score, block_scores, largest, other_scores, projection, pulled, scores
from .problem import Problem, without_factor
from .state import State, batched, unit_torques

__all__ = [
    "CHUNK",
    "Group",
    "Null",
    "OneMore",
    "Screen",
    "Shown",
    "catalogue",
    "draw_noise",
    "exact_columns",
    "family_p",
    "noise_squares",
    "place_p",
    "screen",
]

DRAWS, CHUNK = 400, 50  # draws, and how many are made at once
LOCAL_DRAWS = 4000  # where each place is asked for itself, and counted as one of many
FAR = 3.0  # times the largest score of a part's noise: a score from which no further noise is asked for
KEPT = 16_000_000  # numbers of noise that are held from step to step


class OneMore(Name):
    """The name of one more effect of a place: written as that of the first, and not equal to it."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OneMore) and tuple(self) == tuple(other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash((OneMore, *self))


class Group(NamedTuple):
    """One effect at one place: `effect` has a leading axis, the grid of its shape."""

    name: Name
    effect: Any  # an `Effect`; None for a family that has no name
    columns: Columns


class Shown(NamedTuple):
    """A candidate as a screen saw it, at the point of its grid with the largest score."""

    name: Name
    joints: tuple[int, ...]
    Z: Float[np.ndarray, "k rows T"]
    z: float  # its score


class Screen(NamedTuple):
    """Scores of all groups, and what they were computed from."""

    groups: list[Group]
    scores: list[Score]
    stock: Bank
    H: Float[np.ndarray, "P columns"]

    def shown(self) -> list[Shown]:
        """Every candidate at its best, without the memory of the others' columns."""
        points = (int(np.argmax(result.Q)) for result in self.scores)
        return [
            Shown(group.name, group.columns.joints, group.columns.Z[p].copy(), float(result.z[p]))
            for group, result, p in zip(self.groups, self.scores, points, strict=True)
        ]

    def best(self, rows: Rows) -> list[tuple[float, int, int]]:
        """Rank (Q less its penalties), group and grid point, best first."""
        out = []
        for index, result in enumerate(self.scores):
            point = int(np.argmax(result.Q))
            penalty = result.rank[point] * np.log(rows.size) + 2 * np.log(len(result.Q))
            out.append((float(result.Q[point] - penalty), index, point))
        return sorted(out, reverse=True)


def catalogue(
    problem: Problem,
    state: State,
    rows: Rows,
    whitening: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    before: list[Group] | None = None,
    turned: Collection[int] = (),
) -> list[Group]:
    """Whitened columns of every effect that may be named, at every place and grid point.

    `before` are the groups of an earlier state of the same problem with the same response: columns that do not follow
    the torque are kept. Where the friction of the joints `turned` reverses over another width since then, what follows
    that there, or at all joints, is evaluated anew.
    """
    taken = {(type(e).name, at) for term in state.terms for e, at in _places_of(term)}
    taken |= {(effect.name, tuple(int(i) for i in np.asarray(effect.at))) for effect in state.sensors}
    closed = {n for t, _ in taken for n in related(t, "excludes")}
    wanted = [n for n in CATALOGUE if n not in forbid and n not in closed]
    batches = {n: b for family in problem.families.values() for n, b in family.items()}
    old = {group.name: group for group in before or ()}
    fresh = _fresh_columns(problem, state, whitening, wanted, None if before is None else turned)
    groups, joints, links = [], problem.model.joint_names, problem.model.link_names
    for name in (n for n in wanted if n in batches):
        own, more = links if batches[name].acts_on == "link" else joints, one_more(name)
        for place, at in enumerate(np.asarray(batches[name].at)[:, 0].tolist()):
            first, there = Name(name, tuple(own[i] for i in at)), (name, tuple(at)) in taken
            if there and (more is None or (more.name, tuple(at)) in taken):
                continue
            title = OneMore(*first) if there else first
            known = old.get(title) or old.get(first)
            columns = fresh.get(name, {}).get(place, known.columns if known else None)
            if columns is None and batches[name].inertial:
                columns = _link_columns(rows, at[0], problem.model)
            if columns is not None and columns.Z.any():
                one = known.effect if known else jax.tree.map(lambda x, p=place: np.asarray(x)[p], batches[name])
                groups.append(Group(title, as_kind(one, more) if there and more else one, columns))
    return groups


def _fresh_columns(
    problem: Problem,
    state: State,
    whitening: Float[np.ndarray, "F nv"],
    wanted: Collection[str],
    turned: Collection[int] | None,
) -> dict[str, dict[int, Columns]]:
    """Whitened columns by place: of all wanted effects, or of those whose columns follow the torque of the state or
    the width of the friction of the joints `turned`."""
    response = whitening * state.response(problem.records.omega)[:, None]
    batches = {n: b for family in problem.families.values() for n, b in family.items()}
    weight, out = np.moveaxis(np.asarray(problem.records.weight), 2, 0), {}
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}

    fixed, shaped = (problem.families[family] for family in ("fixed", "shaped"))
    measured = {n: b for n, b in (fixed | shaped).items() if n in wanted}
    asked = {n: np.arange(len(b.at)) for n, b in batches.items()}
    asked |= {n: np.flatnonzero(_turned(b, turned)) for n, b in measured.items() if turned is not None}

    def placed(name: str, rows: np.ndarray, at: np.ndarray) -> None:
        places, grid = asked[name].tolist(), batches[name].at.shape[1]
        parts.setdefault(name, []).append((rows, at))
        if sum(len(joints) for _, joints in parts[name]) < len(places) * grid:
            return
        known = parts.pop(name)
        rows, at = known[0] if len(known) == 1 else (np.concatenate([part[k] for part in known]) for k in (0, 1))
        rows = rows.reshape(len(places), grid, *rows.shape[1:3], -1)
        each = zip(places, at[::grid].tolist(), rows, strict=True)
        out[name] = {place: Columns(tuple(joints), Z) for place, joints, Z in each}

    coloured, factor = without_factor(response)
    plain = turned is None and bool((coloured == 1).all())
    for name, (rows, at) in (problem.plain if plain else {}).items():
        if name in wanted:
            placed(name, rows * (weight * factor[:, None, None])[at][:, None], at)
    masks = {n: np.repeat(np.isin(np.arange(len(b.at)), asked[n]), b.at.shape[1]) for n, b in measured.items()}
    masks = {} if plain else {name: mask for name, mask in masks.items() if mask.any()}
    for family in _fresh_families(problem, state, wanted, turned is None, masks):  # samples of one family at a time
        for name, given in family.items():
            placed(name, unit_rows(given, problem.records, response), given.joints)
    return out


def _fresh_families(
    problem: Problem,
    state: State,
    wanted: Collection[str],
    everything: bool,
    measured: Mapping[str, Bool[np.ndarray, " effects"]],
) -> Iterator[Mapping[str, Units]]:
    """Unit torques at all samples, a family after another; of the effects of the measured motion alone those that are
    named in `measured`, on one axis of places and grid points."""
    yield {n: problem.following(n, state.motion) for n in problem.families["following"] if n in wanted}
    if fixed := [n for n in problem.families["fixed"] if n in measured]:
        yield {n: problem.fixed[n].of(measured[n]) for n in fixed}
    yield from problem.shaped_in_parts({n: measured[n] for n in problem.families["shaped"] if n in measured})
    sensors = {n: b for n, b in problem.families["sensor"].items() if n in wanted and (everything or b.follows_torque)}
    late = [n for n in sensors if kind(sensors[n]) == "response"]  # one program
    for names in [late, *([n] for n in sensors if n not in late)]:
        yield units({n: flattened(sensors[n]) for n in names}, state.motion, problem.records)


def exact_columns(
    problem: Problem, state: State, rows: Rows, whitening: Float[np.ndarray, "F nv"], effect: Effect
) -> Columns:
    """Whitened columns of one effect alone, its shape as it is, as `catalogue` has them."""
    if effect.inertial:
        return _link_columns(rows, int(np.asarray(effect.at)[0]), problem.model)
    given = unit_torques(problem, state, batched(effect))
    response = whitening * state.response(problem.records.omega)[:, None]
    Z = unit_rows(given, problem.records, response)
    return Columns(tuple(given.joints[0].tolist()), Z.reshape(*Z.shape[:3], -1))


def _turned(batch: Effect, joints: Collection[int]) -> Bool[np.ndarray, " places"]:
    """At which places an effect of the measured motion follows how the friction of the `joints` reverses."""
    at, joints = np.asarray(batch.at)[:, 0], joints if batch.reverses else ()
    return np.asarray(np.isin(at, list(joints)).any(axis=1)) if local(batch) else np.full(len(at), len(joints) > 0)


def place_names(model: RobotModel, effect: Effect | type[Effect], at: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the joints or of the link at the indices."""
    names = model.link_names if effect.acts_on == "link" else model.joint_names
    return tuple(names[i] for i in at)


def screen(rows: Rows, linear: Linear, groups: list[Group], before: Screen | None = None) -> Screen:
    """Scores of all groups with the current model projected out.

    `before` is the screen of a model that this one has only added columns to: what is the same is taken from there.
    """
    stock = bank(rows, [group.columns for group in groups], before.stock if before else None)
    H = projection(linear, stock)
    return Screen(groups, scores(linear, stock, H), stock, H)


class Null:
    """Noise with a spectrum, drawn in parts of `CHUNK`, and the scores that it gives.

    A part is the same at every step of a search: its rows are kept where they are few, and so are its products with
    candidates that are the same objects as at the step before.
    """

    def __init__(
        self,
        problem: Problem,
        spectrum: Spectrum,
        whitening: Float[np.ndarray, "F nv"],
        generator: np.random.Generator,
    ) -> None:
        self._draw = partial(draw_noise, problem, spectrum, whitening, CHUNK, slow=True)
        self._seed = int(generator.integers(2**62))
        self._rows: dict[int, np.ndarray] = {}
        self._products: dict[int, dict[int, tuple[Columns, np.ndarray]]] = {}

    def rows(self, part: int) -> Float[np.ndarray, "draws nv T"]:
        """Whitened rows of a part, in single precision."""
        noise = self._rows.get(part)
        if noise is None:
            noise = self._draw(np.random.default_rng([self._seed, part]))
            if noise.size * (part + 1) <= KEPT:
                self._rows[part] = noise
        return noise

    def scores(self, part: int, rows: Rows, linear: Linear, found: Screen) -> Float[np.ndarray, "draws columns"]:
        """Scores of all candidates, with as much drawn for the prior's rows."""
        noise, before = self.rows(part), self._products.get(part, {})
        pairs = zip(found.stock.candidates, found.stock.parts, strict=True)
        known = {id(one): before.get(id(one)) or (one, pulled(one, own, noise)) for one, own in pairs}
        self._products[part] = known
        prior = np.sqrt(np.maximum(np.diag(linear.moment) - rows.Xi.lengths, 0))
        pulls = prior * np.random.default_rng([self._seed, part, 1]).standard_normal((CHUNK, len(prior)))
        return other_scores(rows, found.H, noise, np.concatenate([x for _, x in known.values()], axis=1), pulls)


def family_p(
    rows: Rows,
    linear: Linear,
    found: Screen,
    null: Null,
    generator: np.random.Generator,
    draws: int = DRAWS,
    parts: Float[np.ndarray, "blocks columns"] | None = None,
) -> float:
    """Chance that noise alone gives some candidate of the whole catalogue a score as large as the largest.

    The larger of two nulls: noise drawn from the spectrum (its coefficients redrawn each time), and fair signs of
    whole blocks of the residual, the prior's rows among the blocks. `parts` are the `block_scores` where known.
    """
    if not found.scores:
        return 1.0  # every candidate is forbidden, or stands in the model already
    highest = max(float(result.z.max()) for result in found.scores)
    parts = block_scores(rows, linear, found.stock, found.H) if parts is None else parts
    signs = generator.choice([-1.0, 1.0], (draws, len(parts)))
    above = np.sum(largest(found.stock.span, found.scores, signs @ parts) >= highest)
    drawn = 0
    for part in range(draws // CHUNK):
        z = largest(found.stock.span, found.scores, null.scores(part, rows, linear, found))
        drawn += np.sum(z >= highest)
        if highest > FAR * max(float(z.max()), 1.0):  # no other draw comes near
            break
    return float(1 + max(above, drawn)) / (draws + 1)


def place_p(
    found: Screen,
    parts: Float[np.ndarray, "blocks columns"],
    generator: np.random.Generator,
    draws: int = LOCAL_DRAWS,
) -> float:
    """As `family_p` by fair signs of blocks, each place for itself, times the places: the chance at the surest of them.

    A joint with a large misfit has large scores under any signs, beside which what another joint shows would drown.
    `parts` are the `block_scores`.
    """
    signs = generator.choice([-1.0, 1.0], (draws, len(parts)))
    places: dict[tuple[int, ...], list[int]] = {}
    for index, group in enumerate(found.groups):
        joints = group.columns.joints
        places.setdefault(joints if len(joints) <= 2 else (), []).append(index)
    chances = [1.0]
    for members in places.values():
        scored = [found.scores[i] for i in members]
        highest = max(float(result.z.max()) for result in scored)
        null = largest([found.stock.span[i] for i in members], scored, signs @ parts)
        chances.append((1 + np.sum(null >= highest)) / (draws + 1) * len(places))
    return min(chances)


def draw_noise(
    problem: Problem,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    draws: int,
    generator: np.random.Generator,
    slow: bool = False,
) -> Float[np.ndarray, "draws nv T"]:
    """Whitened rows of noise with what the spectrum may be, drawn anew for each draw (single precision).

    Rows of little weight have the noise of all others: their weight stands for what is beyond it there. `slow`: below
    what the spectrum knows, noise rises as it is expected to (`Spectrum.rise`). The few frequencies there are next to
    nothing of the power, and most of what an offset, a spring or a tilt is told by.
    """
    records = problem.records
    n, _, count, nv = records.shape
    frequency, response = _row_response(problem, whitening)
    power = spectrum.drawn(frequency, draws, generator)
    shape = np.sqrt(np.swapaxes(power * spectrum.rise(frequency) if slow else power, 1, 2)) * response
    # what `rfft` makes of white noise: equal real and imaginary parts, but for the two ends, which are real
    shape *= np.sqrt(count / 2)
    shape[..., [0, -1] if count % 2 == 0 else [0]] *= np.sqrt(2)
    white = generator.standard_normal((draws, nv, n, len(frequency), 2), np.float32).view(np.complex64)[..., 0]
    rows = np.fft.irfft(white * shape[:, :, None].astype(np.float32), count, axis=-1)
    return (rows * np.moveaxis(records.fitted.astype(np.float32), 2, 0)).reshape(draws, nv, -1)


def noise_squares(
    problem: Problem, spectrum: Spectrum, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, " nv"]:
    """Sum over each joint's whitened rows of the squares that noise with the spectrum has there, as in `draw_noise`."""
    frequency, response = _row_response(problem, whitening)
    power = spectrum._replace(lowest=spectrum.known).power(frequency).T * response**2
    count = problem.records.shape[2]
    bins = np.full(len(frequency), 2.0)  # of all `count` frequencies, positive and negative
    bins[[0, -1] if count % 2 == 0 else [0]] = 1.0
    return power @ bins / count * problem.records.fitted.sum((0, 1))


def _row_response(
    problem: Problem, whitening: Float[np.ndarray, "F nv"]
) -> tuple[Float[np.ndarray, " freqs"], Float[np.ndarray, "nv freqs"]]:
    """Frequencies (Hz) of the rows of a slot, and what the row filter and the whitening do to each joint there."""
    count = problem.records.shape[2]
    frequency = np.fft.rfftfreq(count, 1 / float(problem.records.rate))
    known, low_pass = np.asarray(problem.records.omega) / (2 * np.pi), np.asarray(problem.records.low_pass)
    return frequency, np.stack([np.interp(frequency, known, low_pass * column) for column in whitening.T])


def _link_columns(rows: Rows, link: int, model: RobotModel) -> Columns:
    Z = np.swapaxes(rows.X.dense(10 * link, 10 * link + 10), 1, 2)
    return Columns(tuple(range(model.nv)), np.moveaxis(Z, 1, 0)[None])


def _places_of(term: Effect) -> list[tuple[Effect, tuple[int, ...]]]:
    return [(term, tuple(int(i) for i in at)) for at in np.asarray(term.at)]
