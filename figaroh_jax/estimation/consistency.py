"""Physically consistent links: why one is not, and fits whose links all are.

A body has a positive semidefinite pseudo-inertia (Wensing, Kim, Slotine 2018): positive mass and principal inertias of
which none exceeds the sum of the others. Two fits keep to that. `physical_fit` solves the convex problem and so
finds its one optimum; `log_cholesky_fit` writes every pseudo-inertia as L M M' L' about the nominal L L' and needs no
constraints. Both see the data as a triangular factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError, nearest
from ..rigid.inertia import from_pseudo_inertia, pseudo_inertia, to_com
from ..rigid.model import RobotModel
from .conic import Body, Constraints, constrained

__all__ = [
    "Inconsistency",
    "bodies",
    "inconsistencies",
    "log_cholesky_fit",
    "physical_fit",
    "project",
]

TOLERANCE = 1e-9  # of the largest eigenvalue: rounding of a body on the border
ROUND = 30  # steps of Levenberg-Marquardt between two looks at the cost
SETTLED = 1e-6  # of the cost, won in a round: less is convergence
_LOWER = np.tril_indices(4)


class Inconsistency(NamedTuple):
    """A link that no body can have, and why; `eigenvalue` is the smallest of its pseudo-inertia."""

    link: str
    eigenvalue: float
    reason: str


class LogCholeskyFit(NamedTuple):
    """Parameters, half of the sum of squares (prior included), and whether the search has converged."""

    parameters: Float[np.ndarray, " columns"]
    cost: float
    converged: bool
    steps: int


def inconsistencies(inertia: Float[np.ndarray, "links 10"], names: Sequence[str]) -> tuple[Inconsistency, ...]:
    """The links whose ten parameters belong to no body, with the reason; empty: all are possible."""
    out = []
    for ten, name in zip(np.asarray(inertia, float), names, strict=True):
        values = np.linalg.eigvalsh(pseudo_inertia(ten))
        if values[0] < -TOLERANCE * abs(values[-1]) or not np.isfinite(ten).all():
            out.append(Inconsistency(name, float(values[0]), _reason(ten, float(values[0]))))
    return tuple(out)


def _reason(ten: Float[np.ndarray, "10"], eigenvalue: float) -> str:
    mass, com, inertia = to_com(ten)
    if not np.isfinite(ten).all():
        return "a parameter is not finite"
    if mass <= 0:
        return f"its mass is {float(mass):.4g} kg"
    principal = np.linalg.eigvalsh(inertia)
    shown = ", ".join(f"{x:.3g}" for x in principal)
    if principal[0] < 0:
        return f"an inertia about its centre of mass is negative (principal inertias {shown} kg m^2)"
    if principal[2] > principal[0] + principal[1]:
        return f"its largest principal inertia exceeds the sum of the others ({shown} kg m^2)"
    return f"its pseudo-inertia has the eigenvalue {eigenvalue:.3g}"


def bodies(
    model: RobotModel, cad: Mapping[str, Mapping[str, tuple[float, float] | Sequence[Sequence[float]]]] | None = None
) -> tuple[Body, ...]:
    """The links as bodies with their own scales, for a vector that begins with ten parameters of each.

    `cad` bounds links by name: `{"forearm": {"mass": (1.0, 3.0), "com": ((x, y, z), (x, y, z))}}`, kg and m in the
    joint frame (the corners of a box around the centre of mass). Raises `InputError` for unknown links and keys.
    """
    cad = cad or {}
    for link, entry in cad.items():
        if link not in model.link_names:
            raise InputError(f"bounds: robot '{model.name}' has no link '{link}'{nearest(link, model.link_names)}")
        for key in entry:
            if key not in ("mass", "com"):
                raise InputError(f"bounds of {link}: unknown key '{key}'; known: mass, com")
    mass, com, inertia = (np.asarray(part) for part in to_com(np.asarray(model.inertia, float)))
    floor = 1e-3 * max(float(mass.max(initial=0.0)), 1e-3)
    mass = np.maximum(mass, floor)
    size = np.sqrt(np.maximum(np.trace(inertia, axis1=1, axis2=2), 0.0) / mass)
    length = np.maximum(0.05, np.maximum(np.linalg.norm(com, axis=1), size))
    plain = [
        Body(name, tuple(range(10 * k, 10 * k + 10)), float(mass[k]), float(length[k]))
        for k, name in enumerate(model.link_names)
    ]
    return tuple(_bounded(body, cad.get(body.name, {})) for body in plain)


def _bounded(body: Body, entry: Mapping) -> Body:
    least, greatest = entry.get("mass", (0.0, np.inf))
    if not 0 <= least <= greatest:
        raise InputError(f"bounds of {body.name}: mass must be (least, greatest) with 0 <= least <= greatest")
    box = entry.get("com")
    if box is not None:
        low, high = (np.asarray(corner, float) for corner in box)
        if low.shape != (3,) or high.shape != (3,) or (low > high).any():
            raise InputError(f"bounds of {body.name}: com must be two corners of three numbers, low <= high")
        box = low, high
    return replace(body, least_mass=float(least), greatest_mass=float(greatest), box=box)


def physical_fit(
    factor: Float[np.ndarray, "n k"], links: Sequence[Body], lower: Float[np.ndarray, " columns"] | None = None
) -> Float[np.ndarray, " columns"]:
    """Least squares of `factor @ [x, -1]` over parameters whose links are bodies, none below `lower`: the one optimum.

    A prior belongs into the factor (`least_squares.with_prior`). Raises `InputError` where that fails.
    """
    scale = _scales(factor.shape[1] - 1, links)
    return constrained(factor, Constraints(links, lower), scale)


def _scales(columns: int, links: Sequence[Body]) -> Float[np.ndarray, " columns"]:
    scale = np.ones(columns)
    for body in links:
        scale[list(body.columns)] = body.mass * body.length ** np.array([0.0, *[1.0] * 3, *[2.0] * 6])
    return scale


def project(
    inertia: Float[np.ndarray, "links 10"],
    links: Sequence[Body],
    information: Float[np.ndarray, "n columns"] | None = None,
) -> Float[np.ndarray, "links 10"]:
    """The nearest parameters whose links are bodies within their bounds.

    Nearest in each link's own units of mass and length, or in |information @ change|. Feasible links stay as they are
    where no `information` couples them.
    """
    flat = np.asarray(inertia, float).reshape(-1)
    scale = _scales(flat.size, links)
    if information is not None:
        R = np.asarray(information, float)
        return physical_fit(np.column_stack([R, R @ flat]), links).reshape(-1, 10)
    out = np.array(inertia, float)
    for k, body in enumerate(links):
        own = replace(body, columns=range(10))
        root = np.diag(1 / scale[10 * k : 10 * k + 10])
        if _outside(out[k], body):
            out[k] = constrained(np.column_stack([root, root @ out[k]]), Constraints([own]), 1 / np.diag(root))
    return out


def _outside(ten: Float[np.ndarray, "10"], body: Body) -> bool:
    com = ten[1:4] / ten[0] if ten[0] > 0 else np.zeros(3)
    boxed = body.box is not None and bool(((com < body.box[0]) | (com > body.box[1])).any())
    massive = not body.least_mass <= ten[0] <= body.greatest_mass
    return bool(inconsistencies(ten[None], [body.name])) or massive or boxed


def log_cholesky_fit(
    factor: Float[np.ndarray, "n k"],
    nominal: Float[np.ndarray, "links 10"],
    start: Float[np.ndarray, " columns"] | None = None,
    *,
    prior: Literal["none", "entropic"] = "none",
    strength: float = 0.0,
    max_steps: int = 3000,
) -> LogCholeskyFit:
    r"""Links as $P = L M M^T L^T$ about the nominal $L L^T$, M lower triangular; Levenberg-Marquardt (optimistix).

    No constraint is needed, and at M = 1 the robot is the nominal one. `factor` is that of [inertial columns, others,
    y], a Gaussian prior included; the entropic prior adds `strength` times $\sum tr Q - \log\det Q - 4$, $Q = M M^T$
    (Lee, Wensing, Park 2020). `start` is a vector of parameters whose links are bodies (default: the nominal robot).
    """
    import optimistix  # slow to import

    with jax.enable_x64(True):
        roots = np.linalg.cholesky(pseudo_inertia(_interior(np.asarray(nominal, float))))
        flat = np.asarray(nominal, float).reshape(-1) if start is None else np.asarray(start, float)
        links = 10 * len(roots)
        lower = np.linalg.cholesky(pseudo_inertia(_interior(flat[:links].reshape(-1, 10))))
        M = np.linalg.solve(roots, lower)[:, *_LOWER]
        rest = np.zeros(factor.shape[1] - 1 - links)
        rest[: len(flat) - links] = flat[links:]
        R = np.asarray(np.linalg.qr(np.asarray(factor, float), mode="r"))
        unit = max(float(np.linalg.norm(R[:, -1])), 1e-12)
        size = np.linalg.norm(R[:, links:-1], axis=0) / unit
        size = np.where(size > 0, size, 1.0)
        arguments = (R / unit, roots, size, np.sqrt(strength) / unit if prior == "entropic" else 0.0)
        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
        value, cost, steps, settled = (jnp.asarray(M), jnp.asarray(rest * size)), np.inf, 0, False
        theta = flat
        while not settled and steps < max_steps:
            value, theta, squares, count = _search(solver, value, arguments, ROUND)
            steps += int(count)
            # at the border of what is consistent the search creeps without end: the cost decides, not the step
            settled, cost = bool(cost < (1 + SETTLED) * float(squares)), float(squares)
        return LogCholeskyFit(np.asarray(theta), 0.5 * unit**2 * cost, settled, steps)


def _interior(inertia: Float[np.ndarray, "links 10"]) -> Float[np.ndarray, "links 10"]:
    """The links moved off the border of what is consistent: Cholesky's factor must exist."""
    P = pseudo_inertia(inertia)
    values, vectors = np.linalg.eigh(P)
    mass = np.maximum(inertia[:, 0], 1e-3 * max(float(inertia[:, 0].max(initial=0.0)), 1e-3))
    floor = np.maximum(1e-4 * mass, 1e-9)[:, None]
    return np.asarray(from_pseudo_inertia((vectors * np.maximum(values, floor)[:, None]) @ np.swapaxes(vectors, 1, 2)))


