"""A task file whose recordings hold a command and a position: the loop, its recordings, the diagnosis, the answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect, joint_unit, place
from ..effects.catalogue import ROLLOUTS, find
from ..effects.extended import ExtendedModel, extend
from ..effects.plausibility import implausible
from ..errors import InputError
from ..formats.config import robot_options
from ..formats.files import USD
from ..recordings.checks import check_rollouts
from ..recordings.dataset import Recording, read_recordings
from ..results import BoundedEstimate, Cause, Diagnosis, Estimate, Experiment, Gain, Name, Rest, Trace, Verdict
from .alone import inseparable, separable
from .arm import search_arm
from .bodies import body_notes, fitted_links, searched_with_bodies, told_alone
from .causes import BASELINE, motor_of, rigid
from .creep import REMARK, creep_notes, searched_with_both
from .data import Run, Stretch, as_recorded, noise_of, regular, windows, without_gaps
from .faults import refuse_other_order, refuse_other_units
from .fit import Fit
from .found import Named, Search
from .kept_out import largest_of, odd_note, odd_recordings
from .loop import Loop, alike, brought_back, turns
from .own import left_out
from .parameters import put, unit_of, values
from .reading import driven_joints, load_loop
from .rest import nearest_of, parts_of, relative_rest
from .search import search
from .sensitivity import predicted
from .setting import Setting, Structure, begun, residuals, setting
from .sizes import is_excepted, is_open, possible, told_errors
from .thresholds import REFITTED

if TYPE_CHECKING:
    from ..formats.config import Task

__all__ = [
    "EFFECTS",
    "RolloutDiagnosis",
    "all_slide",
    "colour_notes",
    "diagnose_rollout_task",
    "diagnosis_setting",
    "diverged",
    "extended_of",
    "judged_note",
    "judged_rows",
    "one_number_notes",
    "proxies",
    "read_rollouts",
    "simulated",
]

EFFECTS = {  # parameters of effects and the fields of `Joints` that hold them
    effect.name: {told: number for told, number in effect.in_rollouts.numbers}
    for effect in ROLLOUTS.values()
    if effect.in_rollouts.numbers and effect.in_rollouts.place == "joint" and effect.has("torque")
}
_SAME = {effect.name: called for called, effect in ROLLOUTS.items() if called != effect.name}
_WINDOW, _OPEN = 15.0, 1.0  # s
_FAR = 1e3  # rad or m: a simulation that gets there has diverged


class RolloutDiagnosis(NamedTuple):
    """The diagnosis, the loop with its causes, and what it predicts of the held-out recordings."""

    diagnosis: Diagnosis
    loop: Loop
    predictions: dict[str, tuple[np.ndarray, np.ndarray]]


def diagnose_rollout_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None
) -> RolloutDiagnosis:
    """Diagnose what a task of commands and positions describes; `InputError` before any work where it is wrong."""
    progress("reading", 0.0)
    loop, runs, notes = read_rollouts(task)
    here = diagnosis_setting(task, loop, runs)
    notes = (*notes, *left_out(loop.robot, task.diagnose.forbid))
    with jax.enable_x64(True):
        if fitted_links(here):
            progress("fitting the links that the baseline names", 0.0)
            here, _ = told_alone(here, begun(here))
        seek = search_arm if separable(loop) else search
        if loop.robot.nv > 1 and seek is search:
            progress(f"looking for one cause after another, which takes long: {inseparable(loop)}", 0.0)
        found = searched_with_both(seek, here, progress, forbid=task.diagnose.forbid)
        found = searched_with_bodies(seek, here, found, progress, forbid=task.diagnose.forbid)
        if not np.isfinite(found.first.cost):
            raise InputError(f"{task.robot.model}: {diverged(here, found.first)}")
        found = _with_gains_free(task, loop, runs, seek, found, progress)
        progress("measuring the gain", 0.9)
        here = found.setting or here
        kept_out, rows = [run for run in runs if run.holdout], judged_rows(here)
        found = odd_recordings(here, found, kept_out, lambda loop, run: simulated(loop, run, rows))
        notes = (*notes, *(one.text(loop, here.runs) for one in found.faults))
        return _answer(task, here, runs, found, notes)


def read_rollouts(task: Task) -> tuple[Loop, tuple[Run, ...], tuple[str, ...]]:
    """The loop of a task and its recordings."""
    options = robot_options(task.robot)
    if "root" not in task.robot.model_fields_set and task.robot.model.suffix.lower() in (".xml", *USD):
        options["root"] = None  # as the file has it
    drives = {name: drive.model_dump() for name, drive in task.actuator.drives.items()}
    loop, left_out = load_loop(task.robot.model, drives, **options)
    if not loop.drives.names:
        raise InputError(
            f"{task.file}: actuator: robot '{task.robot.model.name}' has no actuators; state each joint's drive, as in "
            "actuator: {joint_1: {kind: position, kp: 20.0, kd: 0.5}}"
        )
    moved = np.abs(np.asarray(loop.drives.transmission)).argmax(1)
    recordings = read_recordings(task, loop.robot, rollouts=True, driven=driven_joints(loop))
    warnings = check_rollouts(task, loop.robot, recordings)
    runs, late = zip(*(_run(loop, r) for r in recordings), strict=True)
    periods = {regular(str(r.file), run.time) for r, run in zip(recordings, runs, strict=True)}
    if max(periods) > 1.02 * min(periods):
        raise InputError(f"{task.file}: data: the periods of the recordings differ ({sorted(periods)} s)")
    period = float(np.mean(list(periods)))
    steps = max(1, int(np.ceil(period / float(loop.dt) - 1e-6)))
    loop = eqx.tree_at(lambda m: m.dt, loop, np.float64(period / steps))
    notes = [f"{task.robot.model.name}: not simulated: {note}" for note in left_out]
    notes += [note for note in late if note]
    for k in sorted({int(k) for k in moved if (moved == k).sum() > 1}):
        both = " and ".join(name for name, at in zip(loop.drives.names, moved, strict=True) if at == k)
        notes.append(f"the drives {both} of {loop.robot.dof_names[k]} take the same command")
    notes.append(f"simulated in steps of {1e3 * period / steps:.3g} ms, {steps} to a sample")
    return loop, runs, (*warnings, *notes)


def _run(loop: Loop, recording: Recording) -> tuple[Run, str]:
    """A recording as a rollout takes it, and what is said of its clock."""
    if recording.command is None:
        raise InputError(f"{recording.file}: a rollout needs `command`")
    columns = np.abs(np.asarray(loop.drives.transmission)).argmax(1)
    command = recording.command[:, columns]
    follows = refuse_other_units(loop, str(recording.file), command, recording.position)
    held_out = recording.role == "holdout"
    trusted = None if recording.trusted is None else np.logical_and.reduce(recording.trusted, axis=1)
    run = Run(recording.name, recording.time, command, recording.position, recording.velocity, held_out, trusted)
    run, late = without_gaps(run)
    refuse_other_order(loop, str(recording.file), run, follows)
    return run, late


def diagnosis_setting(task: Task, loop: Loop, runs: Sequence[Run]) -> Setting:
    """What a search starts from: the baseline that the task states, the gains it knows, what it forbids."""
    known, given = task.baseline, task.baseline.model_fields_set
    rotor = known.rotor if "rotor" in given else bool(np.asarray(loop.joints.armature).any())
    names = [n for n, on in zip(BASELINE, (rotor, known.viscous, known.coulomb), strict=True) if on]
    at = [(_SAME.get(entry.effect, entry.effect), entry.at) for entry in known.effects]
    more = [one for effect, names in at for one in ([(effect, name) for name in names] or [(effect,)])]
    return setting(
        loop, runs, baseline=names, more=more, gains_known=task.actuator.gains == "known", forbid=task.diagnose.forbid,
        stretches=_cut(task, loop, runs),
    )  # fmt: skip


def _cut(task: Task, loop: Loop, runs: Sequence[Run]) -> tuple[Stretch, ...]:
    """Windows of the task's length; `auto`: whole recordings of one joint, else 15 s, which run side by side.

    An arm with a joint that no drive brings back to its command may leave any motion: its windows are of 1 s.
    """
    wanted = task.rollout.window
    if wanted == "whole" or (wanted == "auto" and not separable(loop)):
        return ()
    auto = _WINDOW if brought_back(loop).all() else _OPEN
    length = auto if wanted == "auto" else float(wanted)
    found = []
    for k, run in enumerate(r for r in runs if not r.holdout):
        rows = max(2, round(length / regular(run.name, run.time)))
        found += [Stretch(k, first, rows) for first in range(0, len(run.time) - rows + 1, rows)]
        rest = len(run.time) % rows
        if rest > 0.2 * rows or len(run.time) < rows:
            found.append(Stretch(k, len(run.time) - rest, rest))
    return tuple(found)


def _answer(task: Task, here: Setting, runs: Sequence[Run], found: Search, notes: tuple[str, ...]) -> RolloutDiagnosis:
    loop = here.loop
    first = Structure(here.loop, here.known.table, here.data)
    scale = here.noise[0]
    before, after = (_rms(s, f, scale) for s, f in ((first, found.first), (found.structure, found.last)))
    wanted = task.diagnose.tolerance
    start, rows = put(here.loop, here.known.table, found.first.theta), judged_rows(here)
    plain = {run.name: simulated(start, run, rows) for run in runs if run.holdout}
    most = largest_of(before, found, runs, plain)
    if "position" in wanted.model_fields_set and (most <= wanted.position).all():  # good enough, as the task says
        found.verdict, found.named, found.proxy, found.odd = "nothing", [], [], ()
    named = found.verdict in ("named", "named+rest")
    last = (found.structure, found.last) if named else (first, found.first)
    final = put(last[0].loop, last[0].table, last[1].theta)
    held = {run.name: (plain[run.name], simulated(final, run, rows)) for run in runs if run.holdout}
    gain = _gain(held, runs, found)
    model = extended_of(rigid(final))
    traces = _traces(here, runs, first, found, last, held)
    left = largest_of(after if named else before, found, runs, {name: both[1] for name, both in held.items()})
    shown = [replace(one, role="fit") for one in traces] if found.odd else traces
    refitted = _refitted(here, found if named else None, last)
    creeps = creep_notes(here, found) if named else {}
    told = creeps | body_notes(here, found) if named else {}
    for name, text in (_taken_gains(task, found) if named else {}).items():
        told[name] = "; ".join([*filter(None, [told.get(name)]), text])
    diagnosis = Diagnosis(
        verdict=_verdict(found),
        causes=(*_faulty(found, here), *(_cause(one, found, here, told) for one in (found.named if named else ()))),
        p_value=found.p_value,
        joints=tuple(loop.robot.dof_names[k] for k in loop.measured),
        before=before,
        after=after if named else before,
        noise=here.spread,
        holdout=gain,
        holdout_scheme="recordings kept out of the fit" if held else "quarters of the recording left out in turn",
        experiment=_experiment(found),
        candidates=(),
        traces=traces,
        baseline=extended_of(start),
        model=model,
        rest=_rest(found, left, here.spread, loop, shown),
        notes=(
            *notes,
            *_kinds_note(loop, gain),
            *colour_notes(here),
            *odd_note(found),
            *(judged_note(here) if held else ()),
            *(f"{name}: {text}" for name, text in told.items()),
            *(_open_sizes(found) if named else ()),
            *(one_number_notes(found) if named else ()),
            *implausible(loop.robot, model, task.robot.trust),
            *_spring_note(final),
            *_refitted_note(here, runs, refitted, found.verdict),
        ),
        remark=REMARK if creeps else "",
        refitted=refitted,
        prismatic=tuple(j.kind == "prismatic" for j in loop.robot.joints if not j.follows),
        of_positions=True,
    )
    whole = {run.name: simulated(final, run) if rows else held[run.name][1] for run in runs if run.holdout}
    predictions = {run.name: as_recorded(run, whole[run.name]) for run in runs if run.holdout}
    return RolloutDiagnosis(diagnosis, final, predictions)


def all_slide(loop: Loop) -> bool:
    """Whether every measured joint slides, so that positions are lengths."""
    return not turns(loop)[list(loop.measured)].any()


def _refitted(here: Setting, found: Search | None, model: tuple[Structure, Fit]) -> tuple[str, ...]:
    """Numbers of the baseline that the file has surely otherwise and that no cause has, those first that are surest."""
    structure, last = model
    filed, told = values(here.loop, here.known.table), []
    of_causes = {k for n in found.named for k in n.candidate.entries} if found else set[int]()
    for column, error in enumerate(told_errors(structure, last, found.spread if found else None)):
        k = int(last.free[column])
        if k not in here.baseline or k in of_causes or not (np.isfinite(error) and error > 0):
            continue
        entry, value = here.known.table[k], float(last.theta[k])
        moved = abs(value - filed[k])
        if entry.name in _SAID and moved > REFITTED[0] * error and moved > REFITTED[1] * abs(value):
            place = entry.at[0]
            if entry.name == "scale":
                place = int(np.abs(np.asarray(here.loop.drives.transmission)[place]).argmax())
            size = f"{value:.3g} {unit_of(here.loop, entry)}".rstrip()
            text = f"{_SAID[entry.name]} of {here.loop.robot.dof_names[place]} is {size} ({filed[k]:.3g} in the file)"
            told.append((moved / error, text))
    return tuple(text for _, text in sorted(told, reverse=True))


def _refitted_note(here: Setting, runs: Sequence[Run], refitted: Sequence[str], verdict: Verdict) -> tuple[str, ...]:
    """What the baseline's fit had to change of the file, and how far off the file's own numbers are."""
    if not refitted:
        return ()
    asked = [run for run in runs if run.holdout] or [run for run in runs if not run.holdout]
    with np.errstate(over="ignore", invalid="ignore"):
        error = _pooled(
            [run.position - simulated(here.loop, run, judged_rows(here)) for run in asked], alike(here.loop)
        )
    what = "recordings kept out" if asked[0].holdout else "the recordings"
    unit = "m" if all_slide(here.loop) else "rad"
    size = f"{1e3 * error:.3g} m{unit}" if error < 0.1 else f"{error:.3g} {unit}" if error < _FAR else "without bounds"
    doubt = "" if verdict in ("nothing", "named") else " and, beside a misfit, may make up for what is missing"
    return (
        f"friction, damping and rotors are fitted before anything is named, and their sizes are no causes{doubt}:"
        f" {'; '.join(refitted)}. With the file's own numbers the error on {what} is {size}",
    )


_SAID = {"friction": "friction", "damping": "damping", "armature": "rotor inertia", "scale": "gain factor"}


def _verdict(found: Search) -> Verdict:
    """With rows named that no loop explains; what is left beside them stays a rest."""
    if not found.faults:
        return found.verdict
    with_faults: dict[Verdict, Verdict] = {"nothing": "named", "unknown": "named+rest"}
    return with_faults.get(found.verdict, found.verdict)


def _faulty(found: Search, here: Setting) -> list[Cause]:
    """Rows that were left out of every fit, as causes with their place and time."""
    causes, names = [], here.loop.robot.dof_names
    of = "m" if all_slide(here.loop) else "rad"
    for one in found.faults:
        at = () if one.kind == "clock_error" else tuple(names[j] for j in one.joints)
        size = ("delay", "s") if one.kind == "clock_error" else ("torque", "N m")
        size = size if one.table is None else ("force", "N")
        parameters = {
            "first": Estimate(one.first, 0.5, "s"),
            "last": Estimate(one.last, 0.5, "s"),
            size[0]: Estimate(one.size, float("inf"), size[1]),
        }
        gain = Gain(found.held[0], found.held[0], of)
        causes.append(Cause(Name(one.kind, at), parameters, 0.9, gain, note=one.text(here.loop, here.runs)))
    return causes


def diverged(here: Setting, first: Fit) -> str:
    """Where the simulation with the model's own numbers leaves all bounds: recording, row, joint."""
    read = np.asarray(predicted(here.loop, here.known.table, first.theta[None], here.data, first.start[None]))[0]
    count = len(here.loop.measured)
    lost = ~(np.abs(read[:, :count]) < _FAR)
    where = [(int(lost[..., w].any(1).argmax()), w) for w in range(read.shape[2]) if lost[..., w].any()]
    place = ""
    if where:
        row, w = min(where)
        joint = here.loop.robot.dof_names[here.loop.measured[int(lost[row, :, w].argmax())]]
        one = here.stretches[w]
        run = here.runs[one.run]
        row += one.first
        stamp = run.time[min(row, len(run.time) - 1)]
        place = f" at joint {joint}, in row {row} (from 0, {stamp:.4g} s) of {run.name}"
    return (
        f"the simulation diverges{place} with the model's own gains: they do not suit its inertia and time step; check"
        " kp, kd (their units and signs) and armature"
    )


