"""The identification from recorded torques and its run directory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..formats.config import Task
from ..formats.export import write_model
from ..identification.identification import identify_task
from ..identification.parameter_files import write_parameters
from ..identification.result import Link, to_json
from ..reporting.answer import write_predictions
from ..reporting.identification_report import write_identification
from ..reporting.terminal import show_identification
from .predictions import predictions
from .run import REPORT, RESULT, Done, Progress, run_folder

__all__ = ["identify"]


def identify(task: Task, out: Path, progress: Progress, backend: str) -> Done:
    """Identify, and write everything that the contract asks of an identification."""
    found = identify_task(task, progress=progress, backend=backend)
    wrong = [] if task.identify.infeasible == "write" else [link for link in found.links if not link.consistent]
    if wrong:
        found = replace(found, notes=(_not_written(wrong), *found.notes))
    progress("writing the report", 1.0)
    name = found.model.robot.name
    with run_folder(task, out, "identify", backend) as folder:
        (folder / RESULT).write_text(to_json(found), encoding="utf-8")
        write_predictions(folder / "predictions.npz", predictions(task, found.model, identified=True, band=found.band))
        write_parameters(found, folder)
        write_identification(found, folder / REPORT, name, model_written=not wrong)
        if not wrong:
            write_model(found.model, folder / "model")
    return Done(found, lambda: to_json(found), lambda verbose: show_identification(found, name, verbose=verbose))


def _not_written(wrong: Sequence[Link]) -> str:
    which = "; ".join(f"{link.name}: {link.reason}" for link in wrong)
    return (
        f"model/ is not written: the parameters of {which} are not physically consistent. `identify.fit: physical`"
        " gives consistent links; `identify.infeasible: write` writes these all the same"
    )
