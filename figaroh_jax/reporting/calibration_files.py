"""A calibration for other programs and readers: `result.json`, `report.html` and `model/`.

`model/robot.urdf` is the robot's own file with the origins of the corrected joints; `model/robot.xml` the same as MJCF;
`model/calibration.yaml` the corrections, the effects that no URDF can carry, and the metrology frames;
`model/master_calibration.yaml` what PAL's robot_state_publisher adds to the origins of the nominal URDF.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.calibrated import Calibration, Error, quality_of
from ..calibration.corrections import twist_pose
from ..effects.extended import extend
from ..errors import InputError
from ..formats.export import dump_yaml, model_files
from ..formats.urdf import load_urdf
from ..formats.urdf_text import roll_pitch_yaw
from ..formats.xmlfile import read_xml
from ..results import finite
from ..rigid.kinematics import forward_kinematics
from .answer import cause, rest as rest_of
from .calibration_report import write_calibration_report

if TYPE_CHECKING:
    from ..calibration.kinematic_diagnosis import PoseDiagnosis

__all__ = ["corrected_urdf", "origin_changes", "pose_answer_json", "result", "to_json", "write_calibration"]

_PARITY = 1e-9  # m and entries of the rotation, between the model and the file read back


def write_calibration(calibration: Calibration, folder: Path, source: Path, found: PoseDiagnosis | None = None) -> None:
    """Write everything that the contract asks of a calibration; `source` is the robot's own URDF.

    The page begins with the verdict of the diagnosis `found` that the calibration belongs to.
    """

    write_calibration_report(calibration, folder / "report.html", found)
    model = folder / "model"
    model.mkdir()
    (model / "calibration.yaml").write_text(dump_yaml(_corrections(calibration)), encoding="utf-8")
    if source.suffix.lower() == ".urdf":
        (model / "robot.urdf").write_text(corrected_urdf(calibration, source), encoding="utf-8")
        (model / "master_calibration.yaml").write_text(dump_yaml(origin_changes(calibration, source)), encoding="utf-8")
    parity = _parity(calibration, model / "robot.urdf") if source.suffix.lower() == ".urdf" else None
    content = result(calibration) | {"fk_parity": parity}
    (folder / "result.json").write_text(_json(content), encoding="utf-8")
    _write_mjcf(calibration, model / "robot.xml")


def result(calibration: Calibration) -> dict[str, Any]:
    """The calibration as the dictionary of `result.json`; a number that is not finite becomes None (JSON null)."""

    return {
        "level": calibration.level,
        "parameters": [
            {"name": p.name, "value": finite(p.value), "std": finite(p.std), "unit": p.unit, "status": p.status}
            for p in calibration.parameters
        ],
        "position": _error(calibration.position),
        "orientation": _error(calibration.orientation),
        "distances": [
            {"recording": d.recording, "role": d.role, "unit": "mm"}
            | {key: finite(1e3 * value) for key, value in zip(("stated", "before", "after"), d[2:], strict=True)}
            for d in calibration.distances
        ],
        "outliers": [{"file": o.file, "row": o.row} for o in calibration.outliers],
        "verdict": calibration.verdict,
        "causes": [cause(c) for c in calibration.causes],
        "frames": {name: np.asarray(value).tolist() for name, value in calibration.frames.items()},
        "levels": {
            name: {"position": finite(1e3 * a), "orientation": finite(math.degrees(b))}
            for name, (a, b) in calibration.table.items()
        },
        "held_out": calibration.scheme,
        "rank": calibration.rank,
        "condition": finite(calibration.condition),
        "classes": [list(c) for c in calibration.classes],
        "correlations": [{"one": a, "other": b, "value": finite(r)} for a, b, r in calibration.correlations],
        "quality": [q._asdict() | {"r2": finite(q.r2)} for q in quality_of(calibration)],
        "converged": calibration.converged,
        "unexplained": None if calibration.unexplained is None else finite(calibration.unexplained),
        "notes": list(calibration.notes),
    }


def to_json(calibration: Calibration) -> str:
    """The text of `result.json`: strict JSON, with a newline at its end."""
    return _json(result(calibration))


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def pose_answer_json(diagnosis: PoseDiagnosis) -> str:
    """The text of `answer.json` of a diagnosis of poses; residuals are RMS in mm and deg, as far as measured.

    `rest.relative` is what is left of each beyond the noise, over the RMS of the frames alone.
    """

    experiment = diagnosis.experiment
    answer = {
        "verdict": diagnosis.verdict,
        "causes": [cause(c) for c in diagnosis.causes],
        "p_value": finite(diagnosis.p_value),
        "residual": {
            key: [finite(x) for x in getattr(diagnosis, key) if x is not None] for key in ("before", "after", "noise")
        },
        "rest": rest_of(diagnosis.rest),
        "next_experiment": experiment
        and {"text": experiment.text, "separates": [list(pair) for pair in experiment.separates]},
        "notes": list(diagnosis.calibration.notes),
    }
    return json.dumps(answer, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def corrected_urdf(calibration: Calibration, source: Path) -> str:
    """The robot's own URDF with the origin of every corrected joint, all else as it was."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    root = read_xml(source, "robot")
    for joint, pose in _corrected_joints(calibration, root):
        origin = joint.find("origin")
        if origin is None:
            origin = etree.SubElement(joint, "origin")
        origin.set("xyz", " ".join(repr(float(x)) for x in pose[:3, 3]))
        origin.set("rpy", " ".join(repr(float(x)) for x in roll_pitch_yaw(pose[:3, :3])))
    return '<?xml version="1.0"?>\n' + etree.tostring(root, encoding="unicode") + "\n"