def simulated(loop: Loop, run: Run, rows: int | None = None) -> np.ndarray:
    """Readings of the encoders (rows, joints) that the loop predicts from a recording's first state and command.

    With `rows` from the measured state at the beginning of each window of so many.
    """
    total = len(run.time)
    many = total if rows is None else min(rows, total)
    cut = [Stretch(0, first, min(many, total - first)) for first in range(0, total, many)]
    data = windows(loop, [run], cut, [noise_of(run.position)], 0.3, smooth=True)
    with jax.enable_x64(True):
        read = np.asarray(predicted(loop, (), jnp.zeros((1, 0)), data, np.asarray(data.start)[None]))[0]
    return np.concatenate([read[: one.rows, :, k] for k, one in enumerate(cut)])


def judged_rows(here: Setting) -> int | None:
    """Rows of the windows in which held-out recordings are judged; None: as wholes.

    What no drive brings back to its command leaves any motion, however right its model is.
    """
    return None if brought_back(here.loop).all() else max(one.rows for one in here.stretches)


def judged_note(here: Setting) -> tuple[str, ...]:
    """That held-out recordings are judged in windows."""
    rows = judged_rows(here)
    if rows is None:
        return ()
    length = rows * regular(here.runs[0].name, here.runs[0].time)
    return (
        f"recordings are judged in windows of {length:.3g} s, each simulated from the state measured at its beginning:"
        " no drive brings every joint back to its command, so that a whole recording tells nothing",
    )


