"""Tiny robots in URDF and MJCF, written inline: what a test does not say about a robot is here."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np

from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.model import RobotModel

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


# MJCF: several joints on a body with anchors away from its origin, ball and free joints, welded bodies, turned frames,
# a reference position, defaults, a name for body and joint alike, and bodies and joints without a name
CREATURE = """<mujoco model="creature">
  <compiler angle="degree" eulerseq="XYZ"/>
  <option gravity="0.3 -0.2 -9.5"/>
  <default>
    <joint armature="0.02" damping="0.1"/>
    <default class="stiff"><joint stiffness="3" damping="0.4"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body name="torso" pos="0 0 1" euler="10 20 30">
      <freejoint/>
      <inertial pos="0.05 -0.02 0.1" quat="0.9 0.1 -0.2 0.3" mass="4" diaginertia="0.2 0.15 0.1"/>
      <site name="imu" pos="0.1 0 0.2" euler="0 90 0"/>
      <body name="pack" pos="-0.1 0.05 0.2" euler="30 0 20">
        <geom type="box" size="0.1 0.05 0.08" pos="0.02 0 0.01" mass="0.8"/>
        <site name="strap" pos="0 0.05 0"/>
      </body>
      <body name="thigh" pos="0.1 0.2 -0.1" euler="-10 5 0">
        <joint name="hip_z" axis="0 0 1" pos="0.01 0.02 0.03" range="-60 60"/>
        <joint name="hip_x" axis="1 0.1 0" pos="-0.02 0.03 0.05" ref="15" frictionloss="0.3"/>
        <joint type="slide" axis="0 0.2 1" pos="0.1 0.1 0" damping="2" springref="0.1" stiffness="40"/>
        <geom type="capsule" fromto="0 0 0 0 0.05 -0.4" size="0.05" density="800"/>
        <body name="shank" pos="0 0.05 -0.4">
          <joint name="shank" class="stiff" axis="0 1 0" pos="0 0 0.02" ref="-20" springref="10" armature="0.05"/>
          <inertial pos="0.01 0 -0.2" mass="0.9" fullinertia="0.02 0.021 0.004 0.001 -0.002 0.0005"/>
        </body>
      </body>
      <body pos="0.1 -0.25 0.3" euler="40 0 -30">
        <joint name="shoulder" type="ball" pos="0.02 0.01 -0.03" damping="0.3"/>
        <inertial pos="0.2 0 0" mass="1.1" diaginertia="0.01 0.03 0.03"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="wrist" axis="0 1 1" actuatorfrcrange="-7 7"/>
          <inertial pos="0.05 0.01 0" mass="0.3" diaginertia="0.001 0.002 0.002"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""

# MJCF of an arm on a table: a coupled finger, coupled drives, motors with gears, compensated gravity
GRIPPER = """<mujoco model="gripper">
  <compiler autolimits="true"/>
  <worldbody>
    <body name="table" pos="0.5 0 0.7">
      <geom type="box" size="0.5 0.5 0.02" mass="20"/>
      <body name="upper" pos="0 0.1 0.1" quat="0.8 0.6 0 0" gravcomp="1">
        <joint name="shoulder" axis="0 0 1" range="-90 90" frictionloss="0.4"/>
        <inertial pos="0 0 0.2" mass="3" diaginertia="0.05 0.05 0.01"/>
        <body name="fore" pos="0 0 0.4" gravcomp="0.5">
          <joint name="elbow" axis="0 1 0" damping="0.5 0.2 0.1" armature="0.1"/>
          <inertial pos="0.02 0 0.15" mass="2" diaginertia="0.02 0.02 0.004"/>
          <site name="tool" pos="0 0 0.3"/>
          <body name="left" pos="0 0.03 0.3">
            <joint name="left" type="slide" axis="0 1 0" range="0 0.04" ref="0.01" armature="0.3" damping="1.5"/>
            <inertial pos="0 0 0.03" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>
          </body>
          <body name="right" pos="0 -0.03 0.3">
            <joint name="right" type="slide" axis="0 -1 0" ref="0.02" damping="0.7" stiffness="5" springref="0.03"/>
            <inertial pos="0 0 0.03" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0.005 0.9 0 0 0"/></equality>
  <tendon>
    <fixed name="belt" armature="0.03" damping="0.6" frictionloss="0.2">
      <joint joint="shoulder" coef="2"/><joint joint="elbow" coef="-2"/>
    </fixed>
  </tendon>
  <actuator>
    <motor joint="shoulder" gear="50" ctrlrange="-2 2" armature="1e-4" damping="2e-4"/>
    <position joint="elbow" kp="100" kv="10" forcerange="-80 60" gear="2"/>
    <general joint="left" biastype="affine" biasprm="-0.5 0 0" gear="3"/>
  </actuator>
</mujoco>"""


