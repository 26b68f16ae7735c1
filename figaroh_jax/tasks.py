"""Diagnosis and identification as Python calls them: recordings are checked before any work."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, overload

from .errors import InputError, check_callable, check_each, check_kind, check_positive, nearest
from .formats.config import Baseline, Preprocess, Task
from .formats.taskfile import check_effects
from .recordings.checks import Checked, checked_recordings
from .recordings.dataset import named
from .recordings.posture_checks import check_pose_recordings
from .simulators.native import as_backend

if TYPE_CHECKING:
    from .calibration.kinematic_diagnosis import PoseDiagnosis
    from .identification.result import Identification
    from .recordings.dataset import Recording
    from .recordings.poses import PoseRecording
    from .results import Diagnosis
    from .rigid.model import RobotModel
    from .rollouts.identification import RolloutIdentification
    from .simulators.contract import Backend

__all__ = ["diagnose", "diagnose_task", "identify_task"]


def diagnose_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None, backend: str = "native"
) -> Diagnosis | PoseDiagnosis:
    """Diagnose what a task file describes (`load_task`): torques, measured postures, or commands and positions.

    The rigid body's torques are those of the named backend. Raises `InputError` before any work where the task is
    wrong. The answer has `verdict` and `causes` in each case.

    >>> import figaroh_jax as fj
    >>> found = fj.diagnose_task(fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml")))
    >>> found.verdict, found.causes[0].name.effect
    ('named', 'coupled_transmission')
    """
    _read(task)
    if task.of_postures:
        from .calibration.kinematic_diagnosis import diagnose_pose_task

        _native_alone(backend, "postures are diagnosed")
        return diagnose_pose_task(task, progress)
    if task.of_rollouts:
        from .rollouts.task import diagnose_rollout_task

        _native_alone(backend, "rollouts are diagnosed")
        return diagnose_rollout_task(task, progress).diagnosis
    from .diagnosis.diagnosis import diagnose_task as of_torques

    return of_torques(task, progress, backend)


@overload
def diagnose(
    model: RobotModel | Backend,
    recordings: Sequence[Recording],
    preprocess: Preprocess | None = ...,
    known: Baseline | None = ...,
    *,
    trust: float = ...,
    forbid: Sequence[str] = ...,
    alpha: float = ...,
    progress: Callable[[str, float], None] = ...,
    **options: Any,
) -> Diagnosis: ...


@overload
def diagnose(
    model: RobotModel, recordings: Sequence[PoseRecording], *, forbid: Sequence[str] = ..., **more: Any
) -> PoseDiagnosis: ...


def diagnose(
    model: RobotModel | Backend,
    recordings: Sequence[Recording] | Sequence[PoseRecording],
    preprocess: Preprocess | None = None,
    known: Baseline | None = None,
    *,
    trust: float = 0.10,
    forbid: Sequence[str] = (),
    alpha: float = 0.05,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    **options: Any,
) -> Diagnosis | PoseDiagnosis:
    """What the robot's model gets wrong in the recordings, named where it can be: torques, or measured postures.

    `recordings` are those of `recording` and `postures`, or of `read_recordings`. `model` is the robot, or a backend of
    it (torques). `preprocess`, `known` (what the baseline contains) and `trust` (how far the nominal inertials are
    believed, relative one sigma) are of torques alone; `forbid` names effects left out of the catalogue, `alpha` is the
    level of the test for the whole of it.

    >>> import figaroh_jax as fj
    >>> task = fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml"))
    >>> robot = fj.load_robot(task)
    >>> found = fj.diagnose(robot, fj.read_recordings(task, robot), fj.Preprocess(cutoff=15, rate=50), task.baseline)
    >>> found.verdict
    'named'
    """
    from .recordings.dataset import Recording
    from .recordings.poses import PoseRecording

    check_each("recordings", recordings, (Recording, PoseRecording), "`recording` and `postures` make them of arrays")
    if not len(recordings):
        raise InputError("recordings is empty: there is nothing to diagnose")
    check_effects("forbid", forbid)
    check_positive("alpha", alpha, "the level of a test (0.05, say)", below=1.0)
    check_callable("progress", progress, "progress(phase, share)")
    if known is not None:
        check_kind("known", known, Baseline, "fj.Baseline(rotor=True), say")
    check_positive("trust", trust, "relative one sigma")
    check_each("preprocess", [preprocess or Preprocess()], Preprocess, "Preprocess(cutoff=15), in Hz, say")
    postures = [one for one in recordings if isinstance(one, PoseRecording)]
    if postures:
        from .calibration.kinematic_diagnosis import diagnose_poses

        if len(postures) < len(recordings):
            raise InputError("recordings of torque and postures are diagnosed each by themselves")
        if preprocess is not None or known is not None or options:
            raise InputError("postures have no preprocess, baseline or further options: leave them out")
        robot = as_backend(model).robot
        warnings = check_pose_recordings(None, robot, postures)
        found = diagnose_poses(robot, postures, forbid, alpha, progress)
        return replace(found, calibration=replace(found.calibration, notes=(*warnings, *found.calibration.notes)))
    from .diagnosis.diagnosis import diagnose as of_torques

    known_options = inspect.signature(of_torques).parameters
    for option in options:
        if option not in known_options:
            raise InputError(f"diagnose has no argument '{option}'{nearest(option, known_options)}")
    torques: Any = recordings
    torques = named(torques, as_backend(model).robot)
    warnings, contradictions = _checked(model, torques)
    options = {"contradictions": contradictions} | options
    settings = {"trust": trust, "forbid": forbid, "alpha": alpha, "progress": progress, **options}
    found = of_torques(model, torques, preprocess or Preprocess(), known, **settings)
    return replace(found, notes=(*warnings, *found.notes))


def identify_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None, backend: str = "native"
) -> Identification | RolloutIdentification:
    """Identify what a task file describes (`load_task`): recordings of torque, or of commands and positions.

    The rigid body's regressor is that of the named backend. Raises `InputError` before any work where the task is
    wrong.

    >>> import figaroh_jax as fj
    >>> found = fj.identify_task(fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml")))
    >>> found.rank <= found.structural_rank, found.solution.reason
    (True, '')
    """
    _read(task)
    if task.of_rollouts:
        from .rollouts.identification import identify_rollout_task

        _native_alone(backend, "rollouts are identified")
        return identify_rollout_task(task, progress)
    from .identification.identification import identify_task as of_torques

    return of_torques(task, progress, backend)


def _read(task: Any) -> None:
    """Refuse what no `load_task` made."""
    if not isinstance(task, Task):
        raise InputError(
            f"expected a task as load_task reads it from a file or a dictionary, not {type(task).__name__}"
        )


def _native_alone(backend: str, what: str) -> None:
    if backend != "native":
        raise InputError(f"backend '{backend}': {what} with 'native' alone")


def _checked(model: RobotModel | Backend, recordings: Sequence[Recording]) -> Checked:
    """Warnings about the recordings; `InputError` where one cannot be right."""
    return checked_recordings(None, as_backend(model).robot, recordings)
