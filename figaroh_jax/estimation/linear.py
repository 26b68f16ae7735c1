r"""Base parameters, friction and coupled effects by linear least squares as one pure function: batches by `jax.vmap`.

The columns of links and effects are brought to coordinates in which the data's own columns are orthonormal (`Basis`,
once, on the host, for one robot of the batch), so that their products lose next to nothing. Products are added up by
blocks of time; a bootstrap resample is a count of each block, and needs neither the columns nor the rows again.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiled.batching import filtered_program, program, traced
from ..compiled.linear_algebra import symmetric_solve
from ..compiled.precision import in_float64
from ..effects.base import Effect, Motion, columns, movable
from ..effects.extended import ExtendedModel, extend
from ..errors import InputError, check_kind, check_positive, check_real
from ..recordings.rowfilter import filtered
from ..rigid.model import RobotModel
from ..rigid.regressor import dense_rows
from .accelerators import coordinates
from .base_parameters import TOLERANCE, base_parameters
from .columns import column_names
from .data import TorqueData

__all__ = ["Basis", "LinearFit", "fit_linear", "linear_basis", "linear_limits"]

TURNS = 10  # of the joints' weights
ACTIVE_TURNS = 30  # of the bounds that hold


class Basis(eqx.Module):
    """Which parameters are fitted, and the coordinates in which they are: `columns @ into` is orthonormal."""

    into: Float[np.ndarray, "columns rank"]
    matrix: Float[np.ndarray, "rank columns"]  # base parameters of all parameters
    kept: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)  # of the kept parameters
    expressions: tuple[str, ...] = eqx.field(static=True)  # with what is grouped into them

    def __repr__(self) -> str:
        return f"Basis of {len(self.names)} base parameters: {', '.join(self.names)}"


class LinearFit(eqx.Module):
    """Base parameters of one fit; of many under `jax.vmap`.

    `values` and `std` (rank,) in SI units, in the order of the basis' `names`; `rms` (nv,) of the residual, N m or N.
    """

    values: Float[Array, " rank"]  # SI units, in the order of `Basis.names`
    std: Float[Array, " rank"]  # for white residuals, each joint weighed by its own
    rms: Float[Array, " nv"]  # of the residual, N m or N
    active: Bool[Array, " rank"]  # stands on its limit
    converged: Bool[Array, ""]  # whether the active limits were found


def linear_basis(model: RobotModel | ExtendedModel, data: TorqueData, tolerance: float | None = None) -> Basis:
    """The base parameters that the data tells of the robot and of the linear parameters of its effects; on the host.

    One basis serves all robots of one structure and all recordings of about one motion. Raises `InputError` where the
    data shows no parameter.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> t = np.arange(1000)[:, None] / 250.0
    >>> run = fj.recording(q=0.5 * np.sin(t * np.array([3.0, 4.0, 5.0, 6.0])), tau=np.cos(t) * np.ones(4), rate=250)
    >>> basis = fj.linear_basis(robot, fj.torque_data(robot, run))
    >>> basis.matrix.shape == (len(basis.names), 40)
    True
    """
    whole = model if isinstance(model, ExtendedModel) else extend(model)
    check_kind("data", data, TorqueData, "`torque_data` makes it of recordings")
    if tolerance is not None:
        check_positive("tolerance", tolerance, "what counts as zero, relative")
    if traced(whole, data):
        raise InputError("linear_basis decides ranks on the host: call it outside of jit, grad and vmap")
    with jax.enable_x64(True):
        X, _, weight = _rows(whole, data)
    rows = np.asarray(X)[np.asarray(weight) > 0]
    names = column_names(whole.robot, tuple(_batched(effect) for effect in whole.effects))
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    base = base_parameters(factor, names, tolerance=TOLERANCE if tolerance is None else tolerance)
    if base.rank == 0:
        raise InputError("the data shows no parameter: nothing moves, or every row was left out")
    into = coordinates(factor[:, None], base).into
    kept = tuple(int(k) for k in base.independent)
    return Basis(into, base.matrix, kept, tuple(names[k] for k in kept), tuple(base.expressions))


def linear_limits(model: ExtendedModel, basis: Basis) -> tuple[Float[np.ndarray, " rank"], Float[np.ndarray, " rank"]]:
    """Least and greatest value of each kept parameter that physics allows: friction takes energy, rotors have inertia.

    Links have no limits here: a base parameter is a sum of several links'.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> model = fj.extend(robot, fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"]))
    >>> t = np.arange(1000)[:, None] / 250.0
    >>> run = fj.recording(q=0.5 * np.sin(t * np.array([3.0, 4.0, 5.0, 6.0])), tau=np.cos(t) * np.ones(4), rate=250)
    >>> lower, upper = fj.linear_limits(model, fj.linear_basis(model, fj.torque_data(model, run)))
    >>> float(lower[-1]), float(upper[-1])
    (0.0, inf)
    """
    check_kind("model", model, ExtendedModel, "`extend` makes one; linear_limits(model, basis)")
    check_kind("basis", basis, Basis, "`linear_basis` makes one")
    lower = [-np.inf] * (10 * len(model.robot.joints))
    for effect in model.effects:
        lower += [p.lower for p in effect.parameters().values() if p.linear]
    low = np.array(lower)[list(basis.kept)]
    return low, np.full(len(low), np.inf)


@in_float64
def fit_linear(
    model: RobotModel | ExtendedModel,
    data: TorqueData,
    basis: Basis,
    *,
    counts: Float[Array | np.ndarray, " blocks"] | None = None,
    lower: Float[Array | np.ndarray, " rank"] | None = None,
    upper: Float[Array | np.ndarray, " rank"] | None = None,
) -> LinearFit:
    """Base parameters weighed by joint; a function of arrays alone, for `jax.vmap` over data, robots or `counts`.

    The model's effects enter with the parameters in which they are linear, viscous and Coulomb friction or a coupled
    transmission for instance; what values they have does not matter. `counts` weighs blocks of half a second: drawn
    with replacement it is a bootstrap. `lower` and `upper` limit parameters (`linear_limits`); which limits hold is
    found by a primal-dual active set (Hintermueller, Ito and Kunisch, 2002).

    >>> import jax, numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> t = np.arange(2000)[:, None] / 250.0
    >>> q = 0.5 * np.sin(t * np.array([3.0, 4.0, 5.0, 6.0]) + np.arange(4))
    >>> data = fj.torque_data(robot, fj.recording(q=q, tau=np.cos(q), rate=250))
    >>> basis = fj.linear_basis(robot, data)
    >>> counts = np.random.default_rng(0).multinomial(16, np.full(16, 1 / 16), size=5).astype(float)
    >>> many = jax.jit(jax.vmap(lambda c: fj.fit_linear(robot, data, basis, counts=c)))(counts)
    >>> many.values.shape == (5, len(basis.names))
    True
    """
    whole = model if isinstance(model, ExtendedModel) else extend(model)
    check_kind("data", data, TorqueData, "`torque_data` makes it of recordings")
    check_kind("basis", basis, Basis, "`linear_basis` makes one")
    for name, given in {"counts": counts, "lower": lower, "upper": upper}.items():
        if given is not None:
            check_real(name, given)
    products, rows = _products(whole, data, basis.into)
    weight = jnp.ones(len(rows)) if counts is None else jnp.asarray(counts, float)
    if weight.shape != (len(rows),):
        raise InputError(f"counts has shape {weight.shape}; the data has {len(rows)} blocks")
    G, total = jnp.einsum("b,bjkl->jkl", weight, products), jnp.maximum(weight @ rows, 1e-300)
    kept = jnp.asarray(basis.into)[np.array(basis.kept)]  # kept parameters of the coordinates
    low, high, limited = _limits(lower, upper, len(kept))
    return _weighed(G, total, kept, low, high, tuple(limited.tolist()))


def _fitted(G: Array, total: Array, kept: Array, low: Array, high: Array, which: tuple[int, ...]) -> LinearFit:
    """The fit of products `G` (joints, rank + 1, rank + 1) of `total` rows of each joint; `which` have a limit."""
    limited = np.array(which, int)
    held = kept[limited]

    def solved(scale: Array, side: Array) -> _Turn:
        A = jnp.einsum("jkl,j->kl", G, scale)
        H, h = A[:-1, :-1], A[:-1, -1]
        if not len(limited):
            return _Turn(symmetric_solve(H, h[:, None])[:, 0], H, side, jnp.ones((), bool))
        both = symmetric_solve(H, jnp.column_stack([h, held.T]))
        z, response = both[:, 0], both[:, 1:]
        pull, side, found = _within(held @ response, held @ z, low[limited], high[limited], side)
        return _Turn(z - response @ pull, H, side, found)

    def squares(z: Array) -> Array:
        y = jnp.append(z, -1.0)
        return jnp.maximum(jnp.einsum("k,jkl,l->j", y, G, y), 1e-24 * G[:, -1, -1] + 1e-300)

    def turn(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        one = solved(*state)
        return total / squares(one.z), one.side

    present = jnp.where(G[:, -1, -1] > 0, 1.0, 0.0)
    start = present, jnp.zeros(len(limited), int)
    last = solved(*jax.lax.fori_loop(0, TURNS, turn, start))
    variance = jnp.sum(kept.T * symmetric_solve(last.H, kept.T), axis=0)
    values, active = kept @ last.z, jnp.zeros(len(kept), bool).at[limited].set(last.side != 0)
    nearest = jnp.where(values - low < high - values, low, high)
    values = jnp.where(active, nearest, jnp.clip(values, low, high))  # on a limit exactly
    return LinearFit(values, jnp.sqrt(variance), jnp.sqrt(squares(last.z) / total), active, last.found)


_weighed = program(_fitted, static_argnums=5)  # else its loop would be compiled at each call


class _Turn(NamedTuple):
    """A solution at some weights of the joints."""

    z: Array
    H: Array
    side: Array  # of each limited parameter: -1 on its lower limit, 1 on its upper one
    found: Array  # whether that is settled


def _limits(
    lower: Array | np.ndarray | None, upper: Array | np.ndarray | None, rank: int
) -> tuple[Array, Array, Int[np.ndarray, " limited"]]:
    """Both limits of every parameter, and which have one: all where a transformation holds the limits."""
    given = [x for x in (lower, upper) if x is not None]
    for name, limits in (("lower", lower), ("upper", upper)):
        if limits is not None and np.shape(limits) not in ((), (rank,)):
            raise InputError(
                f"{name} has shape {np.shape(limits)}; one number is expected, or {rank}: one for each of the basis'"
                " names (`linear_limits`)"
            )
    low = jnp.full(rank, -jnp.inf) if lower is None else jnp.broadcast_to(jnp.asarray(lower, float), (rank,))
    high = jnp.full(rank, jnp.inf) if upper is None else jnp.broadcast_to(jnp.asarray(upper, float), (rank,))
    if traced(*given):
        return low, high, np.arange(rank)
    for name, some in (("lower", lower), ("upper", upper)):
        if some is not None and np.isnan(np.asarray(some, float)).any():
            raise InputError(f"{name} holds nan; a number is expected, or inf where there is no limit")
    if lower is not None and upper is not None:  # in NumPy: a `jit` that holds neither may be at work
        least, most = (np.broadcast_to(np.asarray(x, float), rank) for x in (lower, upper))
        if (crossed := np.flatnonzero(least > most)).size:
            k = int(crossed[0])
            raise InputError(f"lower is above upper: {least[k]:g} and {most[k]:g} of the basis' name {k + 1}")
    finite = [np.broadcast_to(np.isfinite(np.asarray(x)), rank) for x in given]
    return low, high, np.flatnonzero(np.any(finite, axis=0)) if finite else np.zeros(0, int)


def _within(K: Array, c: Array, low: Array, high: Array, side: Array) -> tuple[Array, Array, Array]:
    """Multipliers that bring the parameters c - K pull between their limits, where they stand, whether that was found.

    The active set starts at `side`; K is the covariance of the parameters.
    """
    size = jnp.sqrt(jnp.diagonal(K))
    K, c, low, high = K / size[:, None] / size, c / size, low / size, high / size

    def at(side: Array) -> Array:
        """Multipliers where those on a side stand on their limit."""
        held = side != 0
        limit = jnp.where(side < 0, low, jnp.where(side > 0, high, 0.0))
        matrix = jnp.where(held[:, None] & held, K, jnp.eye(len(side)))
        return symmetric_solve(matrix, jnp.where(held, c - jnp.where(held, limit, 0.0), 0.0)[:, None])[:, 0]

    def better(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        side, _, _, count = state
        pull = at(side)
        p = c - K @ pull
        new = jnp.where(pull + (p - high) > 0, 1, jnp.where(pull + (p - low) < 0, -1, 0))
        return new, pull, jnp.all(new == side), count + 1

    def going(state: tuple[Array, Array, Array, Array]) -> Array:
        return ~state[2] & (state[3] < ACTIVE_TURNS)

    begin = side, jnp.zeros(len(c)), jnp.zeros((), bool), jnp.zeros((), int)
    side, pull, done, _ = jax.lax.while_loop(going, better, begin)
    return pull / size, side, done


@filtered_program
def _products(model: ExtendedModel, data: TorqueData, into: Array | np.ndarray) -> tuple[Array, Array]:
    """Products of [columns, torque] by block and joint, and rows of each block and joint."""
    X, y, weight = _rows(model, data)  # n M nv columns
    Z = jnp.einsum("nmjc,ck->njkm", X, jnp.asarray(into), precision=jax.lax.Precision.HIGHEST)
    both = jnp.concatenate([Z, jnp.moveaxis(y, 1, 2)[:, :, None]], axis=2) * jnp.moveaxis(weight, 1, 2)[:, :, None]
    counted = (jnp.moveaxis(weight, 1, 2) > 0).astype(both.dtype)
    together = data.together or both.shape[-1]
    missing = -both.shape[-1] % together
    both, counted = (jnp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, missing),)) for x in (both, counted))
    both = both.reshape(*both.shape[:3], -1, together)
    products = jnp.einsum("njkbr,njlbr->nbjkl", both, both, precision=jax.lax.Precision.HIGHEST)
    rows = counted.reshape(*counted.shape[:2], -1, together).sum(-1)
    return products.reshape(-1, *products.shape[2:]), jnp.swapaxes(rows, 1, 2).reshape(-1, rows.shape[1])


def _rows(model: ExtendedModel, data: TorqueData) -> tuple[Array, Array, Array]:
    """Low-passed columns (n M nv columns), torque less that of known payloads, and weight (n M nv)."""
    terms = tuple(movable(effect) for effect in model.effects)
    n = len(data.position)
    X = jnp.stack([_columns(model, terms, data, k) for k in range(n)])
    if data.source is not None and data.kept is not None:
        assert data.response is not None
        source, kept = data.source.astype(int), data.kept.astype(int)
        rows = [filtered(jnp.moveaxis(X[k], 0, -1), source[k], kept[k], data.response) for k in range(n)]
        X = jnp.stack([jnp.moveaxis(jnp.asarray(one), -1, 0) for one in rows])
    y = jnp.asarray(data.torque)
    if data.carried is not None:
        y = y - jnp.einsum("nmjc,nc->nmj", X[..., : 10 * len(model.robot.joints)], data.carried.reshape(n, -1))
    return X, y, jnp.asarray(data.weight)


def _columns(model: ExtendedModel, terms: tuple[Effect, ...], data: TorqueData, k: int) -> Array:
    """Columns at the samples of one recording (samples nv columns)."""
    t, q, v, a = (jnp.asarray(x)[k] for x in (data.time, data.position, data.velocity, data.acceleration))
    robot, zero = model.robot, jnp.zeros(v.shape)
    blocks = [jnp.moveaxis(dense_rows(robot, q.T, v.T, a.T), -1, 0)]
    motion = Motion(robot, t, q, v, a, zero, zero, jnp.asarray(data.dt), jnp.asarray(model.width))
    for same in _alike(terms):
        many = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(one) for one in x]), *same)
        torques = jax.vmap(lambda one: jnp.moveaxis(columns(one, motion), 0, -1))(many)
        for term, torque in zip(same, torques, strict=True):
            if term.acts_on not in ("link", "robot"):
                torque = torque.reshape(len(q), -1, torque.shape[-1])
                torque = jnp.zeros((*v.shape, torque.shape[-1])).at[:, term.places].add(torque)
            blocks.append(torque)
    return jnp.concatenate(blocks, axis=2)


def _alike(terms: Sequence[Effect]) -> list[list[Effect]]:
    """Neighbours of one class together: their equation is traced once."""
    return [list(same) for _, same in groupby(terms, key=lambda term: (type(term), jax.tree.structure(term)))]


def _batched(effect: Effect) -> Effect:
    return jax.tree.map(lambda x: np.asarray(x)[None], movable(effect))
