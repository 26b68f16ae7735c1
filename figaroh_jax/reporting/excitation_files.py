"""What a design of motions writes: the answer, the motions at 1 kHz, a ROS 2 JointTrajectory, the page."""

from __future__ import annotations

import json
import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..excitation.design import Design, torque_of
from ..excitation.information import UNKNOWN_DRIVE
from ..excitation.limits import CHECK_RATE, Use
from ..excitation.postures import PostureDesign
from ..excitation.sampling import Sampler
from ..excitation.search import Stage
from ..excitation.separation import MOST
from ..results import finite
from ..rigid.model import prismatic
from .report import page_template

__all__ = ["answer", "failure", "summary_lines", "to_json", "write_design", "write_postures"]

ANSWER, PAGE = "excitation.json", "report.html"
POINTS = 50.0  # Hz of the points of a JointTrajectory, which controllers join by quintics
_DRAWN = 400  # points of a curve on the page
OPEN = 0.9 / math.sqrt(UNKNOWN_DRIVE)  # a deviation that says that nothing is known


def to_json(found: Design | PostureDesign) -> str:
    """The text of `excitation.json`."""
    content = answer(found) if isinstance(found, Design) else posture_answer(found)
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def answer(found: Design) -> dict[str, Any]:
    """The answer as JSON has it; what is not finite is null."""
    return {
        "format": 1,
        "kind": "trajectory",
        "robot": found.learned.robot.name,
        "joints": list(found.learned.robot.dof_names),
        "objective": found.objective,
        "logdet": finite(found.logdet),
        "condition": finite(found.condition),
        "scaled_condition": finite(found.scaled_condition),
        "met": found.met,
        "rate": found.rate,
        "noise": [finite(1 / math.sqrt(w)) for w in np.asarray(found.learned.weight)],
        "trajectories": [_stage(k, stage) for k, stage in enumerate(found.stages)],
        "parameters": [
            {"expression": name, "std_before": finite(before), "std": finite(after)}
            for name, before, after in zip(found.learned.expressions, found.std_before, found.std, strict=True)
        ],
        "separated": [
            {"cause": s.truth, "rival": s.rival, "size": s.size, "sigmas": finite(s.sigmas), "repeats": s.repeats}
            | {"seconds": None if s.repeats is None else s.repeats * sum(one.motion.duration for one in found.stages)}
            for s in found.separated
        ],
        "notes": list(found.notes),
    }


def posture_answer(found: PostureDesign) -> dict[str, Any]:
    """The answer of a design of postures."""
    return {
        "format": 1,
        "kind": "postures",
        "robot": found.model.name,
        "joints": list(found.model.dof_names),
        "measurement": {
            "kind": found.instrument.kind,
            "base_frame": found.instrument.base_frame,
            "tool_frame": found.instrument.tool_frame,
            "accuracy": list(found.instrument.accuracy),
        },
        "postures": found.position.tolist(),
        "logdet": finite(found.logdet),
        "bound": finite(found.bound),
        "efficiency": finite(found.efficiency),
        "efficiency_of_candidates": finite(found.chosen_efficiency),
        "efficiency_of_random": finite(found.random_efficiency),
        "candidates": found.candidates,
        "parameters": [
            {"parameter": one.name, "unit": one.unit, "std": finite(std)}
            for one, std in zip(found.parameters, found.std, strict=True)
        ],
        "notes": list(found.notes),
    }


def _stage(k: int, stage: Stage) -> dict[str, Any]:
    basis = stage.motion.basis
    near = nearest_bodies(stage)
    own = {} if near is None else {"clearance": {"rate": POINTS, "distance": np.round(near[1], 6).tolist()}}
    return own | {
        "file": f"trajectory_{k + 1}.csv",
        "duration": stage.motion.duration,
        "logdet": finite(stage.logdet),
        "basis": {"kind": basis.kind, "number": basis.number, "base": basis.base},
        "start": np.asarray(stage.motion.start).tolist(),
        "weights": np.asarray(stage.motion.weights).tolist(),
        "use_at_1_kHz": [
            {"limit": u.kind, "joint": u.joint, "share": finite(u.share), "time": u.time, "value": finite(u.value)}
            | {"allowed": finite(u.limit)}
            for u in stage.uses
        ],
        "starts": [finite(value) for value in stage.starts],
    }


