"""Base parameters and their fit by FIGAROH, when asked to; see `identification.py`, which starts this."""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from importlib.metadata import version

import numpy as np
from peer_regressor import figaroh, load, peak_mb


def main() -> None:
    from figaroh.tools import qrdecomposition, regressor  # pyright: ignore[reportMissingImports]

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the libraries print stays out of the answers
    request = json.loads(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_AS, (int(request["limit_mb"] * 1e6), -1))
    robot = load(request["path"], request["joints"])
    state = np.random.default_rng(0).standard_normal((3, request["samples"], robot.model.nv))
    figaroh(robot, *(x[:2] for x in state), drive=True)  # imports are not timed
    noise = np.random.default_rng(1).standard_normal(request["samples"] * robot.model.nv)
    start = time.process_time()
    try:
        W = figaroh(robot, *state, drive=True)
        parameters = {f"p{k}": 1.0 for k in range(W.shape[1])}  # its own list leaves the drives' columns out
        tau = W @ np.ones(W.shape[1]) + 0.01 * noise
        built = time.process_time()
        gone, kept = regressor.get_index_eliminate(W, parameters, 1e-6)
        reduced = regressor.build_regressor_reduced(W, gone)
        base = qrdecomposition.double_QR(tau, reduced, kept)
        answer = {"rank": int(base[0].shape[1]), "cpu": time.process_time() - start, "build": built - start}
    except MemoryError:
        answer = {"failed": f"MemoryError below {request['limit_mb'] / 1000:g} GB"}
    print(json.dumps(answer | {"peak_mb": peak_mb(), "figaroh": version("figaroh")}), file=answers, flush=True)


if __name__ == "__main__":
    main()
