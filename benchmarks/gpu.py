"""Throughput on an accelerator, and that it gives the numbers of the CPU.

    PYTHONPATH=.:backends python benchmarks/gpu.py ROBOT.urdf ... [--samples N ...] [--json FILE]

Inverse dynamics, mass matrix and regressor (dense, packed, streaming normal matrix) of the core, in float64 and the
kernels of inverse dynamics and packed regressor in float32 too, the robot known when they are compiled and, where told,
an argument of the program; inverse dynamics and regressor of MJX where its package is there. Every function is one
compiled program of arrays that lie on the device already; each is called until half a second has passed, the best call
counts. The first call is told apart. Before that, 1000 samples are computed in a process that sees the CPU alone, and
compared.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import figaroh_jax as fj
from figaroh_jax.compiled.kernels import straight_answers
from figaroh_jax.rigid import dynamics, regressor

CHECKED = 1000  # samples that are compared with the CPU's
DENSE_LIMIT = 16e9  # bytes that a dense regressor may take
MJX_LIMIT = 1 << 16  # samples that MJX is asked for at the most: its regressor holds ten torques a link


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robots", type=Path, nargs="+", metavar="ROBOT.urdf")
    parser.add_argument("--samples", type=int, nargs="+", default=[1 << 14, 1 << 17, 1 << 20])
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--reference", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.reference:
        np.savez(options.reference, allow_pickle=False, **_answers(options.robots[0]))
        return
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, float64 where nothing else is said")
    found = [row for robot in options.robots for row in _robot(robot, options.samples)]
    memory = jax.devices()[0].memory_stats() or {}
    print(f"peak of the device's memory: {memory.get('peak_bytes_in_use', 0) / 1e9:.2f} GB")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


def _robot(file: Path, sizes: list[int]) -> list[dict[str, Any]]:
    rows = []
    errors = _compare(file)
    model = fj.load_urdf(file)
    functions = _functions(model)
    for name, function in functions.items():
        print(f"{model.name:12} {name:26} largest difference from the CPU, relative: {errors[name]:.1e}", flush=True)
        for samples in sizes:
            if name.startswith("mjx") and samples > MJX_LIMIT:
                continue
            if name.startswith("dense") and 80 * samples * model.nv * len(model.joints) > DENSE_LIMIT:
                continue
            first, best = _time(function, _states(model, samples))
            rate = samples / best / 1e6
            rows.append({"robot": model.name, "function": name, "samples": samples, "first": first, "best": best})
            print(f"{'':12} {name:26} {samples:9d} samples  {first:6.2f} s at first  {rate:9.3f} M/s", flush=True)
    return rows


def _functions(model: fj.RobotModel) -> Mapping[str, Callable[..., Any]]:
    """Name -> function of (q, v, a), compiled, the robot an argument of the program."""
    own = {
        "inverse dynamics": fj.inverse_dynamics,
        "mass matrix": lambda model, q, v, a: fj.mass_matrix(model, q),
        "packed regressor": fj.packed_regressor,
        "dense regressor": fj.joint_torque_regressor,
        "normal matrix": lambda model, q, v, a: fj.normal_matrix(model, q, v, a, tau=a),
        "inverse dynamics float32": partial(_single, dynamics._TORQUES),
        "packed regressor float32": partial(_single, regressor._PACKED),
    }
    compiled = {name: jax.jit(partial(function, model)) for name, function in own.items()}
    argument = {name: own[name] for name in ("inverse dynamics", "packed regressor")}
    compiled |= {f"{name}, argument": _bound(jax.jit(function), model) for name, function in argument.items()}
    try:
        from figaroh_jax_mjx import MjxBackend
    except ImportError:
        return compiled
    robot = MjxBackend.build(model)
    theirs = {
        "mjx inverse dynamics": lambda robot, q, v, a: robot.inverse_dynamics(q, v, a),
        "mjx regressor": lambda robot, q, v, a: robot.joint_torque_regressor(q, v, a),
    }
    return compiled | {name: _bound(jax.jit(function), robot) for name, function in theirs.items()}


def _single(straight: Any, model: fj.RobotModel, *state: Any) -> Any:
    return straight_answers(straight, model, *(x.astype(np.float32) for x in state))


def _bound(function: Callable[..., Any], model: Any) -> Callable[..., Any]:
    model = jax.tree.map(jax.device_put, model)
    return lambda *state: function(model, *state)


def _states(model: fj.RobotModel, samples: int) -> list[Any]:
    random = np.random.default_rng(0)
    return [jax.device_put(random.uniform(-1.5, 1.5, (samples, model.nv))) for _ in range(3)]


def _time(function: Callable[..., Any], state: list[Any]) -> tuple[float, float]:
    """Seconds of the first call and of the fastest later one."""
    seconds, begin = [], time.perf_counter()
    while len(seconds) < 3 or time.perf_counter() - begin < 0.5 + seconds[0]:
        start = time.perf_counter()
        jax.block_until_ready(function(*state))
        seconds.append(time.perf_counter() - start)
    return seconds[0], min(seconds[1:])


def _answers(file: Path) -> dict[str, np.ndarray]:
    model = fj.load_urdf(file)
    state = _states(model, CHECKED)
    return {
        name: np.concatenate([np.ravel(x) for x in jax.tree.leaves(function(*state))])
        for name, function in _functions(model).items()
    }


def _compare(file: Path) -> dict[str, float]:
    """Largest difference of each function from the same on the CPU, over the largest number."""
    with tempfile.TemporaryDirectory() as folder:
        reference = Path(folder) / "cpu.npz"
        command = [sys.executable, __file__, str(file), "--reference", str(reference)]
        subprocess.run(command, check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
        with np.load(reference) as cpu:
            here = _answers(file)
            return {name: float(np.abs(here[name] - cpu[name]).max() / np.abs(cpu[name]).max()) for name in here}


if __name__ == "__main__":
    main()
