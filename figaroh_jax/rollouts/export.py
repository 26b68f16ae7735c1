"""A fitted loop in the words of simulators: MJCF with its drives, tables of what each of them means by a number.

What a simulator has no word for is listed with its size, never left out silently.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from scipy.spatial.transform import Rotation

from ..effects.base import Effect
from ..errors import InputError, nearest
from ..formats.xmlfile import read_xml
from ..results import finite
from ..rigid.model import DOF_NAMES
from .loop import STIFFEST, Loop
from .parameters import UNITS

__all__ = ["SIMULATORS", "described", "described_text", "for_simulator", "with_drives"]

_NEUTRAL = ("stribeck_speed", "ripple_order", "friction_rate", "friction_share")  # nothing without what they shape
_JOINT = ("armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness", "rest",
          "play", "offset", "ripple_sine", "ripple_cosine", "ripple_order", "reading", "friction_rate",
          "friction_share")  # fmt: skip
_ITERATIONS = 100, 50  # of MuJoCo's solver and its line search, its own: with 10 and 20 stiff friction creeps again
_SOFT, _IMPEDANCE, _NEAR = ("newton", "genesis"), 0.9, 0.01  # MuJoCo's friction as it is by default
_FAR = 1e10  # what stands in an MJCF for a side without a limit


def described(loop: Loop) -> dict[str, Any]:
    """Every number of the loop by joint and drive, SI units."""
    joints = {
        name: {field: float(np.asarray(getattr(loop.joints, field))[k]) for field in _JOINT}
        for k, name in enumerate(loop.robot.dof_names)
    }
    way, drives = np.asarray(loop.drives.transmission), {}
    for k, name in enumerate(loop.drives.names):
        scale = float(np.asarray(loop.drives.scale)[k])
        gain, bias = (np.asarray(x, float)[k] for x in (loop.drives.gain, loop.drives.bias))
        drives[name] = {
            "joint": loop.robot.dof_names[int(np.abs(way[k]).argmax())],
            "gear": float(way[k][np.abs(way[k]).argmax()]),
            "transmission": {loop.robot.dof_names[j]: float(way[k, j]) for j in np.flatnonzero(way[k])},
            "kp": float(scale * gain[0]),
            "gain_of_length": float(scale * gain[1]),
            "gain_of_rate": float(gain[2]),
            "length": float(scale * bias[1]),
            "kd": float(-bias[2]),
            "constant": float(bias[0]),
            "command_range": _sides(np.asarray(loop.drives.command_range)[k]),
            "force": finite(np.asarray(loop.drives.force_range)[k, 1]),
            "force_range": _sides(np.asarray(loop.drives.force_range)[k]),
            "voltage": finite(np.asarray(loop.drives.voltage)[k]),
            "delay": float(np.asarray(loop.drives.delay)[k]),
            "dead_band": float(np.asarray(loop.drives.dead_band)[k]),
            "time_constant": float(np.asarray(loop.drives.time_constant)[k]),
            "activation": loop.drives.activation[k],
            "activation_range": _sides(np.asarray(loop.drives.activation_range)[k]),
            "early": loop.drives.early[k],
        }
    limits = {name: _limits(loop, k) for k, name in enumerate(loop.robot.dof_names)}
    content = {
        "joints": joints, "drives": drives, "limits": limits, "dt": float(loop.dt), "integrator": loop.integrator,
        "law": loop.law, "start": np.asarray(loop.start, float).tolist(),
    }  # fmt: skip
    pairs = [_pair(loop, k) for k in range(0 if loop.pairs is None else len(loop.pairs.at))]
    if pairs := [one for one in pairs if any(one["parameters"].values())]:
        content["pairs"] = pairs
    own = [_effect(loop, e) for e in loop.effects if any(float(getattr(e, name)) for name in e.amplitudes())]
    return content | ({"effects": own} if own else {})


def _effect(loop: Loop, effect: Effect) -> dict[str, Any]:
    """An effect that acts by its own torque, as `Rest` of `callback.py` takes it."""
    numbers = {name: float(getattr(effect, name)) for name in effect.parameters()}
    at = [loop.robot.dof_names[k] for k in effect.places] if effect.acts_on in ("joint", "pair") else []
    units = {name: parameter.unit for name, parameter in effect.parameters().items()}
    return {"effect": effect.name, "equation": effect.equation, "at": at, "parameters": numbers, "units": units}


def _pair(loop: Loop, k: int) -> dict[str, Any]:
    """A motor that turns with two joints: of `robot.xml` a fixed tendon."""
    assert loop.pairs is not None
    i, j, sign = loop.pairs.at[k]
    numbers = {name: float(np.asarray(getattr(loop.pairs, name))[k]) for name in ("inertia", "damping", "friction")}
    return {"at": [loop.robot.dof_names[i], loop.robot.dof_names[j]], "sign": sign, "parameters": numbers}


def _limits(loop: Loop, k: int) -> dict[str, Any]:
    """The limits of a joint and their softness, and of what its drives give together; None where there is none."""
    j = loop.joints
    told = {"range": _sides(np.asarray(j.limit)[k]) if loop.limited else None, "margin": float(j.limit_margin[k])}
    soft = {name: np.asarray(getattr(j, f"limit_{name}"), float)[k].tolist() for name in ("solref", "solimp")}
    return told | soft | {"torque_range": _sides(np.asarray(j.torque_range)[k])}


def _sides(ends: np.ndarray) -> list[float | None] | None:
    """Both ends of a range, None for an end that is none; None where neither is."""
    return [finite(x) for x in ends] if np.isfinite(ends).any() else None


def described_text(loop: Loop) -> str:
    """`loop.json`."""
    return json.dumps(described(loop), indent=2) + "\n"


def with_drives(file: Path, content: dict[str, Any]) -> str:
    """The text of an MJCF file with the loop's time step, integrator and drives as `general` actuators."""
    root = read_xml(file, "mujoco")
    option = root.find("option")
    option = etree.SubElement(root, "option") if option is None else option
    names = {"euler": "Euler", "explicit": "Euler", "implicitfast": "implicitfast", "rk4": "RK4"}
    option.set("timestep", f"{content['dt']:.9g}")
    option.set("integrator", names[content["integrator"]])
    flag = option.find("flag")
    flag = etree.SubElement(option, "flag") if flag is None else flag
    flag.set("eulerdamp", "disable" if content["integrator"] == "explicit" else "enable")
    option.set("iterations", str(_ITERATIONS[0]))
    option.set("ls_iterations", str(_ITERATIONS[1]))
    _with_free_joints(root, content)
    _with_limits(root, content)
    _with_start(root, content)
    for old in root.findall("actuator"):
        root.remove(old)
    actuators = etree.SubElement(root, "actuator")
    for name, drive in content["drives"].items():
        prm = f"{drive['constant']:.9g} {drive['length']:.9g} {-drive['kd']:.9g}"
        new = etree.SubElement(
            actuators, "general", name=name, **_way(root, name, drive), biastype="affine", biasprm=prm
        )
        more = [drive.get("gain_of_length", 0.0), drive.get("gain_of_rate", 0.0)]
        new.set("gainprm", _text([drive["kp"], *more] if any(more) else [drive["kp"]]))
        if any(more):
            new.set("gaintype", "affine")
        both = (
            None if drive["force"] is None else [-drive["force"], drive["force"]]
        )  # of runs before the range was kept
        for word, key in (("ctrl", "command_range"), ("force", "force_range"), ("act", "activation_range")):
            _set_range(new, word, drive.get(key, both if word == "force" else None))
        if drive["activation"] != "none":
            new.set("dyntype", drive["activation"])
            new.set("dynprm", f"{drive['time_constant']:.9g}")
            new.set("actearly", str(bool(drive.get("early"))).lower())
        if drive["delay"] >= content["dt"]:  # MuJoCo takes no part of a step: `callback.py` does
            new.set("delay", f"{drive['delay']:.9g}")
            new.set("interp", "linear")  # between two steps, as the loop's is; MuJoCo's own takes the later step
            new.set("nsample", str(int(np.ceil(drive["delay"] / content["dt"])) + 2))
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _way(root: Any, name: str, drive: dict[str, Any]) -> dict[str, str]:
    """What an actuator acts on: its joint with the gear, or a fixed tendon over several joints."""
    way = drive.get("transmission") or {drive["joint"]: drive["gear"]}
    if len(way) == 1:
        ((joint, gear),) = way.items()
        return {"joint": joint, "gear": f"{gear:.9g}"}
    group = root.find("tendon")
    group = etree.SubElement(root, "tendon") if group is None else group
    called = f"drive {name}"
    for old in [one for one in group if one.get("name") == called]:
        group.remove(old)
    fixed = etree.SubElement(group, "fixed", name=called)
    for joint, share in way.items():
        etree.SubElement(fixed, "joint", joint=joint, coef=f"{share:.9g}")
    return {"tendon": called}


