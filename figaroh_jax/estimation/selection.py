"""Which effects a model lacks, by any data with a residual: screened, refitted, judged on rows that were left out.

The jobs have screens and gates of their own, for noise and repeats (`diagnosis`), for levels of geometry
(`calibration`) and for drives (`rollouts`); their answers and this one's are all a `results.Selection`. This one asks
of the data nothing but the public residual: for data, effects and devices of a user's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..compiled.precision import in_float64
from ..effects.base import Effect, Place, changed
from ..effects.extended import ExtendedModel, extend, opened
from ..errors import InputError, check_count, check_list, check_positive
from ..results import Cause, Gain, Name, Selection
from ..rigid.model import RobotModel
from .data import Data, as_data
from .fit import fit
from .free import Free, apply, chosen_of
from .solution import Fit

__all__ = ["select"]

TRIED = 4  # candidates that are fitted exactly in each round
BLOCKS, FOLDS = 20, 5  # stretches of rows, and how many groups of them are left out in turn
WORTH = 0.01  # of the squares left out, that a cause must take away at least
RIVAL = 0.9  # of the best one's gain: what gains that much is not told apart


class _Trial(NamedTuple):
    """An effect fitted beside what stands, and squares of each block of rows that were left out."""

    name: Name
    fit: Fit
    effects: tuple[Effect, ...]  # all that were selected, this one last
    squares: Float[np.ndarray, " blocks"]


def select(
    model: RobotModel | ExtendedModel,
    data: Any,
    candidates: Sequence[Effect],
    *,
    free: Any = (),
    prior: dict[str, Any] | None = None,
    alpha: float = 0.05,
    most: int = 4,
) -> Selection:
    """The candidates that the model lacks, one after another as each predicts rows that were left out of the fit.

    `candidates` are effects at their places (`place`), each tried from every value of its shapes' grids; `data` and
    `prior` as for `fit`, `free` what is fitted beside the causes. Rows are cut into 20 stretches, left out in five
    groups. A cause is taken where a paired test over the stretches (t, or signed ranks) is below `alpha`, divided by
    the number of candidates, and its size is one that physics allows. Rows should not be correlated over a stretch's
    length. After `most` causes the search ends: what is still missing then is in their numbers. Answers `named` or
    `nothing`; `solution` is the fit of all.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, t = fj.load_urdf(fj.DEMO), np.arange(1500)[:, None] / 250.0
    >>> q = 0.6 * np.sin(t * np.array([3.0, 4.4, 5.6, 6.9]) + np.arange(4))
    >>> spring, other = (fj.place(fj.CATALOGUE["joint_spring"], robot, [joint]) for joint in ("elbow", "wrist"))
    >>> real = fj.extend(robot, fj.place(fj.CATALOGUE["joint_spring"], robot, ["elbow"], stiffness=3.0))
    >>> a = -q * np.array([3.0, 4.4, 5.6, 6.9]) ** 2
    >>> tau = real.inverse_dynamics(q, np.gradient(q, 0.004, axis=0), a) + np.random.default_rng(0).normal(size=q.shape)
    >>> data = fj.torque_data(robot, fj.recording(q=q, tau=tau, rate=250), fj.Preprocess(cutoff=20))
    >>> [str(cause.name) for cause in fj.select(robot, data, [spring, other]).causes]
    ['joint_spring (elbow)']
    """
    whole = model if isinstance(model, ExtendedModel) else extend(model)
    check_list("candidates", candidates)
    check_positive("alpha", alpha, "the level of a test (0.05, say)", below=1.0)
    check_count("most", most)
    parts, left = as_data(whole, data), list(candidates)
    if not left or not all(isinstance(one, Effect) for one in left):
        raise InputError("candidates: effects at their places are expected: [place(effect, model, ['elbow']), ...]")
    wanted = (
        {kind: True for kind in ([free] if isinstance(free, str) else free)} if not isinstance(free, dict) else free
    )
    held = _left_out(whole, parts, chosen_of(whole, parts, wanted) if wanted else Free(()), prior or {})
    now = _Trial(Name("", ()), *held[:1], (), held[1])
    causes: list[Cause] = []
    while left and len(causes) < most:
        names = [_name(whole.robot, one) for one in left]
        tried = [
            _tried(whole, parts, now, one, names[k], wanted, prior) for k, one in _screened(whole, parts, now, left)
        ]
        good = [one for one in tried if one is not None and _better(now.squares, one.squares) < alpha / len(candidates)]
        if not good:
            break
        best = min(good, key=lambda one: one.squares.sum())
        close = now.squares.sum() - RIVAL * (now.squares.sum() - best.squares.sum())
        alike = tuple(one.name for one in good if one is not best and one.squares.sum() < close)
        causes.append(_cause(best, now, alike, len(causes) + 1))
        left = [one for one, name in zip(left, names, strict=True) if name != best.name]
        now = best
    effects = tuple(changed(one, at=Place(tuple(int(k) for k in np.asarray(one.at)))) for one in now.fit.model.effects)
    solution = replace(now.fit, model=changed(now.fit.model, effects=effects))
    return Selection(verdict="named" if causes else "nothing", causes=tuple(causes), solution=solution)


def _tried(
    model: ExtendedModel,
    data: tuple[Data, ...],
    now: _Trial,
    effect: Effect,
    name: Name,
    free: dict[str, Any],
    prior: dict[str, Any] | None,
) -> _Trial | None:
    """The effect beside those selected, all fitted; nothing where the solver fails or physics forbids its size.

    Places are arrays, so that what is compiled for an effect at one joint serves the others.
    """
    grown = opened(extend(model, *now.effects, effect))
    count = len(model.effects)
    chosen = chosen_of(grown, data, {**{k: v for k, v in free.items() if k != "effects"}, "effects": True})
    kept = tuple(p for p in chosen.parts if p.kind != "effect" or p.key[0] >= count or "effects" in free)
    found, squares = _left_out(grown, data, Free(kept), prior or {})
    if found.reason:
        return None
    last = found.model.effects[-1]
    bounds = [(float(getattr(last, key)), p.lower, p.upper) for key, p in last.parameters().items() if p.linear]
    if any(not low <= value <= high for value, low, high in bounds):
        return None
    return _Trial(name, found, (*now.effects, effect), squares)


def _left_out(
    model: ExtendedModel, data: tuple[Data, ...], free: Free, prior: dict[str, Any]
) -> tuple[Fit, Float[np.ndarray, " blocks"]]:
    """The fit, and squares of each block as predicted without its fold, to first order about the fit."""
    found = _nothing_free(model, data) if not free.parts else fit(model, data, free, prior=prior or None)
    rows = np.asarray(found.rows)
    block = _blocks(rows)
    if free.parts:
        J = np.asarray(_slopes(free.unnamed(), model, data, jnp.asarray(found.values)))
        covariance, variance = np.asarray(found.covariance), max(2.0 * float(found.cost) / max(len(rows), 1), 1e-300)
        whole = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) * variance
        predicted = rows.copy()
        for fold in range(FOLDS):
            mine = block % FOLDS == fold
            rest = whole - J[mine].T @ J[mine]
            predicted[mine] += J[mine] @ np.linalg.lstsq(rest, J[mine].T @ rows[mine], rcond=1e-10)[0]
        rows = predicted
    return found, np.bincount(block, rows**2, minlength=BLOCKS)


def _blocks(rows: np.ndarray) -> Int[np.ndarray, " rows"]:
    """Stretch of each row; all count alike."""
    return np.minimum(np.arange(len(rows)) * BLOCKS // max(len(rows), 1), BLOCKS - 1)


@in_float64
def _nothing_free(model: ExtendedModel, data: tuple[Data, ...]) -> Fit:
    rows = jnp.concatenate([one.residual(model) for one in data])
    none, square = np.zeros(0), 0.5 * jnp.sum(rows**2)
    return Fit(model, data, none, np.zeros((0, 0)), none, square, rows, 0, None, {}, Free(()))


@in_float64
@eqx.filter_jit
def _slopes(free: Free, model: ExtendedModel, data: tuple[Data, ...], values: Any) -> Any:
    """Derivative of the rows by each free number."""

    def rows(numbers: Any) -> Any:
        changed, moved = apply(free, model, data, numbers)
        return jnp.concatenate([one.residual(changed) for one in moved])

    return jax.jacfwd(rows)(values)


def _screened(
    model: ExtendedModel, data: tuple[Data, ...], now: _Trial, left: Sequence[Effect]
) -> list[tuple[int, Effect]]:
    """The candidates that one linear step promises most, each at the best value of its shapes' grids."""
    variants = [(k, one) for k, effect in enumerate(left) for one in _variants(effect)]
    grown = extend(now.fit.model, *(one for _, one in variants))
    first = len(now.fit.model.effects)
    chosen = chosen_of(grown, now.fit.data, "effects")
    linear = [p for p in chosen.parts if p.key[0] >= first and grown.effects[p.key[0]].parameters()[p.key[1]].linear]
    Z = np.asarray(_slopes(Free(tuple(linear)).unnamed(), grown, now.fit.data, jnp.zeros(len(linear))))
    rows = np.asarray(now.fit.rows)
    if now.fit.free.parts:
        base = np.asarray(_slopes(now.fit.free.unnamed(), _before(model, now), data, jnp.asarray(now.fit.values)))
        Q = np.linalg.qr(base / np.maximum(np.linalg.norm(base, axis=0), 1e-300))[0]
        Z, rows = Z - Q @ (Q.T @ Z), rows - Q @ (Q.T @ rows)
    best: dict[int, tuple[float, Effect]] = {}
    for i, (k, one) in enumerate(variants):
        mine = Z[:, [j for j, p in enumerate(linear) if p.key[0] == first + i]]
        step = np.linalg.lstsq(mine, rows, rcond=1e-9)[0]
        drop = float(np.sum(rows**2) - np.sum((rows - mine @ step) ** 2)) if mine.any() else 0.0
        if drop > best.get(k, (0.0, one))[0]:
            names = one.amplitudes()
            began = eqx.tree_at(lambda e: [getattr(e, n) for n in names], one, [np.float64(-x) for x in step])  # noqa: B023
            best[k] = drop, began
    ranked = sorted(best, key=lambda k: -best[k][0])[:TRIED]
    return [(k, best[k][1]) for k in ranked]


