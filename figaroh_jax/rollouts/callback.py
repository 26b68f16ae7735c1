"""What MuJoCo has no words for, beside an exported `robot.xml`: this file reads `loop.json` and needs no plugin.

    import mujoco
    from callback import Rest

    model = mujoco.MjModel.from_xml_path("robot.xml")
    rest, data = Rest(model, "loop.json"), mujoco.MjData(model)
    rest.step(data, command)  # in place of data.ctrl[:] = command; mujoco.mj_step(model, data)
    rest.reading(data)  # what the encoders show

An effect of your own is in `loop.json` with its equation and numbers; say its torque as a function of NumPy's numbers,
`Rest(model, "loop.json", own={"detent": lambda q, v, strength, notch: ...})`: N m or N against the motion at its joint.

Friction that follows the speed (Stribeck) or the load, play of a spring, ripple, constant torques, dead bands, limited
voltages and what is late at such drives, and offsets of encoders. It needs NumPy and MuJoCo alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Rest"]

_HERE = ("stribeck_force", "load_ratio", "stiffness", "offset", "ripple_sine", "ripple_cosine", "reading")


class Rest:
    """Moves a model of `robot.xml` with everything that `loop.json` says; one for each simulation."""

    def __init__(
        self, model: Any, file: str | Path = "loop.json", own: Mapping[str, Callable[..., float]] | None = None
    ):
        content = json.loads(Path(file).read_text(encoding="utf-8"))
        joints, drives = list(content["joints"].items()), list(content["drives"].items())
        single = {model.joint(j).name for j in np.flatnonzero(model.jnt_type >= 2)}  # slides and hinges
        for name, one in joints:  # balls and free bases: all of it is in `robot.xml`
            if name not in single and any(one[word] for word in _HERE):
                raise ValueError(
                    f"{name}: friction, torques and readings of joints of several axes cannot be said here"
                )
        joints = [(name, one) for name, one in joints if name in single]
        self.model, self.late = model, []
        self.at = np.array([model.joint(name).dofadr[0] for name, _ in joints], int)
        self.place = np.array([model.joint(name).qposadr[0] for name, _ in joints], int)
        self.drive = np.array([model.actuator(name).id for name, _ in drives], int)
        self.joints = {name: np.array([one[name] for _, one in joints]) for name in joints[0][1]} if joints else {}
        words = ("kp", "length", "constant", "delay", "dead_band")
        self.drives = {name: np.array([float(one[name]) for _, one in drives]) for name in words}
        self.own = []
        for one in content.get("effects", ()):
            if one["effect"] not in (own or {}) or len(one["at"]) != 1:
                raise ValueError(
                    f"{one['effect']} ({one['equation']}) at {', '.join(one['at'])} is an effect that MuJoCo has no"
                    f" words for: give its torque, Rest(..., own={{'{one['effect']}': lambda q, v, ...: ...}})"
                )
            place = model.joint(one["at"][0])
            self.own.append((place.qposadr[0], place.dofadr[0], (own or {})[one["effect"]], one["parameters"]))
        self.volts = np.array([np.inf if one["voltage"] is None else one["voltage"] for _, one in drives])
        soon = (self.drives["delay"] > 0) & (self.drives["delay"] < model.opt.timestep)
        self.bent = (self.drives["dead_band"] > 0) | np.isfinite(self.volts) | soon
        stateful = [name for (name, one), bent in zip(drives, self.bent, strict=True) if bent and _has_state(one)]
        if stateful:
            raise ValueError(
                f"drive {stateful[0]} has a state of its own: its dead band, voltage or short delay cannot be said here"
            )
        late = self.drives["delay"] * self.bent  # MuJoCo's own delay would be behind what is added here
        model.actuator_delay[self.drive[self.bent]] = 0.0
        self.delay = late / model.opt.timestep
        self.range = np.tile([-np.inf, np.inf], (len(drives), 1))  # what is added here may leave the range of MuJoCo's
        for k in np.flatnonzero(self.bent & (model.actuator_ctrllimited[self.drive] != 0)):
            self.range[k] = model.actuator_ctrlrange[self.drive[k]]
            model.actuator_ctrllimited[self.drive[k]] = 0

    def step(self, data: Any, command: Any) -> None:
        """One step of the model; `command` (drives,) in the order of `loop.json`."""
        import mujoco

        engine: Any = mujoco
        command = np.clip(self._late(np.asarray(command, float)), *self.range.T)
        model, data.ctrl[self.drive] = self.model, command
        engine.mj_forward(model, data)
        length = data.actuator_length[self.drive]
        u = data.ctrl[self.drive]
        plain = self.drives["constant"] + self.drives["kp"] * u + self.drives["length"] * length
        idle = np.abs(self.drives["kp"]) * self.drives["dead_band"]
        force = np.clip(plain - np.clip(plain, -idle, idle), -self.volts, self.volts)
        bent = self.bent & (self.drives["kp"] != 0)
        data.ctrl[self.drive[bent]] += (force - plain)[bent] / self.drives["kp"][bent]
        self._at_the_joints(engine, data, bool(bent.any()))
        engine.mj_step(model, data)

    def reading(self, data: Any) -> np.ndarray:
        """What the encoders of the joints of one axis show, (joints,), rad or m."""
        return data.qpos[self.place] + self.joints["reading"]

    def _at_the_joints(self, engine: Any, data: Any, changed: bool) -> None:
        """Levels of friction, and torques that no element gives."""
        j, at, model = self.joints, self.at, self.model
        joint = model.dof_jntid[at]
        stretch = data.qpos[self.place] - j["rest"]
        stretch = stretch - np.clip(stretch, -j["play"] / 2, j["play"] / 2)
        own = model.jnt_stiffness[joint].reshape(len(at), -1)[:, 0] * (
            data.qpos[self.place] - model.qpos_spring[self.place]
        )
        turn = j["ripple_order"] * data.qpos[self.place]
        ripple = j["ripple_sine"] * np.sin(turn) + j["ripple_cosine"] * np.cos(turn)
        data.qfrc_applied[at] = own - j["stiffness"] * stretch - j["offset"] - ripple
        for place, column, torque, numbers in self.own:
            data.qfrc_applied[column] -= torque(data.qpos[place], data.qvel[column], **numbers)
        if not (j["stribeck_force"].any() or j["load_ratio"].any()):
            return
        if changed and j["load_ratio"].any():
            engine.mj_forward(self.model, data)
        load = np.abs(data.qfrc_actuator[at] + data.qfrc_bias[at])
        fall = np.exp(-((data.qvel[at] / np.where(j["stribeck_speed"] > 0, j["stribeck_speed"], 1.0)) ** 2))
        level = j["friction"] + j["stribeck_force"] * fall + j["load_ratio"] * load
        self.model.dof_frictionloss[at] = np.maximum(level, 0.0)

    def _late(self, command: np.ndarray) -> np.ndarray:
        """What the drives see: the mean over the step of what was held so long before."""
        if not self.delay.any():
            return command
        whole = np.floor(self.delay).astype(int)
        self.late = [command, *self.late[: int(whole.max()) + 1]]
        now, before = (
            np.array([self.late[min(k + more, len(self.late) - 1)][i] for i, k in enumerate(whole)]) for more in (0, 1)
        )
        return now + (self.delay - whole) * (before - now)


def _has_state(drive: dict[str, Any]) -> bool:
    return drive["activation"] != "none"
