"""A run directory: `answer.json` or `result.json`, `report.html`, `model/` and more, written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from ..formats.config import Task, load_task
from ..reporting.provenance import PROVENANCE, provenance
from ..reporting.run_directory import check_directory, task_inputs, whole_directory
from ..simulators.registry import backend_class

__all__ = ["ANSWER", "REPORT", "RESULT", "Done", "Progress", "native_alone", "run_folder", "task_for"]

ANSWER, RESULT, REPORT = "answer.json", "result.json", "report.html"

Progress = Callable[[str, float], None]  # the phase in words, and the share of the work that is done


class Done(NamedTuple):
    """A run that has been written: what it found, what `--json` prints, what a reader sees."""

    found: Any
    to_json: Callable[[], str]
    show: Callable[[bool], None]  # with the notes, or with their number
    failure: str | None = None  # what ends the command with status 1, in words


def task_for(task_file: Path, out: Path, *, recordings: bool = True) -> Task:
    """The task of a run that is to be written to `out`: it can become a run directory and holds no file of the task.

    `recordings`: whether the command needs some.
    """
    check_directory(out)
    task = load_task(task_file)
    if recordings and not task.data:
        raise InputError(f"{task_file}: data is missing: this command needs recordings; only `excite` does without")
    check_directory(out, task_inputs(task_file))
    return task


@contextmanager
def run_folder(
    task: Task, out: Path, command: str, backend: str = "native", options: Sequence[str] = ()
) -> Iterator[Path]:
    """`whole_directory` with the file that says what made the run."""
    inputs = task_inputs(task.file)
    with whole_directory(out, inputs) as folder:
        text = provenance(command, task.file, inputs, backend, options)
        (folder / PROVENANCE).write_text(text, encoding="utf-8")
        yield folder


def native_alone(backend: str, why: str = "a calibration differentiates by the placements of the links") -> None:
    """Refuse another backend than the library's own; `why` says what the others cannot do."""
    if backend != "native":
        backend_class(backend)  # one that is not installed is refused there, with the list of those that are
        raise InputError(
            f"--backend {backend}: {why}, which the contract of backends does not ask for; only 'native' does it"
        )