def _rms(structure: Structure, fitted: Any, scale: np.ndarray) -> np.ndarray:
    weight = np.asarray(structure.data.weight)[:, : len(scale)]
    error = residuals(structure, fitted)[:, : len(scale)] / np.where(weight > 0, weight, 1.0)
    return np.sqrt((error**2).sum((0, 2)) / (weight > 0).sum((0, 2)))


def colour_notes(here: Setting) -> tuple[str, ...]:
    """What the noise of the encoders is, where it is not white."""
    if here.pole is None:
        return ()
    period = regular(here.runs[0].name, here.runs[0].time)
    names = [here.loop.robot.dof_names[k] for k in here.loop.measured]
    slow = [(name, -1e3 * period / np.log(p)) for name, p in zip(names, here.pole, strict=False) if p > 0]
    text = ", ".join(f"{name} {time:.2g} ms" for name, time in slow)
    return (f"the noise of the positions is white noise behind a low pass, and is judged as that: {text}",)


def _slides(loop: Loop, at: Sequence[str]) -> bool:
    """Whether what stands at these places is about a joint that slides; without a joint, whether all do."""
    j = loop.robot.dof_names.index(at[0]) if at and at[0] in loop.robot.dof_names else -1
    return bool(not turns(loop)[j]) if j >= 0 else all_slide(loop)


