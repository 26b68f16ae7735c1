"""The page of a simulation: each joint's motion, against the positions of the file where it holds some."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..results import Trace
from ..rigid.model import RobotModel
from . import wording
from .picture import robot_picture
from .report import page_template, plot_data, plotly_source

__all__ = ["Motion", "write_simulation"]


class Motion(NamedTuple):
    """What the encoders of a simulation read, rad or m, and what the file has of these joints, NaN where nothing."""

    joints: tuple[str, ...]
    units: tuple[str, ...]
    time: Float[np.ndarray, " rows"]
    reading: Float[np.ndarray, "rows joints"]
    velocity: Float[np.ndarray, "rows joints"]
    measured: Float[np.ndarray, "rows joints"]


class _Joint(NamedTuple):
    """One joint as the page shows it; `rms` (rad or m) and `share` of its measured spread where it is measured."""

    name: str
    unit: str
    low: float
    high: float
    rms: float | None
    share: float | None  # None where it stands


def write_simulation(motion: Motion, answer: dict[str, Any], robot: RobotModel, path: Path) -> None:
    """Write the page of a simulation to `path`; `answer` is what `simulation.json` holds."""
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    seen = np.isfinite(motion.measured)
    trace = Trace(
        name=Path(answer["command"]).stem,
        role="holdout",
        time=motion.time,
        position=np.where(seen, motion.measured, motion.reading),
        velocity=motion.velocity,
        measured=motion.measured,
        before=motion.reading,
        after=motion.reading,
    )
    joints = _joints(motion, answer["error"] or {})
    text = page_template("simulation.html", path.parent).render(
        a=answer,
        robot=answer["robot"],
        sentence=_sentence(joints, answer),
        joints=joints,
        picture=Markup(robot_picture(robot)),
        recordings=[trace],
        css=Markup((page / "report.css").read_text("utf-8")),
        js=Markup((page / "report.js").read_text("utf-8")),
        data=Markup(plot_data(np.zeros(len(joints)), motion.units, [trace], "position", alone=True)),
        plotly=Markup(plotly_source()),
    )
    path.write_text(text, encoding="utf-8")


def _joints(motion: Motion, errors: dict[str, Any]) -> list[_Joint]:
    found = []
    for k, (name, unit) in enumerate(zip(motion.joints, motion.units, strict=True)):
        rms = errors[name]["rms"] if name in errors else None
        spread = 0.0 if rms is None else float(motion.measured[:, k].std())
        share = rms / spread if rms is not None and spread > 0 else None
        found.append(
            _Joint(name, unit, float(motion.reading[:, k].min()), float(motion.reading[:, k].max()), rms, share)
        )
    return found


def _sentence(joints: list[_Joint], answer: dict[str, Any]) -> str:
    file = Path(answer["command"]).name
    moved = f"{answer['robot']} was simulated for {wording.number(answer['duration'], 4)} s by the commands of {file}"
    measured = [joint for joint in joints if joint.rms is not None]
    if not measured:
        return f"{moved}, which holds no positions to compare with."
    worst = max(measured, key=lambda joint: (joint.share or 0.0, joint.rms or 0.0))
    share = "" if worst.share is None else f", {wording.number(100 * worst.share, 2)} % of its motion"
    apart = f"{wording.error(worst.rms or 0.0, worst.unit)} RMS{share}"
    if len(measured) == 1:
        return f"{moved}: {worst.name} is {apart} from its measured position."
    return f"{moved}: {worst.name} is farthest from its measured position, {apart}."