def _with_free_joints(root: Any, content: dict[str, Any]) -> None:
    """What acts along and about the axes of free joints: the loop's axes are MuJoCo's, those of effects are not."""
    words = {"armature": "armature", "damping": "damping", "frictionloss": "friction"}
    for joint in root.iterfind(".//joint[@type='free']"):
        axes = [content["joints"].get(f"{joint.get('name')}{axis}", {}) for axis in DOF_NAMES["free"]]
        for word, number in words.items():
            if len(values := {one.get(number) for one in axes}) == 1 and (value := values.pop()):
                joint.set(word, _text([value]))


def _with_limits(root: Any, content: dict[str, Any]) -> None:
    """Ranges and softness of limits and dry friction at the joints, as the loop has them."""
    for joint in root.iter("joint"):
        name = joint.get("name")
        name = name if name in content["joints"] else f"{name}.wx"  # of a ball
        own, limit = content["joints"].get(name), content.get("limits", {}).get(name)
        if own is None or limit is None:
            continue
        _set_range(joint, "", limit["range"])
        if limit["range"] is None:
            joint.set("limited", "false")
        else:
            joint.set("margin", _text([limit["margin"]]))
            joint.set("solreflimit", _text(limit["solref"]))
            joint.set("solimplimit", _text(limit["solimp"]))
        _set_range(joint, "actuatorfrc", limit["torque_range"])
        if content["law"] == "hard" or own.get("friction_rate", 0.0) > 0:
            impedance, time = _friction_words(content, own)
            joint.set("solreffriction", _text([time, 1.0]))
            joint.set("solimpfriction", _text([impedance, impedance, 0.001, 0.5, 2.0]))


