r"""Measured data as pytrees with a pure residual by the model: what `fit`, a user's `jit`, `grad` and `vmap` take.

| data | made by | rows |
|---|---|---|
| `TorqueData` | `torque_data` of recordings | torque of the model less the measured one, both low-passed alike |
| `PoseData` | `pose_data` of postures | predicted less measured of every device, m or rad |
| `RolloutData` | `rollout_data` of commands and positions | simulated less read, in sigmas of the encoders |

Rows are weighted: the inverse of one sigma where it is known, 0 where nothing was measured. Whatever has a method
`residual(model)` is data, yours too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Shaped

from ..compiled.batching import filtered_program
from ..compiled.precision import in_float64
from ..effects.extended import ExtendedModel, changed_robot, extend, opened, read_position, read_sensors
from ..effects.kinematic import PostureMotion, Postures, twists_of
from ..errors import InputError, check_each, check_kind, check_real
from ..recordings.arrays import check_accuracy
from ..recordings.checks import check_columns, position_findings, report_findings
from ..recordings.dataset import Recording, named
from ..recordings.devices import Device
from ..recordings.poses import PoseRecording
from ..recordings.rowfilter import filtered
from ..recordings.signals import prepare_all
from ..recordings.stacked import stack
from ..rigid import lie
from ..rigid.dynamics import inverse_dynamics
from ..rigid.kinematics import frame_pose, placements
from ..rigid.model import Leaf, RobotModel
from ..rigid.spatial import matmul
from .gravity import gravity_moments
from .posefit import ties
from .posegroups import devices_of

if TYPE_CHECKING:
    from ..formats.config import Preprocess

__all__ = ["Data", "PoseData", "TorqueData", "as_data", "pose_data", "residual", "torque_data"]

PLACES = 2**24  # of an extended record: whole numbers are exact so far in float32, which data may become without x64


@runtime_checkable
class Data(Protocol):
    """Anything measured that a model predicts."""

    def residual(self, model: ExtendedModel) -> Float[Array, " rows"]:
        """Weighted rows, pure: JAX transforms it by every array of `model` and of the data."""
        ...


class TorqueData(eqx.Module):
    """`n` recordings of at most `N` samples and `M` rows, joint side, SI units; rows are low-passed torques.

    Made by `figaroh_jax.torque_data`. A pytree: `torque` (n, M, nv) are the measured rows in N m or N, `weight` one
    over their sigma, zero for what does not count. `residual(model)` is pure: to jit, differentiate and map.
    """

    time: Float[Leaf, "n N"]  # s
    position: Float[Leaf, "n N nq"]
    velocity: Float[Leaf, "n N nv"]
    acceleration: Float[Leaf, "n N nv"]
    torque: Float[Leaf, "n M nv"]  # rows of the measured torque, N m or N
    weight: Float[Leaf, "n M nv"]  # 1 / sigma; 0: not measured, gated, padding
    dt: Float[Leaf, ""] | float  # s
    # whole numbers as floats, none above `PLACES`: `jax.grad` by the data takes no others
    source: Float[Leaf, "n L"] | None = None  # sample at each place of the extended record; None: samples are rows
    kept: Float[Leaf, "n M"] | None = None  # place of each row
    response: Shaped[Leaf, " F"] | None = None  # of the row filter
    carried: Float[Leaf, "n links 10"] | None = None  # known payloads
    together: int = eqx.field(static=True, default=0)  # rows of a block, half a second or more; 0: a recording is one

    def residual(self, model: ExtendedModel) -> Float[Array, " rows"]:
        """Torque of the model less the measured one times the weight, recording by recording, row by row."""
        return (self.weight * (self.predicted(model) - self.torque)).reshape(-1)

    def predicted(self, model: ExtendedModel) -> Float[Array, "n M nv"]:
        """Rows of the model's torque, as the sensors read it, N m or N."""
        model = opened(model)
        for name in ("position", "velocity", "acceleration"):
            if np.shape(getattr(self, name))[:2] != np.shape(self.time):
                raise InputError(
                    f"data.{name} has shape {np.shape(getattr(self, name))}, but data.time {np.shape(self.time)}: give"
                    " another motion at these instants"
                )
        axes = (0, 0, 0, 0, None if self.carried is None else 0)
        motion = self.time, self.position, self.velocity, self.acceleration, self.carried
        torque = jax.vmap(lambda *one: self._torque(model, *one), in_axes=axes)(*(_traceable(x) for x in motion))
        if self.source is None:
            return torque
        assert self.kept is not None
        return jax.vmap(self._rows)(torque, self.source, self.kept)

    def _torque(self, model: ExtendedModel, time: Any, q: Any, v: Any, a: Any, carried: Any) -> Array:
        if carried is not None:
            model = eqx.tree_at(lambda m: m.robot.inertia, model, model.robot.inertia + carried)
        return read_sensors(model, time, q, v, a, jnp.asarray(self.dt))

    def _rows(self, torque: Array, source: Array, kept: Array) -> Array:
        places = source.astype(int), kept.astype(int)
        return jnp.asarray(filtered(torque.T, *places, jnp.asarray(self.response))).T


