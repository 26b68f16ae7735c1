"""The page and the terminal's summary of an identification from commands and positions."""

from __future__ import annotations

import sys
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..results import Estimate
from ..rollouts.identification import RolloutIdentification
from . import wording
from .picture import robot_picture
from .report import page_template, plot_data, plotly_source

__all__ = ["show_rollouts", "write_rollouts"]

TITLES = {
    "armature": "armature",
    "friction": "Coulomb friction",
    "kp": "gain kp",
    "kd": "gain kd",
    "scale": "drive gain",
    "delay": "command delay",
    "dead_band": "dead band",
    "voltage": "voltage limit",
    "reading": "encoder offset",
    "offset": "torque offset",
    "load_ratio": "load-dependent friction",
}


_HEAD = "RMS position error"


class Quality(NamedTuple):
    """How far the simulation is from the recording at a joint: RMS (rad or m), as given, as fitted, held out."""

    joint: str
    unit: str
    given: float
    fitted: float
    noise: float
    relative: float  # of the position's spread; held out where recordings are
    r2: float


def write_rollouts(found: RolloutIdentification, path: Path, title: str) -> None:
    """Write the page of `found` to `path`; `title` is the robot's name."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    qualities, held = _qualities(found), bool(found.result["holdout"])
    roles = [trace.role for trace in found.traces]
    text = page_template("rollouts.html", path.parent).render(
        d=found,
        robot=title,
        sentence=_sentence(found, title),
        held=held,
        errors=[(unit, _pooled(found, "before", unit), _pooled(found, "after", unit)) for unit in _units(found)],
        table=_table(found),
        parameters=[one | {"interval": _interval(one), "title": _title(one)} for one in _parameters(found)],
        doubtful=[one | {"title": _title(one)} for one in _parameters(found) if one["status"] != "identified"],
        trades=[note for note in found.result["notes"] if "trade off" in note],
        notes=[note for note in found.result["notes"] if "trade off" not in note],
        qualities=qualities,
        picture=Markup(robot_picture(found.model.robot)),
        recordings=found.traces,
        shown=roles.index("holdout") if "holdout" in roles else 0,
        css=Markup((page / "report.css").read_text("utf-8")),
        js=Markup((page / "report.js").read_text("utf-8")),
        data=Markup(plot_data(np.array(found.result["fit"]["noise"]), found.units, found.traces, "position")),
        plotly=Markup(plotly_source()),
    )
    path.write_text(text, encoding="utf-8")


def show_rollouts(found: RolloutIdentification, robot: str, *, verbose: bool = False) -> None:
    """Print the summary on standard output: the error first, then every number with its interval.

    The notes are counted, but for the one that the numbers are not to be believed; `verbose` shows them.
    """
    sizes = {_title(one): (_interval(one), one["status"]) for one in _parameters(found)}
    name = max(map(len, [*sizes, _HEAD, *found.joints]))
    width = max((len(text) for text, _ in sizes.values()), default=0)
    lines = [f"identified  {_sentence(found, robot)}", ""]
    lines += [
        f"{key:<{name}}  {text:<{width}}{'' if status == 'identified' else '  ' + status}".rstrip()
        for key, (text, status) in sizes.items()
    ]
    lines += ["", f"{_HEAD:<{name}}  {'as given':>10}  {'fitted':>10}"]
    lines += [
        f"{q.joint:<{name}}  {wording.number(q.given, 3):>10}  {wording.number(q.fitted, 3):>10}  {q.unit}"
        for q in _qualities(found)
    ]
    notes = found.result["notes"]
    counted = [note for note in notes if not verbose and not note.startswith("the fit leaves")]
    shown = [f"Note: {note}" for note in notes if note not in counted]
    if counted:
        count = f"{len(counted)} note{'s'[: len(counted) != 1]}"
        shown.append(f"{count} on the data: in the report, or with --verbose")
    print(wording.fitted("\n".join([*lines, "", *shown]).rstrip()), file=sys.stdout)


def _parameters(found: RolloutIdentification) -> list[dict[str, Any]]:
    return found.result["base_parameters"]


def _title(one: dict[str, Any]) -> str:
    kind, _, place = one["expression"].partition(" ")
    return f"{_kind(kind)} {place}"


def _kind(name: str) -> str:
    return TITLES.get(name, name.replace("_", " "))


def _interval(one: dict[str, Any], unit: str | None = None) -> str:
    std = np.inf if one["std"] is None else one["std"]
    return wording.interval(Estimate(one["value"], std, one["unit"] if unit is None else unit))


def _table(found: RolloutIdentification) -> dict[str, Any]:
    """Numbers by joint (rows) and kind (columns) with their unit; in the cells where only some joints turn."""
    parts = [(*one["expression"].partition(" ")[::2], one) for one in _parameters(found)]
    units = {kind: {one["unit"] for other, _, one in parts if other == kind} for kind, _, _ in parts}
    kinds = {kind: next(iter(each)) if len(each) == 1 else "" for kind, each in units.items()}
    places = list(dict.fromkeys(place for _, place, _ in parts))
    cells = {(place, kind): _interval(one, "" if len(units[kind]) == 1 else None) for kind, place, one in parts}
    return {
        "columns": [(_kind(kind), wording.unit(unit)) for kind, unit in kinds.items()],
        "rows": [(place, [cells.get((place, kind), "") for kind in kinds]) for place in places],
    }


def _sentence(found: RolloutIdentification, robot: str) -> str:
    good = sum(one["status"] == "identified" for one in _parameters(found))
    judged = list(found.result["holdout"].values()) or [found.result["fit"]]
    shares = [100 * x for one in judged for x in one["relative"] if x is not None]
    numbers = f"{good} of {len(_parameters(found))} numbers of {robot} are identified."
    if not shares:  # nothing moves
        return numbers
    what = "Held-out motions are" if found.result["holdout"] else "Fitted stretches are"
    return (
        f"{what} simulated from the command with an error of at most {wording.number(max(shares), 2)} % of each joint's"
        f" motion; {numbers}"
    )


def _qualities(found: RolloutIdentification) -> list[Quality]:
    fit, held = found.result["fit"], list(found.result["holdout"].values())
    rows = []
    for j, (joint, unit) in enumerate(zip(found.joints, found.units, strict=True)):
        shares = [one["relative"][j] for one in held or [fit] if one["relative"][j] is not None]
        share = max(shares, default=float("nan"))  # of a joint that stands there is none
        given, fitted = _rms(found, "before", j), _rms(found, "after", j)
        rows.append(Quality(joint, unit, given, fitted, fit["noise"][j], share, 1 - share**2))
    return rows


def _rms(found: RolloutIdentification, which: str, joint: int) -> float:
    """Over the held-out recordings, or all where there are none; NaN where a simulation has diverged."""
    kept = [t for t in found.traces if t.role == "holdout"] or found.traces
    parts = [(t.measured - getattr(t, which))[:, joint] for t in kept if t.measured is not None]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _units(found: RolloutIdentification) -> list[str]:
    """The units of the joints' positions, each once."""
    return list(dict.fromkeys(found.units))


def _pooled(found: RolloutIdentification, which: str, unit: str) -> float:
    """Of all joints of one unit: no number holds rad and m."""
    mine = [j for j, own in enumerate(found.units) if own == unit]
    return float(np.sqrt(np.mean([_rms(found, which, j) ** 2 for j in mine])))