def _with_start(root: Any, content: dict[str, Any]) -> None:
    """The configuration at which the loop starts as that of the file: `ref` of joints, the pose of a free base.

    MuJoCo sets the softness of friction and limits there. What the numbers of the joints mean stays as it was.
    """
    start, moved = _starts(root, content), dict[str, float]()
    for body in root.iter("body"):
        joints = body.findall("joint")
        at = start.get(joints[0].get("name")) if len(joints) == 1 else None
        kind = joints[0].get("type") if at is not None else ""
        if at is None or len(at) != {"hinge": 1, "slide": 1, "free": 7}.get(kind):
            continue
        if kind == "free":
            body.set("pos", _text(at[:3]))
            body.set("quat", _text([at[6], *at[3:6]]))
            continue
        before = float(joints[0].get("ref", 0.0))
        if (way := at[0] - before) == 0:
            continue
        moved[joints[0].get("name")] = way
        joints[0].set("ref", _text(at))
        axis, anchor = (_vector(joints[0], word, np.zeros(3)) for word in ("axis", "pos"))
        place, turn = _vector(body, "pos", np.zeros(3)), _rotation(body)
        about = Rotation.from_rotvec(way * axis / np.linalg.norm(axis) if kind == "hinge" else np.zeros(3))
        shift = anchor - about.apply(anchor) if kind == "hinge" else way * axis / np.linalg.norm(axis)
        body.set("pos", _text((place + turn.apply(shift)).tolist()))
        x, y, z, w = (turn * about).as_quat().tolist()
        body.set("quat", _text([w, x, y, z]))
    for follower in root.iterfind("equality/joint"):  # told by how far both are from where the file has them
        numbers = _vector(follower, "polycoef", np.array([0.0, 1.0, 0.0, 0.0, 0.0]))
        numbers[0] += numbers[1] * moved.get(follower.get("joint2"), 0.0) - moved.get(follower.get("joint1"), 0.0)
        follower.set("polycoef", _text(numbers.tolist()))


