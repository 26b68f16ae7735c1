"""What an identification answers: plain immutable records, the same for report, terminal and `result.json`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.extended import ExtendedModel
from ..estimation.solution import Fit
from ..results import Estimate, Name, Trace, finite

__all__ = ["BaseParameter", "FittedEffect", "Identification", "Link", "Parameter", "Quality", "Status", "to_json"]

Status = Literal["identified", "prior only", "not identifiable", "on its bound"]


class BaseParameter(NamedTuple):
    """A combination of parameters that the torques show."""

    expression: str
    value: float
    std: float
    status: Status


class Parameter(NamedTuple):
    """One parameter of a link or of a joint's drive, and whether it can be told alone."""

    name: str
    value: float
    std: float
    status: Status
    absorbed_in: tuple[str, ...]  # base parameters that contain it
    null_direction: str = ""  # the shortest change that contains it and that no torque shows; empty if told alone


class Link(NamedTuple):
    """Ten inertial parameters in Pinocchio's order, at and in the joint frame."""

    name: str
    parameters: Float[np.ndarray, "10"]
    consistent: bool
    reason: str  # why no body can have them; empty if one can


class FittedEffect(NamedTuple):
    """An effect with its values."""

    name: Name
    parameters: dict[str, Estimate]


@dataclass(frozen=True)
class Quality:
    """Residual of each joint: RMS (N m or N), relative to the torque's RMS, R2 about its mean; NaN without rows."""

    rms: Float[np.ndarray, " nv"]
    relative: Float[np.ndarray, " nv"]
    r2: Float[np.ndarray, " nv"]

    @property
    def total(self) -> float:
        """RMS of the joints together, each counted alike."""
        return float(np.sqrt(np.nanmean(self.rms**2))) if np.isfinite(self.rms).any() else math.nan


@dataclass(frozen=True, repr=False)
class Identification:
    """The fitted robot, what can be trusted of it, and how well it predicts."""

    solution: Fit  # of links and effects, with the covariance of all of them
    joints: tuple[str, ...]
    structural_rank: int  # what some motion could show
    condition: float
    scaled_condition: float
    base: tuple[BaseParameter, ...]
    parameters: tuple[Parameter, ...]
    null_directions: tuple[str, ...]
    links: tuple[Link, ...]
    effects: tuple[FittedEffect, ...]
    fit: Quality
    unconstrained: Quality  # of the base parameters alone, weighted by joint
    nominal: Quality  # of the links as the robot's file has them, with friction fitted beside them
    validated: Quality  # cross-validated in blocks of time
    holdout: dict[str, Quality]
    trust: float  # relative one sigma of the nominal inertials that predicts best
    width: Float[np.ndarray, " nv"]  # half width of the reversal of dry friction, rad/s or m/s
    method: str
    essential: tuple[str, ...] = ()  # base parameters that matter: the others may be zero (`base_parameters.essential`)
    traces: tuple[Trace, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()  # of base parameters, the strongest
    notes: tuple[str, ...] = ()
    prismatic: tuple[bool, ...] = field(default=())
    band: float | None = None  # Hz, that positions were taken down to (`prepare`): predictions want the same

    def __repr__(self) -> str:
        rows = zip(self.joints, self.nominal.relative, self.fit.relative, self.validated.relative, strict=True)
        told = [f"  {joint}: {a:.2%} -> {b:.2%}, cross-validated {c:.2%}" for joint, a, b, c in rows]
        head = f"Identification: {self.rank} of {self.structural_rank} base parameters, {self.method}"
        return "\n".join([f"{head}; error of the torque, nominal -> fitted:", *told])

    @property
    def model(self) -> ExtendedModel:
        """The robot with its fitted links and effects."""
        return self.solution.model

    @property
    def rank(self) -> int:
        """Base parameters that the torques show."""
        return int(self.solution.rank)

    @property
    def torque_units(self) -> tuple[str, ...]:
        """Unit of torque and residual of each joint: "N m", or "N" at a prismatic one."""
        return tuple("N" if straight else "N m" for straight in self.prismatic or (False,) * len(self.joints))


def result(found: Identification) -> dict[str, Any]:
    """The identification as the dictionary of `result.json`; a number that is not finite becomes None."""
    return {
        "rank": found.rank,
        "structural_rank": found.structural_rank,
        "condition": finite(found.condition),
        "scaled_condition": finite(found.scaled_condition),
        "joints": list(found.joints),
        "method": found.method,
        "converged": not found.solution.failure,
        "trust": finite(found.trust),
        "base_parameters": [
            {"expression": b.expression, "value": finite(b.value), "std": finite(b.std), "status": b.status}
            for b in found.base
        ],
        "essential": list(found.essential),
        "parameters": [
            {"name": p.name, "value": finite(p.value), "std": finite(p.std), "status": p.status}
            | {"absorbed_in": list(p.absorbed_in)}
            | ({"null_direction": p.null_direction} if p.null_direction else {})
            for p in found.parameters
        ],
        "null_directions": list(found.null_directions),
        "links": [
            {"name": link.name, "parameters": _numbers(link.parameters), "consistent": link.consistent}
            | ({"reason": link.reason} if link.reason else {})
            for link in found.links
        ],
        "effects": [
            {
                "effect": e.name.effect,
                "at": list(e.name.at),
                "parameters": {
                    name: {"value": finite(x.value), "std": finite(x.std), "unit": x.unit}
                    for name, x in e.parameters.items()
                },
            }
            for e in found.effects
        ],
        "fit": _quality(found.fit),
        "unconstrained": _quality(found.unconstrained),
        "nominal": _quality(found.nominal),
        "cross_validation": _quality(found.validated),
        "holdout": {file: _quality(quality) for file, quality in found.holdout.items()},
        "reversal_width": _numbers(found.width),
        "correlations": [{"between": [a, b], "value": finite(c)} for a, b, c in found.correlations],
        "notes": list(found.notes),
    }


def to_json(found: Identification) -> str:
    """The text of `result.json`: strict JSON in UTF-8 characters, with a newline at its end."""
    return json.dumps(result(found), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _quality(quality: Quality) -> dict[str, list[float | None]]:
    return {name: _numbers(getattr(quality, name)) for name in ("rms", "relative", "r2")}


def _numbers(values: Any) -> list[float | None]:
    return [finite(value) for value in values]
