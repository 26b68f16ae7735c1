"""Configurations of FIGAROH as task files: every key becomes a key of a task, or is listed with the reason why not.

Both of FIGAROH's layouts are read, the flat one (`calibration`, `identification`) and the unified one (`tasks`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ..errors import InputError
from ..formats.export import dump_yaml
from ..formats.robotfile import read_robot
from ..formats.taskfile import read_yaml
from .draft import draft_task
from .reading import read_table

__all__ = ["KEYS", "Migrated", "migrate"]

_SET = "is set anew by the data"
# Every key, by its last words: what it becomes here. A name that begins with a dot is a key of the task file.
KEYS: dict[str, str] = {
    "calib_level": "`calibrate --level joint_offset` or `full`; without it, what predicts best",
    "calibration_level": "`calibrate --level joint_offset` or `full`; without it, what predicts best",
    "non_geom": "nothing: compliance and other effects are taken in where they predict better",
    "include_non_geometric": "nothing: compliance and other effects are taken in where they predict better",
    "base_frame": ".data[].measurement.base_frame (`universe` is the root and is left out)",
    "tool_frame": ".data[].measurement.tool_frame",
    "markers": ".data[].measurement: as many points as markers",
    "ref_joint": "nothing: the place of a marker on the tool is estimated",
    "reference_joint": "nothing: the place of a marker on the tool is estimated",
    "measure": ".data[].measurement: `position` for three axes, `pose` for six",
    "measurable_dof": ".data[].measurement: `position` for three axes, `pose` for six",
    "sensor_type": "nothing: `accuracy` is what is known of a device",
    "free_flyer": ".robot.root",
    "free_flying_base": ".robot.root",
    "base_pose": "nothing: `unknown: [base_frame]` needs no first guess",
    "tip_pose": "nothing: `unknown: [tool_frame]` needs no first guess",
    "tool_pose": "nothing: `unknown: [tool_frame]` needs no first guess",
    "coeff_regularize": "nothing: priors have the size of what is unknown",
    "regularization_coefficient": "nothing: priors have the size of what is unknown",
    "outlier_eps": "nothing: outliers are found by their own statistics and named",
    "outlier_threshold": "nothing: outliers are found by their own statistics and named",
    "tolerance": "nothing: of a solver",
    "max_iterations": "nothing: of a solver",
    "data_file": ".data[].file",
    "source_file": ".data[].file",
    "sample_configs_file": "nothing: the postures stand in the recording",
    "sample_configurations_file": "nothing: the postures stand in the recording",
    "nb_sample": "nothing: all rows of the file are used",
    "number_of_samples": "nothing: all rows of the file are used",
    "camera_frame": ".data[].measurement.camera with `mount`; write it by hand",
    "reference_frame": ".data[].measurement.camera with `mount`; write it by hand",
    "active_joints": ".robot.joints",
    "position": "nothing: limits are those of the model",
    "velocity": "nothing: limits are those of the model",
    "acceleration": "nothing: limits are those of the model, or .excite.limits",
    "torque": "nothing: limits are those of the model",
    "q_lim_def": "nothing: limits are those of the model",
    "dq_lim_def": ".preprocess.gate where it is a list: slower samples are dropped",
    "ddq_lim_def": "nothing: limits are those of the model",
    "tau_lim_def": "nothing: limits are those of the model",
    "fv": f"nothing: viscous friction {_SET}",
    "viscous": f"nothing: viscous friction {_SET}",
    "fs": f"nothing: Coulomb friction {_SET}",
    "static": f"nothing: Coulomb friction {_SET}",
    "Ia": f"nothing: rotor inertia {_SET}",
    "actuator_inertias": f"nothing: rotor inertia {_SET}",
    "offset": f"nothing: the offset of the torque {_SET}",
    "joint_offsets": f"nothing: the offset of the torque {_SET}",
    "Iam6": f"nothing: inertia of the coupling {_SET}",
    "fvm6": f"nothing: damping of the coupling {_SET}",
    "fsm6": f"nothing: friction of the coupling {_SET}",
    "reduction_ratio": ".transmission, as a comment: it holds where the recording is on the motor side",
    "reduction_ratios": ".transmission, as a comment: it holds where the recording is on the motor side",
    "ratio_essential": "nothing: essential parameters are marked in the report",
    "has_friction": ".baseline.viscous and .baseline.coulomb",
    "friction": ".baseline.viscous and .baseline.coulomb",
    "has_joint_offset": ".baseline.offset",
    "joint_offset": ".baseline.offset",
    "has_actuator_inertia": ".baseline.rotor",
    "actuator_inertia": ".baseline.rotor",
    "has_coupled_wrist": ".baseline.effects: coupled_transmission at the last two joints",
    "coupled_joints": ".baseline.effects: coupled_transmission",
    "is_static_regressor": "nothing: friction and offset are fitted together with the links",
    "static_regressor": "nothing: friction and offset are fitted together with the links",
    "is_inertia_regressor": "nothing: the links are always fitted",
    "inertia_regressor": "nothing: the links are always fitted",
    "is_joint_torques": "nothing: the recording holds torque",
    "use_joint_torques": "nothing: the recording holds torque",
    "is_external_wrench": "`root: free_flyer` with the wrench as torque, in Python `SensorStates`",
    "include_external_forces": "`root: free_flyer` with the wrench as torque, in Python `SensorStates`",
    "force_torque": "`root: free_flyer` with the wrench as torque, in Python `SensorStates`",
    "force_torque_sensors": "`root: free_flyer` with the wrench as torque, in Python `SensorStates`",
    "external_wrench_offsets": ".baseline.offset",
    "external_force_offsets": ".baseline.offset",
    "embedded_forces": "nothing: wrenches are in the root's own axes",
    "wls": "nothing: rows are always weighted by their joint's noise",
    "cut_off_frequency_butterworth": ".preprocess.cutoff",
    "cutoff_frequency": ".preprocess.cutoff",
    "filter_type": "nothing: the filter has no phase and is the same for torque and regressor",
    "filter_order": "nothing: the filter has no phase and is the same for torque and regressor",
    "ts": ".data[].rate",
    "sampling_frequency": ".data[].rate",
    "mass_load": ".data[].load.mass; write its frame by hand",
    "additional_mass": ".data[].load.mass; write its frame by hand",
    "which_body_loaded": ".data[].load.frame; write it by hand",
    "loaded_body_index": ".data[].load.frame; write it by hand",
    "sync_joint_motion": "nothing: FIGAROH does not use it",
    "synchronize_joint_motion": "nothing: FIGAROH does not use it",
    "n_wps": ".excite.basis.quintic",
    "waypoints": ".excite.basis.quintic",
    "t_s": ".excite.duration, times the stretches between waypoints",
    "segment_duration": ".excite.duration, times the stretches between waypoints",
    "freq": "nothing: trajectories are written at 1 kHz",
    "frequency": "nothing: trajectories are written at 1 kHz",
    "soft_lim": ".excite.limits: narrower ones by hand",
    "joint_limit_margin": ".excite.limits: narrower ones by hand",
    "velocity_scaling": ".excite.limits.velocity by hand",
    "acceleration_scaling": ".excite.limits.acceleration by hand",
    "jerk_limit": "nothing: the bases are smooth",
    "max_attempts": "nothing: every start is improved by gradient",
    "max_optimization_attempts": "nothing: every start is improved by gradient",
}
_BRANCHES = (  # what stands below them describes the file, the place or an output, and no task
    "meta",
    "description",
    "name",
    "instance",
    "custom",
    "variants",
    "variables",
    "environment",
    "output",
    "collision_checking",
    "workspace_bounds",
    "optimal_configuration",
    "enabled",
    "type",
    "inherits_from",
    "extends",
)


class Migrated(NamedTuple):
    """A task file, and one line for every key of the configuration: what became of it."""

    text: str
    keys: tuple[str, ...]


def migrate(config: Path, model: Path, recordings: Sequence[Path] = (), *, job: str | None = None) -> Migrated:
    """The task of a configuration of FIGAROH for the robot `model`; `recordings` are drafted as `new` does.

    `job` is "identify" or "calibrate"; None: what the configuration holds, the first of both.

    Raises `InputError` for a file that is none, and for a recording that cannot be read.
    """
    content = _inherited(config)
    if not {"calibration", "identification", "tasks"} & content.keys():
        raise InputError(f"{config}: holds none of calibration, identification, tasks: no configuration of FIGAROH")
    found = dict(_leaves(content))
    lines = tuple(f"{path}: {_becomes(path)}" for path in found)
    get = _getter(found)
    joints = get("active_joints") or None
    keys: dict[str, Any] = {"robot": {"model": str(model.resolve())}}
    if get("free_flyer", "free_flying_base"):
        keys["robot"]["root"] = "free_flyer"
    if recordings:
        drafted = yaml.safe_load(draft_task(model, recordings, joints=joints).text)
        keys = drafted | {"robot": drafted["robot"] | keys["robot"]}
    if joints and not recordings:
        keys["robot"]["joints"] = list(joints)
    parts = ["# Translated from a configuration of FIGAROH. What became of its keys:", *(f"#   {x}" for x in lines), ""]
    tasks = content.get("tasks") or content
    measured = (job or ("identify" if "identification" in tasks else "calibrate")) == "calibrate"
    if measured:
        keys |= _calibration(found, get, model, config)
        keys["robot"]["joints"] = keys["data"][0]["position"]
    else:
        keys |= _identification(get, joints, recordings)
    ratio = get("reduction_ratio", "reduction_ratios")
    if ratio and not measured:
        parts.append(
            f"# transmission: {{position: {ratio}, torque: {ratio}}}  # where it is recorded on the motor side"
        )
    return Migrated("\n".join([*parts, dump_yaml(keys)]), lines)


def _inherited(config: Path) -> dict[str, Any]:
    """The file on top of the one that it extends."""
    content = read_yaml(config)
    if not isinstance(content, dict):
        raise InputError(f"{config}: holds no keys and values")
    parent = content.get("extends")
    if not isinstance(parent, str) or not (config.parent / parent).is_file():
        return content
    return _merged(read_yaml(config.parent / parent), content)


def _merged(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return {**old, **{key: _merged(old.get(key), value) for key, value in new.items()}}


def _leaves(content: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every key with a value that is no mapping, by its path; a list of mappings is looked into."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _leaves(value, f"{path}.{key}" if path else str(key))
    elif isinstance(content, list) and content and all(isinstance(one, dict) for one in content):
        for k, one in enumerate(content):
            yield from _leaves(one, path if len(content) == 1 else f"{path}[{k}]")
    else:
        yield path, content


def _becomes(path: str) -> str:
    words = path.replace("]", "").replace("[", ".").split(".")
    known = KEYS.get(words[-1])
    if known is not None and not set(words[:-1]) & {"variants", "custom", "environment", "optimal_configuration"}:
        return known
    if set(words) & set(_BRANCHES):
        return "nothing: it is not part of a task"
    return "NOT TRANSLATED: this key is not known"


def _getter(found: dict[str, Any]) -> Callable[..., Any]:
    """The value of the first path that ends with one of some names, outside of variants."""

    def get(*names: str) -> Any:
        for path, value in found.items():
            words = path.split(".")
            if words[-1] in names and words[0] not in ("variants", "custom", "variables", "environment"):
                return value
        return None

    return get


def _identification(
    get: Callable[..., Any], joints: Sequence[str] | None, recordings: Sequence[Path]
) -> dict[str, Any]:
    keys: dict[str, Any] = {}
    rate = get("sampling_frequency") or (1 / get("ts") if get("ts") else None)
    if not recordings:
        keys["data"] = [{"file": "RECORDING.csv", "position": "q", "torque": "tau", "rate": rate or 1000.0}]
    cutoff, gate = get("cut_off_frequency_butterworth", "cutoff_frequency"), get("dq_lim_def")
    preprocess: dict[str, Any] = {"cutoff": float(cutoff)} if cutoff else {}
    if isinstance(gate, list) and joints and len(gate) == len(joints):
        preprocess["gate"] = dict(zip(joints, map(float, gate), strict=True))
    friction = get("has_friction", "friction")
    baseline: dict[str, Any] = {
        "viscous": friction is not False,
        "coulomb": friction is not False,
        "rotor": bool(get("has_actuator_inertia", "actuator_inertia")),
        "offset": bool(get("has_joint_offset", "joint_offset")),
    }
    pair = get("coupled_joints") or (list(joints[-2:]) if joints and get("has_coupled_wrist") else None)
    if pair:
        baseline["effects"] = [{"effect": "coupled_transmission", "at": pair}]
    keys |= {"preprocess": preprocess, "baseline": baseline}
    points, seconds = get("n_wps", "waypoints"), get("t_s", "segment_duration")
    if points and seconds:
        keys["excite"] = {"basis": {"quintic": int(points)}, "duration": float(seconds) * (int(points) - 1)}
    return keys


def _calibration(found: dict[str, Any], get: Callable[..., Any], model: Path, config: Path) -> dict[str, Any]:
    """Columns of FIGAROH's files: x1, y1, z1 (and phix1, phiy1, phiz1) of each marker, then the joints by name."""
    file = get("data_file", "source_file")
    if not file:
        raise InputError(f"{config}: names neither joint torques nor a data_file of measured points")
    place = next((p for p in (config.parent / file, config.parent.parent / file) if p.is_file()), config.parent / file)
    axes = get("measure", "measurable_dof") or [True] * 3
    markers = max(1, sum(path.rsplit(".", 1)[-1] in ("measure", "measurable_dof") for path in found))
    known = read_robot(model, kinematic=True)
    entry: dict[str, Any] = {"file": str(place.resolve())}
    names = _header(place)
    entry["position"] = [name for name in names if name in known.joint_names] or list(known.joint_names)
    columns = [f"{axis}{k + 1}" for k in range(markers) for axis in "xyz"]
    frames = {"tool_frame": get("tool_frame"), "unknown": ["base_frame", "tool_frame"]}
    if get("base_frame") not in (None, "universe"):
        frames["base_frame"] = get("base_frame")
    if all(axes[3:6]) and len(axes) == 6:
        raise InputError(f"{config}: measures six axes; write `measurement.pose` as x y z qx qy qz qw by hand")
    entry["measurement"] = {"position": columns} | frames
    return {"data": [entry]}


def _header(file: Path) -> tuple[str, ...]:
    return read_table(file, "data_file").names if file.is_file() else ()