def _starts(root: Any, content: dict[str, Any]) -> dict[str, list[float]]:
    """Where each joint starts; by its own name also where it has several coordinates, as `base.vx` has."""
    single = {joint.get("name") for joint in root.iter("joint")}
    joints = [name if name in single else name.rsplit(".", 1)[0] for name in content["joints"]]
    found, at = dict[str, list[float]](), 0
    for joint in dict.fromkeys(joints):
        many = joints.count(joint)
        many += many > 1  # a quaternion, or the cosine and sine of an angle
        found[joint] = content.get("start", [])[at : at + many]
        at += many
    return found


def _vector(element: Any, word: str, default: np.ndarray) -> np.ndarray:
    return np.array(element.get(word).split(), float) if element.get(word) else default.copy()


def _rotation(body: Any) -> Rotation:
    w, x, y, z = _vector(body, "quat", np.array([1.0, 0.0, 0.0, 0.0]))
    return Rotation.from_quat([x, y, z, w])


def _friction_words(content: dict[str, Any], own: dict[str, float]) -> tuple[float, float]:
    """MuJoCo's impedance and time constant of dry friction; of a hard one as stiff as it takes.

    An impedance that is the same at any depth gives both numbers of the soft law.
    """
    if content["law"] == "hard":
        return STIFFEST, 2.0 * content["dt"]
    impedance = 1.0 / (1.0 + own["friction_share"])
    return impedance, 2.0 / (own["friction_rate"] * impedance)


def _set_range(element: Any, word: str, ends: list[float | None] | None) -> None:
    if ends is not None:
        low, high = ends
        element.set(f"{word}range", _text([-_FAR if low is None else low, _FAR if high is None else high]))
        element.set(f"{word}limited", "true")


def _text(numbers: list[float]) -> str:
    return " ".join(f"{x:.17g}" for x in numbers)


# (our number: theirs), and what a number means there
SIMULATORS: dict[str, tuple[dict[str, str], str]] = {
    "mujoco": (
        {
            "armature": "joint armature",
            "damping": "joint damping",
            "friction": "joint frictionloss",
            "stiffness": "joint stiffness",
            "rest": "joint springref",
            "kp": "general gainprm[0] (of a servo also -biasprm[1])",
            "kd": "-general biasprm[2]",
            "force": "general forcerange",
            "delay": "general delay",
        },
        "friction is a soft constraint (solreffriction, solimpfriction) that creeps under load; damping is implicit;"
        " what is unsaid is done by callback.py",
    ),
    "newton": (
        {
            "armature": "joint_armature",
            "damping": "joint_damping",
            "friction": "joint_friction",
            "kp": "joint_target_ke",
            "kd": "joint_target_kd",
            "force": "joint_effort_limit",
        },
        "read by its MuJoCo solver, where friction is MuJoCo's; single precision",
    ),
    "isaaclab": (
        {
            "armature": "ImplicitActuatorCfg.armature",
            "friction": "ImplicitActuatorCfg.friction",
            "kp": "ImplicitActuatorCfg.stiffness",
            "kd": "ImplicitActuatorCfg.damping",
            "force": "ImplicitActuatorCfg.effort_limit_sim",
            "delay": "DelayedPDActuatorCfg.max_delay, in steps",
        },
        "add the joint's damping to the actuator's; friction is an effort in PhysX 5.1 on, a share of the load before",
    ),
    "genesis": (
        {
            "armature": "set_dofs_armature",
            "damping": "set_dofs_damping",
            "friction": "set_dofs_frictionloss",
            "stiffness": "set_dofs_stiffness",
            "kp": "set_dofs_kp",
            "kd": "set_dofs_kv",
            "force": "set_dofs_force_range",
        },
        "friction is MuJoCo's soft frictionloss; drives have no states",
    ),
    "gazebo": (
        {
            "damping": "dynamics damping",
            "friction": "dynamics friction",
            "stiffness": "dynamics spring_stiffness",
            "rest": "dynamics spring_reference",
            "kp": "JointPositionController p_gain",
            "kd": "JointPositionController d_gain",
            "force": "JointPositionController cmd_max",
        },
        "friction is Coulomb's; the gains act at the controller's rate, explicitly",
    ),
}