def _traceable(x: Any) -> Any:
    return None if x is None else jnp.asarray(x)


class PoseData(eqx.Module):
    """Postures that one device measured; its own place (frames, markers, sockets) is that of the device's arrays."""

    position: Float[Leaf, "postures nq"]  # rad or m
    datum: Any  # what the device measured, the postures on the first axis
    weight: Float[Leaf, "postures rows"]  # 1 / sigma; 0: not measured
    device: Device
    tied: Float[Leaf, ""] | float = 1.0  # weight of the device's constraints
    base_frame: str = eqx.field(static=True, default="")
    tool_frame: str = eqx.field(static=True, default="")
    begins: tuple[int, ...] = eqx.field(static=True, default=(0,))  # first posture of each recording
    time: Float[Leaf, " postures"] | None = None  # s, since the first posture of the recording
    duration: float = eqx.field(static=True, default=1.0)  # s, of all recordings together

    def residual(self, model: ExtendedModel) -> Float[Array, " rows"]:
        """Predicted less measured times the weight, posture by posture, then the device's constraints."""
        unknown = jnp.zeros(len(self.device.unknowns()))
        poses = self.tool_poses(model)
        datum = jax.tree.map(jnp.asarray, self.datum)
        device: Device = jax.tree.map(jnp.asarray, self.device)
        rows = jax.vmap(lambda pose, seen: device.residual(pose, unknown, seen))(poses, datum)
        # what was not measured has no derivative either
        rows = jnp.where(jnp.asarray(self.weight) > 0, rows, 0.0) * self.weight
        if not ties(self.device):
            return rows.reshape(-1)
        return jnp.concatenate([rows.reshape(-1), self.tied * device.constraint(unknown)])

    def tool_poses(self, model: ExtendedModel) -> Float[Array, "postures 4 4"]:
        """Poses of the tool frame in the base frame (m); to be traced in float64."""
        robot, q = changed_robot(model), jnp.asarray(self.position)
        poses = self._joint_poses(model, robot, q)
        start, end = (
            frame_pose(poses, robot, k, robot.frames[k].parent)
            for k in (robot.frame_index(self.base_frame), robot.frame_index(self.tool_frame))
        )
        back = jnp.swapaxes(start[:3, :3], 0, 1)
        rotation = matmul(back, end[:3, :3])
        place = jnp.sum(back * (end[:3, 3] - start[:3, 3])[None], axis=1)
        top = jnp.moveaxis(jnp.concatenate([rotation, place[:, None]], axis=1), -1, 0)
        bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (len(q), 1, 4))
        return jnp.concatenate([top, bottom], axis=1)

    def _joint_poses(self, model: ExtendedModel, robot: RobotModel, q: Array) -> Float[Array, "nj 4 4 postures"]:
        """With each joint's frame where the effects' twists put it in each posture."""
        true = true_position(model, robot, q, self.begins)
        if not any(effect.has("twist") for effect in model.effects):
            return placements(robot, true.T)
        torque, moment = gravity_moments(robot, q)
        time = jnp.zeros(len(q)) if self.time is None else jnp.asarray(self.time)
        seen = Postures(q, _before(q, self.begins), torque, moment, 0.0 * torque, time, self.duration)
        twists = jnp.moveaxis(twists_of(model.effects, robot, seen), -1, 0)
        places = jnp.asarray(robot.placement) @ jax.vmap(jax.vmap(lie.twist_pose))(twists)

        def one(place: Array, position: Array) -> Array:
            moved = eqx.tree_at(lambda r: r.placement, robot, place)
            return placements(moved, position[:, None])[..., 0]

        return jax.vmap(one, out_axes=-1)(places, true)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Name, unit and typical size of what the device leaves open."""
        return self.device.unknowns()

    def moved(self, numbers: Float[Array, " unknowns"]) -> PoseData:
        """The data with the device's frames moved."""
        return eqx.tree_at(lambda d: d.device, self, self.device.moved(numbers))


def _before(q: Float[Array, "postures nq"], begins: tuple[int, ...]) -> Float[Array, "postures nq"]:
    """The posture measured before; the first one's own."""
    first = np.isin(np.arange(len(q)), begins)[:, None]
    return jnp.where(first, q, jnp.roll(q, 1, axis=0))


