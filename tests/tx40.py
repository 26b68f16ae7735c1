"""The TX40 recording as a task: its gears couple joints 5 and 6, and motor torques stand in place of currents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

GEARS = (32.0, 32.0, 45.0, -48.0, 45.0, 32.0)
POSITION = np.diag(GEARS)  # motor position = POSITION @ joint position
POSITION[5, 4] = 32.0
TORQUE = np.diag(GEARS)  # joint torque = TORQUE @ motor torque
TORQUE[4, 5] = 32.0
OFFSET = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0)  # rad, added to the joint position


def write_task(folder: Path, data_dir: Path, **changes: object) -> Path:
    """Write `tx40.yaml` into `folder` for the recording below `data_dir`; `changes` replace whole top-level keys."""
    tx40 = data_dir / "staubli_tx40"
    task = {
        "robot": {"model": str(tx40 / "tx40.urdf"), "trust": 1.0},
        "data": [
            {
                "file": str(tx40 / "tx40.npz"),
                "rate": 5000,
                "position": "motor_position",
                "torque": "motor_current",
            }
        ],
        "transmission": {"position": POSITION.tolist(), "torque": TORQUE.tolist(), "offset": list(OFFSET)},
        "preprocess": {"window": [0.05, 7.66], "cutoff": 20},
    } | changes
    file = folder / "tx40.yaml"
    file.write_text(yaml.safe_dump(task, sort_keys=False), encoding="utf-8")
    return file
