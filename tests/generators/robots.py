"""Robots that the cases are made of: nominal models as Pinocchio reads them, and plausible friction of their joints."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

# Two revolute joints and a slide: enough for every law, and no file is needed.
SMALL_ARM = """<?xml version="1.0"?>
<robot name="small_arm">
  <link name="base"/>
  <link name="turret"><inertial><origin xyz="0.02 0.01 0.1"/><mass value="6"/>
    <inertia ixx="0.05" iyy="0.06" izz="0.04" ixy="0.002" ixz="0.001" iyz="-0.002"/></inertial></link>
  <link name="beam"><inertial><origin xyz="0.2 0.01 0.02"/><mass value="4"/>
    <inertia ixx="0.01" iyy="0.09" izz="0.09" ixy="0.001" ixz="-0.002" iyz="0.001"/></inertial></link>
  <link name="ram"><inertial><origin xyz="0.1 0.02 -0.03"/><mass value="2"/>
    <inertia ixx="0.004" iyy="0.012" izz="0.011" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="turret"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="4" effort="200"/></joint>
  <joint name="lift" type="revolute"><parent link="turret"/><child link="beam"/><origin xyz="0.1 0 0.1"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="4" effort="200"/></joint>
  <joint name="slide" type="prismatic"><parent link="beam"/><child link="ram"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-0.3" upper="0.3" velocity="1.5" effort="500"/></joint>
</robot>
"""


@dataclass(frozen=True)
class Robot:
    """Nominal robot: its URDF, the joints that move (column order) and their true viscous and Coulomb friction."""

    name: str
    urdf: str
    model: pin.Model
    joints: tuple[str, ...]
    links: tuple[str, ...]  # link moved by each joint
    prismatic: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray


# file below the data folder, joints held still, viscous (N m s/rad), Coulomb (N m)
FILES = {
    "tx40": ("staubli_tx40/tx40.urdf", (), (8.05, 5.53, 1.97, 1.11, 1.86, 0.65), (7.14, 8.26, 6.34, 2.48, 3.03, 0.6)),
    "panda": (
        "panda_gaz2019/panda.urdf",
        ("panda_finger_joint1", "panda_finger_joint2"),
        (3.0, 3.5, 2.5, 2.5, 1.2, 1.0, 0.8),
        (4.0, 5.0, 4.0, 4.0, 1.5, 1.5, 1.0),
    ),
    "ur10e": ("ur10e_innopolis/ur10e.urdf", (), (12.0, 12.0, 8.0, 2.5, 2.5, 2.0), (12.0, 14.0, 9.0, 2.5, 2.5, 2.0)),
}
INLINE = {"small": (SMALL_ARM, (2.5, 2.0, 8.0), (3.0, 3.5, 6.0))}


def data_folder() -> Path:
    """Folder of the real robots' files: `FIGAROH_JAX_DATA`, else `../shared/data` beside the repository."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("FIGAROH_JAX_DATA", beside))


def available(name: str) -> bool:
    """Whether the robot's model is on this machine."""
    return name in INLINE or (data_folder() / FILES[name][0]).is_file()


def load(name: str) -> Robot:
    """The robot called `name`."""
    if name in INLINE:
        text, viscous, coulomb = INLINE[name]
        still: tuple[str, ...] = ()
    else:
        file, still, viscous, coulomb = FILES[name]
        text = (data_folder() / file).read_text()
    full = pin.buildModelFromXML(text)
    locked = [full.getJointId(joint) for joint in still]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
    joints = tuple(model.names)[1:]
    prismatic = np.array(["P" in model.joints[i + 1].shortname()[10:] for i in range(model.nv)])
    links = tuple(_moved_link(model, i + 1) for i in range(model.nv))
    return Robot(name, text, model, joints, links, prismatic, np.array(viscous), np.array(coulomb))


def _moved_link(model: pin.Model, joint: int) -> str:
    bodies = [f for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint]
    return next(f.name for f in bodies if f.placement.isIdentity(1e-12))


def torque(model: pin.Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Joint torque of the rigid bodies along a motion, one call of Pinocchio for each row."""
    data = model.createData()
    return np.array([pin.rnea(model, data, *row).copy() for row in zip(q, v, a, strict=True)])


def ten(model: pin.Model, joint: int) -> np.ndarray:
    """Inertial parameters of the link that joint index `joint` (from 0) moves, in Pinocchio's order."""
    return model.inertias[joint + 1].toDynamicParameters()


def add_ten(model: pin.Model, joint: int, change: np.ndarray) -> pin.Model:
    """Copy of the model with `change` added to the ten parameters of one link."""
    changed = model.copy()
    changed.inertias[joint + 1] = pin.Inertia.FromDynamicParameters(ten(model, joint) + change)
    return changed


def ten_of_body(mass: float, com: np.ndarray, density_radius: np.ndarray) -> np.ndarray:
    """Ten parameters of a body: mass, centre of mass, root mean squares of its density along x, y, z."""
    second = mass * (np.diag(density_radius**2) + np.outer(com, com))
    return ten_of_pseudo(np.block([[second, mass * com[:, None]], [mass * com[None], np.array([[mass]])]]))


def ten_of_pseudo(pseudo: np.ndarray) -> np.ndarray:
    """Ten parameters of a 4 x 4 pseudo-inertia [[second moment, m c], [m c', m]]."""
    second, first, mass = pseudo[:3, :3], pseudo[:3, 3], pseudo[3, 3]
    inertia = np.trace(second) * np.eye(3) - second
    xx, xy, yy, xz, yz, zz = (inertia[i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    return np.array([mass, *first, xx, xy, yy, xz, yz, zz])


def pseudo_of_ten(p: np.ndarray) -> np.ndarray:
    """Pseudo-inertia of ten parameters."""
    inertia = np.array([[p[4], p[5], p[7]], [p[5], p[6], p[8]], [p[7], p[8], p[9]]])
    second = np.trace(inertia) / 2 * np.eye(3) - inertia
    return np.block([[second, p[1:4, None]], [p[None, 1:4], p[None, :1]]])


def true_robot(model: pin.Model, error: float, rng: np.random.Generator) -> pin.Model:
    """The robot as it really is: every link stretched, moved and made heavier by about `error` (relative one-sigma).

    A congruence of the pseudo-inertia, so that the links stay bodies that can exist.
    """
    changed = model.copy()
    for joint in range(model.nv):
        nominal = pseudo_of_ten(ten(model, joint))
        lever = np.linalg.norm(nominal[:3, 3]) / nominal[3, 3] if nominal[3, 3] > 0 else 0.0
        affine = np.eye(4)
        affine[:3, :3] += error / 2 * rng.standard_normal((3, 3))
        affine[:3, 3] = error * lever * rng.standard_normal(3)
        pseudo = (1 + error * rng.standard_normal()) * affine @ nominal @ affine.T
        changed.inertias[joint + 1] = pin.Inertia.FromDynamicParameters(ten_of_pseudo(pseudo))
    return changed
