"""The terminal: a progress bar on standard error while work goes on, a short summary on standard output at its end."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from rich import progress as bars
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from ..results import Cause, Diagnosis, Estimate
from . import wording

if TYPE_CHECKING:
    from ..calibration.calibrated import Calibration
    from ..calibration.kinematic_diagnosis import PoseDiagnosis
    from ..identification.result import FittedEffect, Identification

__all__ = [
    "Progress",
    "calibration_summary",
    "identification_summary",
    "show",
    "show_calibration",
    "show_identification",
    "summary",
]

_STYLE = {"nothing": "green", "named": "bold blue", "named+rest": "bold blue", "unknown": "bold yellow"}


class Progress:
    """Progress on standard error, a context manager that is called with a phase and the share done of the whole.

    A terminal gets one moving bar, which vanishes at the end; a file or a pipe gets one line a phase; `quiet` nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._console = Console(stderr=True, quiet=quiet)
        self._live = self._console.is_terminal and not quiet
        self._phase = ""
        columns = (bars.TextColumn("{task.description:<28}"), bars.BarColumn(), bars.TimeElapsedColumn())
        self._progress = bars.Progress(
            *columns, console=self._console, transient=True, disable=not self._live, refresh_per_second=4
        )
        self._task = self._progress.add_task("", total=1.0)

    def __enter__(self) -> Progress:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None):
        self._progress.stop()

    def __call__(self, phase: str, fraction: float) -> None:
        """Show that the work is in `phase` and that `fraction` (0 to 1) of all of it is done."""
        done = min(max(fraction, 0.0), 1.0)
        if self._live:
            self._progress.update(self._task, completed=done, description=_plain(phase))
        elif phase != self._phase:
            self._console.print(Text(f"{done:4.0%}  {phase}"), soft_wrap=True)
        self._phase = phase


def show(diagnosis: Diagnosis, robot: str = "the robot", *, verbose: bool = False) -> None:
    """Print the summary on standard output."""
    _print(summary(diagnosis, robot, verbose=verbose))


def _print(shown: RenderableType) -> None:
    """On standard output; in a pipe or a file without the spaces that fill lines up."""
    console = Console(file=sys.stdout)
    if console.is_terminal:
        console.print(shown)
        return
    with console.capture() as text:
        console.print(shown)
    sys.stdout.write("\n".join(line.rstrip() for line in text.get().split("\n")))


def _notes(notes: Sequence[str], verbose: bool) -> list[RenderableType]:
    """The notes, or how many there are."""
    if verbose:
        return [Text(f"Note: {note}", style="dim") for note in notes]
    count = f"{len(notes)} note{'s'[: len(notes) != 1]}"
    return [Text(f"{count} on the data: see the report, or add --verbose", style="dim")] if notes else []


def summary(diagnosis: Diagnosis, robot: str = "the robot", *, verbose: bool = False) -> RenderableType:
    """The diagnosis in a few lines: verdict, causes with parameters, residual per joint, what to measure next.

    The notes on the data are counted; `verbose` shows them.
    """
    style = "yellow" if diagnosis.rest.undecided else _STYLE[diagnosis.verdict]
    head = Text.assemble((diagnosis.verdict, style), f"  {wording.sentence(diagnosis, robot)}")
    parts: list[RenderableType] = [head]
    parts += [_cause(number, cause) for number, cause in enumerate(diagnosis.causes, 1)]
    if diagnosis.verdict in ("named+rest", "unknown"):
        parts += [Text(), *(Text(line) for line in wording.rest(diagnosis))]
    if diagnosis.rest.nearest:
        parts.append(Text("\nConsidered, but not named:"))
        parts += [Padding(Text(wording.nearest(near)), (0, 0, 0, 3), expand=False) for near in diagnosis.rest.nearest]
    if diagnosis.links is not None:
        first, *others = wording.links(diagnosis)
        parts.append(Text(f"\n{first}"))
        parts += [Padding(Text(one), (0, 0, 0, 3), expand=False) for one in others]
    parts += [Text(), _residuals(diagnosis), Text()]
    parts.append(Text(f"Held out: {diagnosis.holdout_scheme}. {wording.p_value(diagnosis.p_value)}.", style="dim"))
    if diagnosis.experiment is not None:
        parts.append(Text(f"Measure next: {diagnosis.experiment.text}"))
        if diagnosis.experiment.separates and "excite --from" not in diagnosis.experiment.text:
            parts.append(Text("`figaroh-jax excite --from RUN` designs a motion that separates them", style="dim"))
    parts += _notes(diagnosis.notes, verbose)
    return Group(*parts)


def show_calibration(calibration: Calibration, found: PoseDiagnosis | None = None, *, verbose: bool = False) -> None:
    """Print the summary of a calibration, or of the diagnosis of poses that it belongs to, on standard output."""
    _print(calibration_summary(calibration, found, verbose=verbose))


