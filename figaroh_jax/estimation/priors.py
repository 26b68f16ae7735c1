"""What is believed of inertial parameters before the data: how far, and which bodies are consistent."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from jaxtyping import Float

from ..rigid.inertia import to_com
from ..rigid.model import RobotModel
from .conic import Body, Constraints, NotConverged, constrained
from .consistency import inconsistencies

__all__ = ["body_precision", "physical_body", "rigid_prior"]

UNSEEN = 1e-12  # of the largest information: what a direction without any counts for
LIGHT, SHORT, LONG = 0.05, 0.05, 1.0  # kg, m, m: scales of a body, the first two at the least


def rigid_prior(model: RobotModel, trust: float) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Nominal inertial parameters and their precision: one sigma is `trust` times m, m L (three times), J (six times).

    L = max(0.05 m, |c|) and J = tr(I)/3 + 0.3 m L^2 give each link its own scale; a massless link gets that of one
    thousandth of the heaviest.
    """
    nominal = np.asarray(model.inertia)
    mass, com, inertia = (np.asarray(part) for part in to_com(nominal))
    floor = 1e-3 * max(float(mass.max(initial=0.0)), 1e-3)
    mass = np.maximum(mass, floor)
    length = np.maximum(SHORT, np.linalg.norm(com, axis=1))
    turning = np.trace(inertia, axis1=1, axis2=2) / 3 + 0.3 * mass * length**2
    scale = np.column_stack([mass, *[mass * length] * 3, *[turning] * 6])
    return nominal.reshape(-1), 1 / (trust * scale.reshape(-1)) ** 2


def physical_body(free: Float[np.ndarray, "10"], information: Float[np.ndarray, "10 10"]) -> Float[np.ndarray, "10"]:
    """The ten parameters nearest to `free` (in the metric `information`) that a body of positive mass can have.

    What the metric does not see stays near `free`: else the mass may grow without end, for what that makes of a moment.
    """
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    root = np.sqrt(np.maximum(values, UNSEEN * values[-1]))[:, None] * vectors.T
    mass = max(abs(float(free[0])), LIGHT)
    length = min(max(SHORT, float(np.linalg.norm(free[1:4])) / mass), LONG)
    # parameters far from any body are not always found in a metric: then those nearest in units of their own
    for rows, kg, m in ((root, mass, length), (np.eye(10), float(np.abs(free).max()), 1.0)):
        body = Body("body", range(10), kg, m)
        scale = kg * m ** np.array([0.0, *[1.0] * 3, *[2.0] * 6])
        with suppress(NotConverged):
            found = constrained(np.column_stack([rows, rows @ free]), Constraints([body]), scale)
            if not inconsistencies(found[None], [body.name]):
                return found
    raise NotConverged(f"no body lies near the parameters {free}")


def body_precision(ten: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """Prior precision of a fitted body about itself: half of its own scale, no arm shorter than 5 cm."""
    mass, com, _ = (np.asarray(part) for part in to_com(ten))
    length = max(SHORT, float(np.linalg.norm(com)))
    scale = float(mass) * np.array([1.0, *[length] * 3, *[length**2] * 6])
    return 1 / (0.5 * np.maximum(scale, 1e-6)) ** 2