@partial(jax.jit, static_argnums=(0, 3))
def _search(solver, start, arguments, max_steps):
    import optimistix

    found = optimistix.least_squares(_residual, solver, start, arguments, max_steps=max_steps, throw=False)
    squares = (_residual(found.value, arguments) ** 2).sum()
    return found.value, _parameters(found.value, arguments), squares, found.stats["num_steps"]


def _parameters(value: tuple[Array, Array], arguments: tuple) -> Float[Array, " columns"]:
    M, rest = value
    _, roots, size, _ = arguments
    L = jnp.asarray(roots) @ jnp.zeros((len(M), 4, 4)).at[:, *_LOWER].set(M)
    inertia = jnp.asarray(from_pseudo_inertia(L @ jnp.swapaxes(L, 1, 2)))
    return jnp.concatenate([inertia.reshape(-1), rest / size])


def _residual(value: tuple[Array, Array], arguments: tuple) -> Float[Array, " rows"]:
    R, _, _, entropic = arguments
    misfit = R @ jnp.append(_parameters(value, arguments), -1.0)
    M = value[0]
    turned = np.array([i == j for i, j in zip(*_LOWER, strict=True)])
    diagonal = jnp.abs(M[:, turned]) + 1e-12
    spread = _root_divergence(diagonal)
    return jnp.concatenate([misfit, entropic * M[:, ~turned].reshape(-1), entropic * spread.reshape(-1)])


def _root_divergence(m: Float[Array, "..."]) -> Float[Array, "..."]:
    """Signed square root of m^2 - 1 - 2 log m, smooth at its zero m = 1."""
    d = m - 1.0
    near = jnp.abs(d) < 1e-3
    safe = jnp.where(near, 2.0, m)
    far = jnp.sign(safe - 1.0) * jnp.sqrt(safe**2 - 1.0 - 2.0 * jnp.log(safe))
    return jnp.where(near, jnp.sqrt(2.0) * d * (1.0 - d / 6.0), far)
