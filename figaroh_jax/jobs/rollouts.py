"""The diagnosis and the identification from commands and positions, and their run directories."""

from __future__ import annotations

from pathlib import Path

from ..formats.config import Task
from ..formats.export import write_model
from ..reporting.answer import to_json, write_predictions
from ..reporting.report import write_report
from ..reporting.rollout_report import show_rollouts, write_rollouts
from ..reporting.terminal import show
from ..rollouts.identification import identify_rollout_task
from ..rollouts.stored import add_loop
from ..rollouts.task import diagnose_rollout_task
from .run import ANSWER, REPORT, RESULT, Done, Progress, run_folder

__all__ = ["diagnose", "identify"]


def diagnose(task: Task, out: Path, progress: Progress) -> Done:
    """Diagnose rollouts, and write the answer, the predicted positions and the loop's model."""
    done = diagnose_rollout_task(task, progress)
    found, name = done.diagnosis, done.diagnosis.model.robot.name
    progress("writing the report", 1.0)
    with run_folder(task, out, "diagnose") as folder:
        (folder / ANSWER).write_text(to_json(found), encoding="utf-8")
        write_predictions(folder / "predictions.npz", done.predictions, "position")
        write_report(found, folder / REPORT, name)
        write_model(found.model, folder / "model", found.causes)
        add_loop(folder / "model", done.loop)
    return Done(found, lambda: to_json(found), lambda verbose: show(found, name, verbose=verbose))


def identify(task: Task, out: Path, progress: Progress) -> Done:
    """Identify rollouts, and write the result, the predicted positions and the loop's model."""
    found = identify_rollout_task(task, progress)
    name = found.model.robot.name
    progress("writing the report", 1.0)
    with run_folder(task, out, "identify") as folder:
        (folder / RESULT).write_text(found.to_json(), encoding="utf-8")
        write_rollouts(found, folder / REPORT, name)
        write_predictions(folder / "predictions.npz", found.predictions, "position")
        write_model(found.model, folder / "model")
        add_loop(folder / "model", found.loop)
    return Done(found, found.to_json, lambda verbose: show_rollouts(found, name, verbose=verbose))
