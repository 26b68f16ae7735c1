"""The design of motions and postures, and its run directory."""

from __future__ import annotations

import json
from pathlib import Path

from ..effects.registry import find
from ..errors import InputError
from ..excitation.design import Cause
from ..excitation.postures import PostureDesign
from ..excitation.task import excite_task
from ..formats.config import Task, robot_options
from ..formats.robotfile import load_extended
from ..reporting.excitation_files import failure, summary_lines, to_json, write_design, write_postures
from ..reporting.wording import fitted
from .run import ANSWER, Done, Progress, run_folder

__all__ = ["ambiguous_pairs", "excite"]


def excite(task: Task, out: Path, progress: Progress, of_run: Path | None) -> Done:
    """Design what the task's `excite` block asks for, or what tells the causes of the run `of_run` apart."""
    separate = () if of_run is None else ambiguous_pairs(of_run)
    found = excite_task(task, progress, separate=separate)
    progress("writing the report", 1.0)
    own = [] if of_run is None else ["--from", str(of_run.resolve())]
    with run_folder(task, out, "excite", options=own) as folder:
        if isinstance(found, PostureDesign):
            write_postures(found, folder)
        else:
            write_design(found, folder, load_extended(task.robot.model, **robot_options(task.robot)).model)

    def show(verbose: bool) -> None:
        print(fitted("\n".join(summary_lines(found))))

    return Done(found, lambda: to_json(found), show, failure(found))


def ambiguous_pairs(folder: Path) -> list[tuple[Cause, Cause]]:
    """The causes of a finished diagnosis with what each is ambiguous with: effect, place, sizes.

    Raises `InputError` for another directory, and where nothing is ambiguous.
    """
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
        raise InputError(f"--from {folder}: no cause of this diagnosis is ambiguous; there is nothing to resolve")
    return pairs
