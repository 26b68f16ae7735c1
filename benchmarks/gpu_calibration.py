"""Calibration of many postures on an accelerator in float64, and that it gives the numbers of the CPU.

    PYTHONPATH=. python benchmarks/gpu_calibration.py [--postures N ...] [--json FILE]

A six-joint arm (the Denavit-Hartenberg numbers of a UR10e) with geometry off by about a millimetre and a milliradian;
its poses in a tracker's frame are made here in NumPy, with noise. Both frames and the geometry (30 unknowns that can
be told apart) are fitted from the closed-form start. Told are the first call, with compilation, and the best of five
later ones, each from arrays on the host to numbers on the host; then the same in a process that sees the CPU alone.
Needs jax, numpy, equinox and jaxtyping, nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from figaroh_jax.calibration.gauge import find_gauge
from figaroh_jax.estimation import posefit
from figaroh_jax.estimation.posesolver import solve
from figaroh_jax.recordings import starts
from figaroh_jax.recordings.devices import Poses
from figaroh_jax.rigid.chain import Chain

A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)  # m
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
BOTH = ("base_frame", "tool_frame")
SAMPLE = 500  # postures that decide what can be told apart
NOISE = 1e-4  # m and rad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--postures", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.child:
        print(json.dumps([fitted(N) for N in options.postures]))
        return
    device = jax.devices()[0]
    print(f"jax {jax.__version__}, {device.device_kind}, float64", flush=True)
    here = [fitted(N) for N in options.postures]
    command = [sys.executable, __file__, "--child", "--postures", *map(str, options.postures)]
    answer = subprocess.run(command, check=True, capture_output=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    for ours, cpu in zip(here, json.loads(answer.stdout), strict=True):
        off = np.abs(np.subtract(ours["unknowns"], cpu["unknowns"])).max()
        times = [f"first {x['first']:6.2f} s, then {1e3 * x['best']:8.1f} ms" for x in (ours, cpu)]
        print(
            f"{ours['postures']:8d} postures, {ours['parameters']} unknowns, {ours['steps']} steps: {times[0]};"
            f" CPU {times[1]}; {cpu['best'] / ours['best']:.1f} times as fast; unknowns differ by {off:.1e} mrad or mm;"
            f" fitted noise {100 * ours['noise']:.2f} % off",
            flush=True,
        )
    if (memory := device.memory_stats()) is not None:
        print(f"peak memory of the device {memory['peak_bytes_in_use'] / 1e6:.0f} MB")
    if options.json:
        options.json.write_text(json.dumps({"device": device.device_kind, "runs": here}, indent=1), encoding="utf-8")


def fitted(postures: int) -> dict[str, Any]:
    """One calibration, timed."""
    rng = np.random.default_rng(postures)
    q, truth = rng.uniform(-2.5, 2.5, (postures, 6)), 1e-3 * rng.normal(size=(6, 6))
    base, tool = (pose(rng.normal(size=(1, 3)), rng.normal(size=(1, 3)))[0] for _ in range(2))
    noise = pose(*(NOISE * rng.normal(size=(2, postures, 3))))
    problem = assembled(q, base @ arm(q, truth) @ tool @ noise)
    few = assembled(q[:SAMPLE], (base @ arm(q, truth) @ tool @ noise)[:SAMPLE])
    count = len(np.asarray(problem.scale))
    dependent = find_gauge(posefit.linearise(few, np.zeros(count))[1], [*range(36, count), *range(36)]).dependent
    free = np.array([k not in dependent for k in range(count)], float)
    weights = np.full(6 * postures, 1.0 / NOISE)
    seconds, found = [], None
    while found is None or len(seconds) < 6:
        start = time.perf_counter()
        found = solve(problem, weights, 1.0 - free, free, np.zeros(count))
        seconds.append(time.perf_counter() - start)
    if not found.converged:
        raise SystemExit(f"{postures} postures: not converged in {found.steps} steps")
    again = solve(problem, weights, 1.0 - free, free, 0.5 * found.unknowns)
    if np.abs(again.unknowns - found.unknowns).max() > 1e-6:
        raise SystemExit(f"{postures} postures: another start ends elsewhere")
    left = 2.0 * found.cost / (6 * postures - free.sum())
    return {
        "postures": postures,
        "parameters": int(free.sum()),
        "first": seconds[0],
        "best": min(seconds[1:]),
        "steps": found.steps,
        "noise": abs(left**0.5 - 1.0),
        "unknowns": found.unknowns.tolist(),
    }


def assembled(q: np.ndarray, seen: np.ndarray) -> posefit.Problem:
    """Offsets and geometry of all six joints, and both frames from their closed-form start."""
    placement = np.concatenate([np.eye(4)[None], [dh(k) for k in range(5)]])
    ones, zeros, names = np.ones(6), np.zeros(6), tuple(range(6))
    chain = Chain(np.eye(4), dh(5), placement, np.tile([0.0, 0, 1], (6, 1)), ones, ones, zeros, np.arange(6), names)
    near = arm(q[:SAMPLE], np.zeros((6, 6)))
    start = starts.place_poses(near[:, :3, :3], near[:, :3, 3], seen[:SAMPLE], BOTH)
    device = Poses(start[0], seen[:, :3, 3].mean(axis=0), BOTH, start[1])
    unit = [(6 * j + k, j, np.broadcast_to(np.eye(6)[:, k : k + 1], (6, len(q)))) for j in range(6) for k in range(6)]
    group = posefit.group_of(chain, device, q.T, 36, unit, seen, np.ones((len(q), 6), bool))
    return posefit.Problem((group,), posefit.sizes([group], [1e-3] * 36), 36)


def arm(q: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """Poses of the flange (N, 4, 4), each joint's frame moved by its twist before the joint turns about z."""
    whole = np.tile(np.eye(4), (len(q), 1, 1))
    for j, twist in enumerate(twists):
        turn = pose(np.zeros((len(q), 3)), q[:, j : j + 1] * [0.0, 0.0, 1.0])
        whole = whole @ (pose(twist[None, :3], twist[None, 3:]) @ turn) @ dh(j)
    return whole


def dh(j: int) -> np.ndarray:
    """From behind joint j to the frame of the next one: along z, along x, about x."""
    return pose(np.array([[A[j], 0.0, D[j]]]), np.array([[ALPHA[j], 0.0, 0.0]]))[0]


def pose(translation: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of translations (m) and rotation vectors (rad), (N, 3) each."""
    angle = np.linalg.norm(rotation, axis=1)[:, None, None]
    x, y, z = (rotation / np.maximum(angle[:, 0], 1e-300)).T
    K = np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]]).transpose(2, 0, 1)
    found = np.tile(np.eye(4), (len(x), 1, 1))
    found[:, :3, :3] += np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    found[:, :3, 3] = translation
    return found


if __name__ == "__main__":
    main()