def true_position(
    model: ExtendedModel, robot: RobotModel, q: Float[Array, "postures nq"], begins: tuple[int, ...] = (0,)
) -> Array:
    """Where the joints stand while their sensors read `q`, at rest under gravity; no load is carried."""
    if not any(effect.has("position_error") for effect in model.effects):
        return q
    still = jnp.zeros((len(q), robot.nv))
    load = inverse_dynamics(robot, q, still, still)
    rest = still, still, load, load, 0.0, jnp.asarray(model.width)
    motion = PostureMotion(robot, jnp.zeros(len(q)), q, *rest, _before(q, begins), still)
    return q - (read_position(model.effects, motion) - q)


def torque_data(
    model: RobotModel | ExtendedModel,
    recordings: Recording | Sequence[Recording],
    preprocess: Preprocess | None = None,
    *,
    noise: Float[ArrayLike, "..."] = 1.0,
) -> TorqueData:
    """The recordings with torque as data of a residual; the work on the host that nothing differentiates.

    They are brought to even samples, position low-passed and differentiated, and rows of torque as `preprocess`
    says (`Preprocess(cutoff=...)`, Hz). `noise` is one sigma of the rows (N m or N; one, or one for each joint): rows
    count in its units. Recordings with role "holdout" are left out. Raises `InputError` where they do not fit, and for
    one of more than `PLACES` samples.

    >>> import numpy as np, figaroh_jax as fj
    >>> model = fj.load_urdf(fj.DEMO)
    >>> t = np.arange(1000)[:, None] / 250.0
    >>> run = fj.recording(q=np.sin(t + np.arange(4)), tau=np.cos(t + np.arange(4)), rate=250)
    >>> data = fj.torque_data(model, run, noise=0.1)
    >>> data.residual(fj.extend(model)).shape[0] == data.torque.size
    True
    """
    from ..formats.config import Preprocess
    from .regression import BLOCK, BLOCK_PERIODS  # a calibration has no use for it

    robot = (model if isinstance(model, ExtendedModel) else extend(model)).robot
    given = [recordings] if isinstance(recordings, Recording) else recordings
    check_each("recordings", given, Recording, "`recording` makes one of arrays")
    check_each("preprocess", [preprocess or Preprocess()], Preprocess, "Preprocess(cutoff=15), in Hz, say")
    fitted = named([one for one in given if one.role == "fit"], robot)
    lacking = next((one for one in fitted if one.torque is None), None)
    if not fitted or lacking is not None:
        raise InputError(f"{lacking.file} has no torque" if lacking else "no recording to fit: all have role holdout")
    _belong(robot, fitted)
    check_real("noise", noise)
    if np.shape(noise) not in ((), (robot.nv,)) or not (np.isfinite(noise) & (np.asarray(noise) > 0)).all():
        raise InputError(f"noise is {noise!r:.100}; one sigma above zero is expected (N m or N), or one for each joint")
    signals = prepare_all(tuple(fitted), preprocess or Preprocess(), band=None, model=robot, sticks=False)
    records = stack(signals, robot)
    places = records.source.shape[1]
    if places > PLACES:
        raise InputError(
            f"the longest recording takes {places} samples, extended at both ends: more than {PLACES} cannot be counted"
            " in single precision; split it into shorter recordings"
        )
    flat = np.moveaxis(np.asarray(records.torque), 2, 1)
    rows = [
        filtered(x, s, k, np.asarray(records.low_pass))
        for x, s, k in zip(flat, records.source, records.kept, strict=True)
    ]
    return TorqueData(
        records.time,
        records.position,
        records.velocity,
        records.acceleration,
        np.swapaxes(np.stack(rows), 1, 2),
        np.asarray(records.weight) / np.asarray(noise),
        np.float64(records.dt),
        np.asarray(records.source, float),
        np.asarray(records.kept, float),
        np.asarray(records.low_pass),
        records.carried,
        max(1, round(float(records.rate) * max(BLOCK, BLOCK_PERIODS / float(records.cutoff)))),
    )


def _belong(robot: RobotModel, recordings: Sequence[Recording]) -> None:
    """Refuse positions of another number of joints, or in a unit in which they cannot be this robot's."""
    found = []
    for one in recordings:
        check_columns(one, robot)
        if robot.nq == robot.nv:
            findings = position_findings(one.position, robot, "rad", one.time)
            found += [(one.file.name, finding) for finding in findings]
    report_findings(found)