def nearest_bodies(stage: Stage) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (s) and the least distance (m) of two bodies by what surrounds them; None where none are looked at."""
    clearance = stage.clearance
    if clearance is None or not clearance.rows.names:
        return None
    time = stage.motion.basis.instants(POINTS)
    return time, clearance.distances(np.asarray(stage.motion.at(time)[0])).min(axis=1)


def failure(found: Design | PostureDesign) -> str | None:
    """What is not met at 1 kHz, in words; None where everything is."""
    if isinstance(found, PostureDesign):
        return None
    wrong = [
        f"trajectory {k + 1}: {_excess(use)}"
        for k, stage in enumerate(found.stages)
        if not stage.met
        for use in stage.uses
        if use.share > 1.0
    ]
    return "; ".join(wrong) or None


def _excess(use: Use) -> str:
    if use.kind == "clearance":
        return f"{use.joint} are {use.value:.4g} m apart at {use.time:.3f} s; the clearance is {use.limit:.4g} m"
    over = f"{use.share - 1:.1%} over its limit {use.limit:.4g}"
    return f"{use.kind} of '{use.joint}' is {use.value:.4g} at {use.time:.3f} s, {over}"


def posture_lines(found: PostureDesign) -> list[str]:
    """The design of postures in a few lines."""
    lines = [
        f"{found.model.name}: {len(found.position)} postures for {len(found.parameters)} parameters that a"
        f" {found.instrument.kind} can tell; {found.efficiency:.1%} of the certified bound of {found.candidates}"
        f" candidates (random choices {found.random_efficiency:.1%})"
    ]
    for unit, scale, name in (("m", 1e3, "mm"), ("rad", 1e3, "mrad")):
        own = [std for one, std in zip(found.parameters, found.std, strict=True) if one.unit == unit]
        if own:
            lines.append(f"expected standard deviations: {scale * min(own):.2g} to {scale * max(own):.2g} {name}")
    return [*lines, *(f"Note: {note}" for note in found.notes)]


def write_postures(found: PostureDesign, folder: Path) -> None:
    """Write the postures, the answer and the page into the directory."""
    from markupsafe import Markup

    (folder / ANSWER).write_text(to_json(found), encoding="utf-8")
    header = ",".join(found.model.dof_names)
    np.savetxt(folder / "postures.csv", found.position, delimiter=",", header=header, comments="", fmt="%.9g")
    page = resources.files("figaroh_jax") / "page"
    text = page_template("postures.html", folder).render(
        d=found,
        robot=found.model.name,
        lines=posture_lines(found),
        parameters=[
            (one.name, 1e3 * std, "mm" if one.unit == "m" else "mrad")
            for one, std in zip(found.parameters, found.std.tolist(), strict=True)
        ],
        css=Markup((page / "report.css").read_text("utf-8")),
    )
    (folder / PAGE).write_text(text, encoding="utf-8")


def summary_lines(found: Design | PostureDesign) -> list[str]:
    """The design in a few lines."""
    if isinstance(found, PostureDesign):
        return posture_lines(found)
    known = found.std_before < OPEN
    better = (found.std_before / found.std)[known]
    seconds = sum(stage.motion.duration for stage in found.stages)
    lines = [
        f"{found.learned.robot.name}: {_count(found)}, {seconds:g} s; log determinant {found.logdet:.2f} of the"
        f" information on {found.learned.rank} parameters, condition number {found.condition:.4g}"
        f" ({found.scaled_condition:.3g} with normalised columns)"
    ]
    if len(better):
        less = f"expected standard deviations fall {np.exp(np.log(better).mean()):.3g} times (geometric mean"
        unknown = found.learned.rank - len(better)
        lines.append(f"{less}; of {unknown} more nothing was known)" if unknown else f"{less})")
    for k, stage in enumerate(found.stages):
        used = ", ".join(
            f"{use.kind} {use.share:.1%} ({use.joint})" if use.kind != "clearance" else _apart(use)
            for use in stage.uses
        )
        lines.append(f"trajectory {k + 1}: largest use at 1 kHz: {used or 'no limits'}")
    for s in found.separated:
        lines.append(
            f"{s.truth} and {s.rival} differ by {s.sigmas:.2g} standard deviations; {_times(s.repeats, seconds)}"
        )
    return [*lines, *(f"Note: {note}" for note in found.notes)]


def _times(repeats: int | None, seconds: float) -> str:
    if repeats is None:
        return f"{MOST} repeats do not make the name sure: the links would have to be known better (`trust`)"
    return f"{'one run' if repeats == 1 else f'{repeats} repeats'} for a sure name, {repeats * seconds:g} s"


def _apart(use: Use) -> str:
    return f"{use.joint} {1e3 * use.value:.0f} mm apart (at least {1e3 * use.limit:.0f})"


def _count(found: Design) -> str:
    return "1 trajectory" if len(found.stages) == 1 else f"{len(found.stages)} trajectories"


def write_design(found: Design, folder: Path, model: Any) -> None:
    """Write everything into the directory; `model` is the robot with its effects."""
    (folder / ANSWER).write_text(to_json(found), encoding="utf-8")
    learned = found.learned
    torque = torque_of(model, learned, Sampler(learned.robot, learned.terms, np.asarray(learned.width)))
    drawn = []
    for k, stage in enumerate(found.stages):
        time = stage.motion.basis.instants(CHECK_RATE)
        q, v, a = (np.asarray(x) for x in stage.motion.at(time))
        tau = torque(np.stack([q, v, a]))
        name = f"trajectory_{k + 1}"
        np.savez_compressed(folder / f"{name}.npz", t=time, q=q, v=v, a=a, torque=tau)
        _write_table(folder / f"{name}.csv", learned.robot.dof_names, time, {"q": q, "v": v, "a": a, "torque": tau})
        (folder / f"{name}.yaml").write_text(joint_trajectory(learned.robot.dof_names, stage), encoding="utf-8")
        drawn.append((time, {"position": q, "velocity": v, "acceleration": a, "torque": tau}))
    (folder / PAGE).write_text(_page(found, drawn, folder), encoding="utf-8")


def _write_table(
    path: Path, joints: tuple[str, ...], time: Float[np.ndarray, " n"], arrays: dict[str, Float[np.ndarray, "n nv"]]
) -> None:
    header = ",".join(["t", *(f"{kind}_{joint}" for kind in arrays for joint in joints)])
    rows = np.column_stack([time, *arrays.values()])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")


def joint_trajectory(joints: tuple[str, ...], stage: Stage) -> str:
    """The motion as `trajectory_msgs/msg/JointTrajectory` in YAML, for `ros2 topic pub` or an action goal."""
    time = stage.motion.basis.instants(POINTS)
    states = [np.asarray(x) for x in stage.motion.at(time)]
    lines = ["joint_names:", *(f"- {json.dumps(name)}" for name in joints), "points:"]
    for k, t in enumerate(time):
        nanoseconds = round(float(t) * 1e9)
        for lead, key, values in zip("-  ", ("positions", "velocities", "accelerations"), states, strict=True):
            lines.append(f"{lead} {key}: [{', '.join(f'{x:.9g}' for x in values[k])}]")
        lines.append(f"  time_from_start: {{sec: {nanoseconds // 10**9}, nanosec: {nanoseconds % 10**9}}}")
    return "\n".join(lines) + "\n"


_LINEAR = {"position": "m", "velocity": "m/s", "acceleration": "m/s²", "torque": "N"}
_ANGULAR = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "torque": "N\N{NO-BREAK SPACE}m"}


def _page(found: Design, drawn: list[tuple[np.ndarray, dict[str, np.ndarray]]], folder: Path) -> str:
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    sliding = prismatic(found.learned.robot)
    return page_template("excitation.html", folder).render(
        d=found,
        robot=found.learned.robot.name,
        joints=list(found.learned.robot.dof_names),
        units=[_LINEAR if slides else _ANGULAR for slides in sliding],
        open=OPEN,
        seconds=sum(stage.motion.duration for stage in found.stages),
        lines=summary_lines(found),
        failure=failure(found),
        parameters=list(zip(found.learned.expressions, found.std_before.tolist(), found.std.tolist(), strict=True)),
        curves=[_curves(found, time, arrays) for time, arrays in drawn],
        near=[_near_curve(stage) for stage in found.stages],
        css=Markup((page / "report.css").read_text("utf-8")),
    )


def _curves(found: Design, time: np.ndarray, arrays: dict[str, np.ndarray]) -> list[list[dict[str, Any]]]:
    """For each joint: position, velocity and torque as points of a drawing with the limits."""
    out = []
    for j in range(found.learned.robot.nv):
        own = []
        for kind, values in arrays.items():
            limit = found.limits.of(kind)[j]
            ends = found.limits.position[j] if kind == "position" else np.array([-limit, limit])
            own.append(_curve(kind, time, values[:, j], ends))
        out.append(own)
    return out


def _near_curve(stage: Stage) -> dict[str, Any] | None:
    """The least distance between bodies against time, and the margin."""
    near, clearance = nearest_bodies(stage), stage.clearance
    if near is None or clearance is None:
        return None
    margin = clearance.margin
    return _curve("clearance", near[0], np.minimum(near[1], 10 * margin), np.array([margin]))


def _curve(kind: str, time: np.ndarray, values: np.ndarray, ends: np.ndarray) -> dict[str, Any]:
    """A curve and its limits in a box of 300 x 90."""
    kept = np.unique(np.linspace(0, len(time) - 1, _DRAWN).astype(int))
    shown = [x for x in ends.tolist() if math.isfinite(x)]
    low, high = min([float(values.min()), *shown]), max([float(values.max()), *shown])
    span = (high - low) or 1.0

    def y(x: float) -> float:
        return round(85 - 80 * (x - low) / span, 2)

    points = " ".join(f"{300 * time[k] / max(time[-1], 1e-9):.1f},{y(float(values[k]))}" for k in kept)
    return {"kind": kind, "points": points, "limits": [y(x) for x in shown], "low": float(values.min())} | {
        "high": float(values.max()),
        "allowed": shown,
    }