def _ways(drive: dict[str, Any]) -> dict[str, float]:
    """How a drive turns with the joints, gear included."""
    return drive.get("transmission") or {drive["joint"]: drive["gear"]}


def _at_the_joint(drive: dict[str, Any]) -> dict[str, Any]:
    """A drive's numbers at its joint: what it does per rad of the joint, with the torque that arrives there."""
    gear = drive["gear"]
    size = {"kp": gear**2, "length": gear**2, "kd": gear**2, "constant": gear}
    told = drive | {key: drive[key] * factor for key, factor in size.items()}
    for key in ("force", "voltage"):
        told[key] = None if drive[key] is None else drive[key] * abs(gear)
    told["dead_band"] = drive["dead_band"] / abs(gear)
    follows, brakes = drive["length"] != 0, drive["kd"] != 0
    told["kind"] = "general"
    if follows and np.isclose(drive["kp"], -drive["length"], rtol=1e-9):
        told["kind"] = "position"
    elif not follows and brakes and np.isclose(drive["kp"], drive["kd"], rtol=1e-9):
        told["kind"] = "velocity"
    elif not follows and not brakes:
        told["kind"] = "torque"
    return told


def _command_words(place: str, told: dict[str, Any]) -> list[dict[str, Any]]:
    """What becomes of a command where it is not the joint's position itself."""
    gear, kind = told["gear"], told["kind"]
    if len(_ways(told)) > 1 or kind == "general":
        return []
    share = {"position": 1 / gear, "velocity": 1 / gear, "torque": told["kp"] / gear}[kind]
    if kind == "position" and share == 1:
        return []
    word = {"position": "position target", "velocity": "velocity target", "torque": "joint effort"}[kind]
    found = [{"at": place, "number": "command", "word": f"{word}, per unit of the command", "value": share}]
    if kind == "velocity":
        found.append({"at": place, "number": "kd", "word": "gain of the velocity's error", "value": told["kd"]})
    if kind != "position" and told["force"] is not None:
        found.append({"at": place, "number": "force", "word": "limit of the joint's effort", "value": told["force"]})
    return found


def _beyond_words(place: str, told: dict[str, Any], drive: dict[str, Any]) -> list[dict[str, Any]]:
    """What of a drive none of the simulators' servos has: several joints, gains of its own, states, ranges."""
    found = []
    several, general = len(_ways(drive)) > 1, told["kind"] == "general"
    if several:
        found += [(f"transmission {joint}", share, "") for joint, share in _ways(drive).items()]
    if several or general:
        own = (("kp", "kp"), ("length", "kp"), ("kd", "kd"), ("force", "force_limit"))
        found += [(key, drive[key], UNITS[unit]) for key, unit in own]
    if told["kind"] != "position" or several:
        found += [(key, drive[key], UNITS[key]) for key in ("voltage", "delay", "dead_band")]
    found += [(key, drive.get(key, 0.0), "") for key in ("gain_of_length", "gain_of_rate")]
    found.append(("constant", told["constant"], UNITS["offset"]))
    if drive["activation"] != "none":
        found.append((f"time_constant of its {drive['activation']}", drive["time_constant"], "s"))
    for key, unit in (("command_range", "rad"), ("force_range", "N m")):
        low, high = drive.get(key) or (None, None)
        if key == "force_range" and (high is None or low == -high):
            low, high = (low if high is None else None), None
        found += [(f"{key} {side}", x, unit) for side, x in (("low", low), ("high", high))]
    return [
        {"at": place, "number": number, "value": value, "unit": unit}
        for number, value, unit in found
        if value is not None and (value != 0 or number.endswith((" low", " high")))
    ]


