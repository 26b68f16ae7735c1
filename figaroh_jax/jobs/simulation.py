"""A model of a finished run moved by commands from a file, and what it did as a run directory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..effects.extended import ExtendedModel, require_single_axes
from ..effects.simulation import simulate as move
from ..errors import InputError
from ..formats.export import load_model
from ..recordings.draft_columns import Commands, read_commands
from ..reporting.motion_view import SIMULATION, model_folder
from ..reporting.provenance import PROVENANCE, provenance
from ..reporting.run_directory import check_directory, whole_directory
from ..reporting.simulation_report import Motion, write_simulation
from ..rigid.manifold import neutral
from ..rigid.model import RobotModel
from ..rollouts.causes import rigid
from ..rollouts.data import Run, Stretch, noise_of, regular, windows
from ..rollouts.faults import refuse_other_units
from ..rollouts.loop import Loop
from ..rollouts.simulation import rollout
from ..rollouts.stored import LOOP, read_loop
from .run import REPORT, Done, Progress

__all__ = ["simulate"]

_SLOWEST = 0.02  # s between rows: a file of fewer is a list of set points, and the rows are those of the steps
_STEP = 1e-3  # s, the longest step of a model of torques
_SPAN, _FEW = 0.05, 5  # s and least rows of a parabola that tells how fast a recording without velocities begins
_MOST = 5_000_000  # steps


class _Plan(NamedTuple):
    """The steps of a simulation: the row of the command that holds in each, and the steps at which rows are written."""

    dt: float
    row: np.ndarray  # (steps,)
    part: np.ndarray  # (steps,) how far each step is on the way to the next row, 0 to 1
    written: np.ndarray  # (rows,)


def simulate(
    model: Path,
    file: Path,
    out: Path,
    progress: Progress,
    *,
    interpolate: bool = False,
    start: str | None = None,
    columns: Sequence[str] = (),
    rate: float | None = None,
) -> Done:
    """Move the model of a run by the commands of `file`, held from row to row, and write what it did.

    A model of rollouts takes what its drives are commanded, one of torques the torques of its joints. It starts at
    `start` at rest (joints that it does not name at zero), else as the file's first rows say where it has
    positions, else at the model's zero at rest.
    Written are `simulation.csv`, `simulation.npz`, `simulation.json`, `report.html` and what made them; with positions
    in the file also how far the motion is from them.
    """
    folder = model_folder(model)
    check_directory(out, [folder, file])
    if rate is not None and not 0 < rate < np.inf:
        raise InputError(f"--rate {rate:g}: a rate in Hz is a positive number")
    progress("reading", 0.0)
    of_rollouts = (folder / LOOP).is_file()
    moved: Loop | ExtendedModel = read_loop(folder) if of_rollouts else load_model(folder)
    robot = moved.robot
    if isinstance(moved, Loop):
        way = np.abs(np.asarray(moved.drives.transmission))
        drives, of = moved.drives.names, [robot.dof_names[k] for k in way.argmax(1)]
        motors = not np.asarray(moved.drives.bias)[:, 1:].any()  # whose command is a torque
        kinds = ("command", "torque") if motors else ("command",)
    else:
        require_single_axes(robot, "a simulation of torques")
        drives, of, kinds = robot.dof_names, robot.dof_names, ("torque", "command")
    told = rigid(moved).robot if isinstance(moved, Loop) else robot  # no column holds the twist of a spring
    given = read_commands(file, drives, of, told, kinds=kinds, columns=columns, rate=rate)
    plan = _planned(file, given, float(moved.dt) if isinstance(moved, Loop) else _STEP)
    position, velocity, begun = _begun(moved, file, given, start)
    after = np.minimum(plan.row + 1, len(given.time) - 1)
    command = given.command[plan.row]
    if interpolate:
        command = command + plan.part[:, None] * (given.command[after] - command)
    progress("simulating", 0.2)
    q, v, read = _moved(moved, command, position, velocity, plan.dt)
    found = {
        "time": given.time[0] + plan.dt * plan.written,
        "position": q[plan.written],
        "velocity": v[plan.written],
        "reading": read[plan.written],
        "command": command[plan.written],
    }
    answer = _answer(folder, file, moved, given, plan, found, begun, interpolate)
    text = json.dumps(answer, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    progress("writing", 1.0)
    options = ["--command", str(file.resolve()), *(["--columns", ",".join(columns)] if columns else [])]
    options += [] if rate is None else ["--rate", repr(rate)]
    options += [*(["--interpolate"] if interpolate else []), *([] if start is None else ["--start", start])]
    with whole_directory(out, [folder, file]) as work:
        made = provenance("simulate", model, [*_files(folder), *_files(file)], "native", options)
        (work / PROVENANCE).write_text(made, encoding="utf-8")
        (work / f"{SIMULATION}.json").write_text(text, encoding="utf-8")
        np.savez_compressed(work / f"{SIMULATION}.npz", allow_pickle=False, **found)
        head = ["t", *_names(robot), *(f"v.{name}" for name in robot.dof_names), *(f"u.{name}" for name in drives)]
        table = np.column_stack([found["time"], found["position"], found["velocity"], found["command"]])
        np.savetxt(work / f"{SIMULATION}.csv", table, "%.10g", ",", header=",".join(head), comments="")
        write_simulation(_motion(moved, given, found), answer, robot, work / REPORT)
    return Done(answer, lambda: text, lambda verbose: print("\n".join(_summary(answer))))


def _planned(file: Path, given: Commands, longest: float) -> _Plan:
    """Steps that divide the period of an even clock; a list of set points is held in steps of the model's own."""
    time = given.time
    if len(time) < 2:
        raise InputError(
            f"{file}: {len(time)} row of commands; the last one says when the simulation ends, so it takes two"
        )
    steps = np.diff(time)
    even = bool((np.abs(steps - np.median(steps)) <= 0.5 * np.median(steps)).all())
    if given.position is not None or (even and np.median(steps) <= _SLOWEST * (1 + 1e-6)):
        period = regular(str(file), time)
        many = max(1, int(np.ceil(period / longest - 1e-6)))
        count = np.arange((len(time) - 1) * many + 1)
        plan = _Plan(period / many, count // many, count % many / many, count[::many])
    else:
        whole = (time[-1] - time[0]) / longest
        if whole > _MOST:
            raise InputError(
                f"{file}: {time[-1] - time[0]:.6g} s are {whole:.3g} steps of {longest:.3g} s; is the time in s?"
            )
        count = np.arange(int(np.floor(whole + 1e-6)) + 1)
        now = time[0] + longest * count
        row = np.clip(np.searchsorted(time, now + 1e-9 * longest, side="right") - 1, 0, len(time) - 1)
        ahead = np.append(steps, np.inf)[row]
        plan = _Plan(longest, row, np.clip((now - time[row]) / ahead, 0.0, 1.0), count)
    if len(plan.row) > _MOST:
        raise InputError(
            f"{file}: {len(plan.row)} steps of {plan.dt:.3g} s; at most {_MOST} are simulated, cut the file"
        )
    return plan


def _begun(
    moved: Loop | ExtendedModel, file: Path, given: Commands, start: str | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Configuration and velocity at the beginning, and where they come from."""
    robot = moved.robot
    q, v = (np.array(moved.start, float) if isinstance(moved, Loop) else neutral(robot)), np.zeros(robot.nv)
    column = dict(zip(robot.dof_names, range(robot.nv), strict=True))
    place = {j.name: at.start for j, at in zip(robot.joints, robot.dofs.positions, strict=True) if not j.follows}
    if start is not None:
        for name, value in _stated(start, robot).items():
            q[place[name]] = value
        return q, v, "--start, at rest"
    if given.position is None:
        return q, v, "the model's zero, at rest"
    if isinstance(moved, Loop) and given.joints == tuple(robot.dof_names[k] for k in moved.measured):
        refuse_other_units(moved, str(file), given.command, given.position)
        run = Run(file.name, given.time, given.command, given.position, given.velocity)
        cut = windows(moved, [run], [Stretch(0, 0, len(run.time))], [noise_of(run.position)], 0.3, smooth=True)
        state = np.asarray(cut.start)[:, 0]
        return state[: robot.nv], state[robot.nv : 2 * robot.nv], "the first rows of the file"
    begin, speed = given.position[0], None if given.velocity is None else given.velocity[0]
    rows = max(_FEW, int(np.searchsorted(given.time - given.time[0], _SPAN)))
    if speed is None and len(given.time) >= _FEW:
        _, speed, begin = np.polyfit(given.time[:rows] - given.time[0], given.position[:rows], 2)
    for k, name in enumerate(given.joints):
        q[place[name]] = begin[k]
        v[column[name]] = 0.0 if speed is None else speed[k]
    return q, v, "the first rows of the file"


def _stated(start: str, robot: RobotModel) -> dict[str, float]:
    single = [j.name for j in robot.joints if not j.follows and j.kind in ("revolute", "prismatic")]
    found: dict[str, float] = {}
    for part in start.split(","):
        name, _, value = (text.strip() for text in part.partition("="))
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = np.nan
        if name not in single or not np.isfinite(found[name]):
            raise InputError(
                f"--start {start}: '{part}' is not JOINT=VALUE (rad or m) of one of the joints {', '.join(single)}"
            )
    return found


def _moved(
    moved: Loop | ExtendedModel, command: np.ndarray, q: np.ndarray, v: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and readings at every step; `InputError` where the motion diverges."""
    if isinstance(moved, Loop):
        done = rollout(eqx.tree_at(lambda m: m.dt, moved, np.float64(dt)), command, q, v)
        return np.asarray(done.position), np.asarray(done.velocity), np.asarray(done.reading)
    found = move(moved, command, q, v, dt)
    speed = np.asarray(found.velocity)
    lost = np.argwhere(~(np.abs(speed) < 1e6))
    if len(lost):
        row, column = lost[0]
        raise InputError(
            f"the simulation diverges at joint {moved.robot.dof_names[column]}, {row * dt:.4g} s: torques without a"
            " controller leave any motion; check their units and where it starts"
        )
    return np.asarray(found.position), speed, np.asarray(found.position_read)


def _names(robot: RobotModel) -> Sequence[str]:
    """The numbers of a configuration, as columns are called."""
    names = [""] * robot.nq
    for joint, at in zip(robot.joints, robot.dofs.positions, strict=True):
        many = at.stop - at.start
        parts = {7: ("x", "y", "z", "qx", "qy", "qz", "qw"), 4: ("qx", "qy", "qz", "qw")}.get(
            many, tuple(map(str, range(many)))
        )
        if not joint.follows:
            names[at] = [f"q.{joint.name}"] if many == 1 else [f"q.{joint.name}.{part}" for part in parts]
    return names


def _answer(
    folder: Path,
    file: Path,
    moved: Loop | ExtendedModel,
    given: Commands,
    plan: _Plan,
    found: dict[str, np.ndarray],
    begun: str,
    interpolate: bool,
) -> dict[str, Any]:
    robot, error, unit = moved.robot, None, _units(moved.robot)
    if given.position is not None:
        at = [robot.dof_names.index(name) for name in given.joints]
        rms = np.sqrt(np.mean((found["reading"][:, at] - given.position) ** 2, axis=0))
        error = {name: {"rms": float(x), "unit": unit[name]} for name, x in zip(given.joints, rms, strict=True)}
    return {
        "format": 1,
        "robot": robot.name,
        "model": str(folder),
        "kind": "rollout" if isinstance(moved, Loop) else "torque",
        "command": str(file),
        "columns": list(given.columns),
        "drives": list(moved.drives.names if isinstance(moved, Loop) else robot.dof_names),
        "between_rows": "interpolated" if interpolate else "held",
        "joints": list(robot.dof_names),
        "start": begun,
        "step": plan.dt,
        "steps": len(plan.row),
        "rows": len(plan.written),
        "duration": float(found["time"][-1] - found["time"][0]),
        "error": error,
    }


def _units(robot: RobotModel) -> dict[str, str]:
    turns = robot.dofs.turns[np.argsort(robot.dofs.column)][: robot.nv]
    return {name: "rad" if turning else "m" for name, turning in zip(robot.dof_names, turns, strict=True)}


def _motion(moved: Loop | ExtendedModel, given: Commands, found: dict[str, np.ndarray]) -> Motion:
    """What the page shows: the joints of one axis that have an encoder."""
    robot, unit = moved.robot, _units(moved.robot)
    single = [joint.name for joint in robot.joints if joint.kind in ("revolute", "prismatic")]
    read = range(robot.nv) if isinstance(moved, ExtendedModel) else moved.measured
    at = [k for k in read if robot.dof_names[k] in single]
    names = tuple(robot.dof_names[k] for k in at)
    measured = np.full((len(found["time"]), len(at)), np.nan)
    for k, name in enumerate(given.joints if given.position is not None else ()):
        measured[:, names.index(name)] = np.asarray(given.position)[:, k]
    reading = found["reading"][:, [[*read].index(k) for k in at]]
    units = tuple(unit[name] for name in names)
    return Motion(names, units, found["time"], reading, found["velocity"][:, at], measured)


def _files(path: Path) -> list[Path]:
    """The file, or those of a folder."""
    return [path] if path.is_file() else sorted(one for one in path.rglob("*") if one.is_file())


def _summary(answer: dict[str, Any]) -> list[str]:
    lines = [
        f"simulated  {answer['robot']}: {answer['duration']:.4g} s in {answer['steps']} steps of"
        f" {1e3 * answer['step']:.4g} ms, commands ({', '.join(answer['columns'])})"
        f" {answer['between_rows']}, from {answer['start']}."
    ]
    if answer["error"]:
        lines += ["", "RMS distance from the file's positions"]
        width = max(map(len, answer["error"]))
        lines += [f"{name:<{width}}  {one['rms']:.4g} {one['unit']}" for name, one in answer["error"].items()]
    return lines
