"""A run directory: `answer.json` or `result.json`, `report.html`, `model/` and more, written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .errors import InputError, as_written
from .reporting.run_directory import check_directory, refusals, task_inputs, whole_directory, write_file
from .reporting.wording import fitted

if TYPE_CHECKING:
    from .calibration.calibrated import Calibration
    from .calibration.kinematic_diagnosis import PoseDiagnosis
    from .effects.extended import ExtendedModel
    from .excitation.design import Cause, Design
    from .excitation.postures import PostureDesign
    from .formats.config import Load, Task
    from .identification.result import Identification, Link
    from .results import Diagnosis
    from .rollouts.identification import RolloutIdentification
    from .rollouts.loop import Loop

__all__ = [
    "ANSWER",
    "JOBS",
    "REPORT",
    "RESULT",
    "Job",
    "calibrate_file",
    "diagnose_file",
    "excite_file",
    "export_loop",
    "identify_file",
    "predictions",
    "write_run",
]

ANSWER, RESULT, REPORT, LOOP = "answer.json", "result.json", "report.html", "loop.json"


class Job(NamedTuple):
    """A command on a task file: what it runs and writes, what `--json` prints, what a reader sees."""

    noun: str  # of the run directory's default name
    run: Callable[..., Any]  # (task file, run directory, progress, backend), and the command's own options by name
    to_json: Callable[[Any], str]
    show: Callable[[Any, bool], None]  # with the notes, or with their number
    failure: Callable[[Any], str | None] = lambda found: None  # what ends the command with status 1, in words


def diagnose_file(
    task_file: Path,
    out: Path,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
    backend: str = "native",
) -> Diagnosis | PoseDiagnosis:
    """Read a task, diagnose it and write the run directory `out`: torques, or postures with a measurement.

    The rigid body's torques are those of the named backend. An earlier run in `out` is replaced; a directory that holds
    anything else is refused before any work. Wrong input raises `InputError`, and nothing is written.
    """
    from .simulators.registry import check_backend

    check_backend(backend, "joint_torque_regressor")
    task = _task_for(task_file, out)
    if task.of_postures:
        _native_alone(backend)
        return _diagnose_poses(task, out, progress)
    if task.of_rollouts:
        _native_alone(backend)
        return _diagnose_rollouts(task, out, progress)
    from .diagnosis.diagnosis import diagnose_task

    diagnosis = diagnose_task(task, progress=progress, backend=backend)
    progress("writing the report", 1.0)
    write_run(task, diagnosis, out, backend)
    return diagnosis


def _diagnose_rollouts(task: Task, out: Path, progress: Callable[[str, float], None]) -> Diagnosis:
    from .formats.export import write_model
    from .reporting.answer import to_json, write_predictions
    from .reporting.report import write_report
    from .rollouts.task import diagnose_rollout_task

    found = diagnose_rollout_task(task, progress)
    progress("writing the report", 1.0)
    with _run_folder(task, out, "diagnose") as folder:
        (folder / ANSWER).write_text(to_json(found.diagnosis), encoding="utf-8")
        write_predictions(folder / "predictions.npz", found.predictions, "position")
        write_report(found.diagnosis, folder / REPORT, found.diagnosis.model.robot.name)
        write_model(found.diagnosis.model, folder / "model", found.diagnosis.causes)
        _write_loop(folder / "model", found.loop)
    return found.diagnosis


def export_loop(model: Path, simulator: str, out: Path | None = None) -> str:
    """The loop of a run's `model` directory in the words of a simulator, as JSON; with `out`, written there too.

    For MuJoCo `out` also gets `robot.xml`, with everything that MuJoCo has words for. Raises `InputError` for another
    directory, and for a simulator that is not known.
    """
    from .rollouts.export import for_simulator, with_drives

    try:
        content = json.loads((model / LOOP).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{model}: no readable {LOOP}; name the `model` directory of a rollout's run") from None
    with as_written(model / LOOP):
        text = json.dumps(for_simulator(content, simulator), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        files = {f"{simulator}.json": text}
        if simulator == "mujoco" and out is not None:
            files["robot.xml"] = with_drives(model / "robot.xml", content)
    if out is not None:
        _write_files(out, files)
    return text


def _write_files(out: Path, files: Mapping[str, str]) -> None:
    """Files into a folder that may be there, all or none; one that says something else stops it."""
    for name, text in files.items():
        path = out / name
        with refusals(out):
            if os.path.lexists(path) and not (path.is_file() and path.read_bytes() == text.encode()):
                raise InputError(f"--out {out}: {name} is there and says something else; name another folder")
    with refusals(out):
        out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_file(out / name, text, "--out")


def _write_loop(folder: Path, loop: Loop) -> None:
    """`loop.json`, every number of the loop, and the drives in `robot.xml`."""
    from .rollouts.export import described, described_text, with_drives

    (folder / LOOP).write_text(described_text(loop), encoding="utf-8")
    mjcf = folder / "robot.xml"
    mjcf.write_text(with_drives(mjcf, described(loop)), encoding="utf-8")


def identify_file(
    task_file: Path,
    out: Path,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
    backend: str = "native",
) -> Identification | RolloutIdentification:
    """Read a task, identify its robot and write the run directory `out`, as `diagnose_file` does."""
    from .simulators.registry import check_backend

    check_backend(backend, "joint_torque_regressor")
    task = _task_for(task_file, out)
    if task.of_rollouts:
        _native_alone(backend)
        return _identify_rollouts(task, out, progress)
    from .formats.export import write_model
    from .identification.identification import identify_task
    from .identification.parameter_files import write_parameters
    from .reporting.answer import write_predictions
    from .reporting.identification_report import write_identification

    found = identify_task(task, progress=progress, backend=backend)
    wrong = [] if task.identify.infeasible == "write" else [link for link in found.links if not link.consistent]
    if wrong:
        found = replace(found, notes=(_not_written(wrong), *found.notes))
    progress("writing the report", 1.0)
    with _run_folder(task, out, "identify", backend) as folder:
        (folder / RESULT).write_text(_identification_json(found), encoding="utf-8")
        write_predictions(folder / "predictions.npz", predictions(task, found.model, identified=True))
        write_parameters(found, folder)
        write_identification(found, folder / REPORT, found.model.robot.name, model_written=not wrong)
        if not wrong:
            write_model(found.model, folder / "model")
    return found


@contextmanager
def _run_folder(
    task: Task, out: Path, command: str, backend: str = "native", options: Sequence[str] = ()
) -> Iterator[Path]:
    """`whole_directory` with the file that says what made the run."""
    from .reporting.provenance import PROVENANCE, provenance

    inputs = task_inputs(task.file)
    with whole_directory(out, inputs) as folder:
        text = provenance(command, task.file, inputs, backend, options)
        (folder / PROVENANCE).write_text(text, encoding="utf-8")
        yield folder


def _identify_rollouts(task: Task, out: Path, progress: Callable[[str, float], None]) -> RolloutIdentification:
    from .formats.export import write_model
    from .reporting.answer import write_predictions
    from .reporting.rollout_report import write_rollouts
    from .rollouts.identification import identify_rollout_task

    found = identify_rollout_task(task, progress)
    progress("writing the report", 1.0)
    with _run_folder(task, out, "identify") as folder:
        (folder / RESULT).write_text(found.to_json(), encoding="utf-8")
        write_rollouts(found, folder / REPORT, found.model.robot.name)
        write_predictions(folder / "predictions.npz", found.predictions, "position")
        write_model(found.model, folder / "model")
        _write_loop(folder / "model", found.loop)
    return found


def _task_for(task_file: Path, out: Path, *, recordings: bool = True) -> Task:
    """The task of a run that is to be written to `out`: it can become a run directory and holds no file of the task.

    `recordings`: whether the command needs some.
    """
    from .formats.config import load_task

    check_directory(out)
    task = load_task(task_file)
    if recordings and not task.data:
        raise InputError(f"{task_file}: data is missing: this command needs recordings; only `excite` does without")
    check_directory(out, task_inputs(task_file))
    return task


def _not_written(wrong: Sequence[Link]) -> str:
    which = "; ".join(f"{link.name}: {link.reason}" for link in wrong)
    return (
        f"model/ is not written: the parameters of {which} are not physically consistent. `identify.fit: physical`"
        " gives consistent links; `identify.infeasible: write` writes these all the same"
    )


def _diagnose_poses(task: Task, out: Path, progress: Callable[[str, float], None]) -> PoseDiagnosis:
    from .calibration.kinematic_diagnosis import diagnose_pose_task
    from .reporting.calibration_files import pose_answer_json, write_calibration

    found = diagnose_pose_task(task, progress)
    progress("writing the report", 1.0)
    with _run_folder(task, out, "diagnose") as folder:
        write_calibration(found.calibration, folder, task.robot.model)
        (folder / ANSWER).write_text(pose_answer_json(found), encoding="utf-8")
    return found


def calibrate_file(
    task_file: Path,
    out: Path,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
    backend: str = "native",
    *,
    level: str | None = None,
    priors: bool = True,
) -> Calibration:
    """Read a task, calibrate its robot and write the run directory `out`, as `diagnose_file` does.

    `level` and `priors` are those of `calibration.calibrate`.
    """
    _native_alone(backend)
    task = _task_for(task_file, out)
    from .calibration.calibration import calibrate_task
    from .reporting.calibration_files import write_calibration

    calibration = calibrate_task(task, progress=progress, level=level, priors=priors)
    own = [*(["--level", level] if level else []), *([] if priors else ["--no-priors"])]
    progress("writing the report", 1.0)
    with _run_folder(task, out, "calibrate", options=own) as folder:
        write_calibration(calibration, folder, task.robot.model)
    return calibration


def excite_file(
    task_file: Path,
    out: Path,
    progress: Callable[[str, float], None] = lambda phase, fraction: None,
    backend: str = "native",
    *,
    of_run: Path | None = None,
) -> Design | PostureDesign:
    """Read a task, design what its `excite` block asks for and write the run directory `out`, as `diagnose_file` does.

    `of_run` is a finished diagnosis: the motion is then one that tells its causes from what they are ambiguous with.
    A design that does not meet a limit at 1 kHz is written too, and says so; the command then ends with status 1.
    """
    _native_alone(backend, "a design differentiates the regressor in closed form")
    task = _task_for(task_file, out, recordings=False)
    from .excitation.postures import PostureDesign
    from .excitation.task import excite_task
    from .formats.config import robot_options
    from .formats.robotfile import load_extended
    from .reporting.excitation_files import write_design, write_postures

    separate = () if of_run is None else ambiguous_pairs(of_run)
    found = excite_task(task, progress, separate=separate)
    progress("writing the report", 1.0)
    own = [] if of_run is None else ["--from", str(of_run.resolve())]
    with _run_folder(task, out, "excite", options=own) as folder:
        if isinstance(found, PostureDesign):
            write_postures(found, folder)
            return found
        write_design(found, folder, load_extended(task.robot.model, **robot_options(task.robot)).model)
    return found


def ambiguous_pairs(folder: Path) -> list[tuple[Cause, Cause]]:
    """The causes of a finished diagnosis with what each is ambiguous with: effect, place, sizes.

    Raises `InputError` for another directory, and where nothing is ambiguous.
    """
    from .effects.registry import find

    try:
        answer = json.loads((folder / ANSWER).read_text(encoding="utf-8"))
        causes = [(one["effect"], one["at"], one["parameters"], one["ambiguous_with"]) for one in answer["causes"]]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"--from {folder}: no readable {ANSWER}; name the run directory of a diagnosis") from None
    pairs: list[tuple[Cause, Cause]] = []
    for effect, at, parameters, others in causes:
        known = find(effect).parameters()
        size = {n: p["value"] for n, p in parameters.items() if n in known and p.get("value") is not None}
        size = {} if find(effect).inertial else size
        pairs += [((effect, tuple(at), size), (other["effect"], tuple(other["at"]), {})) for other in others]
    if not pairs:
        raise InputError(f"--from {folder}: no cause of this diagnosis is ambiguous; there is nothing to tell apart")
    return pairs


def _native_alone(backend: str, why: str = "") -> None:
    if backend != "native":
        from .simulators.registry import backend_class

        backend_class(backend)  # one that is not installed is refused there, with the list of those that are
        why = why or "a calibration differentiates by the placements of the links"
        raise InputError(
            f"--backend {backend}: {why}, which the contract of backends does not ask for; only 'native' does it"
        )


def write_run(task: Task, diagnosis: Diagnosis, out: Path, backend: str = "native") -> None:
    """Write everything that the contract asks of a diagnosis into the directory `out`."""
    from .formats.export import write_model
    from .reporting.answer import to_json, write_predictions
    from .reporting.report import write_report

    with _run_folder(task, out, "diagnose", backend) as folder:
        (folder / ANSWER).write_text(to_json(diagnosis), encoding="utf-8")
        write_predictions(folder / "predictions.npz", predictions(task, diagnosis.model, slowed=diagnosis.slowed))
        write_report(diagnosis, folder / REPORT, diagnosis.model.robot.name)
        write_model(diagnosis.model, folder / "model", diagnosis.causes)


def predictions(
    task: Task, extended: ExtendedModel, *, identified: bool = False, slowed: bool = False
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Time (s) and the extended model's torque (N m or N) of each holdout recording, on its own time stamps.

    The recording's motion is prepared as for the fit (`slowed`: positions taken down to the band of their own motion),
    but over its whole length, whatever window the fit kept. Where the model is an identified one, a known payload is
    carried in addition.
    """
    from .effects.extended import predict
    from .recordings.dataset import read_recordings
    from .recordings.signals import choose_rates, prepare, to_recording_times

    if all(entry.role == "fit" for entry in task.data):
        return {}
    recordings = read_recordings(task, extended.robot, floating=identified)
    rates = choose_rates(recordings, task.preprocess)
    whole = task.preprocess.model_copy(update={"window": None, "gate": {}})
    found = {}
    for recording in recordings:
        if recording.role == "holdout":
            motion = prepare(recording, whole, rates, slowed=slowed, model=extended.robot)
            carrying = _carrying(extended, recording.load if identified else None)
            state = motion.position, motion.velocity, motion.acceleration
            if extended.robot.nq == extended.robot.nv:
                torque = predict(carrying, motion.time, *state, motion.dt)
            else:
                torque = carrying.inverse_dynamics(*state)
            found[recording.name] = recording.time, to_recording_times(motion.time, np.asarray(torque), recording.time)
    return found