def _spring_note(loop: Loop) -> tuple[str, ...]:
    """Which of the written files have the spring between motor and link."""
    if (i := motor_of(loop.robot)) is None:
        return ()
    joint = loop.robot.joints[i].name
    return (f"robot.xml has the spring between motor and link of {joint}; URDF has none, robot.urdf is rigid",)


def _mixed(loop: Loop) -> bool:
    """Whether some measured joints turn and others slide."""
    return not alike(loop).all()


def _pooled(parts: Sequence[np.ndarray], mine: np.ndarray) -> float:
    """RMS of errors (rows, joints) over rows and some of the joints."""
    return float(np.sqrt(np.mean(np.concatenate([part[:, mine].ravel() for part in parts]) ** 2)))


def _gain(held: dict[str, tuple[np.ndarray, np.ndarray]], runs: Sequence[Run], found: Search) -> Gain:
    """Over the joints that turn, of a robot with both kinds; over those that slide where all causes stand there."""
    loop, measured = found.structure.loop, {run.name: run.position for run in runs if run.holdout}
    slides = all(_slides(loop, one.candidate.at) for one in found.named) if found.named else all_slide(loop)
    if measured:
        mine = alike(loop, slides=slides)
        before, after = (_pooled([measured[k] - v[i] for k, v in held.items()], mine) for i in (0, 1))
        return Gain(before, after, "m" if slides else "rad")
    of = "m" if all_slide(loop) else "rad"
    if not found.named:
        return Gain(found.held[0], found.held[0], of)
    return Gain(found.held[0], found.held[-1], of)


