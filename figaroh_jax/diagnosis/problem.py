"""The recordings of a diagnosis and what is believed of the robot before: fixed from its beginning to its end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..effects.base import Effect, Motion
from ..effects.catalogue import CATALOGUE
from ..recordings.stacked import Records, open_rows
from ..rigid.model import RobotModel
from ..simulators.contract import Backend
from .design import Units, candidates, flattened, kind, shapes, units
from .shifts import links_torque, rigid_torque

__all__ = ["Layout", "Problem", "family_of"]

_OF_THE_MOTION = ("torque", "gain", "motion", "families", "fixed")  # cached, and the same for all weights of the rows


class Layout(eqx.Module):
    """Which rows repeat, belong together or are left out together; T = recordings x rows."""

    partner: Int[np.ndarray, "partners T"]
    paired: Float[np.ndarray, "nv T"]
    block: Int[np.ndarray, " T"]
    fold: Int[np.ndarray, " T"]  # by which causes are chosen: excitations, or slices in turn where they are few
    part: Int[np.ndarray, " T"]  # by which the gain is told: excitations, or quarters that follow one another
    repeats: bool = eqx.field(static=True)


@dataclass(frozen=True)
class Problem:
    """Recordings and what is believed of the robot before; rows that are not fitted have no weight.

    The torque of the robot's rigid body, and its regressor, are the backend's; what an effect adds to them is ours.
    """

    backend: Backend
    records: Records
    layout: Layout
    trust: float
    width: Float[np.ndarray, " nv"]  # half width of the friction's reversal, rad/s or m/s
    held: Float[np.ndarray, "n M nv"]  # 1: a row of a holdout recording with torque

    @property
    def model(self) -> RobotModel:
        """The robot."""
        return self.backend.robot

    def weighted(self, weight: Float[np.ndarray, "n M nv"]) -> Problem:
        """The problem with other weights of its rows; what the motion alone says is not computed anew."""
        other = replace(self, records=eqx.tree_at(lambda r: r.weight, self.records, weight))
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in _OF_THE_MOTION})
        return other

    @cached_property
    def torque(self) -> Float[np.ndarray, "n M nv"]:
        """Rows of the measured torque, not whitened, also those that are not fitted, N m or N."""
        return open_rows(self.records, self.records.flat(self.records.torque), np.ones(len(self.records.omega)))

    @cached_property
    def gain(self) -> Float[np.ndarray, " F"]:
        """Power gain of the row filter."""
        return np.asarray(self.records.low_pass) ** 2

    @cached_property
    def motion(self) -> Motion:
        """All samples of all recordings as measured, with the load of the nominal robot and of what it carries."""
        r = self.records
        q, v, a = (r.flat(x) for x in (r.position, r.velocity, r.acceleration))
        load = np.asarray(self.backend.inverse_dynamics(q, v, a))
        if r.carried is not None:
            load = load + links_torque(self.model, q, v, a, r) - rigid_torque(self.model, q, v, a)
        return Motion(self.model, r.flat(r.time), q, v, a, load, load, r.dt, self.width)

    @cached_property
    def families(self) -> dict[str, dict[str, Effect]]:
        """Candidates of the whole catalogue (leading axes places, grid), by what their torque depends on.

        The equations of a family are one program: `fixed` by the measured motion alone, `shaped` (those that have a
        shape to search too), `following` the current model's torque, `sensor` through the rigid body or the filter.
        """
        out: dict[str, dict[str, Effect]] = {name: {} for name in ("fixed", "shaped", "following", "sensor", "link")}
        measured = eqx.tree_at(lambda m: m.total, self.motion, self.records.flat(self.records.torque))
        for name, effect in CATALOGUE.items():
            batch = candidates(effect, self.model, measured)
            if batch.at.shape[0]:
                out[family_of(effect)][name] = batch
        return out

    @cached_property
    def fixed(self) -> dict[str, Units]:
        """Unit torques of the effects that depend on the measured motion alone."""
        return self.family("fixed", self.motion)

    def family(self, name: str, motion: Motion) -> dict[str, Units]:
        """Unit torques of a family, on one axis of places and grid points."""
        return units({n: flattened(b) for n, b in self.families[name].items()}, motion, self.records)


def family_of(effect: type[Effect]) -> str:
    if effect.inertial:
        return "link"
    if kind(effect) != "columns" or not (effect.has("torque") or effect.has("torque_error")):
        return "sensor"
    if effect.follows_torque:
        return "following"
    return "shaped" if shapes(effect) else "fixed"