def _carrying(extended: ExtendedModel, load: Load | None) -> ExtendedModel:
    """The model with a known payload at its link."""
    if load is None:
        return extended
    import equinox as eqx

    from .recordings.dataset import carried_body

    link, ten = carried_body(extended.robot, load)
    inertia = np.array(extended.robot.inertia, float)
    inertia[link] += ten
    return eqx.tree_at(lambda m: m.robot.inertia, extended, inertia)


def _diagnosis_json(diagnosis: Diagnosis | PoseDiagnosis) -> str:
    from .results import Diagnosis

    if isinstance(diagnosis, Diagnosis):
        from .reporting.answer import to_json

        return to_json(diagnosis)
    from .reporting.calibration_files import pose_answer_json

    return pose_answer_json(diagnosis)


def _show_diagnosis(diagnosis: Diagnosis | PoseDiagnosis, verbose: bool = False) -> None:
    from .reporting.terminal import show, show_calibration
    from .results import Diagnosis

    if isinstance(diagnosis, Diagnosis):
        show(diagnosis, diagnosis.model.robot.name, verbose=verbose)
    else:
        show_calibration(diagnosis.calibration, diagnosis.verdict, verbose=verbose)


def _identification_json(found: Identification | RolloutIdentification) -> str:
    from .identification.result import Identification, to_json

    return to_json(found) if isinstance(found, Identification) else found.to_json()


