"""A small right task in a folder: robot, recording and task file, for tests to read as it is or to spoil."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

JOINTS = ("shoulder", "elbow", "slide")

URDF = """<robot name="bench">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="3.0"/>
    <inertia ixx="0.04" iyy="0.04" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="2.0"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
    <inertia ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool0"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="100" velocity="5"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
    <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
  <joint name="slide" type="prismatic"><parent link="fore"/><child link="rod"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.5" effort="50" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="rod"/><child link="tool0"/><origin xyz="0 0 0.2"/></joint>
</robot>
"""


def arrays(seconds: float = 4.0, rate: float = 250.0) -> dict[str, Any]:
    """Time, position, velocity and torque of a smooth motion (the torque is any smooth signal)."""
    t = np.arange(int(seconds * rate)) / rate
    phase = 2 * np.pi * np.outer(t, [0.5, 0.8, 0.6])
    amplitude = np.array([0.8, 0.6, 0.1])
    q = amplitude * np.sin(phase) + np.array([0.1, -0.2, 0.25])
    dq = amplitude * 2 * np.pi * np.array([0.5, 0.8, 0.6]) * np.cos(phase)
    return {"t": t, "q": q, "dq": dq, "tau": 5 * np.cos(phase) + 1.0}


def task() -> dict[str, Any]:
    """Keys of a right task: `run1.npz` to fit, `run2.npz` held out."""
    entry = {"time": "t", "position": "q", "torque": "tau"}
    return {
        "robot": {"model": "robot.urdf"},
        "data": [{"file": "run1.npz", **entry}, {"file": "run2.npz", "role": "holdout", **entry}],
        "preprocess": {"cutoff": 15},
    }


def write(folder: Path, keys: Any = None) -> Path:
    """Write robot, recordings and task into `folder`; returns the task file."""
    (folder / "robot.urdf").write_text(URDF)
    np.savez(folder / "run1.npz", **arrays())
    np.savez(folder / "run2.npz", **arrays(seconds=3.0))
    file = folder / "task.yaml"
    file.write_text(keys if isinstance(keys, str) else yaml.safe_dump(keys or task(), sort_keys=False))
    return file