def _kinds_note(loop: Loop, gain: Gain) -> tuple[str, ...]:
    """Which joints the error of the headline counts, where one number cannot hold them all."""
    if not _mixed(loop):
        return ()
    names = np.array([loop.robot.dof_names[k] for k in loop.measured])[alike(loop, slides=gain.unit == "m")]
    kind = "slide" if gain.unit == "m" else "turn"
    return (f"the error in {gain.unit} is that of the joints that {kind}: {', '.join(names)}",)


def _cause(one: Named, found: Search, here: Setting, told: dict[Name, str]) -> Cause:
    structure, fitted = found.structure, found.last
    errors = told_errors(structure, fitted, found.spread)
    parameters = {}
    for name, entry in zip(one.candidate.reported, one.candidate.entries, strict=True):
        column = int(np.flatnonzero(fitted.free == entry)[0])
        value, error = float(fitted.theta[entry]), float(errors[column])
        unit = unit_of(structure.loop, structure.table[entry])
        if one.candidate.effect == "joint_spring" and name == "offset":
            stiffness = float(fitted.theta[one.candidate.entries[0]])
            unit = joint_unit("rad", unit == "N")
            name, value, error = "rest", -value / stiffness, error / abs(stiffness)
        value -= one.candidate.kind.neutral
        bound = possible(structure.table[entry].name) if name != "rest" else -np.inf
        parameters[name] = BoundedEstimate(value, error, unit, bound - one.candidate.kind.neutral)
    first = structure.table[one.candidate.entries[0]]
    if first.name == "pair_inertia" and here.loop.pairs is not None:
        parameters["sign"] = Estimate(float(here.loop.pairs.at[first.at[0]][2]), 0.0, "")
    if one.candidate.effect == "gravity_tilt":  # as angles
        pull = float(np.linalg.norm(here.loop.robot.gravity))
        x, y = ((np.arcsin(parameters[name].value / pull), parameters[name].std / pull) for name in ("x", "y"))
        parameters = {"about_x": Estimate(-y[0], y[1], "rad"), "about_y": Estimate(*x, "rad")}
    name, at = Name(one.candidate.effect, one.candidate.at), one.candidate.at
    sure = 1.0 / (1 + len(one.alike)) * (0.98 if found.verdict == "named" else 0.8)
    gain = Gain(one.before, one.after, "m" if _slides(here.loop, at) else "rad")
    return Cause(name, parameters, sure, gain, one.alike, note=told.get(name, one.candidate.kind.looks_like))


