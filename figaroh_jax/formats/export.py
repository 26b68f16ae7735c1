"""The extended model as a folder that other tools read and that loads back: `robot.urdf`, `robot.xml`, `effects.yaml`.

The two robot files carry what their formats can. `effects.yaml` holds everything: the joints in column order, the ten
inertial parameters of every link before any effect, every effect with its parameters and where else it is written, and
a warning for all that a robot file could not say.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import yaml
from jaxtyping import Int

from ..effects.base import Effect, joint_unit, place
from ..effects.catalogue import find
from ..effects.extended import ExtendedModel, changed_robot, extend
from ..errors import InputError, check_finite, check_kind, check_path
from ..results import Cause, Estimate, Name
from ..rigid.model import DOF_NAMES, RobotModel
from .mjcf_text import mjcf_text
from .native import Carried, carried, changed_leaves, drives, place_names
from .taskfile import read_yaml
from .urdf import load_urdf
from .urdf_text import urdf_text

__all__ = ["dump_yaml", "load_model", "mark_written", "model_files", "refuse_others", "write_model"]

_LAST = b"# as written: "
_HEAD = "# The extended model: the robot before its effects, and every effect. Read by figaroh-jax.\n"

_GEOMETRY = ("placement", "axis", "ratio", "offset", "frame_placement")


class _Dumper(yaml.SafeDumper):
    """Numbers in full, lists of numbers on one line, no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(np.ndarray, lambda dumper, array: dumper.represent_list(array.tolist()))


def dump_yaml(content: Mapping[str, Any], *, line: bool = False) -> str:
    """The mapping as YAML, in its order, numbers in full and lists of numbers on one line, or all of it (`line`)."""
    width, flow = (float("inf"), True) if line else (120, None)
    return yaml.dump(
        dict(content), Dumper=_Dumper, sort_keys=False, width=width, default_flow_style=flow, allow_unicode=True
    )


def write_model(model: ExtendedModel | RobotModel, directory: str | Path, causes: Sequence[Cause] = ()) -> None:
    """Write `robot.urdf`, `robot.xml` and `effects.yaml` into `directory`, which is made where it is missing.

    Files of these names that it has not written, or that were changed since, are not replaced: `InputError`.

    `causes` give the standard deviations of the effects that they name; those of the others are null. What a format
    cannot carry stands in `effects.yaml`, at the effect and under `warnings`.

    >>> import tempfile, figaroh_jax as fj
    >>> model = fj.load_urdf(fj.DEMO)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_model(model, folder)
    ...     fj.load_model(folder).robot.nv
    4
    """
    check_kind("model", model, (ExtendedModel, RobotModel), "write_model(model, directory)")
    check_path("directory", directory)
    _write(model_files(extend(model) if isinstance(model, RobotModel) else model, causes), Path(directory))


def _write(texts: Mapping[str, str], directory: Path) -> None:
    """Write files of a model by their names; `InputError` where others of these names are there, or nothing can be."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            refuse_others(directory / name, text)
        before = _written(directory / "effects.yaml")  # of a loop too
        for name, text in texts.items():
            (directory / name).write_text(text, encoding="utf-8")
        mark_written(*(directory / name for name in texts), before=before)
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}; name another folder") from error


def refuse_others(file: Path, text: str, writer: str = "write_model") -> None:
    """Raise `InputError` where a file of a model's folder is there that was not written so, or changed since.

    One that holds the `text` already may be written again.
    """
    if not file.exists() or (file.is_file() and file.read_bytes() == text.encode()):
        return
    known = _written(file.with_name("effects.yaml"))
    if file.name not in known:
        raise InputError(f"{file} is there and is none that {writer} wrote; name another folder")
    if not (file.is_file() and _digest(file.read_bytes()) == known[file.name]):
        raise InputError(f"{file} was changed after {writer} wrote it; name another folder")


def mark_written(*files: Path, before: Mapping[str, str] | None = None) -> None:
    """Note in the `effects.yaml` of a model's folder what its files hold, once they were written.

    `before` are the notes of an `effects.yaml` that stood there, of files that this one does not know.
    """
    head = files[0].with_name("effects.yaml")
    if not head.is_file():
        return
    known = {**(before or {}), **_written(head)} | {file.name: _digest(file.read_bytes()) for file in files}
    head.write_bytes(head.read_bytes().partition(_LAST)[0] + _last(known))


def _last(digests: Mapping[str, str]) -> bytes:
    return _LAST + ", ".join(f"{name} {digest}" for name, digest in digests.items()).encode() + b"\n"


def _written(file: Path) -> dict[str, str]:
    """Digests of the files of a model by their names, as they were written; empty where `file` tells of none."""
    last = file.read_bytes().partition(_LAST)[2].partition(b"\n")[0] if file.is_file() else b""
    return dict(re.findall(r"(\S+) ([0-9a-f]{16})", last.decode(errors="replace")))


def _digest(content: bytes) -> str:
    """Of a file's content, without the line that tells the digests."""
    before, _, after = content.partition(_LAST)
    return hashlib.sha256(before + after.partition(b"\n")[2]).hexdigest()[:16]


