"""The real recordings that effects are hidden in: each set as a task, with its files on the joint side and as stored.

Torque is kept twice: `torque` on the joint side (N m), on which effects act, and in the file in the words of the task
(motor torque, current). `stored` turns what is added at the joints into what is added in the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

Array = np.ndarray
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
OFFSET = {"offset": True}
ENTRY = {"time": "t", "position": "q", "torque": "tau"}
UR_GAIN = np.array([10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232])  # N m/A, published with the recordings
TIAGO_GAIN = np.array([13.6, 13.6, -8.7, -8.7])  # N m a unit of effort, arm_1 to arm_4
TX40_GEARS = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])


@dataclass(frozen=True)
class Recording:
    """One file: what it holds, how the task declares it, and its motion and torque at the joints."""

    name: str
    arrays: dict[str, Array]
    entry: dict[str, Any]
    time: Array  # (samples,) s
    position: Array  # (samples, joints) rad
    torque: Array  # (samples, joints) N m

    @property
    def fitted(self) -> bool:
        return self.entry.get("role", "fit") == "fit"


@dataclass(frozen=True)
class RealSet:
    """A robot and its recordings; `stored` maps torque added at the joints (samples, joints) to that of the file."""

    name: str
    urdf: str
    joints: tuple[str, ...]
    task: dict[str, Any]  # all of it but robot.model and data
    recordings: tuple[Recording, ...]
    model: pin.Model
    stored: Callable[[Array], Array] = field(default=lambda added: added)
    baseline_pair: tuple[int, int] | None = None  # joints whose coupling the task's baseline holds

    @property
    def cutoff(self) -> float:
        return float(self.task["preprocess"]["cutoff"])

    @property
    def window(self) -> tuple[float, float]:
        low, high = self.task["preprocess"].get("window", (-np.inf, np.inf))
        return float(low), float(high)


def links_of(model: pin.Model, joint: int) -> tuple[str, ...]:
    """Links that move with joint index `joint` (from 0); the first is the one at the joint itself."""
    bodies = [f for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint + 1]
    return tuple(f.name for f in sorted(bodies, key=lambda f: np.linalg.norm(f.placement.translation)))


def _robot(urdf: str, joints: tuple[str, ...]) -> pin.Model:
    """The model with every joint but `joints` locked at its neutral position."""
    whole = pin.buildModelFromXML(urdf)
    locked = [whole.getJointId(name) for name in list(whole.names)[1:] if name not in joints]
    model = pin.buildReducedModel(whole, locked, pin.neutral(whole)) if locked else whole
    if tuple(model.names)[1:] != joints or model.nq != model.nv:
        raise ValueError(f"joints of the model are {list(model.names)[1:]}, expected {list(joints)}")
    return model


def _set(
    name: str,
    file: str,
    joints: list[str],
    recordings: list[Recording],
    preprocess: dict[str, Any],
    robot: dict[str, Any] | None = None,
    baseline: dict[str, Any] | None = None,
    **more: Any,
) -> RealSet:
    urdf = (DATA / file).read_text()
    task = {"robot": {"joints": joints, **(robot or {})}, "preprocess": preprocess, "baseline": baseline or OFFSET}
    if "transmission" in more:
        task["transmission"] = more.pop("transmission")
    names = tuple(joints)
    return RealSet(name, urdf, names, task, tuple(recordings), _robot(urdf, names), **more)


def _recording(name: str, t: Array, q: Array, tau: Array, **entry: Any) -> Recording:
    """A recording whose file is on the joint side."""
    rows = len(t)
    q, tau = q.reshape(rows, -1).astype(float), tau.reshape(rows, -1).astype(float)
    return Recording(name, {"t": t, "q": q, "tau": tau}, ENTRY | entry, t, q, tau)


def ur10e() -> RealSet:
    """Motor currents, through the gains that were published with them; friction of the drives is in them."""
    runs = {"20_02_10_30sec_12harm": "fit", "20_02_12_40sec_12harm": "fit", "20_02_10_20sec_7harm": "holdout"}
    recordings = []
    for run, role in runs.items():
        with np.load(DATA / "ur10e_innopolis" / "id" / f"{run}.npz") as file:
            t, q, i = (np.asarray(file[key], float) for key in ("t", "q", "i"))
        entry = ENTRY | {"units": {"torque": "A"}, "role": role}
        recordings.append(Recording(run, {"t": t, "q": q, "tau": i}, entry, t, q, i * UR_GAIN))
    names = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    return _set(
        "ur10e",
        "ur10e_innopolis/ur10e.urdf",
        [f"{n}_joint" for n in names],
        recordings,
        {"cutoff": 5},
        transmission={"torque": np.diag(UR_GAIN).tolist()},
        stored=lambda added: added / UR_GAIN,
    )


def panda() -> RealSet:
    """Torque sensors at the joints; the first 15 s fitted, the rest held out."""
    with np.load(DATA / "panda_gaz2019" / "panda_exciting_traj1.npz") as file:
        t, q, tau = (file[key] for key in ("t", "q", "tau"))
    cut = int(np.searchsorted(t, 15.0))
    recordings = [
        _recording("first", t[:cut], q[:cut], tau[:cut], role="fit"),
        _recording("last", t[cut:], q[cut:], tau[cut:], role="holdout"),
    ]
    joints = [f"panda_joint{k}" for k in range(1, 8)]
    return _set("panda", "panda_gaz2019/panda.urdf", joints, recordings, {"cutoff": 5})


def tx40() -> RealSet:
    """Motor angles and torques at 5 kHz; gears couple joints 5 and 6, which the baseline holds."""
    with np.load(DATA / "staubli_tx40" / "tx40.npz") as file:
        motor, tau = (np.asarray(file[f"motor_{key}"], float) for key in ("position", "current"))
    position, torque = np.diag(TX40_GEARS), np.diag(TX40_GEARS)
    position[5, 4] = torque[4, 5] = 32.0
    offset = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])
    joints = [f"joint_{k}" for k in range(1, 7)]
    t = np.arange(len(motor)) / 5000.0
    at_joints = motor @ np.linalg.inv(position).T + offset
    entry = {"rate": 5000, "position": "q", "torque": "tau"}
    recording = Recording("tx40", {"q": motor, "tau": tau}, entry, t, at_joints, tau @ torque.T)
    return _set(
        "tx40",
        "staubli_tx40/tx40.urdf",
        joints,
        [recording],
        {"window": [0.05, 7.66], "cutoff": 20, "rate": 50},
        {"trust": 1.0},
        OFFSET | {"effects": [{"effect": "coupled_transmission", "at": joints[4:]}]},
        transmission={"position": position.tolist(), "torque": torque.tolist(), "offset": offset.tolist()},
        stored=lambda added: added @ np.linalg.inv(torque).T,
        baseline_pair=(4, 5),
    )


def tiago() -> RealSet:
    """Efforts of arm_1 to arm_4 through gain and gear; the first 70 % fitted, the rest held out."""
    with np.load(DATA / "tiago_dynamic" / "tiago_dynamic.npz") as file:
        t, q, effort = (file[key] for key in ("t", "q", "effort"))
    q, tau = q[:, 1:5], effort[:, 1:5] * TIAGO_GAIN
    cut = int(0.7 * len(t))
    recordings = [
        _recording("first", t[:cut], q[:cut], tau[:cut], role="fit"),
        _recording("last", t[cut:], q[cut:], tau[cut:], role="holdout"),
    ]
    joints = [f"arm_{k}_joint" for k in range(1, 5)]
    return _set("tiago", "tiago_dynamic/tiago_no_hand.urdf", joints, recordings, {"cutoff": 2})


def kuka() -> RealSet:
    """Torque sensors at the joints; two runs of one motion fitted, another motion held out."""
    recordings = []
    for k in (1, 2, 3):
        with np.load(DATA / "kuka_lwr4" / f"measurements_{k}.npz") as file:
            t, q, tau = (file[key] for key in ("t", "q", "tau"))
        more = {"role": "holdout"} if k == 3 else {"role": "fit", "repeat": "A"}
        recordings.append(_recording(f"measurements_{k}", t, q, tau, **more))
    joints = [f"lwr_{k}_joint" for k in range(7)]
    return _set("kuka", "kuka_lwr4/lwr4.urdf", joints, recordings, {"cutoff": 10})


def simple_pendulum() -> RealSet:
    """One joint with a quasi-direct drive; torque from the motor's current."""
    return _pendulum(
        "dfki_simple_pendulum",
        "simple_pendulum.urdf",
        ["Joint_1"],
        {"ddp": "fit", "direct_collocation": "fit", "pd_system_identification": "holdout"},
        8.0,
    )


def double_pendulum() -> RealSet:
    """Two joints, 500 Hz; torque from the motors' currents."""
    fitted = dict.fromkeys(("143339", "143524", "143601", "143704", "154220"), "fit")
    runs = {f"C1_20230629-{k}": role for k, role in {**fitted, "154548": "holdout"}.items()}
    return _pendulum("dfki_double_pendulum", "double_pendulum_C1.urdf", ["Joint1", "Joint2"], runs, 15.0)


def _pendulum(name: str, urdf: str, joints: list[str], runs: dict[str, str], cutoff: float) -> RealSet:
    recordings = []
    for run, role in runs.items():
        with np.load(DATA / name / f"{run}.npz") as file:
            t, q, tau = (file[key] for key in ("t", "q", "tau"))
        recordings.append(_recording(run, t, q, tau, role=role))
    return _set(name, f"{name}/{urdf}", joints, recordings, {"cutoff": cutoff})


SETS: dict[str, Callable[[], RealSet]] = {
    "ur10e": ur10e,
    "panda": panda,
    "tx40": tx40,
    "tiago": tiago,
    "kuka": kuka,
    "dfki_simple_pendulum": simple_pendulum,
    "dfki_double_pendulum": double_pendulum,
}
