"""A made recording set with the truth that is hidden in it, and how it is written to disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Truth:
    """One hidden effect: its name and place in the words of the contract, its parameters in SI units."""

    effect: str
    at: tuple[str, ...]
    parameters: dict[str, float]


@dataclass(frozen=True)
class Case:
    """Recordings of a robot: each a dict of `name`, `time` (s), `position`, `torque` (joint side), `repeat`, `role`."""

    robot: str
    urdf: str  # text of the nominal model
    joints: tuple[str, ...]
    recordings: tuple[dict[str, Any], ...]
    truth: tuple[Truth, ...]
    trust: float
    seed: int
    induced: dict[str, float] = field(default_factory=dict)  # effect: RMS of its torque over the joint's RMS torque
    baseline: dict[str, bool] = field(default_factory=dict)  # what the task declares beside friction
    links: tuple[tuple[float, ...], ...] = ()  # the true ten parameters of each, with what is hidden in them

    def write(self, folder: Path | str, forbid: Sequence[str] = (), cutoff: float = 15, rate: float = 50) -> Path:
        """Write recordings, nominal URDF and `task.yaml` into `folder`; return the path of the task."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "robot.urdf").write_text(self.urdf)
        for rec in self.recordings:
            arrays = {"t": rec["time"], "q": rec["position"], "tau": rec["torque"]}
            np.savez(folder / f"{rec['name']}.npz", **arrays)
        path = folder / "task.yaml"
        # JSON is YAML: no package for writing it is needed here
        path.write_text(json.dumps(self._task(forbid, cutoff, rate), indent=1))
        return path

    def _task(self, forbid: Sequence[str], cutoff: float, rate: float) -> dict[str, Any]:
        robot: dict[str, Any] = {"model": "robot.urdf", "joints": list(self.joints), "trust": self.trust}
        task: dict[str, Any] = {"robot": robot, "data": [_entry(rec) for rec in self.recordings]}
        task["preprocess"] = {"cutoff": cutoff, "rate": rate}
        if self.baseline:
            task["baseline"] = self.baseline
        if forbid:
            task["diagnose"] = {"forbid": list(forbid)}
        return task


def _entry(rec: dict[str, Any]) -> dict[str, Any]:
    entry = {"file": f"{rec['name']}.npz", "time": "t", "position": "q", "torque": "tau", "role": rec["role"]}
    return entry | ({"repeat": rec["repeat"]} if rec["repeat"] else {})
