"""The page of a calibration: what was gained, why this level, the errors as arrows in space, every parameter."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.calibrated import Calibration, Shown
from . import wording
from .report import page_template, plotly_source

__all__ = ["write_calibration_report"]

_COLOURS = {"before": "#c2410c", "after": "#0f766e"}


def write_calibration_report(calibration: Calibration, path: Path) -> None:
    """Write the page, one file that needs no network."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    text = page_template("calibration.html").render(
        c=calibration,
        robot=calibration.model.name,
        sentence=wording.calibration_sentence(calibration),
        level=wording.level,
        distances=wording.distances(calibration),
        errors=[error for error in (calibration.position, calibration.orientation) if error is not None],
        table=[(name, 1e3 * a, np.degrees(b)) for name, (a, b) in calibration.table.items()],
        quality=_quality(calibration),
        css=Markup((page / "report.css").read_text("utf-8")),
        plotly=Markup(plotly_source()),
        figure=Markup(_figure(calibration)),
    )
    path.write_text(text, encoding="utf-8")


def _quality(calibration: Calibration) -> list[tuple[str, str, list[float]]]:
    """For each recording and axis: mean, std, RMSE, max of the error after (mm), and R2 of the points."""
    rows = []
    for shown in calibration.points:
        for axis, name in enumerate("xyz"):
            error = 1e3 * shown.after[:, axis]
            spread = 1e3 * np.std(shown.at[:, axis])
            r2 = 1.0 - np.mean(error**2) / spread**2 if spread > 0.0 else float("nan")
            size = [error.mean(), error.std(), np.sqrt(np.mean(error**2)), np.abs(error).max(), r2]
            rows.append((shown.name, name, [float(x) for x in size]))
    return rows


def _figure(calibration: Calibration) -> str:
    """Traces of plotly as JSON that may stand inside a script element: arrows, drawn longer than they are."""
    shown = [s for s in calibration.points if np.ptp(s.at) > 0.0]
    if not shown:
        return "[]"
    size = max(float(np.ptp(np.concatenate([s.at for s in shown]), axis=0).max()), 1e-6)
    longest = max(float(np.linalg.norm(s.before, axis=1).max()) for s in shown)
    stretch = 0.15 * size / max(longest, 1e-12)
    traces = [_arrows(shown, which, stretch) for which in ("before", "after")]
    return json.dumps(traces, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _arrows(shown: list[Shown], which: str, stretch: float) -> dict[str, Any]:
    ends: dict[str, list[float | None]] = {axis: [] for axis in "xyz"}
    text: list[str] = []
    for part in shown:
        for point, error, row in zip(part.at, getattr(part, which), part.row, strict=True):
            for k, axis in enumerate("xyz"):
                ends[axis] += [float(point[k]), float(point[k] + stretch * error[k]), None]
            text += [f"{part.name}, row {row}: {1e3 * np.linalg.norm(error):.3g} mm"] * 3
    line = {"color": _COLOURS[which], "width": 5}
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": f"{which} (x {stretch:.0f})",
        "line": line,
        "text": text,
    } | ends
