"""`excite` as a task file asks for it: what is to be learned, limits, what recordings have told already."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.interpolate import make_interp_spline

from ..errors import InputError, check_kind
from ..formats.collision import read_shapes
from ..formats.config import Task, robot_options
from ..formats.excite_keys import Excite, Sight, SizedEffect
from ..formats.robotfile import impossible_said, load_extended, load_robot, stated_baseline
from ..recordings.reading import read_table
from ..rigid.model import RobotModel
from .clearance import Box, Capsule, Clearance, clearance_of
from .design import Cause, Design, excite
from .information import learn
from .limits import Limits, limits_of, open_limits
from .motions import Basis, fourier, quintic, spline
from .postures import ACCURACY, Instrument, PostureDesign, View, excite_postures
from .touch import Touch

__all__ = ["excite_task"]

DEFAULT_NOISE = 0.01  # of the largest torque
ONLY_NOISE = (
    "the noise is that of the recordings; what they say about the links is not counted, since either cause changes it"
)


def excite_task(
    task: Task,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    separate: Sequence[tuple[Cause, Cause]] = (),
) -> Design | PostureDesign:
    """Design what the `excite` block of a task asks for; raises `InputError` where it is wrong, before any work.

    `separate`: pairs of causes (effect, place, sizes) that are to be told apart, in place of the block's objective.
    Recordings of the task are what is known already: their information is the prior, their residuals are the noise.

    >>> import pathlib, tempfile, figaroh_jax as fj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "task.yaml")
    ...     limits = "{acceleration: 10.0}"
    ...     text = f"robot: {{model: {fj.DEMO}}}\\nexcite: {{duration: 2.0, limits: {limits}}}"
    ...     _ = file.write_text(text)
    ...     found = fj.excite_task(fj.load_task(file))
    >>> len(found.stages)
    1
    """
    check_kind("task", task, Task, "`load_task` reads one")
    asked = task.excite
    if separate:
        asked = excite_block(asked)
    if asked is None:
        raise InputError(
            f"{task.file}: no `excite` block: it says what is to be designed, as in excite: {{duration: 10}}"
        )
    robot = load_robot(task, kinematic=asked.kind == "postures")
    if asked.kind == "postures":
        return _postures(task, asked, robot, progress)
    model, (known, notes) = load_extended(task.robot.model, **robot_options(task.robot)).model, stated_baseline(task)
    basis = basis_of(asked)
    bounds = asked.limits
    clearance, around = clearance_asked(task, asked, model.robot)
    stated = {kind: _waived(getattr(bounds, kind)) for kind in ("position", "velocity", "torque")}
    limits = _limits_of(task, model.robot, **stated, acceleration=bounds.acceleration, clearance=clearance)
    noise = DEFAULT_NOISE if asked.noise is None else asked.noise
    learned = learn(model, known, noise=noise, trust=task.robot.trust)
    said = [*notes, *around, *open_limits(model.robot, limits, stated)]
    said += [f"limits.{kind}: none: the motion keeps no limit of the {kind}" for kind, x in stated.items() if x is None]
    if task.data:
        from .known import with_recordings  # the machinery of fits, which a design without recordings does without

        progress("reading what is known", 0.0)
        after, texts = with_recordings(task, model.robot, known, learned, asked.noise is None)
        if separate or asked.objective == "separate":  # the causes were at work in the recordings too
            learned, texts = learned.with_noise(1 / np.sqrt(np.asarray(after.weight))), (*texts[:-1], ONLY_NOISE)
        else:
            learned = after
        said += texts
    elif asked.noise is None:
        said.append(f"neither recordings nor noise are given: one sigma is {DEFAULT_NOISE:.0%} of the largest torque")
    found = excite(
        model,
        basis,
        limits,
        learned,
        objective="separate" if separate else asked.objective,
        predict=[read_motion(path, model.robot) for path in asked.predict],
        separate=separate or [(told(a), told(b)) for a, b in asked.separate],
        trust=task.robot.trust,
        trajectories=asked.trajectories,
        start=asked.start,
        starts=asked.starts,
        rate=asked.rate,
        progress=progress,
    )
    if not np.isfinite(found.scaled_condition):
        said.append(
            "some parameters do not show at all in this motion: within these limits it is too short or too slow, or the"
            " basis too small"
        )
    return replace(found, notes=(*said, *found.notes))


def _waived(stated: Any) -> Any:
    """A limit as `limits_of` takes it, where None is none."""
    return None if isinstance(stated, str) and stated == "none" else stated


def _limits_of(task: Task, robot: RobotModel, **stated: Any) -> Limits:
    """`limits_of`, whose messages name the task."""
    try:
        return limits_of(robot, **stated)
    except InputError as error:
        raise InputError(f"{task.file}: excite.{error}") from None


def clearance_asked(task: Task, asked: Excite, robot: RobotModel) -> tuple[Clearance | None, tuple[str, ...]]:
    """The distances that a task asks for, and what is to be said of them."""
    margin = asked.limits.clearance
    if margin is None:
        return None, ("no limits.clearance is given: distances between bodies are not looked at",)
    shapes, notes = read_shapes(task.robot.model)
    limits = _limits_of(task, robot, position=asked.limits.position)
    found = clearance_of(
        robot,
        shapes,
        margin=margin,
        bodies=[Capsule(one.link, one.at, one.to or one.at, one.radius) for one in asked.bodies],
        floor=asked.floor,
        boxes=[Box(one.name, one.size, one.at, one.turn) for one in asked.boxes],
        ignore=asked.ignore,
        position=limits.position,
    )
    return found, (*notes, *found.notes)


def told(one: SizedEffect) -> Cause:
    """A cause of a task: effect, place, sizes."""
    return one.effect, one.at, one.size


def excite_block(asked: Excite | None) -> Excite:
    """The block of a task that has one, else its defaults; of a motion."""
    return Excite() if asked is None else asked.model_copy(update={"kind": "trajectory"})


def _postures(task: Task, asked: Excite, robot: RobotModel, progress: Callable[[str, float], None]) -> PostureDesign:
    """Postures for the device of the block, or of the recordings."""
    measurement = asked.measurement or next((one.measurement for one in task.data if one.measurement), None)
    if measurement is None:
        raise InputError(
            f"{task.file}: excite.measurement is missing: postures are chosen for a device, as in"
            " measurement: {pose: pose, base_frame: base_link, tool_frame: tool0}"
        )
    if measurement.tool_frame is None:
        raise InputError(f"{task.file}: excite.measurement.tool_frame is missing: which frame is measured?")
    base = measurement.base_frame or next((f.name for f in robot.frames if f.parent < 0), robot.frames[0].name)
    for name in (base, measurement.tool_frame):
        robot.frame_index(name)
    place, turn = measurement.accuracy.position, measurement.accuracy.orientation
    kind = "pose" if measurement.kind == "camera" else measurement.kind
    instrument = Instrument(
        cast(Any, kind),
        base,
        measurement.tool_frame,
        tuple(measurement.unknown),
        (place or ACCURACY[0], turn or ACCURACY[1]),
        _view(asked.view, measurement.mount if measurement.kind == "camera" else "world"),
        tuple(Touch(one.place, one.axis, one.radius, one.tilt) for one in asked.touch),
        asked.point,
    )
    clearance, said = clearance_asked(task, asked, robot)
    limits = _limits_of(task, robot, position=asked.limits.position)
    found = excite_postures(
        robot,
        instrument,
        count=asked.postures,
        candidates=asked.candidates,
        position_limit=limits.position,
        clearance=clearance,
        progress=progress,
    )
    said = (*impossible_said(task.robot.model), *said)
    if asked.view is None and not asked.touch:
        said = (*said, "no view is given: what the device can see from its place is not looked at")
    if place is None:
        said = (*said, f"no accuracy is given: {1e3 * ACCURACY[0]:g} mm and {1e3 * ACCURACY[1]:g} mrad are taken")
    return replace(found, notes=(*said, *found.notes))


def _view(given: Sight | None, mount: str | None) -> View | None:
    if given is None:
        return None
    hand = "hand" if mount == "hand" else "world"
    return View(given.place, given.axis, hand, given.cone, given.tilt, given.near, given.far)


def basis_of(asked: Excite) -> Basis:
    """The basis that a task names."""
    given = asked.basis
    if given.fourier is not None:
        return fourier(given.fourier, given.base or 1.0 / asked.duration, asked.duration)
    if given.spline is not None:
        return spline(given.spline, asked.duration)
    assert given.quintic is not None
    return quintic(given.quintic, asked.duration)


def read_motion(path: Path, robot: RobotModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, v, a of a file with these arrays, or with `t` (s) and `q`, from which a quintic spline gives the others."""
    key = "excite.predict"
    table = read_table(path, key)
    if "q" not in table.names or not ({"v", "a"} <= set(table.names) or "t" in table.names):
        raise InputError(f"{path} ({key}): holds {', '.join(table.names) or 'nothing'}; q, v, a or t, q are expected")
    whole = {"v", "a"} <= set(table.names)
    joints = robot.dof_names
    arrays = {name: table.matrix(name, joints, key) for name in (("q", "v", "a") if whole else ("q",))}
    for name, values in arrays.items():
        if values.shape != (len(arrays["q"]), robot.nv):
            raise InputError(f"{path} ({key}): {name} has shape {values.shape}; (samples, {robot.nv}) is expected")
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, column = wrong[0]
            raise InputError(f"{path} ({key}): {name} is {values[row, column]} in row {row}, column {column} (from 0)")
    if whole:
        return arrays["q"], arrays["v"], arrays["a"]
    time = table.vector("t", key)
    if len(time) != len(arrays["q"]) or len(time) < 6 or not (np.diff(time) > 0).all():
        raise InputError(f"{path} ({key}): t must increase, one stamp for each row of q, six at the least")
    curve = make_interp_spline(time, arrays["q"], 5)
    return arrays["q"], np.asarray(curve.derivative(1)(time)), np.asarray(curve.derivative(2)(time))