def _in_mujoco(place: str, drive: dict[str, Any]) -> list[dict[str, Any]]:
    """What a `general` actuator has beside a servo's gains; all of it stands in `robot.xml`."""
    told = []
    if drive["length"] != -drive["kp"]:
        told.append(("length", "general biasprm[1]", drive["length"]))
    if drive["constant"]:
        told.append(("constant", "general biasprm[0]", drive["constant"]))
    ways = _ways(drive)
    if len(ways) > 1:
        told += [(f"transmission {joint}", "fixed tendon's coef", share) for joint, share in ways.items()]
    elif drive["gear"] != 1:
        told.append(("gear", "general gear", drive["gear"]))
    return [{"at": place, "number": number, "word": word, "value": value} for number, word, value in told]


def for_simulator(content: dict[str, Any], name: str) -> dict[str, Any]:
    """The loop's numbers in the words of a simulator: `values`, `meaning`, and `unsaid` with what it cannot say.

    MuJoCo's are those of its actuators, the others' those of the joint that a drive turns, its gear counted in.
    """
    if name not in SIMULATORS:
        raise InputError(f"--for {name}: unknown simulator{nearest(name, SIMULATORS)}")
    words, meaning = SIMULATORS[name]
    if name == "mujoco" and content["integrator"] == "explicit":
        meaning = meaning.replace("damping is implicit", "damping is explicit")
    values, unsaid = [], []

    def say(place: str, number: str, value: float | None, unit: str) -> None:
        if value is None or number in _NEUTRAL:
            return
        short = name == "mujoco" and number == "delay" and 0 < value < content["dt"]
        if number in words and not short:
            values.append({"at": place, "number": number, "word": words[number], "value": value})
        elif value != 0:
            unsaid.append({"at": place, "number": number, "value": value, "unit": unit})

    for place, numbers in content["joints"].items():
        for number, value in numbers.items():
            if number != "rest" or numbers["stiffness"] != 0:  # without a spring nothing rests
                say(place, number, value, UNITS.get(number, ""))
        if numbers["friction"] > 0 and (content["law"] == "hard" or numbers.get("friction_rate", 0.0) > 0):
            told = {"at": place, "number": "friction_impedance", "value": _friction_words(content, numbers)[0]}
            if name == "mujoco":
                values.append(told | {"word": "joint solimpfriction, its first two"})
            elif name in _SOFT and abs(told["value"] - _IMPEDANCE) > _NEAR:
                unsaid.append(told | {"unit": ""})
    for place, drive in content["drives"].items():
        told = drive if name == "mujoco" else _at_the_joint(drive)
        where = place if name == "mujoco" or len(_ways(drive)) > 1 else drive["joint"]
        if name == "mujoco" or (told["kind"] == "position" and len(_ways(drive)) == 1):
            for number in ("kp", "kd", "force", "voltage", "delay", "dead_band"):
                say(where, number, told[number], UNITS["force_limit" if number == "force" else number])
        if name == "mujoco":
            values += _in_mujoco(place, drive)
            continue
        values += _command_words(where, told)
        unsaid += _beyond_words(where, told, drive)
    for one in content.get("pairs", ()):
        place = f"{one['at'][0]} {'+' if one['sign'] > 0 else '-'} {one['at'][1]}"
        for number, value in one["parameters"].items():
            if name == "mujoco":
                word = {"inertia": "armature", "damping": "damping", "friction": "frictionloss"}[number]
                values.append({"at": place, "number": f"pair_{number}", "word": f"tendon {word}", "value": value})
            elif value:
                unit = UNITS[f"pair_{number}"]
                unsaid.append({"at": place, "number": f"pair_{number}", "value": value, "unit": unit})
    for one in content.get("effects", ()):
        place = ", ".join(one["at"]) or "the robot"
        unsaid += [
            {"at": place, "number": f"{one['effect']}.{number}", "value": value, "unit": one["units"][number]}
            for number, value in one["parameters"].items()
        ]
    return {"simulator": name, "meaning": meaning, "values": values, "unsaid": unsaid}
