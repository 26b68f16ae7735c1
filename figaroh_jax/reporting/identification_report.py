"""The page of an identification: the report's style and plots around its own tables."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..identification.result import FittedEffect, Identification, Link, Quality
from ..rigid.inertia import pseudo_inertia, to_com
from . import wording
from .report import page_template, plot_data, plotly_source

__all__ = ["write_identification"]

BORDER = 1e-3  # of the largest second moment: a smaller one is that of a sheet or a rod
SHORT = {
    "viscous_friction": "viscous",
    "coulomb_friction": "Coulomb",
    "rotor_inertia": "rotor inertia",
    "torque_offset": "offset",
}


class DriveTable(NamedTuple):
    """Friction and drives as a table of joints; what does not fit into it stands in `others`."""

    columns: list[tuple[str, str]]  # title, unit
    rows: list[tuple[str, list[str]]]
    others: list[FittedEffect]


def write_identification(found: Identification, path: Path, title: str, *, model_written: bool = True) -> None:
    """Write the page of an identification to `path`; `title` is the robot's name."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    roles = [trace.role for trace in found.traces]
    kinds = {"given links": found.nominal, "free links": found.unconstrained, "fit": found.fit}
    judged = list(found.holdout.values())[-1] if found.holdout else found.validated
    text = page_template("identification.html", path.parent).render(
        d=found,
        robot=title,
        columns=kinds | {"cross-validated": found.validated} | found.holdout,
        predicts=_predicts(found, judged),
        drives=drive_table(found),
        links=[_described(found, k, link) for k, link in enumerate(found.links)],
        identified=sum(one.status == "identified" for one in found.base),
        judged=judged,
        wrong=[link for link in found.links if not link.consistent],
        recordings=found.traces,
        shown=roles.index("holdout") if "holdout" in roles else 0,
        files=["predictions", *(["model"] if model_written else [])],
        css=Markup((page / "report.css").read_text("utf-8")),
        js=Markup((page / "report.js").read_text("utf-8")),
        data=Markup(plot_data(np.zeros(len(found.joints)), found.torque_units, found.traces)),
        plotly=Markup(plotly_source()),
    )
    path.write_text(text, encoding="utf-8")


def _predicts(found: Identification, judged: Quality) -> str:
    """How well torque that was not fitted is told, in words."""
    r2 = judged.r2[np.isfinite(judged.r2)]
    what = "Held-out torque" if found.holdout else "Torque of stretches left out in turn"
    if not r2.size:
        return "No torque could be predicted"
    return f"{what} is predicted with R² of {wording.number(float(r2.min()), 3)} to {float(r2.max()):.3f}"


def drive_table(found: Identification) -> DriveTable:
    """Effects of one parameter at one joint, those of a kind in a column with their common unit."""
    single = [
        e for e in found.effects if len(e.name.at) == 1 and len(e.parameters) == 1 and e.name.at[0] in found.joints
    ]
    kinds = list(dict.fromkeys(e.name.effect for e in single))
    values = {(e.name.at[0], e.name.effect): next(iter(e.parameters.values())) for e in single}
    units = {kind: {x.unit for (_, other), x in values.items() if other == kind} for kind in kinds}
    common = {kind: next(iter(own)) if len(own) == 1 else "" for kind, own in units.items()}

    def cell(joint: str, kind: str) -> str:
        if (joint, kind) not in values:
            return ""
        estimate = values[joint, kind]
        return wording.interval(estimate._replace(unit="") if common[kind] else estimate)

    columns = [(SHORT.get(kind, wording.effect_title(kind)), wording.unit(common[kind])) for kind in kinds]
    rows = [(joint, [cell(joint, kind) for kind in kinds]) for joint in found.joints]
    return DriveTable(columns, rows, [e for e in found.effects if e not in single])


def _described(found: Identification, k: int, link: Link) -> dict[str, Any]:
    """A link in a reader's numbers."""
    mass, com, inertia = (np.asarray(part) for part in to_com(link.parameters))
    mass_of = found.parameters[10 * k]
    values = np.linalg.eigvalsh(pseudo_inertia(link.parameters)) if np.isfinite(link.parameters).all() else np.zeros(4)
    border = values[0] < BORDER * abs(values[-2])
    moments = np.linalg.eigvalsh(inertia) if np.isfinite(inertia).all() else np.full(3, np.nan)
    return {
        "name": link.name,
        "mass": wording.number(float(mass), 3),
        "told": "data" if mass_of.status == "identified" else "prior" if mass_of.status == "prior only" else "",
        "com": " ".join(wording.number(round(1e3 * float(x), 1), 4) for x in com),
        "moments": " ".join(wording.number(float(x), 2) for x in moments),
        "exists": ("border" if border else "yes") if link.consistent else "no",
    }