def _before(model: ExtendedModel, now: _Trial) -> ExtendedModel:
    """The model that the present fit's numbers change."""
    return extend(model, *now.effects)


def _variants(effect: Effect) -> list[Effect]:
    """The effect without a size, at every value of its shapes' grids."""
    known = effect.parameters()
    linear, curved = ([key for key, p in known.items() if p.linear == kind] for kind in (True, False))
    blank = eqx.tree_at(lambda e: [getattr(e, n) for n in linear], effect, [np.float64(0.0)] * len(linear))
    if not curved:
        return [blank]
    grids = product(*(known[key].grid or (float(getattr(effect, key)),) for key in curved))
    return [eqx.tree_at(lambda e: [getattr(e, n) for n in curved], blank, [np.float64(x) for x in g]) for g in grids]


def _better(before: np.ndarray, after: np.ndarray) -> float:
    """Chance of so much a gain over the blocks, one-sided; one where it is not worth it.

    The better of Student's t of the gains and Wilcoxon's signed ranks, for two: gains are sizes in white noise, and
    where one stretch moves a hundred times as far as another their mean says little, but all are gains.
    """
    if after.sum() > (1.0 - WORTH) * before.sum():
        return 1.0
    from scipy.stats import ttest_rel, wilcoxon  # two seconds to import, for this alone

    chances = [test(before, after, alternative="greater")[1] for test in (ttest_rel, wilcoxon)]
    return float(min(2.0 * np.nanmin(chances), 1.0))


def _name(robot: RobotModel, effect: Effect) -> Name:
    known = robot.link_names if effect.acts_on == "link" else robot.dof_names
    return Name(effect.name, tuple(known[int(k)] for k in np.asarray(effect.at)))


def _cause(best: _Trial, before: _Trial, alike: tuple[Name, ...], found: int) -> Cause:
    words = " ".join([best.name.effect, *best.name.at])
    last = best.fit.model.effects[-1]
    sizes = {key: best.fit.parameters.get(f"{words} {key}") for key in last.parameters()}
    values = {k: e._replace(value=float(getattr(last, k))) for k, e in sizes.items() if e is not None}
    root = [float(np.sqrt(one.squares.sum() / len(best.fit.rows))) for one in (before, best)]
    sure = 1.0 - _better(before.squares, best.squares)
    return Cause(best.name, values, sure / (1 + len(alike)), Gain(root[0], root[1], "of the rows' unit"), alike, found)