def _open_sizes(found: Search) -> list[str]:
    """Why a cause is named although its interval holds zero: what the data tell of it, and what they do not."""
    told = []
    for one in found.named:
        at = one.candidate, found.structure, found.last
        if is_excepted(*at) and is_open(*at, found.spread):
            why = "every joint has some" if one.candidate.kind.usual else "torques are known up to the drive's gain"
            told.append(
                f"{Name(one.candidate.effect, one.candidate.at)} is named because recordings that were not fitted are"
                f" predicted better with it; how large it is they do not tell (its 95 % interval reaches 0): {why}"
            )
    return told


def one_number_notes(found: Search) -> list[str]:
    """Which causes have one number together, and why."""
    together: dict[tuple, list[str]] = {}
    for one in found.named:
        together.setdefault((one.candidate.effect, one.candidate.entries), []).append(", ".join(one.candidate.at))
    return [
        f"{effect} has one size at {', '.join(at)}: the model file gives them the same drive, and none of them shows"
        " enough of it with a size of its own"
        for (effect, _), at in together.items()
        if len(at) > 1
    ]


def _with_gains_free(
    task: Task,
    loop: Loop,
    runs: Sequence[Run],
    seek: Callable[..., Search],
    found: Search,
    progress: Callable[[str, float], None],
) -> Search:
    """What was found; no names where a load stands beside a rest, and gains not taken as right leave noise alone.

    A load and a gain look alike to the joint that carries it; what the load does at the others is the rest.
    """
    loaded = any(one.candidate.effect in ("payload", "link_inertia") for one in found.named)
    asked = found.verdict == "named+rest" and loaded and task.actuator.gains == "known"
    if not asked or "actuator_gain" in task.diagnose.forbid:
        return found
    progress("asking whether the drives' gains are right", 0.9)
    free = task.model_copy(update={"actuator": task.actuator.model_copy(update={"gains": "free"})})
    other = seek(diagnosis_setting(free, loop, runs), progress, forbid=task.diagnose.forbid)
    gains = [str(Name("actuator_gain", n.candidate.at)) for n in other.named if n.candidate.effect == "actuator_gain"]
    if other.verdict != "named" or not gains:
        return found
    why = f"{' and '.join(gains)} in its place leaves noise alone: set actuator.gains: free, or correct the gain"
    told = [(Name(n.candidate.effect, n.candidate.at), n.gain, why) for n in found.named]
    return replace(found, verdict="unknown", named=[], doubtful=[*told, *found.doubtful])


