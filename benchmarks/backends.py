"""Samples a second of inverse dynamics and regressor by every installed backend, in one interleaved run.

    python benchmarks/backends.py [--robots NAME ...] [--backends NAME ...] [--samples N] [--rounds N]

Robots are found by FIGAROH_JAX_DATA. MuJoCo C uses all cores, the others what JAX is allowed to. A round asks every
backend in turn; the median over the rounds is told, with the ratio to Pinocchio's loop within the rounds. The first
call, with its compilation, is told apart.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np

import figaroh_jax as fj
from figaroh_jax.simulators import registry

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
ROBOTS = {"UR10e": "ur10e_innopolis/ur10e.urdf", "TALOS": "talos_contact/talos_full_v2.urdf"}
FUNCTIONS = ("inverse_dynamics", "joint_torque_regressor")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--backends", nargs="+", default=list(registry.names()), metavar="NAME")
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'robot':7}{'function':24}{'backend':11}{'first call s':>13}{'samples/s':>12}{'times Pinocchio':>17}")
    for robot in options.robots:
        for function in FUNCTIONS:
            _table(robot, function, options)


def _table(robot: str, function: str, options: argparse.Namespace) -> None:
    samples, rounds = options.samples, options.rounds
    model = fj.load_urdf(DATA / ROBOTS[robot])
    backends = {name: registry.backend(name, model) for name in options.backends}
    state = [np.random.default_rng(k).uniform(-1.5, 1.5, (samples, model.nv)) for k in range(3)]
    first = {name: _seconds(backend, function, state) for name, backend in backends.items()}
    times = [{name: _seconds(backend, function, state) for name, backend in backends.items()} for _ in range(rounds)]
    for name in backends:
        rate = samples / median(row[name] for row in times)
        ratio = median(row["pinocchio"] / row[name] for row in times) if "pinocchio" in backends else float("nan")
        print(f"{robot:7}{function:24}{name:11}{first[name]:13.2f}{rate:12.0f}{ratio:17.2f}", flush=True)


def _seconds(backend: Any, function: str, state: list[np.ndarray]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(getattr(backend, function)(*state))
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
