"""Base parameters and their least squares fit against FIGAROH: CPU seconds and peak memory, in one run.

Random states of a robot with viscous, Coulomb, rotor and offset columns; torque of known parameters and noise. Ours
streams the states through well-conditioned products (`States`, `condense_on_devices`) or, with `--factors`, triangular
factors (`condense`); FIGAROH 1.0.2 builds the tall regressor and factors it twice. Each case is a process of its own on
one thread; compilation is told apart. `--stream N` reads N samples from files on disk. The environment of FIGAROH is
the one that `regressor.py` makes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path
from typing import Any

from regressor import DATA, FIGAROH, ONE_THREAD, ROBOTS, ROOT, peak_mb

PEER = ROOT / ".cache" / f"figaroh-{FIGAROH}" / "bin" / "python"
CASES = (("UR10e", 10**5), ("TALOS", 10**4), ("TALOS", 10**5))
PIECE = 20_000  # samples that are made, or read from disk, at once


def joints_of(robot: str) -> list[str]:
    """Moving joints in the model's order."""
    from figaroh_jax.formats.urdf import load_urdf

    return list(load_urdf(DATA / ROBOTS[robot]).joint_names)


def ours(request: dict[str, Any]) -> dict[str, Any]:
    """Fit all samples; the first fit, of one chunk, compiles."""
    import numpy as np

    from figaroh_jax.estimation.accelerators import condense_on_devices
    from figaroh_jax.estimation.base_parameters import base_parameters
    from figaroh_jax.estimation.columns import friction_terms
    from figaroh_jax.estimation.least_squares import solve
    from figaroh_jax.estimation.regression import condense
    from figaroh_jax.estimation.states import States, read_pieces
    from figaroh_jax.formats.config import Baseline
    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.rigid.dynamics import inverse_dynamics

    model = load_urdf(request["path"], joints=request["joints"])
    terms = friction_terms(model, Baseline(viscous=True, coulomb=True, rotor=True, offset=True))
    generator = np.random.default_rng(0)
    data = np.empty((4, 0, model.nv))
    if not request["files"]:
        data = np.empty((4, request["samples"], model.nv))
        data[:3] = generator.standard_normal((3, request["samples"], model.nv))
        for k in range(0, request["samples"], PIECE):
            q, v, a = data[:3, k : k + PIECE]
            data[3, k : k + PIECE] = np.asarray(inverse_dynamics(model, q, v, a)) + v + np.sign(v) + a + 1.0
        data[3] += 0.01 * generator.standard_normal(data[3].shape)

    def fit(samples: int) -> tuple[int, float]:
        if request["files"]:
            rows = States(model, lambda: islice(read_pieces(request["files"], PIECE), -(-samples // PIECE)), terms)
        else:
            pieces = range(0, samples, PIECE)
            rows = States(model, lambda: (tuple(data[:, k : min(k + PIECE, samples)]) for k in pieces), terms)
        factors = request["factors"] and not request["files"]
        condensed = condense(rows, rows.used, folds=1) if factors else condense_on_devices(rows, folds=1)
        base = base_parameters(condensed.factor()[:, :-1], rows.names)
        return base.rank, float(solve(condensed, kept=base.independent).rms.max())

    before, start = peak_mb(), time.process_time()
    fit(100 if request["factors"] else PIECE)
    compiled = time.process_time() - start
    start, wall = time.process_time(), time.perf_counter()
    count = request["samples"]
    rank, rms = fit(count)
    cpu, seconds = time.process_time() - start, time.perf_counter() - wall
    return {"rank": rank, "rms": rms, "cpu": cpu, "first": compiled, "rate": count / seconds} | {
        "peak_mb": peak_mb(),
        "before_mb": before,
    }


def ask(command: list[str], request: dict[str, Any]) -> dict[str, Any]:
    done = subprocess.run(
        [*command, json.dumps(request)], env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True
    )
    if done.returncode:
        return {"failed": f"status {done.returncode}"}
    return json.loads(done.stdout.splitlines()[-1])


def write_states(folder: str, request: dict[str, Any], samples: int) -> list[str]:
    """Files of random states and torques, made piece by piece."""
    import numpy as np

    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.rigid.dynamics import inverse_dynamics

    model = load_urdf(request["path"], joints=request["joints"])
    files = [str(Path(folder) / f"{name}.npy") for name in ("q", "v", "a", "tau")]
    arrays = [np.lib.format.open_memmap(f, mode="w+", dtype=float, shape=(samples, model.nv)) for f in files]
    generator = np.random.default_rng(0)
    for k in range(0, samples, PIECE):
        n = min(PIECE, samples - k)
        q, v, a = generator.standard_normal((3, n, model.nv))
        noise = 0.01 * generator.standard_normal((n, model.nv))
        tau = np.asarray(inverse_dynamics(model, q, v, a)) + v + np.sign(v) + a + 1.0 + noise
        for array, values in zip(arrays, (q, v, a, tau), strict=True):
            array[k : k + n] = values
    return files


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--work", help=argparse.SUPPRESS)
    parser.add_argument("--no-peer", action="store_true", help="ours alone")
    parser.add_argument("--limit-mb", type=float, default=12_000, help="memory that FIGAROH may take")
    parser.add_argument("--cases", nargs="*", default=[f"{name}:{n}" for name, n in CASES], metavar="ROBOT:SAMPLES")
    parser.add_argument("--factors", action="store_true", help="by QR factorisations (`condense`), not by products")
    parser.add_argument("--figaroh", default=str(PEER), metavar="PYTHON", help="of an environment that has figaroh")
    parser.add_argument("--stream", type=int, default=0, metavar="N", help="samples of the UR10e from a file on disk")
    options = parser.parse_args()
    if options.work:
        print(json.dumps(ours(json.loads(options.work))))
        return
    for case in options.cases:
        robot, samples = case.split(":")
        request = {"path": str(DATA / ROBOTS[robot]), "joints": joints_of(robot), "samples": int(samples), "files": []}
        request["factors"] = options.factors
        mine = ask([sys.executable, __file__, "--work"], request)
        print(f"{case} ours   {_line(mine)}; the first fit, with compilation: {mine.get('first', 0):.1f} s", flush=True)
        if options.no_peer:
            continue
        peer = ask(
            [options.figaroh, str(ROOT / "benchmarks" / "peer_identification.py")],
            request | {"limit_mb": options.limit_mb},
        )
        print(f"{case} figaroh {_line(peer)}", flush=True)
        if "cpu" in peer and "cpu" in mine:
            print(f"{case} figaroh / ours: {peer['cpu'] / mine['cpu']:.1f}", flush=True)
    if options.stream:
        request = {"path": str(DATA / ROBOTS["UR10e"]), "joints": joints_of("UR10e"), "samples": options.stream}
        request["factors"] = False
        with tempfile.TemporaryDirectory(dir=ROOT / ".cache") as folder:
            files = write_states(folder, request, options.stream)
            found = ask([sys.executable, __file__, "--work"], request | {"files": files})
        print(f"UR10e, {options.stream} samples from disk: {_line(found)}, {found['rate']:.0f} samples/s", flush=True)


def _line(found: dict[str, Any]) -> str:
    if "failed" in found:
        return found["failed"]
    memory = f"peak {found['peak_mb']:.0f} MB" + (f" ({found['before_mb']:.0f} before)" if "before_mb" in found else "")
    return f"rank {found['rank']}, {found['cpu']:.2f} CPU s, {memory}"


if __name__ == "__main__":
    main()