def _taken_gains(task: Task, found: Search) -> dict[Name, str]:
    """That a payload was told from a drive's gain by taking the gains for right."""
    if task.actuator.gains == "free":
        return {}
    text = "the drives' gains are taken as right (actuator.gains: known); a gain that is off may look the same, and"
    rest = "; a misfit stays, so try that before you believe this" if found.verdict == "named+rest" else ""
    return {
        Name(one.candidate.effect, one.candidate.at): f"{text} gains: free tells both{rest}"
        for one in found.named
        if one.candidate.effect == "payload"
    }


def _experiment(found: Search) -> Experiment | None:
    for one in found.named or found.proxy:
        if one.alike or found.proxy:
            other = one.alike[0].effect if one.alike else "what is not in the catalogue"
            text = one.candidate.kind.experiment
            pair = ((one.candidate.effect, other),)
            return Experiment(text.format(at=", ".join(one.candidate.at)), pair if one.alike else ())
    return None


def proxies(found: Sequence[Named]) -> str:
    """Each of the best proxies, with what does as well in its place."""
    return ", ".join(" or ".join(map(str, (Name(n.candidate.effect, n.candidate.at), *n.alike))) for n in found)


def _rest(found: Search, left: np.ndarray, noise: np.ndarray, loop: Loop, traces: Sequence[Trace]) -> Rest:
    if found.verdict in ("nothing", "named"):
        return Rest(np.zeros(0))
    names = tuple(loop.robot.dof_names[k] for k in loop.measured)
    k = int((left / noise).argmax())
    text = f"{1e3 * left[k]:.3g} mrad at {names[k]} against {1e3 * noise[k]:.3g} of noise"
    proxy = proxies(found.proxy)
    text = f"{text}; best proxy, not a cause: {proxy}" if proxy else text
    size = relative_rest(left, noise, traces)
    return Rest(size, parts_of(traces, names, noise, size), nearest_of(found), text)


