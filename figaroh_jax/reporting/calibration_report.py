"""The page of a calibration: what was gained, why this level, the errors as arrows in space, every parameter."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from ..calibration.calibrated import Calibration, Shown, quality_of
from ..calibration.corrections import twist_pose
from ..rigid.model import RobotModel
from . import wording
from .picture import middle_posture, robot_picture, segments
from .report import BADGES, page_template, plotly_source

if TYPE_CHECKING:
    from ..calibration.kinematic_diagnosis import PoseDiagnosis

__all__ = ["nominal_of", "write_calibration_report"]


def write_calibration_report(calibration: Calibration, path: Path, found: PoseDiagnosis | None = None) -> None:
    """Write the page, one file that needs no network; with the verdict of a diagnosis, where it belongs to one."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    text = page_template("calibration.html", path.parent).render(
        picture=Markup(_picture(calibration)),
        magnify=_magnified(calibration),
        c=calibration,
        robot=calibration.model.name,
        sentence=wording.calibration_sentence(calibration),
        found=found,
        badge=wording.level(calibration.level) if found is None else BADGES[found.verdict],
        verdict="" if found is None else wording.pose_sentence(found, calibration.model.name),
        level=wording.level,
        distances=wording.distances(calibration),
        errors=[error for error in (calibration.position, calibration.orientation) if error is not None],
        table=[(name, 1e3 * a, np.degrees(b)) for name, (a, b) in calibration.table.items()],
        quality=quality_of(calibration),
        stretch=_stretch(_shown(calibration)),
        parameters={
            status: [p for p in calibration.parameters if p.status == status]
            for status in ("identified", "prior only", "gauge")
        },
        css=Markup((page / "report.css").read_text("utf-8")),
        plotly=Markup(plotly_source()),
        figure=Markup(_figure(calibration)),
    )
    path.write_text(text, encoding="utf-8")


def nominal_of(calibration: Calibration) -> RobotModel:
    """The robot before its corrections."""
    placement = np.array(calibration.model.placement)
    for k, joint in enumerate(calibration.model.joints):
        if joint.name in calibration.twists:
            placement[k] = placement[k] @ np.linalg.inv(twist_pose(calibration.twists[joint.name]))
    return eqx.tree_at(lambda m: m.placement, calibration.model, placement)


_MAGNIFY = (20, 10, 5, 2, 1)  # times that differences are drawn, the first that leaves the robot to be seen
_APART = 0.3  # of the robot's size, between the two as drawn


def _magnified(calibration: Calibration) -> int:
    """How many times as large as they are differences of the two robots are drawn."""
    q = middle_posture(calibration.model)
    own, nominal = segments(calibration.model, q), segments(nominal_of(calibration), q)
    size = np.ptp(nominal.reshape(-1, 3), axis=0).max()
    off = np.linalg.norm(own - nominal, axis=-1).max()
    return next((times for times in _MAGNIFY if times * off <= _APART * size), _MAGNIFY[-1])


def _picture(calibration: Calibration) -> str:
    affected = {name for cause in calibration.causes for name in cause.name.at} | calibration.twists.keys()
    nominal, times = nominal_of(calibration), float(_magnified(calibration))
    return robot_picture(calibration.model, affected=affected, nominal=nominal, magnify=times)


def _shown(calibration: Calibration) -> list[Shown]:
    return [part for part in calibration.points if np.ptp(part.at) > 0.0]


def _stretch(shown: list[Shown]) -> int:
    """How much longer than they are arrows are drawn: all but the few longest then stay apart."""
    if not shown:
        return 1
    size = float(np.ptp(np.concatenate([part.at for part in shown]), axis=0).max())
    long = float(np.quantile(np.concatenate([np.linalg.norm(part.before, axis=1) for part in shown]), 0.9))
    return max(1, round(0.1 * size / max(long, 1e-12)))


def _figure(calibration: Calibration) -> str:
    """Traces of plotly as JSON that may stand inside a script element: arrows, and sizes by row."""
    shown = _shown(calibration)
    both = ("before", "after")
    traces = {
        "space": [_arrows(shown, which, _stretch(shown)) for which in both] if shown else [],
        "rows": [_sizes(part, which) for part in shown for which in both],
    }
    return json.dumps(traces, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _sizes(part: Shown, which: str) -> dict[str, Any]:
    size = 1e3 * np.linalg.norm(getattr(part, which), axis=1)
    return {
        "type": "scatter",
        "mode": "markers",
        "name": which,
        "x": part.row,
        "y": size.tolist(),
        "marker": {"size": 6},
    }


def _arrows(shown: list[Shown], which: str, stretch: int) -> dict[str, Any]:
    ends: dict[str, list[float | None]] = {axis: [] for axis in "xyz"}
    text: list[str] = []
    for part in shown:
        for point, error, row in zip(part.at, getattr(part, which), part.row, strict=True):
            for k, axis in enumerate("xyz"):
                ends[axis] += [float(point[k]), float(point[k] + stretch * error[k]), None]
            text += [f"{part.name}, row {row}: {1e3 * np.linalg.norm(error):.3g} mm"] * 3
    return {"name": which, "text": text} | ends