def quadruped(legs: int = 4) -> str:
    """MJCF of a walking robot: a free trunk and three joints a leg."""
    trunk = '<freejoint name="base"/><inertial pos="0.01 0 0.02" mass="5" fullinertia="0.02 0.06 0.07 0.001 0.002 0"/>'
    body = ""
    for leg in range(legs):
        x, y = 0.2 * (-1) ** (leg // 2), 0.1 * (-1) ** leg
        body += f'''<body name="hip{leg}" pos="{x} {y} 0"><joint name="abduct{leg}" axis="1 0 0" armature="0.005"/>
          <inertial pos="0 {y / 5} 0" mass="0.6" diaginertia="4e-4 6e-4 5e-4"/>
          <body name="thigh{leg}" pos="0 {y / 2} 0"><joint name="swing{leg}" axis="0 1 0" range="-2 2" damping="0.1"/>
            <inertial pos="0 0 -0.05" mass="0.9" diaginertia="5e-3 5e-3 1e-3"/>
            <body name="shank{leg}" pos="0 0 -0.2"><joint name="knee{leg}" axis="0 1 0" frictionloss="0.1"/>
              <inertial pos="0.01 0 -0.1" mass="0.2" diaginertia="2e-3 2e-3 1e-4"/>
              <site name="foot{leg}" pos="0 0 -0.2"/></body></body></body>'''
    world = f'<body name="trunk" pos="0 0 0.4">{trunk}{body}</body>'
    return f'<mujoco model="quadruped"><compiler angle="radian"/><worldbody>{world}</worldbody></mujoco>'


MJCF = {"creature": CREATURE, "gripper": GRIPPER, "quadruped": quadruped()}


def without_looks(urdf: str) -> str:
    """The URDF without what names a mesh."""
    for tag in ("visual", "collision"):
        urdf = re.sub(rf"<{tag}\b.*?</{tag}>|<{tag}\b[^>]*/>", "", urdf, flags=re.DOTALL)
    return urdf


def load(text: str, folder: Path, **options: object) -> RobotModel:
    """Model of a robot given as text."""
    path = folder / "robot.urdf"
    path.write_text(text)
    return load_urdf(path, **options)  # pyright: ignore[reportArgumentType]


def states(model: RobotModel, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random positions over more than a turn, velocities and accelerations."""
    q, v, a = np.random.default_rng(seed).uniform(-4.0, 4.0, (3, samples, model.nv))
    return q, v, a


# gravity along x, centre of mass on x: a textbook pendulum
PENDULUM = robot(
    '<link name="base"/><link name="bob"><inertial><mass value="1.3"/><origin xyz="0.4 0 0"/>'
    '<inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    joint("swing", "base", "bob", rpy="0 1.5707963267948966 0", xyz="0 0 0"),
)

# a plane in an odd direction, and a free joint that does not hang on the world
PLANE = robot(
    *LINKS[:4],
    joint("glide", "base", "a", "planar", "1 2 -2"),
    joint("turn", "a", "b", axis="0 1 -2"),
    joint("fly", "b", "c", "floating"),
)

# free and ball joints, anchors off the bodies' origins, a reference position, a welded body, a floor
BEAST = """<mujoco model="beast"><compiler angle="radian"/><option gravity="0.3 -0.2 -9.7"/><worldbody>
<geom type="plane" size="5 5 0.1"/>
<body name="trunk" pos="0 0 0.5" quat="0.9 0.1 -0.2 0.3"><freejoint name="root"/>
  <geom type="box" size="0.3 0.1 0.05" mass="4" pos="0.02 0 0.01"/>
  <body name="upper" pos="0.3 0 0.05" quat="0.8 0.3 0 0.2">
    <joint name="shoulder" type="ball" pos="0.01 0.02 -0.03" damping="0.1"/>
    <geom type="capsule" size="0.04" fromto="0 0 0 0.2 0.05 0.1" mass="1.2"/>
    <body name="hand" pos="0.25 0 0">
      <joint name="wrist" type="hinge" axis="0 1 1" pos="0 0 0.02" ref="0.3" armature="0.2" range="-2 2"/>
      <geom type="box" size="0.05 0.03 0.02" mass="0.4" pos="0.03 0 0"/>
      <site name="tip" pos="0.05 0.01 0.02" quat="0.5 0.5 0.5 0.5"/>
    </body>
  </body>
  <body name="tail" pos="-0.3 0 0"><joint name="slider" type="slide" axis="1 0 1" range="-0.2 0.2"/>
    <geom type="sphere" size="0.05" mass="0.3"/>
    <body name="fin" pos="-0.1 0 0"><geom type="box" size="0.05 0.05 0.01" mass="0.1" euler="0.3 0.2 0.1"/></body>
  </body>
</body></worldbody></mujoco>"""


def _quadruped() -> str:
    """A trunk on a free joint and four legs of three hinges."""
    legs = []
    for leg, (x, y) in {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}.items():
        thigh = (
            f'<body name="{leg}_calf" pos="0 0 -0.2"><joint name="{leg}_knee" axis="0 1 0" range="-2.6 -0.5"/>'
            '<geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.2" mass="0.2"/></body>'
        )
        hip = (
            f'<body name="{leg}_thigh" pos="0 {0.3 * y} 0"><joint name="{leg}_hip" axis="0 1 0" range="-1 3"/>'
            f'<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.9"/>{thigh}</body>'
        )
        legs.append(
            f'<body name="{leg}_abductor" pos="{x} {y} 0"><joint name="{leg}_abduction" axis="1 0 0" range="-1 1"/>'
            f'<geom type="sphere" size="0.05" mass="0.7"/>{hip}</body>'
        )
    trunk = '<freejoint name="base"/><geom type="box" size="0.2 0.1 0.06" mass="6" pos="0.01 0 0"/>'
    return (
        '<mujoco model="quadruped"><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.4">'
        f"{trunk}{''.join(legs)}</body></worldbody></mujoco>"
    )


MIXED = {"pendulum": PENDULUM, "plane": PLANE, "beast": BEAST, "quadruped": _quadruped()}
_HELD = tempfile.TemporaryDirectory(prefix="figaroh_jax_robots_")  # gone at the end
_FOLDER = Path(_HELD.name)


def write(name: str) -> Path:
    """File of one of the robots of this module, in a folder of the test run."""
    text = (INLINE | MIXED)[name]
    path = _FOLDER / (f"{name}.xml" if text.startswith("<mujoco") else f"{name}.urdf")
    path.write_text(text)
    return path
