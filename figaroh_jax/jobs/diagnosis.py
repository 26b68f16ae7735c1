"""The diagnosis of recorded torques and its run directory."""

from __future__ import annotations

from pathlib import Path

from ..diagnosis.diagnosis import diagnose_task
from ..formats.config import Task
from ..formats.export import write_model
from ..reporting.answer import to_json, write_predictions
from ..reporting.report import write_report
from ..reporting.terminal import show
from .predictions import predictions
from .run import ANSWER, REPORT, Done, Progress, run_folder

__all__ = ["diagnose"]


def diagnose(task: Task, out: Path, progress: Progress, backend: str) -> Done:
    """Diagnose, and write everything that the contract asks of a diagnosis."""
    found = diagnose_task(task, progress=progress, backend=backend)
    progress("writing the report", 1.0)
    with run_folder(task, out, "diagnose", backend) as folder:
        (folder / ANSWER).write_text(to_json(found), encoding="utf-8")
        write_predictions(folder / "predictions.npz", predictions(task, found.model, band=found.band))
        write_report(found, folder / REPORT, found.model.robot.name)
        write_model(found.model, folder / "model", found.causes)
    name = found.model.robot.name
    return Done(found, lambda: to_json(found), lambda verbose: show(found, name, verbose=verbose))
