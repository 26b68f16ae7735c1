"""Arms whose model files have wrong links, each in one way that is drawn; Pinocchio makes their recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import tasks
from simulated_arm import RATE, Truth, arm, recording

from figaroh_jax.recordings.dataset import Recording
from figaroh_jax.results import Name


class Wrong(NamedTuple):
    """A file that is wrong, recordings of the robot as it is, and what is to be told of it."""

    file: Path
    recordings: list[Recording]
    told: Name | None  # None: nothing
    number: str = ""  # a number that is to be told with it,
    size: float = 0.0  # and how large it is
    beside: tuple[Name, ...] = ()  # what else is there


def hand(folder: Path, seed: int) -> Wrong:
    """The file has a hand at the last link that is not mounted."""
    rng, truth = np.random.default_rng(seed), arm(folder, 0.02, seed)
    mass, (x, y, z) = float(rng.uniform(0.3, 0.8)), rng.uniform(-0.05, 0.1, 3)
    more = f"""<link name="hand"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>
      <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="mount" type="fixed"><parent link="tool0"/><child link="hand"/></joint></robot>"""
    truth.file.write_text(tasks.URDF.replace("</robot>", more))
    return Wrong(truth.file, _recordings(truth, seed), Name("link_inertia", ("rod",)), "mass", -mass)


def moved(folder: Path, seed: int) -> Wrong:
    """The forearm's centre of mass lies 7 to 14 cm beside where the file has it."""
    rng, truth = np.random.default_rng(seed), arm(folder, 0.02, seed)
    way, body = rng.choice([-1, 1], 2) * rng.uniform(0.05, 0.1, 2), truth.model.inertias[2]
    truth.model.inertias[2] = pin.Inertia(float(body.mass), body.lever + np.append(way, 0.0), body.inertia)
    more = truth.model.inertias[2].toDynamicParameters()[1] - float(truth.nominal.inertia[1, 1])
    return Wrong(truth.file, _recordings(truth, seed), Name("link_inertia", ("fore",)), "mx", more)


def rotor(folder: Path, seed: int) -> Wrong:
    """The drive of the first joint has a rotor, of which the file says nothing."""
    truth, inertia = arm(folder, 0.005, seed), float(np.random.default_rng(seed).uniform(0.3, 0.8))
    each = inertia * np.eye(truth.model.nv)[0]
    return Wrong(truth.file, _turning(truth, each, seed), Name("rotor_inertia", ("shoulder",)), "inertia", inertia)


def rotors(folder: Path, seed: int) -> Wrong:
    """Every drive has a rotor, of which the file says nothing."""
    truth, rng = arm(folder, 0.02, seed), np.random.default_rng(seed)
    inertia = rng.uniform(0.5, 1.5, truth.model.nv) * _about_joints(truth)
    first, *others = _drives(truth)
    return Wrong(truth.file, _turning(truth, inertia, seed), first, "inertia", float(inertia[0]), tuple(others))


def load(folder: Path, seed: int) -> Wrong:
    """The same with a load at the last link, which is no rotor: it weighs something."""
    truth, rng = arm(folder, 0.02, seed), np.random.default_rng(seed)
    inertia, mass = rng.uniform(0.5, 1.5, truth.model.nv) * _about_joints(truth), float(rng.uniform(0.5, 1.5))
    place = pin.SE3(np.eye(3), rng.uniform(-0.05, 0.1, 3))
    truth.model.inertias[truth.model.nv] += place.act(pin.Inertia.FromSphere(mass, 0.04))
    others = (Name("link_inertia", ("rod",)), *_drives(truth))
    return Wrong(truth.file, _turning(truth, inertia, seed), Name("payload", ("rod",)), "mass", mass, others)


def gain(folder: Path, seed: int) -> Wrong:
    """All torques are read too large by the same factor."""
    truth, factor = arm(folder, 0.02, seed), float(np.random.default_rng(seed).uniform(1.5, 2.0))
    read = [replace(one, torque=factor * np.array(one.torque)) for one in _recordings(truth, seed)]
    return Wrong(truth.file, read, Name("torque_gain", ()), "gain", factor)


def right(folder: Path, seed: int) -> Wrong:
    """The links are as believed."""
    truth = arm(folder, 0.05, seed)
    return Wrong(truth.file, _recordings(truth, seed), None)


KINDS: dict[str, Callable[[Path, int], Wrong]] = {
    "hand": hand, "moved": moved, "rotor": rotor, "rotors": rotors, "load": load, "gain": gain, "right": right,
}  # fmt: skip


def _recordings(truth: Truth, seed: int) -> list[Recording]:
    return [
        recording(truth, 15.0, seed, name="first"),
        recording(truth, 15.0, seed + 1, name="last", role="holdout"),
    ]


def _turning(truth: Truth, inertia: np.ndarray, seed: int) -> list[Recording]:
    """Recordings with rotors of this inertia at each joint."""
    return [
        replace(
            one,
            torque=np.array(one.torque) + inertia * np.gradient(np.gradient(one.position, axis=0), axis=0) * RATE**2,
        )
        for one in _recordings(truth, seed)
    ]


def _about_joints(truth: Truth) -> np.ndarray:
    """Inertia of all links about each joint, stretched out."""
    return np.diag(pin.crba(truth.model, truth.model.createData(), pin.neutral(truth.model)))


def _drives(truth: Truth) -> list[Name]:
    return [Name("rotor_inertia", (joint,)) for joint in truth.nominal.joint_names]
