"""Rollouts as data of a residual: what the encoders read less what a simulation from command and start predicts.

The numbers of the joints (rotor, friction, springs) are those of the model's effects; those of the drives (gains,
delay, limits) are the loop's, and the data leave the ones named in `drives` open, beside the state at each start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..effects.base import Effect
from ..effects.extended import ExtendedModel, changed_robot
from ..errors import InputError, check_each, check_finite, check_kind, nearest
from ..recordings.checks import check_columns, position_findings, report_findings
from ..recordings.dataset import Recording
from ..rigid.model import Leaf, RobotModel
from .alone import alone, carried_by, separable
from .data import Run, Stretch, noise_of, regular, windows
from .loop import Loop, State, advance, integrated, mobility
from .own import placed
from .parameters import UNITS, Entry, current, put, values
from .sensitivity import Windows, began, carrying, read_of
from .simulation import delayed
from .task import EFFECTS, extended_of

__all__ = ["RolloutData", "rollout_data"]

DRIVES = ("kp", "kd", "scale", "delay", "dead_band", "voltage", "force_limit", "time_constant")
_WHOLE = 1e4  # s: windows as long as the recordings


class RolloutData(eqx.Module):
    """Recordings of command and position behind one loop, side by side; rows in sigmas of the encoders' noise."""

    loop: Loop
    windows: Windows
    start: Float[Leaf, "states runs"]  # position and velocity at the first row
    begun: Float[Leaf, "states runs"]  # the same as measured
    change: Float[Leaf, " open"]  # of the drives' numbers that are open
    drives: tuple[str, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        return f"RolloutData: readings (rows, encoders, recordings) {np.shape(self.windows.reading)}\n  {self.loop}"

    @property
    def model(self) -> ExtendedModel:
        """The loop's robot with what acts at its joints as effects: where a fit begins."""
        return extended_of(self.loop)

    def residual(self, model: ExtendedModel) -> Float[Array, " rows"]:
        """Predicted less read over its sigma, row by row, then the start less the measured one over its own."""
        error = (self.predicted(model) - self.windows.reading) * self.windows.weight
        begin = (jnp.asarray(self.start) - self.begun) * self.windows.precision
        return jnp.concatenate([error.reshape(-1), begin.reshape(-1)])

    def predicted(self, model: ExtendedModel) -> Float[Array, "rows readings runs"]:
        """What the encoders read (rad or m), and their rates where these were recorded."""
        loop = _with_model(self.loop, model)
        if self.drives:
            table = self._open()
            loop = put(loop, table, current(self.loop, table) + self.change)
        return _simulated(loop, jax.tree.map(jnp.asarray, self.windows), jnp.asarray(self.start))

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Name, unit and typical size of each number that the data leave open."""
        table, names = self._open(), self.loop.drives.names
        own = []
        for entry, size in zip(table, np.abs(values(self.loop, table)) if table else (), strict=True):
            own.append((f"drives {names[entry.at[0]]} {entry.name}", UNITS[entry.name], 0.1 * size or 0.01))
        n, runs = self.loop.robot.nv, np.shape(self.start)[1]
        for k, word in enumerate(("position", "velocity")):
            for joint in self.loop.robot.dof_names:
                own += [(f"start {r + 1} {joint} {word}", ("rad", "rad/s")[k], (1e-2, 1e-1)[k]) for r in range(runs)]
        assert len(own) == len(table) + 2 * n * runs
        return tuple(own)

    def moved(self, numbers: Float[Array, " unknowns"]) -> RolloutData:
        """The data with its open numbers changed."""
        count = len(self.change)
        start = jnp.asarray(self.start) + numbers[count:].reshape(np.shape(self.start))
        return eqx.tree_at(lambda d: (d.change, d.start), self, (self.change + numbers[:count], start))

    def _open(self) -> tuple[Entry, ...]:
        return tuple(Entry(name, (k,)) for name in self.drives for k in range(len(self.loop.drives.names)))


def rollout_data(
    loop: Loop,
    recordings: Recording | Sequence[Recording],
    *,
    noise: Float[ArrayLike, "..."] | None = None,
    drives: Sequence[str] = (),
    joint: str | None = None,
) -> RolloutData:
    """Recordings with a `command` as data of a residual; all of one period, a multiple of the loop's step.

    `noise` is one sigma of the encoders (rad or m; one, or one each; default: what the recordings show), `drives` the
    numbers of the drives that a fit may free (`kp`, `kd`, `delay`, ... of `rollouts.parameters`). Held-out recordings
    are left out. Start the fit at `data.model`.

    `joint`: that joint of an arm by itself, the others moving as they were measured; what it carries follows from their
    motion (`alone`). No error of another joint reaches it.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> drives = {name: {"kind": "position", "kp": 60.0, "kd": 4.0} for name in robot.joint_names}
    >>> loop, _ = fj.load_loop(fj.DEMO, drives, dt=0.01)
    >>> u = 0.3 * np.sin(0.05 * np.arange(60)[:, None] + np.arange(4))
    >>> seen = fj.rollout(loop, u, u[0]).reading
    >>> run = fj.recording(q=seen, command=u, rate=100)
    >>> data = fj.rollout_data(loop, run, noise=1e-3)
    >>> fj.residual(data.model, data).shape  # 60 readings of four joints, and how each of the states begins
    (248,)
    >>> fj.rollout_data(loop, run, noise=1e-3, joint="elbow").model.robot.dof_names
    ('elbow',)
    """
    unknown = next((name for name in drives if name not in DRIVES), None)
    if unknown is not None:
        raise InputError(f"drives: no number '{unknown}'{nearest(unknown, DRIVES)}")
    if noise is not None:
        check_finite("noise", noise)
        if not (np.asarray(noise) > 0).all():
            raise InputError("noise: one sigma above zero is expected, of all encoders or one for each, rad or m")
    check_kind("loop", loop, Loop, "`load_loop` makes one of a robot's file and its drives")
    if not isinstance(recordings, Recording):
        check_each("recordings", recordings, Recording, "`recording` makes one of arrays")
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    runs = [_run(loop, one) for one in given if one.role == "fit"]
    if not runs:
        raise InputError("no recording to fit: all have role holdout")
    spread = np.mean([noise_of(run.position) ** 2 for run in runs], axis=0) ** 0.5 if noise is None else noise
    spread = np.broadcast_to(np.asarray(spread, float), (len(loop.measured),))
    if joint is not None:
        loop, runs, spread = _alone(loop, runs, spread, joint)
    stretches = [Stretch(k, 0, len(run.time)) for k, run in enumerate(runs)]
    with jax.enable_x64(True):
        cut = windows(loop, runs, stretches, [spread], _WHOLE)
    rows = max(len(run.time) for run in runs)
    kept = eqx.tree_at(
        lambda w: (w.command, w.reading, w.weight, w.share),
        cut,
        (cut.command[: cut.lead + rows], cut.reading[:rows], cut.weight[:rows], cut.share[:rows]),
    )
    if cut.carried is not None:
        kept = eqx.tree_at(lambda w: w.carried, kept, cut.carried[:rows])
    count = len(drives) * len(loop.drives.names)
    return RolloutData(loop, kept, cut.start, cut.start, np.zeros(count), tuple(drives))


def _alone(
    loop: Loop, runs: Sequence[Run], noise: Float[np.ndarray, " encoders"], joint: str
) -> tuple[Loop, list[Run], Float[np.ndarray, "1"]]:
    """The loop of one joint under its own name, its recordings with what it carries, and its encoder's noise."""
    names = loop.robot.dof_names
    if joint not in names:
        raise InputError(f"joint: the loop has no joint '{joint}'{nearest(joint, names)}")
    if not separable(loop):
        raise InputError("joint: one joint alone needs drives that act at one joint each, and every joint measured")
    number = names.index(joint)
    small, mine = alone(loop, runs, carried_by(loop, runs), number)
    named = replace(small.robot, joints=(small.robot.joints[0]._replace(name=joint),))
    return replace(small, robot=named), list(mine), noise[[list(loop.measured).index(number)]]


def _run(loop: Loop, one: Recording) -> Run:
    if one.command is None:
        raise InputError(f"{one.file} has no command: a rollout simulates the drives' setpoints")
    period, steps = regular(str(one.file), one.time), float(loop.dt)
    if abs(period / steps - round(period / steps)) > 1e-3:
        fits = period / max(1, int(np.ceil(period / steps - 1e-6)))
        raise InputError(
            f"{one.file}: the period is {period:.6g} s, no multiple of the loop's step of {steps:.6g} s; give it one"
            f" that fits: dataclasses.replace(loop, dt={fits:.9g})"
        )
    columns = np.abs(np.asarray(loop.drives.transmission)).argmax(1)
    if one.position.shape[1] != len(loop.measured):
        raise InputError(
            f"{one.file}: q has {one.position.shape[1]} columns, but the loop measures {len(loop.measured)} joints"
        )
    if len(loop.measured) == loop.robot.nv == loop.robot.nq:
        check_columns(one, loop.robot)
        report_findings([(one.file.name, f) for f in position_findings(one.position, loop.robot, "rad", one.time)])
    return Run(one.name, one.time, one.command[:, columns], one.position, None)


def _with_model(loop: Loop, model: ExtendedModel) -> Loop:
    """The loop with the model's robot, and its effects in place of what acts at the loop's joints."""
    robot: RobotModel = changed_robot(model)
    leaves: dict[str, Array] = {leaf: jnp.zeros(robot.nv) for fields in EFFECTS.values() for leaf in fields.values()}
    acts: list[Effect] = []
    for effect in model.effects:
        fields = EFFECTS.get(effect.name)
        if fields is None:
            if not effect.has("change"):
                acts.append(effect)
            continue
        for name, leaf in fields.items():
            leaves[leaf] = leaves[leaf].at[effect.places[0]].add(getattr(effect, name))
    if "stribeck_friction" not in {effect.name for effect in model.effects}:
        leaves["stribeck_speed"] = jnp.asarray(loop.joints.stribeck_speed)  # of a friction that is not there
    names = list(leaves)
    joints = eqx.tree_at(
        lambda j: [*(getattr(j, name) for name in names), j.rest],
        loop.joints,
        [*(leaves[name] for name in names), jnp.zeros(robot.nv)],
    )
    own = placed(loop.robot, acts) if acts else ()
    return replace(eqx.tree_at(lambda m: (m.robot, m.joints), loop, (robot, joints)), effects=own)


def _simulated(loop: Loop, data: Windows, start: Array) -> Array:
    """Readings (rows, readings, runs): each step is found without, and then taken with derivatives."""
    weight, rates = mobility(loop), data.reading.shape[1] > len(loop.measured)
    carried = None if data.carried is None else jnp.repeat(data.carried, data.substeps, axis=0)
    fine = jnp.repeat(data.command, data.substeps, axis=0)
    seen = delayed(fine, jnp.asarray(loop.drives.delay), loop.dt)[data.lead * data.substeps :]

    def one(carry: tuple[State, Array], given: tuple[Array, Array | None]) -> tuple[tuple[State, Array], State]:
        (state, warm), (control, load) = carry, given
        here = carrying(loop, load)
        step: Any = jax.lax.stop_gradient(advance(here, state, control, weight, warm)[1])
        return (integrated(here, state, control, weight, step), step.a), state

    state = began(loop, data, start)
    _, states = jax.lax.scan(one, (state, jnp.zeros_like(state.v)), (seen, carried))
    rows = jax.tree.map(lambda x: x[:: data.substeps], states)
    return jax.vmap(lambda q, v, act: read_of(loop, State(q, v, act), rates))(*rows)