def _show_identification(found: Identification | RolloutIdentification, verbose: bool = False) -> None:
    from .identification.result import Identification

    if isinstance(found, Identification):
        from .reporting.terminal import show_identification

        show_identification(found, found.model.robot.name, verbose=verbose)
    else:
        from .reporting.rollout_report import show_rollouts

        show_rollouts(found, found.model.robot.name, verbose=verbose)


def _calibration_json(calibration: Calibration) -> str:
    from .reporting.calibration_files import to_json

    return to_json(calibration)


def _show_calibration(calibration: Calibration, verbose: bool = False) -> None:
    from .reporting.terminal import show_calibration

    show_calibration(calibration, verbose=verbose)


def _design_json(found: Design | PostureDesign) -> str:
    from .reporting.excitation_files import to_json

    return to_json(found)


def _show_design(found: Design | PostureDesign, verbose: bool = False) -> None:
    from .reporting.excitation_files import summary_lines

    print(fitted("\n".join(summary_lines(found))))


def _design_failure(found: Design | PostureDesign) -> str | None:
    from .reporting.excitation_files import failure

    return failure(found)


JOBS = {
    "diagnose": Job("diagnosis", diagnose_file, _diagnosis_json, _show_diagnosis),
    "identify": Job("identification", identify_file, _identification_json, _show_identification),
    "calibrate": Job("calibration", calibrate_file, _calibration_json, _show_calibration),
    "excite": Job("excitation", excite_file, _design_json, _show_design, _design_failure),
}
