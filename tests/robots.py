"""Tiny robots in URDF, written inline: what a test does not say about a robot is here."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from figaroh_jax.model import RobotModel
from figaroh_jax.urdf import load_urdf

REAL = {  # robots of the recordings, under the data folder
    "tx40": "staubli_tx40/tx40.urdf",
    "ur10e": "ur10e_innopolis/ur10e.urdf",
    "panda": "panda_gaz2019/panda.urdf",
    "tiago": "tiago_dynamic/tiago_no_hand.urdf",
    "talos": "talos_contact/talos_full_v2.urdf",
}


def link(name: str, mass: float = 1.0, com: str = "0.1 -0.05 0.2", rpy: str = "0.3 -0.2 0.5") -> str:
    """A link whose inertia is turned and shifted against its frame."""
    inertia = (
        f'<inertia ixx="{0.02 * mass}" iyy="{0.03 * mass}" izz="{0.015 * mass}" ixy="0.001" ixz="-0.002" iyz="0"/>'
    )
    inertial = f'<mass value="{mass}"/><origin xyz="{com}" rpy="{rpy}"/>{inertia}'
    return f'<link name="{name}"><inertial>{inertial}</inertial></link>'


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    axis: str = "0 0 1",
    xyz: str = "0.1 0.2 0.3",
    rpy: str = "0.4 -0.3 0.2",
    more: str = "",
) -> str:
    """A joint; `more` holds further elements (limit, mimic)."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def robot(*parts: str) -> str:
    return f'<robot name="tiny">{"".join(parts)}</robot>'


LINKS = [link("base"), link("a", 2.0), link("b", 1.5, com="-0.1 0.2 0"), link("c", 0.7), link("d", 0.4)]

ARM = robot(*LINKS[:3], joint("turn", "base", "a", axis="1 2 -1"), joint("slide", "a", "b", "prismatic", "0 3 4"))

# two branches; a fixed joint in the middle; a mimic joint that stands before the joint it follows
TREE = robot(
    *LINKS,
    link("e", 0.3),
    link("f", 0.2),
    joint("hip", "base", "a", axis="0 1 0"),
    joint("copy", "a", "b", axis="1 0 1", more='<mimic joint="knee" multiplier="-1.5" offset="0.3"/>'),
    joint("weld", "b", "c", "fixed"),
    joint("finger", "c", "d", "prismatic", "1 1 0"),
    joint("knee", "a", "e", "continuous", "0 1 0.5"),
    joint("toe", "base", "f", axis="1 0 0"),
)

LIMIT = '<limit lower="-2" upper="2" velocity="3" effort="40"/>'  # Pinocchio reads no sliding joint without one

# joints of several degrees of freedom below, beside and above others
GENERAL = robot(
    *LINKS,
    link("e", 0.3),
    joint("lift", "base", "a", "prismatic", "0 0 1", more=LIMIT),
    joint("cart", "a", "b", "planar", "0 0 1"),
    joint("elbow", "b", "c", axis="1 0 1", more=LIMIT),
    joint("loose", "c", "d", "floating"),
    joint("tail", "base", "e", "continuous", "0 1 0"),
)

INLINE = {"arm": ARM, "tree": TREE}


def load(text: str, folder: Path, **options: object) -> RobotModel:
    """Model of a robot given as text."""
    path = folder / "robot.urdf"
    path.write_text(text)
    return load_urdf(path, **options)  # pyright: ignore[reportArgumentType]


def states(model: RobotModel, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random positions over more than a turn, velocities and accelerations."""
    q, v, a = np.random.default_rng(seed).uniform(-4.0, 4.0, (3, samples, model.nv))
    return q, v, a