def _corrected_joints(calibration: Calibration, root: Any) -> Iterator[tuple[Any, np.ndarray]]:
    """Joint elements whose origin changes, with the new pose."""
    for joint in root.iterchildren("joint"):
        twist = calibration.twists.get(joint.get("name"))
        if twist is not None and twist.any():
            origin = joint.find("origin")
            yield joint, _origin({} if origin is None else origin) @ twist_pose(twist)


def origin_changes(calibration: Calibration, source: Path) -> dict[str, Any]:
    """What to add to `xyz` (m) and `rpy` (rad) of the joints of the URDF `source`, in the layout of PAL's robots.

    The angles are those whose sum with the ones written in the URDF gives the corrected rotation, the smaller ones of
    the two triplets that do.
    """

    found = {}
    for joint, pose in _corrected_joints(calibration, read_xml(source, "robot")):
        origin = joint.find("origin")
        written = {} if origin is None else origin
        xyz, rpy = (np.array([float(x) for x in written.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
        roll, pitch, yaw = roll_pitch_yaw(pose[:3, :3])
        both = np.array([[roll, pitch, yaw], [roll + np.pi, np.pi - pitch, yaw + np.pi]]) - rpy
        turns = (both + np.pi) % (2.0 * np.pi) - np.pi
        change = [*(pose[:3, 3] - xyz), *min(turns, key=np.linalg.norm)]
        name = joint.get("name").removesuffix("_joint")
        for key, value in zip(("dx", "dy", "dz", "droll", "dpitch", "dyaw"), change, strict=True):
            if abs(value) > 1e-12:
                found[f"{name}_{key}"] = float(value)
    return {"robot_state_publisher": {"geometric_calibration": found}}


def _origin(element: Any) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, 3] = [float(x) for x in element.get("xyz", "0 0 0").split()]
    pose[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in element.get("rpy", "0 0 0").split()]).as_matrix()
    return pose


def _parity(calibration: Calibration, urdf: Path) -> float:
    """Largest difference (m) of the file, read back, from the calibrated model in 100 random postures."""

    model = calibration.model
    again = load_urdf(urdf, joints=model.joint_names, posture=calibration.posture, kinematic=True)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, model.nv))
    off = float(np.abs(np.asarray(forward_kinematics(model, q)) - np.asarray(forward_kinematics(again, q))).max())
    if not off < _PARITY:
        raise InputError(
            f"{urdf.name}: read back, it differs from the calibrated model by {off:.2g} m; please report it"
        )
    return off


def _write_mjcf(calibration: Calibration, path: Path) -> None:

    try:
        text = model_files(extend(calibration.model))["robot.xml"]
    except InputError:  # links that MuJoCo could not move
        return
    path.write_text(text, encoding="utf-8")


def _corrections(calibration: Calibration) -> dict[str, Any]:
    """Corrections in the way controllers take them: offsets by joint, twists of placements, frames, effects."""
    effects = [p for p in calibration.parameters if p.name.split()[0] not in _PLAIN]
    return {
        "level": calibration.level,
        "offsets": {
            p.name.split(" ", 1)[1]: float(p.value) for p in calibration.parameters if p.name.startswith("joint_offset")
        },
        "placements": {name: [float(x) for x in twist] for name, twist in calibration.twists.items()},
        "frames": {name: np.asarray(value).tolist() for name, value in calibration.frames.items()},
        "effects": [{"name": p.name, "value": float(p.value), "std": float(p.std), "unit": p.unit} for p in effects],
    }


_PLAIN = ("joint_offset", "link_geometry", "base_frame", "tool_frame", "socket", "plane", "anchor")


def _error(error: Error | None) -> dict[str, Any] | None:
    if error is None:
        return None
    return {"unit": error.unit} | {
        key: finite(getattr(error, key)) for key in ("before", "after", "validated_before", "validated_after")
    }
