"""The problem of `calibration.py speed` for SciPy and Pinocchio: a Python loop and finite differences.

    python benchmarks/pinocchio_calibration.py PROBLEM.npz

solves the one that `calibration.py` wrote and prints this process' CPU seconds, from its first line to the answer.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


class Peer:
    """The same problem for SciPy: a Pinocchio loop and finite differences."""

    def __init__(self, path: Path, frame: str, joint: np.ndarray, twists: np.ndarray) -> None:
        import pinocchio  # pyright: ignore[reportMissingImports]

        pin: Any = pinocchio
        self.pin, self.robot, self.joint, self.twists = pin, pin.buildModelFromUrdf(str(path)), joint, twists
        self.nominal = [pin.SE3(placement) for placement in self.robot.jointPlacements]
        self.tool = self.robot.getFrameId(frame)

    def poses(self, q: np.ndarray, x: np.ndarray, base, marker) -> list:
        """Poses of the marker in the device's frame, with the columns' coefficients `x`."""
        total = np.zeros((6, 6))
        np.add.at(total, self.joint, x[:, None] * self.twists)
        for k, twist in enumerate(total):
            E = self.pin.SE3(self.pin.exp3(twist[3:]), twist[:3])
            self.robot.jointPlacements[k + 1] = self.nominal[k + 1] * E
        data, found = self.robot.createData(), []
        for row in q:
            self.pin.framesForwardKinematics(self.robot, data, row)
            found.append(base * data.oMf[self.tool] * marker)
        return found

    def solve(self, q: np.ndarray, seen: list, near: list, picked: np.ndarray) -> float:
        """Cost of the least squares over both frames and the columns `picked`."""
        from scipy.optimize import least_squares

        def residual(y: np.ndarray) -> np.ndarray:
            x = np.zeros(len(self.joint))
            x[picked] = 1e-3 * y[12:]
            marks = [m * self.pin.exp6(1e-2 * d) for m, d in zip(near, (y[:6], y[6:12]), strict=True)]
            found = self.poses(q, x, *marks)
            return 1e4 * np.concatenate([self.pin.log6(s.actInv(p)).vector for s, p in zip(seen, found, strict=True)])

        return least_squares(residual, np.zeros(12 + len(picked)), method="lm").cost


def main(file: str) -> None:
    with np.load(file) as z:
        peer = Peer(Path(str(z["urdf"])), str(z["frame"]), z["joint"], z["twists"])
        seen, near = ([peer.pin.SE3(pose) for pose in z[name]] for name in ("poses", "near"))
        cost = peer.solve(z["q"], seen, near, z["picked"])
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(json.dumps({"cpu": time.process_time(), "peak_mb": int(peak.split()[1]) / 1024, "cost": cost}))


if __name__ == "__main__":
    main(sys.argv[1])
