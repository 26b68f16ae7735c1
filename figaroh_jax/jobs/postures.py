"""The diagnosis and the calibration of measured postures, and their run directories."""

from __future__ import annotations

from pathlib import Path

from ..calibration.calibration import calibrate_task
from ..calibration.kinematic_diagnosis import diagnose_pose_task
from ..formats.config import Task
from ..reporting.calibration_files import pose_answer_json, to_json, write_calibration
from ..reporting.terminal import show_calibration
from .run import ANSWER, Done, Progress, run_folder

__all__ = ["calibrate", "diagnose"]


def diagnose(task: Task, out: Path, progress: Progress) -> Done:
    """Diagnose postures, and write the files of their calibration with the answer."""
    found = diagnose_pose_task(task, progress)
    progress("writing the report", 1.0)
    with run_folder(task, out, "diagnose") as folder:
        write_calibration(found.calibration, folder, task.robot.model, found)
        (folder / ANSWER).write_text(pose_answer_json(found), encoding="utf-8")

    def show(verbose: bool) -> None:
        show_calibration(found.calibration, found, verbose=verbose)

    return Done(found, lambda: pose_answer_json(found), show)


def calibrate(task: Task, out: Path, progress: Progress, level: str | None, priors: bool) -> Done:
    """Calibrate, and write everything that the contract asks of a calibration."""
    found = calibrate_task(task, progress=progress, level=level, priors=priors)
    own = [*(["--level", level] if level else []), *([] if priors else ["--no-priors"])]
    progress("writing the report", 1.0)
    with run_folder(task, out, "calibrate", options=own) as folder:
        write_calibration(found, folder, task.robot.model)
    return Done(found, lambda: to_json(found), lambda verbose: show_calibration(found, verbose=verbose))