def calibration_summary(
    calibration: Calibration, found: PoseDiagnosis | None = None, *, verbose: bool = False
) -> RenderableType:
    """The calibration in a few lines: how much better, why this level, outliers and causes, what to know."""
    word = (calibration.level, "bold blue") if found is None else (found.verdict, _STYLE[found.verdict])
    said = "" if found is None else f"{wording.pose_sentence(found, calibration.model.name)} "
    head = Text.assemble(word, f"  {said}{wording.calibration_sentence(calibration)}\n")
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("held-out RMS error")
    errors = [error for error in (calibration.position, calibration.orientation) if error is not None]
    for error in errors:
        table.add_column(error.unit, justify="right")
    for name, pair in calibration.table.items():
        values = [pair[0] * 1e3] * (calibration.position is not None)
        values += [pair[1] * 57.29577951308232] * (calibration.orientation is not None)
        table.add_row(wording.level(name), *(wording.number(value, 4) for value in values))
    parts: list[RenderableType] = [head, table]
    for number, cause in enumerate(calibration.causes, 1):
        values = ", ".join(f"{key} {wording.interval(value)}" for key, value in cause.parameters.items())
        told = cause.note if cause.name.effect == "outlier" else "; ".join(filter(None, (values, cause.note)))
        parts.append(Text.assemble(f"\n{number}. ", (wording.phrase(cause.name), "bold"), f"  {told}"))
        if cause.ambiguous_with:
            parts.append(
                Text(f"   not distinguishable from {wording.aside(cause.name, cause.ambiguous_with)}", style="yellow")
            )
    if found is not None and found.rest.nearest:
        parts.append(Text("\nConsidered, but not named:"))
        parts += [Padding(Text(wording.nearest(near)), (0, 0, 0, 3), expand=False) for near in found.rest.nearest]
    parts.append(Text(f"\nHeld out: {calibration.scheme}. {wording.distances(calibration)}".rstrip(), style="dim"))
    return Group(*parts, *_notes(calibration.notes, verbose))


def _cause(number: int, cause: Cause) -> RenderableType:
    gain = cause.gain
    lines = [
        Text.assemble(
            f"\n{number}. ",
            (wording.phrase(cause.name), "bold"),
            f"  [{cause.name.effect}]  error {' → '.join(wording.fall(gain.before, gain.after, gain.unit))}, ",
            f"confidence {cause.confidence:.2f}",
        )
    ]
    lines += [Text(line) for line in _aligned(cause.parameters)]
    if cause.ambiguous_with:
        lines.append(
            Text(f"not distinguishable from {wording.aside(cause.name, cause.ambiguous_with)}", style="yellow")
        )
    if cause.note:
        lines.append(Text(cause.note, style="dim"))
    return Group(lines[0], *(Padding(line, (0, 0, 0, 3), expand=False) for line in lines[1:]))


def _aligned(parameters: Mapping[str, Estimate]) -> list[str]:
    """One parameter a line, names, values and intervals below each other."""
    sizes = {name: wording.interval(value).partition(" ± ") for name, value in parameters.items()}
    widths = max(map(len, sizes), default=0), max((len(v) for v, mark, _ in sizes.values() if mark), default=0)
    return [
        f"{name:<{widths[0]}}  {value:>{widths[1] if mark else 0}}{mark}{rest}"
        for name, (value, mark, rest) in sizes.items()
    ]


def _residuals(diagnosis: Diagnosis) -> RenderableType:
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("RMS residual")
    columns = {"before": diagnosis.before, "after": diagnosis.after, "noise": diagnosis.noise}
    if diagnosis.links is not None:
        columns = {"links of the file": diagnosis.links.filed} | columns
    for title in columns:
        table.add_column(title, justify="right")
    table.add_column("")
    for joint, unit, *values in zip(diagnosis.joints, diagnosis.torque_units, *columns.values(), strict=True):
        table.add_row(Text(joint), *(wording.number(float(value), 3) for value in values), unit)
    return table


def _plain(text: str) -> str:
    return text.replace("[", "(").replace("]", ")")  # the progress bar reads brackets as its own markup


def show_identification(found: Identification, robot: str = "the robot", *, verbose: bool = False) -> None:
    """Print the summary of an identification on standard output."""
    _print(identification_summary(found, robot, verbose=verbose))


def identification_summary(found: Identification, robot: str = "the robot", *, verbose: bool = False) -> RenderableType:
    """The identification in a few lines: rank, error of each joint, friction, notes."""
    base = [one.status for one in found.base]
    wrong = [link.name for link in found.links if not link.consistent]
    head = Text.assemble(
        ("identified", "bold blue"),
        f"  {robot}: {found.rank} of {found.structural_rank} structurally identifiable base parameters are excited;"
        f" {base.count('identified')} are identified; condition number {found.condition:.4g}",
    )
    inconsistent = f"Not physically consistent: {', '.join(wrong)}."
    links = inconsistent if wrong else "All link inertias are physically consistent."
    parts: list[RenderableType] = [head, Text(links, style="yellow" if wrong else "")]
    parts += [Text(), _qualities(found), Text()]
    parts += [Text(_effect(effect)) for effect in found.effects]
    return Group(*parts, *_notes(found.notes, verbose))


def _effect(effect: FittedEffect) -> str:
    values = ", ".join(f"{name} {wording.interval(value)}" for name, value in effect.parameters.items())
    return f"{wording.phrase(effect.name)}: {values}"


def _qualities(found: Identification) -> RenderableType:
    """RMS residual of every joint on the data fitted, cross-validated, and on each held-out recording."""
    columns = {"nominal": found.nominal, "fit": found.fit, "cross-validated": found.validated} | found.holdout
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("RMS residual")
    for title in [*columns, "R2"]:
        table.add_column(Text(title), justify="right")
    table.add_column("")
    last = list(found.holdout.values())[-1] if found.holdout else found.validated
    for j, (joint, unit) in enumerate(zip(found.joints, found.torque_units, strict=True)):
        values = [wording.number(float(quality.rms[j]), 3) for quality in columns.values()]
        table.add_row(Text(joint), *values, f"{last.r2[j]:.4f}" if math.isfinite(last.r2[j]) else "–", unit)
    return table
