"""What is believed of inertial parameters before the data: how far, and which bodies can exist."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..rigid.inertia import to_com
from ..rigid.model import RobotModel

__all__ = ["body_precision", "physical_body", "rigid_prior"]

UNSEEN = 1e-12  # of the largest information: what a direction without any counts for
LEVENBERG = 1000  # steps at the most
SETTLED = 1e-10  # of the square, by which a last step would still make it fall
ROUNDING = 1e-20  # of the square of all that is wanted: a smaller one is none


def rigid_prior(model: RobotModel, trust: float) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Nominal inertial parameters and their precision: one sigma is `trust` times m, m L (three times), J (six times).

    L = max(0.05 m, |c|) and J = tr(I)/3 + 0.3 m L^2 give each link its own scale; a massless link gets that of one
    thousandth of the heaviest.
    """
    nominal = np.asarray(model.inertia)
    mass, com, inertia = (np.asarray(part) for part in to_com(nominal))
    floor = 1e-3 * max(float(mass.max(initial=0.0)), 1e-3)
    mass = np.maximum(mass, floor)
    length = np.maximum(0.05, np.linalg.norm(com, axis=1))
    turning = np.trace(inertia, axis1=1, axis2=2) / 3 + 0.3 * mass * length**2
    scale = np.column_stack([mass, *[mass * length] * 3, *[turning] * 6])
    return nominal.reshape(-1), 1 / (trust * scale.reshape(-1)) ** 2


def physical_body(free: Float[np.ndarray, "10"], information: Float[np.ndarray, "10 10"]) -> Float[np.ndarray, "10"]:
    """The ten parameters nearest to `free` (in the metric `information`) that a body of positive mass can have.

    The pseudo-inertia is L L' with L lower triangular (Wensing, Kim, Slotine 2018), L by Levenberg-Marquardt. What the
    metric does not see stays near `free`: else the mass may grow without end, for what that makes of a moment.
    """
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    root = np.sqrt(np.maximum(values, UNSEEN * values[-1]))[:, None] * vectors.T
    lower = np.tril_indices(4)
    start = np.diag(np.sqrt(max(float(free[0]), 0.05) * np.array([0.002, 0.002, 0.002, 1.0])))[lower]
    basis = np.zeros((10, 4, 4))
    basis[(np.arange(10), *lower)] = 1.0

    # the ten parameters are quadratic in x
    products = np.einsum("iab,jcb->ijac", basis, basis)
    forms = np.moveaxis(_ten((products + np.swapaxes(products, 2, 3)) / 2), 2, 0).reshape(100, 10)
    weighed, wanted = (root @ forms.reshape(10, 100)).reshape(100, 10), root @ free

    L = np.tensordot(_quadratic_minimum(weighed.reshape(10, 10, 10), wanted, start), basis, 1)
    return _ten(L @ L.T)


def _quadratic_minimum(
    forms: Float[np.ndarray, "m k k"], wanted: Float[np.ndarray, " m"], start: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Least squares of x' A_i x - b_i, each A_i symmetric, by Levenberg-Marquardt (Nielsen's rule of its damping).

    On the host: a call of another library's solver takes longer than this one, and its import ten times as long.
    """
    x, damping, growth = start, 1e-3, 2.0
    half = forms @ x
    left = half @ x - wanted
    scale = np.zeros_like(x)
    for _ in range(LEVENBERG):
        hessian, slope = 4 * half.T @ half, 2 * left @ half
        scale = np.maximum(scale, np.diag(hessian))
        step = np.linalg.solve(hessian + damping * np.diag(np.maximum(scale, 1e-300)), -slope)
        expected = step @ (damping * scale * step - slope)  # twice of what the square falls by in the linear model
        ahead = forms @ (x + step)
        error = ahead @ (x + step) - wanted
        fall = left @ left - error @ error
        if expected <= SETTLED * (left @ left) + ROUNDING * (wanted @ wanted):
            break
        if fall > 0:
            x, half, left = x + step, ahead, error
            damping, growth = damping * max(1 / 3, 1 - (2 * fall / expected - 1) ** 3), 2.0
        else:
            damping, growth = damping * growth, growth * 2
    return x


def body_precision(ten: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """Prior precision of a fitted body about itself: half of its own scale, no arm shorter than 5 cm."""
    mass, com, _ = (np.asarray(part) for part in to_com(ten))
    length = max(0.05, float(np.linalg.norm(com)))
    scale = float(mass) * np.array([1.0, *[length] * 3, *[length**2] * 6])
    return 1 / (0.5 * np.maximum(scale, 1e-6)) ** 2


def _ten(P: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 10"]:
    """Ten parameters of pseudo-inertias [[S, h], [h', m]]: the inertia is tr(S) 1 - S."""
    trace = np.trace(P[..., :3, :3], axis1=-2, axis2=-1)
    (xx, yy, zz), (xy, xz, yz) = ((P[..., i, i] for i in range(3)), (P[..., i, j] for i, j in ((0, 1), (0, 2), (1, 2))))
    h = (P[..., k, 3] for k in range(3))
    return np.stack([P[..., 3, 3], *h, trace - xx, -xy, trace - yy, -xz, -yz, trace - zz], axis=-1)