def pose_data(
    model: RobotModel | ExtendedModel,
    recordings: PoseRecording | Sequence[PoseRecording],
    *,
    sigma: tuple[float, float] | None = None,
) -> tuple[PoseData, ...]:
    """Measured postures as data of a residual, one for each device; its frames start in closed form.

    Recordings of one kind with the same frames share a device. `sigma` is one sigma of positions (m) and orientations
    (rad); by default the recordings' `accuracy`, else 1: rows in m and rad. Held-out recordings have weight zero.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q = np.random.default_rng(0).uniform(-1, 1, (12, robot.nv))
    >>> seen = np.asarray(fj.frame_placement(robot, q, "hand"))[:, :3, 3]
    >>> (data,) = fj.pose_data(robot, fj.postures(q=q, position=seen, base_frame="base", tool_frame="hand"))
    >>> bool(abs(fj.residual(robot, data)).max() < 1e-6)
    True
    """
    robot = model.robot if isinstance(model, ExtendedModel) else model
    check_kind("model", model, (RobotModel, ExtendedModel), "pose_data(model, recordings)")
    if not isinstance(recordings, PoseRecording):
        check_each("recordings", recordings, PoseRecording, "`postures` makes one of arrays")
    if sigma is not None:
        check_accuracy(sigma, "sigma", may_lack=False)
    given = [recordings] if isinstance(recordings, PoseRecording) else list(recordings)
    each_joint = robot.nq == robot.nv and all(one.position.shape[1] == robot.nv for one in given)
    if each_joint:  # else the kinematics refuse it
        report_findings([(r.file.name, f) for r in given for f in position_findings(r.position, robot, "rad")])
    found, duration = [], max(sum(float(np.ptp(one.time)) for one in given), 1e-9)
    for members, device, datum, measured in devices_of(robot, given):
        scale = sigma or tuple(given[members[0]].accuracy[k] or 1.0 for k in (0, 1))
        fit = np.concatenate([np.full(len(given[k].position), given[k].role == "fit") for k in members])
        weight = np.asarray(measured, float) * fit[:, None] / np.asarray(scale)[np.array(device.channels())]
        position = np.concatenate([given[k].position for k in members])
        first = given[members[0]]
        frames = first.base_frame, first.tool_frame
        begins = np.cumsum([0, *(len(given[k].position) for k in members[:-1])])
        time = np.concatenate([given[k].time - given[k].time[0] for k in members])
        rest = tuple(begins.tolist()), time, duration
        found.append(PoseData(position, datum, weight, device, 1.0 / scale[0], *frames, *rest))
    return tuple(found)


def as_data(model: ExtendedModel, data: Any) -> tuple[Data, ...]:
    """Recordings, postures and data of any kind, one or several, as a tuple of data."""
    if isinstance(data, Recording):
        return (torque_data(model, data),)
    if isinstance(data, PoseRecording):
        return pose_data(model, data)
    if isinstance(data, Data):
        return (data,)
    if not isinstance(data, Sequence) or isinstance(data, str | bytes) or not len(data):
        raise InputError(
            f"data is {type(data).__name__}: expected recordings, postures or an object with a method `residual(model)`"
        )
    for kind, make in ((Recording, torque_data), (PoseRecording, pose_data)):
        if all(isinstance(one, kind) for one in data):
            made = make(model, data)
            return made if isinstance(made, tuple) else (made,)
    return tuple(part for one in data for part in as_data(model, one))


def residual(model: RobotModel | ExtendedModel, data: Any) -> Float[Array, " rows"]:
    """What the model gets wrong in the data: predicted less measured, weighted, in float64; pure.

    `data`: a `TorqueData` (rows N m or N), a `PoseData` of any device (m, rad), a `RolloutData`, your own with a method
    `residual(model)`, recordings and postures as they are (prepared anew at each call: prepare them once with
    `torque_data` or `pose_data` where that counts), or a sequence of those. Differentiable by every array of the
    model (placements, inertials, gravity, parameters of effects) and of the data; rows without weight are zero.

    >>> import jax, numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> t = np.arange(1000)[:, None] / 250.0
    >>> data = fj.torque_data(robot, fj.recording(q=np.sin(t + np.arange(4)), tau=0 * t + np.zeros(4), rate=250))
    >>> cost = lambda model: (fj.residual(model, data) ** 2).mean()
    >>> jax.grad(cost)(robot).gravity.shape
    (3,)
    """
    whole = model if isinstance(model, ExtendedModel) else extend(model)
    return _residual(whole, as_data(whole, data))


@in_float64
@filtered_program
def _residual(model: ExtendedModel, data: tuple[Data, ...]) -> Float[Array, " rows"]:
    parts = [one.residual(model) for one in data]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)
