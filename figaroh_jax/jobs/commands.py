"""The commands that take a task file. What a task's recordings hold decides which module does the work.

Each reads the task, does the job and writes the run directory `out`. An earlier run in `out` is replaced; a directory
that holds anything else is refused before any work. Wrong input raises `InputError`, and nothing is written. The
modules that do the work are imported once the task has been read: a wrong one is told without waiting for them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..simulators.registry import check_backend
from .run import Done, Progress, native_alone, task_for

__all__ = ["COMMANDS", "Command", "calibrate", "diagnose", "excite", "identify"]


def diagnose(task_file: Path, out: Path, progress: Progress, backend: str = "native") -> Done:
    """Name what a robot's simulation gets wrong: torques (by the named backend), postures or rollouts."""
    check_backend(backend, "joint_torque_regressor")
    task = task_for(task_file, out)
    if task.of_postures:
        native_alone(backend)
        from . import postures

        return postures.diagnose(task, out, progress)
    if task.of_rollouts:
        native_alone(backend)
        from . import rollouts

        return rollouts.diagnose(task, out, progress)
    from . import diagnosis

    return diagnosis.diagnose(task, out, progress, backend)


def identify(task_file: Path, out: Path, progress: Progress, backend: str = "native") -> Done:
    """Fit a robot's dynamics to torques (by the named backend) or rollouts."""
    check_backend(backend, "joint_torque_regressor")
    task = task_for(task_file, out)
    if task.of_rollouts:
        native_alone(backend)
        from . import rollouts

        return rollouts.identify(task, out, progress)
    from . import identification

    return identification.identify(task, out, progress, backend)


def calibrate(
    task_file: Path,
    out: Path,
    progress: Progress,
    backend: str = "native",
    *,
    level: str | None = None,
    priors: bool = True,
) -> Done:
    """Fit a robot's kinematics to postures; `level` and `priors` are those of `figaroh_jax.calibrate`."""
    native_alone(backend)
    task = task_for(task_file, out)
    from . import postures

    return postures.calibrate(task, out, progress, level, priors)


def excite(
    task_file: Path, out: Path, progress: Progress, backend: str = "native", *, of_run: Path | None = None
) -> Done:
    """Design what the task's `excite` block asks for.

    `of_run` is a finished diagnosis: the motion is then one that tells its causes from what they are ambiguous with.
    A design that does not meet a limit at 1 kHz is written too, and says so; the command then ends with status 1.
    """
    native_alone(backend, "a design differentiates the regressor in closed form")
    task = task_for(task_file, out, recordings=False)
    from . import excitation

    return excitation.excite(task, out, progress, of_run)


class Command(NamedTuple):
    """A command, and the noun of its run directory's default name."""

    noun: str
    run: Callable[..., Done]


COMMANDS = {
    "diagnose": Command("diagnosis", diagnose),
    "identify": Command("identification", identify),
    "calibrate": Command("calibration", calibrate),
    "excite": Command("excitation", excite),
}
