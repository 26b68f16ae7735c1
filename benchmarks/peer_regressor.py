"""Builds joint-torque regressors with FIGAROH's own builder, or with Pinocchio in a Python loop, when asked to.

Runs under the interpreter of FIGAROH's environment, without this project: `regressor.py` starts it and writes one JSON
request a line; each answer is a line with the CPU seconds of the build, the norm of W and the peak resident memory.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]


def load(path: str, joints: list[str]) -> Any:
    """Robot with only the given joints moving; no mesh is needed."""
    model = pin.buildModelFromUrdf(path)
    still = [i for i, name in enumerate(model.names) if i and name not in joints]
    model = pin.buildReducedModel(model, still, pin.neutral(model))
    return SimpleNamespace(model=model, data=model.createData())


def pinocchio_loop(robot: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    W = np.empty((len(q), robot.model.nv, 10 * (robot.model.njoints - 1)))
    for k in range(len(q)):
        W[k] = pin.computeJointTorqueRegressor(robot.model, robot.data, q[k], v[k], a[k])
    return W


def figaroh(robot: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray, drive: bool = False) -> np.ndarray:
    from figaroh.tools.regressor import build_regressor_basic  # pyright: ignore[reportMissingImports]

    options: dict[str, Any] = {"has_friction": drive, "has_actuator_inertia": drive, "has_joint_offset": drive}
    options |= {"is_joint_torques": True, "act_idxv": range(robot.model.nv)}
    return build_regressor_basic(robot, q, v, a, options)


METHODS = {
    "pinocchio": pinocchio_loop,
    "figaroh": figaroh,
    "figaroh+drives": lambda *x: figaroh(*x, drive=True),
}


def peak_mb() -> float:
    """Peak resident memory of this process (ru_maxrss would inherit the peak of the one that started it)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the libraries print stays out of the answers
    print(json.dumps({"figaroh": version("figaroh"), "pin": version("pin")}), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        robot = load(request["path"], request["joints"])
        state = np.random.default_rng(0).standard_normal((3, request["samples"], robot.model.nv))
        order = [request["joints"].index(name) for name in list(robot.model.names)[1:]]
        state = [np.ascontiguousarray(x[:, order]) for x in state]
        METHODS[request["method"]](robot, *(x[:2] for x in state))  # imports are not timed
        start = time.process_time()
        W = METHODS[request["method"]](robot, *state)
        cpu = time.process_time() - start
        peak = peak_mb()
        norm = float(W.ravel() @ W.ravel()) ** 0.5
        del W
        print(json.dumps({"cpu": cpu, "norm": norm, "peak_mb": peak}), file=answers, flush=True)


if __name__ == "__main__":
    main()