def model_files(extended: ExtendedModel, causes: Sequence[Cause] = ()) -> dict[str, str]:
    """Text of each of the three files by its name (see `write_model`)."""
    with jax.enable_x64(True):
        robot = jax.tree.map(np.asarray, changed_robot(extended))
        for link, ten in zip(robot.link_names, robot.inertia, strict=True):
            check_finite(f"model: the inertia of link '{link}'", ten)
        return _files(extended, robot, causes)


def _files(extended: ExtendedModel, robot: RobotModel, causes: Sequence[Cause]) -> dict[str, str]:
    in_urdf, in_mjcf = carried(extended, "urdf"), carried(extended, "mjcf")
    urdf, urdf_warnings = urdf_text(robot, drives(extended, in_urdf))
    mjcf, mjcf_warnings = mjcf_text(robot, drives(extended, in_mjcf))
    effects = [
        _describe(extended.robot, effect, causes, *answers)
        for effect, *answers in zip(extended.effects, in_urdf, in_mjcf, strict=True)
    ]
    content = _robot(extended, robot) | {"effects": effects}
    warnings = {"warnings": [*urdf_warnings, *mjcf_warnings, *_warnings(extended, in_urdf, in_mjcf)]}
    text = dump_yaml(content)
    text += yaml.dump(warnings, Dumper=_Dumper, width=120, default_flow_style=False)
    return {"robot.urdf": urdf, "robot.xml": mjcf, "effects.yaml": _HEAD + text}


def _robot(extended: ExtendedModel, changed: RobotModel) -> dict[str, Any]:
    robot = extended.robot
    limits = zip(robot.position_limit, robot.velocity_limit, robot.effort_limit, extended.width, strict=True)
    joints = [
        {"name": name, "position": np.asarray(p), "velocity": float(v), "effort": float(e), "reversal": float(w)}
        for name, (p, v, e, w) in zip(robot.dof_names, limits, strict=True)
    ]
    owners = [(joint.coordinate, len(DOF_NAMES[joint.kind]), joint.name) for joint in robot.joints if not joint.follows]
    for first, width, name in owners:
        for entry in joints[first : first + width] if width > 1 else ():
            entry["joint"] = name  # the one of several degrees of freedom that it belongs to
    links = [
        {"name": name, "inertia": np.asarray(ten)} for name, ten in zip(robot.link_names, robot.inertia, strict=True)
    ]
    geometry: dict[str, Any] = {
        leaf: np.asarray(getattr(robot, leaf)) for leaf in changed_leaves(robot, changed) if leaf in _GEOMETRY
    }
    gravity = {"gravity": np.asarray(robot.gravity)}
    if shifted := _shifted(robot):
        geometry["frames"] = shifted
    return {"format": 1, "robot": robot.name, **gravity, "joints": joints, "links": links, **geometry}


def _shifted(robot: RobotModel) -> list[dict[str, Any]]:
    """Frames called as links but away from their joints, where a URDF has the links."""
    links = {joint.link: i for i, joint in enumerate(robot.joints)}
    return [
        {"name": frame.name, "placement": np.asarray(placement)}
        for frame, placement in zip(robot.frames, robot.frame_placement, strict=True)
        if links.get(frame.name) == frame.parent and not np.array_equal(np.asarray(placement), np.eye(4))
    ]


def _describe(
    robot: RobotModel, effect: Effect, causes: Sequence[Cause], in_urdf: Carried, in_mjcf: Carried
) -> dict[str, Any]:
    at = place_names(robot, effect)
    same = [c.parameters for c in causes if c.name == (effect.name, at)]
    values = _physical(effect)
    # a joint may have two of them; what recordings differ by is no number of the model
    alike = (p for p in same if all(np.isclose(p[n].value, values[n]) for n in values if n in p))
    known = next(alike, (same or [{}])[0])
    answer = {
        "effect": effect.name,
        "at": list(at),
        "parameters": _parameters(robot, effect, known),
        "fields": {name: float(getattr(effect, name)) for name in _fields(effect)},
        "urdf": in_urdf.yes,
        "mjcf": in_mjcf.yes,
    }
    reasons = {f"not in {form}": c.why for form, c in (("urdf", in_urdf), ("mjcf", in_mjcf)) if not c.yes}
    return answer | reasons


def _parameters(robot: RobotModel, effect: Effect, known: Mapping[str, Estimate]) -> dict[str, Any]:
    slides = effect.acts_on in ("joint", "pair") and _slides(robot, np.ravel(np.asarray(effect.at)))
    units = {name: joint_unit(unit, slides) for name, unit in effect.units().items()}
    return {
        name: {"value": float(value), "std": float(known[name].std) if name in known else None, "unit": units[name]}
        for name, value in _physical(effect).items()
    }


