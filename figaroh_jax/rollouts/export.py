"""A fitted loop in the words of simulators: MJCF with its drives, tables of what each of them means by a number.

What a simulator has no word for is listed with its size, never left out silently.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from ..effects.base import Effect
from ..errors import InputError, nearest
from ..formats.xmlfile import read_xml
from ..results import finite
from .loop import Loop
from .parameters import UNITS

__all__ = ["SIMULATORS", "described", "described_text", "for_simulator", "with_drives"]

_NEUTRAL = {"stribeck_speed": None, "ripple_order": None, "friction_rate": None, "friction_share": None, "rest": None}
_JOINT = ("armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness", "rest",
          "play", "offset", "ripple_sine", "ripple_cosine", "ripple_order", "reading")  # fmt: skip


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
            "kp": float(scale * gain[0]),
            "length": float(scale * bias[1]),
            "kd": float(-bias[2]),
            "constant": float(bias[0]),
            "force": finite(np.asarray(loop.drives.force_range)[k, 1]),
            "voltage": finite(np.asarray(loop.drives.voltage)[k]),
            "delay": float(np.asarray(loop.drives.delay)[k]),
            "dead_band": float(np.asarray(loop.drives.dead_band)[k]),
            "time_constant": float(np.asarray(loop.drives.time_constant)[k]),
            "activation": loop.drives.activation[k],
        }
    content = {
        "joints": joints, "drives": drives, "dt": float(loop.dt), "integrator": loop.integrator, "law": loop.law,
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


def described_text(loop: Loop) -> str:
    """`loop.json`."""
    return json.dumps(described(loop), indent=2) + "\n"


def with_drives(file: Path, content: dict[str, Any]) -> str:
    """The text of an MJCF file with the loop's time step, integrator and drives as `general` actuators."""
    root = read_xml(file, "mujoco")
    option = root.find("option")
    option = etree.SubElement(root, "option") if option is None else option
    names = {"euler": "Euler", "implicitfast": "implicitfast", "rk4": "RK4"}
    option.set("timestep", f"{content['dt']:.9g}")
    option.set("integrator", names[content["integrator"]])
    for old in root.findall("actuator"):
        root.remove(old)
    actuators = etree.SubElement(root, "actuator")
    for name, drive in content["drives"].items():
        prm = f"{drive['constant']:.9g} {drive['length']:.9g} {-drive['kd']:.9g}"
        new = etree.SubElement(
            actuators, "general", name=name, joint=drive["joint"], gear=f"{drive['gear']:.9g}", biastype="affine",
            gainprm=f"{drive['kp']:.9g}", biasprm=prm,
        )  # fmt: skip
        if drive["force"] is not None:
            new.set("forcerange", f"{-drive['force']:.9g} {drive['force']:.9g}")
            new.set("forcelimited", "true")
        if drive["activation"] != "none":
            new.set("dyntype", drive["activation"])
            new.set("dynprm", f"{drive['time_constant']:.9g}")
        if drive["delay"] > 0:
            new.set("delay", f"{drive['delay']:.9g}")
            new.set("nsample", str(int(np.ceil(drive["delay"] / content["dt"])) + 2))
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


# (our number: theirs), and what a number means there
SIMULATORS: dict[str, tuple[dict[str, str], str]] = {
    "mujoco": (
        {
            "armature": "joint armature",
            "damping": "joint damping",
            "friction": "joint frictionloss",
            "stiffness": "joint stiffness",
            "rest": "joint springref",
            "kp": "general gainprm[0], -biasprm[1]",
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


def for_simulator(content: dict[str, Any], name: str) -> dict[str, Any]:
    """The loop's numbers in the words of a simulator: `values`, `meaning`, and `unsaid` with what it cannot say."""
    if name not in SIMULATORS:
        raise InputError(f"--for {name}: unknown{nearest(name, SIMULATORS)}; known: {', '.join(SIMULATORS)}")
    words, meaning = SIMULATORS[name]
    values, unsaid = [], []
    for kind in ("joints", "drives"):
        for place, numbers in content[kind].items():
            for number, value in numbers.items():
                if number in ("joint", "gear", "length", "activation") or value is None:
                    continue
                if number in words:
                    values.append({"at": place, "number": number, "word": words[number], "value": value})
                elif value != 0 and number not in (*_NEUTRAL, "time_constant", "constant"):
                    unit = UNITS["force_limit" if number == "force" else number]
                    unsaid.append({"at": place, "number": number, "value": value, "unit": unit})
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
