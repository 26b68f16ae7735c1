r"""Momentum and energy forms: parameters from positions, velocities and torques, without accelerations.

With the momentum $p = M v$, $\dot p = \tau + \partial_q T - g - f$ (T the kinetic energy, f friction), so over a window
$\int \tau = \Delta p - \int (\partial_q T - g - f)$; with the energy E, $\int v'\tau = \Delta E + \int v' f$. Both are
linear in the same columns as the torque (Gautier and Khalil, 1988; Slotine and Li, 1991). Integrals by Simpson's rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..effects.base import Effect
from ..errors import InputError
from ..estimation.columns import column_names, random_states, term_columns
from ..estimation.regression import Piece
from ..rigid.kinematics import placements
from ..rigid.model import RobotModel
from ..rigid.regressor import dense_rows

__all__ = ["WindowRows", "energy_columns", "momentum_columns"]

Form = Literal["momentum", "energy"]


@dataclass(frozen=True)
class WindowRows:
    """Rows for `regression.condense`: one for each joint (momentum) or one for all (energy) over each window.

    `source` gives records (q, v, tau) at even steps of `dt` s, samples first; a window is `window` steps (even), the
    next begins where it ends. For fixed robots with joints of one axis.
    """

    model: RobotModel
    source: Callable[[], Iterable[Sequence[Any]]]
    dt: float
    form: Form = "momentum"
    window: int = 10
    terms: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        if self.model.nq != self.model.nv:
            raise InputError("momentum and energy forms take revolute and prismatic joints")
        if self.window < 2 or self.window % 2:
            raise InputError(f"window is {self.window}, expected an even number of steps (Simpson's rule)")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, as for the torque."""
        return column_names(self.model, self.terms)

    @cached_property
    def used(self) -> Bool[np.ndarray, "rows columns"]:
        """Which columns of a row can differ from zero."""
        q, v, _ = random_states(self.model, 64)
        stored, rate = self._parts(q, v)
        return (np.abs(stored).max(axis=0) > 0) | (np.abs(rate).max(axis=0) > 0)

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """A piece for each record of the source."""
        del fitted
        if widths:
            raise InputError("WindowRows takes no widths of reversals")
        for number, (q, v, tau) in enumerate(self.source()):
            q, v, tau = (np.asarray(x, float) for x in (q, v, tau))
            if not all(x.shape == (len(q), self.model.nv) and np.isfinite(x).all() for x in (q, v, tau)):
                raise InputError(f"record {number} of the source: q, v and tau must be finite, of one shape")
            count = (len(q) - 1) // self.window
            if count < 1:
                raise InputError(f"record {number} of the source: {len(q)} samples are less than a window")
            stored, rate = self._parts(q, v)
            ends = np.arange(count + 1) * self.window
            X = np.diff(stored[ends], axis=0) + self._integral(rate, count)
            y = self._integral(tau if self.form == "momentum" else np.sum(v * tau, axis=1, keepdims=True), count)
            yield Piece(X, y, np.ones(y.shape), ends[:-1] * self.dt, np.arange(count) % 5, number)

    def _parts(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns of what is stored, and of what the torque gives beside its change."""
        with jax.enable_x64(True):
            one = momentum_columns if self.form == "momentum" else energy_columns
            stored, rate = one(self.model, self.terms, q, v)
            return np.asarray(stored), np.asarray(rate)

    def _integral(self, x: np.ndarray, count: int) -> np.ndarray:
        weight = np.full(self.window + 1, 2.0)
        weight[1::2], weight[[0, -1]] = 4.0, 1.0
        inside = np.arange(count)[:, None] * self.window + np.arange(self.window + 1)
        return np.einsum("k,nk...->n...", weight * self.dt / 3, x[inside])


@eqx.filter_jit
def momentum_columns(
    model: RobotModel, terms: tuple[Effect, ...], q: Float[ArrayLike, "samples nv"], v: Float[ArrayLike, "samples nv"]
) -> tuple[Float[Array, "samples nv columns"], Float[Array, "samples nv columns"]]:
    r"""Columns P and H with $\tau = \dot P \theta + H \theta$: momentum (N m s), and $g + f - \partial_q T$ (N m).

    To be called where 64-bit JAX is on; an effect may depend on the acceleration linearly, as a rotor does.

    >>> import jax, numpy as np, figaroh_jax as fj
    >>> robot, (q, v) = fj.load_urdf(fj.DEMO), np.random.default_rng(0).normal(size=(2, 10, 4))
    >>> with jax.enable_x64(True):
    ...     P, H = map(np.asarray, fj.acceleration_free.momentum_columns(robot, (), q, v))
    >>> momentum = np.einsum("sij,sj->si", fj.mass_matrix(robot, q), v)
    >>> bool(np.allclose(P @ np.asarray(robot.inertia).ravel(), momentum, rtol=0, atol=1e-9))
    True
    """
    q, v = jnp.asarray(q), jnp.asarray(v)
    still = jnp.zeros_like(v)
    kinetic, turned = jax.vmap(lambda way: _along(model, q, v, way), out_axes=1)(jnp.eye(model.nv))
    del kinetic
    gravity = _rows(model, q, still, still)
    resting, moving = (term_columns(model, terms, jnp.zeros(model.nv), q, v, a) for a in (still, v))
    drives = [m - r for m, r in zip(moving, resting, strict=True)]
    stored = [_rows(_weightless(model), q, still, v), *drives]
    return jnp.concatenate(stored, axis=2), jnp.concatenate([gravity - turned, *resting], axis=2)


@eqx.filter_jit
def energy_columns(
    model: RobotModel, terms: tuple[Effect, ...], q: Float[ArrayLike, "samples nv"], v: Float[ArrayLike, "samples nv"]
) -> tuple[Float[Array, "samples 1 columns"], Float[Array, "samples 1 columns"]]:
    r"""Columns E and D with $v' \tau = \dot E \theta + D \theta$: energy (J) and the power of friction (W).

    >>> import jax, numpy as np, figaroh_jax as fj
    >>> robot, (q, v) = fj.load_urdf(fj.DEMO), np.random.default_rng(0).normal(size=(2, 10, 4))
    >>> with jax.enable_x64(True):
    ...     E, still = (np.asarray(fj.acceleration_free.energy_columns(robot, (), q, x)[0]) for x in (v, 0 * v))
    >>> kinetic = 0.5 * np.einsum("si,sij,sj->s", v, fj.mass_matrix(robot, q), v)
    >>> bool(np.allclose((E - still)[:, 0] @ np.asarray(robot.inertia).ravel(), kinetic, rtol=0, atol=1e-9))
    True
    """
    q, v = jnp.asarray(q), jnp.asarray(v)
    still = jnp.zeros_like(v)
    resting, moving = (term_columns(model, terms, jnp.zeros(model.nv), q, v, a) for a in (still, v))
    stored = [_kinetic(model, q, v) + _potential(model, q)]
    stored += [0.5 * jnp.einsum("sj,sjk->sk", v, m - r) for m, r in zip(moving, resting, strict=True)]
    lost = [jnp.zeros_like(stored[0]), *(jnp.einsum("sj,sjk->sk", v, r) for r in resting)]
    return jnp.concatenate(stored, axis=1)[:, None], jnp.concatenate(lost, axis=1)[:, None]


def _rows(model: RobotModel, q: Array, v: Array, a: Array) -> Float[Array, "samples nv columns"]:
    return jnp.moveaxis(dense_rows(model, q.T, v.T, a.T), -1, 0)


def _weightless(model: RobotModel) -> RobotModel:
    return eqx.tree_at(lambda m: m.gravity, model, jnp.zeros(3))


def _kinetic(model: RobotModel, q: Array, v: Array) -> Float[Array, "samples columns"]:
    """Half of v' M v: the torque without gravity at rest that gives the acceleration v is M v."""
    return 0.5 * jnp.einsum("sj,sjk->sk", v, _rows(_weightless(model), q, jnp.zeros_like(v), v))


def _along(model: RobotModel, q: Array, v: Array, way: Array) -> tuple[Array, Array]:
    return jax.jvp(lambda x: _kinetic(model, x, v), (q,), (jnp.broadcast_to(way, q.shape),))


def _potential(model: RobotModel, q: Array) -> Float[Array, "samples columns"]:
    """Energy of a unit of mass and first moments against gravity; inertias have none."""
    pose = placements(model, q.T)  # (links, 4, 4, samples)
    height = -jnp.einsum("i,laik->lak", jnp.asarray(model.gravity), jnp.swapaxes(pose[:, :3], 1, 2))
    columns = jnp.concatenate([height[:, 3:], height[:, :3], jnp.zeros((len(height), 6, len(q)))], axis=1)
    return jnp.moveaxis(columns, -1, 0).reshape(len(q), -1)