def _slides(robot: RobotModel, columns: Int[np.ndarray, " places"]) -> bool:
    """Whether one of the coordinates is a length."""
    of, follows = robot.dofs, np.array([joint.follows for joint in robot.joints])
    own = np.isin(of.column, columns) & ~follows[of.joint]
    return not of.turns[own].all()


def _physical(effect: Effect) -> Mapping[str, Any]:
    try:
        return effect.physical()
    except ZeroDivisionError:  # e.g. where a spring of zero stiffness rests
        return {name: getattr(effect, name) for name in effect.parameters()}


def _fields(effect: Effect) -> list[str]:
    known = list(effect.parameters())  # a state (`memory`) is the simulation's
    others = [field.name for field in dataclasses.fields(effect) if field.name not in ("at", "memory", *known)]
    if others:
        raise InputError(
            f"effect '{effect.name}' has a field '{others[0]}' that is not a parameter; declare it with "
            "`amplitude` or `shape`, or the model cannot be written"
        )
    return known


def _warnings(extended: ExtendedModel, in_urdf: Sequence[Carried], in_mjcf: Sequence[Carried]) -> list[str]:
    """One line for each effect that a robot file leaves out, and for dry friction, which MuJoCo softens."""
    lines = []
    for effect, *answers in zip(extended.effects, in_urdf, in_mjcf, strict=True):
        name = Name(effect.name, place_names(extended.robot, effect))
        for file, answer in zip(("robot.urdf", "robot.xml"), answers, strict=True):
            if not answer.yes:
                lines.append(f"{file} lacks {name}: {answer.why}")
    if drives(extended, tuple(in_mjcf)).frictionloss.any():
        lines.append("robot.xml: frictionloss is a soft constraint in MuJoCo, not a step at the reversal")
    return lines


def load_model(directory: str | Path) -> ExtendedModel:
    """The extended model that `write_model` wrote, the same to rounding: joints in their order, every effect.

    Effects of your own must have been registered (`register`) before. Raises `InputError` for a folder that
    holds no such model, and for effects, joints or links that are not known.

    >>> import tempfile, figaroh_jax as fj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_model(fj.extend(fj.load_urdf(fj.DEMO)), folder)
    ...     fj.load_model(folder).robot.joint_names[0]
    'waist'
    """
    check_path("directory", directory)
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"{directory} is not a folder; a model folder with effects.yaml and robot.urdf is expected")
    file = directory / "effects.yaml"
    if not file.is_file() and (directory / "model" / file.name).is_file():
        raise InputError(f"{file} does not exist; the model of this run is in {directory / 'model'}")
    if not file.is_file() and (directory / "calibration.yaml").is_file():
        raise InputError(
            f"{file} does not exist: {directory} is that of a calibration, whose robot has no effects: read its"
            " robot.urdf by load_urdf, or its robot.xml by load_mjcf"
        )
    content = read_yaml(file)
    try:
        robot = _restored(content, directory / "robot.urdf")
        effects = [
            place(find(e["effect"]), robot, e["at"], **{k: float(x) for k, x in e["fields"].items()})
            for e in content["effects"]
        ]
        return extend(robot, *effects, width=np.array([float(joint["reversal"]) for joint in content["joints"]]))
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except KeyError as error:
        raise InputError(f"{file}: the key {error} is missing; the file is written by figaroh-jax") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{file}: not as figaroh-jax writes it: {error}") from None


def _restored(content: Mapping[str, Any], urdf: Path) -> RobotModel:
    """The robot of the URDF as it was before its effects."""
    joints = content["joints"]
    names = list(dict.fromkeys(joint.get("joint", joint["name"]) for joint in joints))
    robot = load_urdf(urdf, joints=names, gravity=content["gravity"])
    inertia = np.array(robot.inertia)
    for link in content["links"]:
        inertia[robot.link_index(link["name"])] = _array(link["inertia"], (10,))
    values = {
        "inertia": inertia,
        "position_limit": _array([joint["position"] for joint in joints], (robot.nv, 2)),
        "velocity_limit": _array([joint["velocity"] for joint in joints], (robot.nv,)),
        "effort_limit": _array([joint["effort"] for joint in joints], (robot.nv,)),
    }
    frames = np.array(robot.frame_placement)
    for frame in content.get("frames", ()):
        frames[robot.frame_index(frame["name"])] = _array(frame["placement"], (4, 4))
    values |= {"frame_placement": frames}
    values |= {leaf: _array(content[leaf], np.shape(getattr(robot, leaf))) for leaf in _GEOMETRY if leaf in content}
    return eqx.tree_at(lambda m: [getattr(m, name) for name in values], robot, list(values.values()))


def _array(numbers: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(numbers, float)
    if array.shape != shape:
        raise InputError(f"numbers of shape {array.shape} where {shape} are expected")
    return array