def _traces(
    here: Setting, runs: Sequence[Run], first: Structure, found: Search, last: tuple[Structure, Any], held: dict
) -> tuple[Trace, ...]:
    traces, fitted = [], [r for r in runs if not r.holdout]
    with jax.enable_x64(True):
        both = [
            np.asarray(predicted(s.loop, s.table, f.theta[None], s.data, f.start[None])[0])
            for s, f in ((first, found.first), last)
        ]
    for k, run in enumerate(fitted):
        mine = [(w, stretch) for w, stretch in enumerate(here.stretches) if stretch.run == k]
        rows = np.concatenate([np.arange(one.first, one.first + one.rows) for _, one in mine])
        ny = run.position.shape[1]
        before, after = (np.concatenate([x[: one.rows, :ny, w] for w, one in mine]) for x in both)
        traces.append(_trace(run, "fit", rows, before, after))
    for run in runs:
        if run.holdout:
            traces.append(_trace(run, "holdout", slice(None), *held[run.name]))
    return tuple(traces)


def _trace(run: Run, role: Any, rows: slice | np.ndarray, before: np.ndarray, after: np.ndarray) -> Trace:
    time, position = run.time[rows], run.position[rows]
    velocity = np.gradient(position, time, axis=0) if run.velocity is None else run.velocity[rows]
    return Trace(run.name, role, time, position, velocity, position, before, after)


def extended_of(loop: Loop) -> ExtendedModel:
    """The robot and what acts at its joints as effects, for the files that carry them."""
    own: list[Effect] = []
    robot = jax.tree.map(np.asarray, loop.robot)
    for k, name in enumerate(robot.dof_names):
        for effect, fields in EFFECTS.items():
            numbers = {field: float(np.asarray(getattr(loop.joints, leaf))[k]) for field, leaf in fields.items()}
            if effect == "joint_spring":
                numbers["offset"] -= numbers["stiffness"] * float(np.asarray(loop.joints.rest)[k])
            if effect == "torque_offset" and np.asarray(loop.joints.stiffness)[k]:
                continue  # the spring holds it
            kind = find(effect)
            if any(numbers[key] for key in kind.amplitudes() if key != "offset" or effect == "torque_offset"):
                own.append(place(kind, robot, [name], **numbers))
    for k, (i, j, sign) in enumerate(loop.pairs.at if loop.pairs is not None else ()):
        numbers = {
            field: float(np.asarray(getattr(loop.pairs, field))[k]) for field in ("inertia", "damping", "friction")
        }
        if any(numbers.values()):
            pair = [robot.dof_names[i], robot.dof_names[j]]
            own.append(place(find("coupled_transmission"), robot, pair, **numbers, sign=float(sign)))
    own += [e for e in loop.effects if any(float(getattr(e, name)) for name in e.amplitudes())]
    return extend(robot, *own)
