"""External wrenches: what known ones do at the coordinates, and the six rows of a sensor that measures one.

A free flyer's own six rows (`joint_torque_regressor`) are the wrench on its root: torques recorded with
`generalized_force` of all measured wrenches added make it a robot like any other. A sensor between bodies (a force
plate under the base, a wrist) has six rows of its own beside those of the joints, with no friction in them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..compiled.batching import over_samples
from ..effects.base import Effect
from ..errors import InputError
from ..estimation.base_parameters import TEN, BaseParameters, base_parameters
from ..estimation.columns import column_names, random_states, state_columns
from ..estimation.regression import Piece
from ..rigid.inertia import transform
from ..rigid.kinematics import ancestors, check_shapes, frame_jacobian, frame_pose, motion, placements
from ..rigid.model import RobotModel
from ..rigid.regressor import unit_wrenches
from ..rigid.spatial import cross, rotate_back

__all__ = ["SensorStates", "generalized_force", "wrench_regressor"]

AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


def generalized_force(
    model: RobotModel, q: Float[ArrayLike, "samples nq"], wrenches: Mapping[str, Float[ArrayLike, "samples 6"]]
) -> Float[np.ndarray, "samples nv"]:
    r"""What wrenches on frames do at the coordinates, $\sum_f J_f(q)^T w_f$ (N m or N).

    `wrenches`: by name of the frame the force (N) and torque about its origin (N m) that the environment exerts on the
    robot there, in the axes of the frame. Added to the motors' torques (zero for a free root) it is what
    `inverse_dynamics` and friction have to give. Raises `InputError` for an unknown frame or a wrong shape.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, q = fj.load_urdf(fj.DEMO), np.zeros((10, 4))
    >>> push = np.tile([0.0, 0.0, 5.0, 0.0, 0.0, 0.0], (10, 1))  # 5 N along z of the hand
    >>> J = np.asarray(fj.frame_jacobian(robot, q, "hand", "local"))
    >>> bool(np.allclose(fj.wrenches.generalized_force(robot, q, {"hand": push}), 5.0 * J[:, 2], rtol=0, atol=1e-12))
    True
    """
    total = np.zeros((len(np.asarray(q)), model.nv))
    for name, wrench in wrenches.items():
        if np.shape(wrench) != (len(total), 6):
            raise InputError(f"wrench on '{name}' has shape {np.shape(wrench)}, expected {(len(total), 6)}")
        total += np.einsum("skv,sk->sv", np.asarray(frame_jacobian(model, q, name, "local")), np.asarray(wrench))
    return total


def wrench_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
    frame: str,
) -> Float[Array, "*batch 6 columns"]:
    """Wrench that moves each link, linear in its ten parameters, as a sensor at `frame` would feel it.

    Force (N) and torque about the frame's origin (N m) in its axes; 10 columns a link, in tree order, gravity included.
    What a sensor feels is the sum over the links that it carries: all of them on a force plate. Raises `InputError`
    where there is no such frame or the arrays do not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, zero = fj.load_urdf(fj.DEMO), np.zeros((1, 4))
    >>> W = np.asarray(fj.wrenches.wrench_regressor(robot, zero, zero, zero, "base"))[0]
    >>> weight = 9.81 * np.asarray(robot.inertia)[:, 0].sum()  # of all links, N
    >>> bool(abs((W @ np.asarray(robot.inertia).ravel())[2] - weight) < 1e-9)
    True
    """
    index = model.frame_index(frame)
    with jax.enable_x64(True):
        check_shapes(model, q=q, v=v, a=a)
        which = (model, index, model.frames[index].parent)
        return over_samples(_wrench_rows, which, q, v, a, width=60 * len(model.joints))


def _wrench_rows(which: tuple[RobotModel, Any, Any], q: Array, v: Array, a: Array) -> Float[Array, "6 columns samples"]:
    model = which[0]
    wrench, turning = unit_wrenches(motion(model, q, v, a))
    force = jnp.concatenate([wrench[:, :, :3], jnp.zeros_like(turning)], axis=1)
    torque = jnp.concatenate([wrench[:, :, 3:], turning], axis=1)
    pose = frame_pose(placements(model, q), *which)
    at = pose[:3, 3]
    parts = [rotate_back(pose[:3, :3], x) for x in (force, torque - cross(jnp.broadcast_to(at, force.shape), force))]
    rows = jnp.concatenate(parts, axis=2)  # (links, 10, 6, samples)
    return jnp.moveaxis(rows, 2, 0).reshape(6, -1, q.shape[-1])


@dataclass(frozen=True)
class SensorStates:
    """Rows for `regression.condense` from states of a robot with a wrench sensor: its joints', then the sensor's six.

    `source` gives pieces (q, v, a, tau, wrench) as `States`, the wrench (samples, 6) with which the sensor at `frame`
    holds what it carries, in the axes of the frame. On a frame of the world it is a plate that carries all links. On a
    link it is a wrist: it carries the links beyond, and a tool of ten parameters of its own (`m_<frame>` ..., at and in
    the frame), which the joints feel too. The sensor's offsets (`Fx0` ...) are fitted; `terms` act on the joints alone.
    """

    model: RobotModel
    source: Callable[[], Iterable[Sequence[Any]]]
    frame: str
    terms: tuple[Effect, ...] = ()
    width: float | Float[np.ndarray, " nv"] = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Columns of the links and the terms, then those of the tool if there is one, then the sensor's offsets."""
        tool = () if self._link < 0 else tuple(f"{name}_{self.frame}" for name in TEN)
        return (*column_names(self.model, self.terms), *tool, *(f"{axis}0" for axis in AXES))

    @cached_property
    def structure(self) -> Float[np.ndarray, "samples rows columns"]:
        """Columns at random states."""
        samples = max(64, 4 * len(self.names) // self.model.nv)
        return self.columns(*random_states(self.model, samples))

    @property
    def used(self) -> Bool[np.ndarray, "rows columns"]:
        """Which columns of a row can differ from zero."""
        return np.asarray(np.abs(self.structure).max(axis=0) > 0)

    @property
    def structural(self) -> BaseParameters:
        """Base parameters that some motion could show."""
        return base_parameters(self.structure.reshape(-1, len(self.names)), self.names)

    def columns(
        self, q: Float[np.ndarray, "samples nq"], v: Float[np.ndarray, "samples nv"], a: Float[np.ndarray, "samples nv"]
    ) -> Float[np.ndarray, "samples rows columns"]:
        """Rows of the joints and of the sensor."""
        model, link, own = self.model, self._link, len(column_names(self.model, self.terms))
        width = jnp.broadcast_to(np.asarray(self.width, float), (model.nv,))
        out = np.zeros((len(q), model.nv + 6, len(self.names)))
        with jax.enable_x64(True):
            out[:, : model.nv, :own] = state_columns(model, self.terms, width, (), q, v, a)
        felt = np.asarray(wrench_regressor(model, q, v, a, self.frame))
        carried = np.ones(len(model.joints))
        if link >= 0:
            carried = np.array(ancestors(model.joints)[link])
            carried[link] = 0.0
        out[:, model.nv :, : felt.shape[2]] = felt * np.repeat(carried, 10)
        if link >= 0:
            placement = np.asarray(model.frame_placement[model.frame_index(self.frame)])
            with jax.enable_x64(True):
                moved = np.stack([np.asarray(transform(ten, placement)) for ten in np.eye(10)], axis=1)
            block = slice(10 * link, 10 * link + 10)
            both = np.concatenate([out[:, : model.nv, block], felt[:, :, block]], axis=1)
            out[:, :, own : own + 10] = both @ moved
        out[:, model.nv :, -6:] = np.eye(6)
        return out

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """A piece of the source after the other."""
        del fitted
        if widths:
            raise InputError("SensorStates takes no widths of reversals")
        count = 0
        for number, (q, v, a, tau, wrench) in enumerate(self.source()):
            y = np.concatenate([tau, wrench], axis=1)
            if not np.isfinite(y).all():
                raise InputError(f"piece {number} of the source: torque or wrench is not finite")
            index = count + np.arange(len(y))
            yield Piece(self.columns(q, v, a), y, np.ones(y.shape), index.astype(float), index // 128 % 5, 0)
            count += len(y)

    @property
    def _link(self) -> int:
        return self.model.frames[self.model.frame_index(self.frame)].parent
