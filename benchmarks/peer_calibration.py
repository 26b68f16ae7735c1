"""Calibrates a robot with FIGAROH's own class when asked to; see `calibration.py`, which starts this.

Runs under the interpreter of FIGAROH's environment, without this project. One JSON request as argument: URDF, CSV with
the columns x1, y1, z1 and the joints, `base_frame`, `tool_frame`, `level` and rows to leave out; one JSON answer.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import warnings
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import yaml
from peer_regressor import peak_mb


def main() -> None:
    import figaroh.calibration.base_calibration as peer  # pyright: ignore[reportMissingImports]

    class Plain(peer.BaseCalibration):
        """FIGAROH's default cost without the warning that it gives at each of its evaluations."""

        def cost_function(self, var: np.ndarray) -> np.ndarray:
            pose = peer.calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            return self._compute_logmap_residuals(self.PEE_measured, pose)

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the libraries print stays out of the answers
    warnings.simplefilter("ignore")
    request = json.loads(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "config.yaml"
        config.write_text(yaml.safe_dump(configuration(request)))
        model = pin.buildModelFromUrdf(request["urdf"])
        robot = SimpleNamespace(model=model, data=model.createData(), q0=pin.neutral(model))
        start = time.process_time()
        found = Plain(robot, str(config), del_list=request["left_out"])
        found.calib_config |= {"known_baseframe": False, "known_tipframe": False}
        found.initialize()
        result = found.solve(enable_logging=False)
        cpu = time.process_time() - start
    error = found.PEE_measured - found.get_pose_from_measure(result.x)
    rms = 1e3 * float(np.sqrt(np.sum(error**2) / len(found.q_measured)))
    answer = {
        "cpu": cpu,
        "rms": rms,
        "parameters": len(result.x),
        "evaluations": int(result.nfev),
        "peak_mb": peak_mb(),
    }
    print(json.dumps(answer | {"figaroh": version("figaroh")}), file=answers, flush=True)


def configuration(request: dict) -> dict:
    """The unified configuration of FIGAROH for positions of one marker."""
    measured = [True, True, True, False, False, False]
    poses = {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6}
    task = {
        "enabled": True,
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": request["base_frame"], "tool_frame": request["tool_frame"]},
        "parameters": {"calibration_level": request["level"], "outlier_threshold": None},
        "measurements": {"markers": [{"measurable_dof": measured}], "poses": poses},
        "data": {"source_file": request["csv"]},
    }
    return {"schema_version": "2.0", "robot": {"name": "robot"}, "tasks": {"calibration": task}}


if __name__ == "__main__":
    main()
