"""The catalogue: every effect that can be named, with its equation, parameters, units and where it acts.

The classes stand by what they are about: `friction`, `transmission`, `inertia`, `sensors`, `environment`. `register`
adds one of yours.
"""

from __future__ import annotations

from . import (
    drives as drives,
    environment as environment,
    friction as friction,
    inertia as inertia,
    sensors as sensors,
    transmission as transmission,
)
from .registry import CATALOGUE, ROLLOUTS, find, one_more, register, related

__all__ = ["CATALOGUE", "ROLLOUTS", "find", "one_more", "register", "related"]
