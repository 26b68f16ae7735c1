"""Samples a second of the streaming fit in float64, on one device and on several, and that it is the CPU's fit.

    PYTHONPATH=. python benchmarks/gpu_identification.py [--devices 1 2 4] [--samples N] [--robots arm humanoid]

Robots are built here (no file): an arm of 6 and a tree of 32 revolute joints, with viscous, Coulomb, rotor and offset
columns; torques are Pinocchio's. The source gives the same pieces of random states again and again, from the host's
memory ("host": they travel to the devices) or the devices' own ("device"). A fit is all of it: rows, products, rank
and base parameters weighed by joint; the seconds of the host's algebra (rank and fit), which do not grow with the
samples, are told beside. The first fit, of one piece, compiles and is told apart. Meanwhile a process that sees the CPU
alone fits 4000 samples by `condense`, with QR factorisations in NumPy; the devices' fit of them is compared with it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from figaroh_jax.compiled.executable_cache import keep_programs
from figaroh_jax.effects.catalogue import find
from figaroh_jax.estimation.accelerators import condense_on_devices
from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.least_squares import WeightedByJoint, solve
from figaroh_jax.estimation.regression import condense
from figaroh_jax.estimation.states import States
from figaroh_jax.rigid.model import Joint, RobotModel

CHECKED = 4000  # samples
DIFFERENT = 1 << 16  # samples of a piece
FROM_HOST = 16  # so many times fewer samples where they travel
NOISE = 0.05  # N m
DRIVES = ("viscous_friction", "coulomb_friction", "rotor_inertia", "torque_offset")
DRIVE = 0.7  # hidden value of every drive parameter
SIZES = {"arm": (1 << 21, 1 << 29), "humanoid": (1 << 18, 1 << 28)}  # samples of a piece, and in all


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--robots", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--samples", type=int, help="in all, in place of the robots' own number")
    parser.add_argument("--piece", type=int, help="samples of a piece and device, likewise")
    parser.add_argument("--chunk", type=int, help="samples whose rows exist at once on a device")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--by-host", type=Path, help="fit the first robot on the CPU, into this file, and no more")
    options = parser.parse_args()
    if options.by_host:
        _fit_on_host(options.robots[0], options.by_host)
        return
    keep_programs()  # a second run of the benchmark compiles nothing
    devices = jax.devices()
    print(f"jax {jax.__version__}, {len(devices)} x {devices[0].device_kind}, float64")
    found = []
    for robot in options.robots:
        piece, samples = options.piece or SIZES[robot][0], options.samples or SIZES[robot][1]
        with TemporaryDirectory() as folder, _host(robot, Path(folder)) as host:
            start = time.perf_counter()
            rows = _Source(MODELS[robot]())
            joints = len(rows.states.frames)
            print(f"{robot:9} columns of {joints} joints in {time.perf_counter() - start:.1f} s", flush=True)
            for count in (n for n in options.devices if n <= len(devices)):
                found += _measure(robot, rows, devices[:count], piece, samples, options.chunk)
            host.wait()
            _compare(robot, rows, np.load(Path(folder) / "fit.npy"), options.chunk)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


def _measure(
    robot: str, rows: _Source, devices: list[Any], piece: int, samples: int, chunk: int | None
) -> list[dict[str, Any]]:
    """Rates of both sources."""
    out = []
    length = piece * len(devices)
    on_host = _piece(rows.states.model, length)
    mesh = Mesh(np.array(devices), ("samples",))
    with jax.enable_x64(True):
        there = [jax.device_put(x, NamedSharding(mesh, PartitionSpec("samples"))) for x in on_host]
    for source, part in {"device": there, "host": on_host}.items():
        start = time.perf_counter()
        _fit(rows, part, 1, devices, chunk)
        first = time.perf_counter() - start
        pieces = max(1, samples // length // (FROM_HOST if source == "host" else 1))
        start = time.perf_counter()
        _, error, algebra = _fit(rows, part, pieces, devices, chunk)
        seconds = time.perf_counter() - start
        rate = pieces * length / seconds / 1e6
        print(
            f"{robot:9} {len(devices)} device(s), from {source:6} {pieces * length:9d} samples {seconds:7.2f} s"
            f" {rate:8.3f} M samples/s, of which the host's algebra {algebra:.2f} s; first {first:.1f} s; residual"
            f" {error:.4f} N m",
            flush=True,
        )
        row = {"robot": robot, "devices": len(devices), "source": source, "rate": rate, "first": first}
        out.append(row | {"seconds": seconds, "algebra": algebra})
    return out


def _fit(
    rows: _Source, part: Any, pieces: int, devices: list[Any], chunk: int | None
) -> tuple[np.ndarray, float, float]:
    """Parameters, the largest residual, and seconds of what follows the sums."""
    rows.given = [part] * pieces
    condensed = condense_on_devices(rows.states, devices, chunk=chunk)
    start = time.perf_counter()
    base = base_parameters(condensed.factor()[:, :-1], rows.states.names)
    found = solve(condensed, WeightedByJoint(), kept=base.independent)
    return found.parameters[base.independent], float(found.rms.max()), time.perf_counter() - start


class _Source:
    """States of a robot whose pieces are exchanged: its structural base parameters are found once."""

    def __init__(self, model: RobotModel) -> None:
        joints = np.arange(model.nv)[:, None]
        terms = tuple(find(n)(joints, **{p: np.zeros(model.nv) for p in find(n).parameters()}) for n in DRIVES)
        self.given: list[Any] = []
        self.states = States(model, lambda: self.given, terms)


def _piece(model: RobotModel, samples: int) -> list[np.ndarray]:
    """Random states, some again and again: their torques are made one by one."""
    random = np.random.default_rng(0)
    q, v, a = (random.uniform(-2.0, 2.0, (min(samples, DIFFERENT), model.nv)) for _ in range(3))
    tau = _torques(model, q, v, a) + DRIVE * (v + np.sign(v) + a + 1)
    tau += NOISE * random.standard_normal(tau.shape)
    return [np.resize(x, (samples, model.nv)) for x in (q, v, a, tau)]


def _torques(model: RobotModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Pinocchio's, of the robots of this file: revolute joints."""
    robot = pin.Model()
    for i, joint in enumerate(model.joints):
        at = pin.SE3(model.placement[i, :3, :3], model.placement[i, :3, 3])
        robot.addJoint(joint.parent + 1, pin.JointModelRevoluteUnaligned(model.axis[i]), at, joint.name)
        robot.inertias[i + 1] = pin.Inertia.FromDynamicParameters(np.asarray(model.inertia[i]))
    robot.gravity.linear = np.asarray(model.gravity)
    data = robot.createData()
    return np.array([pin.rnea(robot, data, *state) for state in zip(q, v, a, strict=True)])


def _host(robot: str, folder: Path) -> subprocess.Popen[bytes]:
    """The fit on the CPU, by a process of its own."""
    command = [sys.executable, __file__, "--robots", robot, "--by-host", str(folder / "fit.npy")]
    return subprocess.Popen(command, env=os.environ | {"JAX_PLATFORMS": "cpu"})


def _fit_on_host(robot: str, file: Path) -> None:
    rows = _Source(MODELS[robot]())
    rows.given = [_piece(rows.states.model, CHECKED)]
    host = condense(rows.states, rows.states.used)
    base = base_parameters(host.factor()[:, :-1], rows.states.names)
    np.save(file, solve(host, WeightedByJoint(), kept=base.independent).parameters[base.independent])


def _compare(robot: str, rows: _Source, expected: np.ndarray, chunk: int | None) -> None:
    """The fit on a device against the fit by QR factorisations on the host."""
    found, error, _ = _fit(rows, _piece(rows.states.model, CHECKED), 1, jax.devices()[:1], chunk)
    different = np.abs(found - expected).max() / np.abs(expected).max()
    print(
        f"{robot:9} rank {len(found)}, largest difference from the host's fit, relative: {different:.1e};"
        f" residual {error:.4f} N m for noise of {NOISE} N m",
        flush=True,
    )


def _robot(name: str, parents: list[int], seed: int) -> RobotModel:
    """Revolute joints with axes and offsets in all directions; links of 1 to 4 kg that bodies can have."""
    random, n = np.random.default_rng(seed), len(parents)
    placement = np.tile(np.eye(4), (n, 1, 1))
    axis, inertia = np.eye(3)[random.integers(0, 3, n)], np.zeros((n, 10))
    for i in range(n):
        placement[i, :3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
        placement[i, :3, :3] *= np.sign(np.linalg.det(placement[i, :3, :3]))
        placement[i, :3, 3] = random.uniform(-0.3, 0.3, 3)
        points, mass = random.uniform(-0.15, 0.15, (4, 3)), random.uniform(0.25, 1.0, 4)
        about = np.sum([m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(mass, points, strict=True)], axis=0)
        inertia[i] = [mass.sum(), *(mass @ points), *about[_ENTRIES]]
    return RobotModel(
        placement=placement,
        axis=axis,
        inertia=inertia,
        ratio=np.ones(n),
        offset=np.zeros(n),
        gravity=np.array([0.0, 0.0, -9.81]),
        frame_placement=np.zeros((0, 4, 4)),
        position_limit=np.tile([-np.inf, np.inf], (n, 1)),
        velocity_limit=np.full(n, np.inf),
        effort_limit=np.full(n, np.inf),
        joints=tuple(Joint(f"j{i}", "revolute", parent, i, f"l{i}") for i, parent in enumerate(parents)),
        frames=(),
        name=name,
    )


_ENTRIES = ([0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2])  # of the inertia, in Pinocchio's order


def _limb(parent: int, first: int, length: int) -> list[int]:
    return [parent, *range(first, first + length - 1)]


# a waist of two joints that carries two arms of 7 and a head of 4, and two legs of 6 on the base
_TREE = [-1, 0, *_limb(1, 2, 7), *_limb(1, 9, 7), *_limb(1, 16, 4), *_limb(-1, 20, 6), *_limb(-1, 26, 6)]
MODELS = {"arm": lambda: _robot("arm", [-1, 0, 1, 2, 3, 4], 0), "humanoid": lambda: _robot("humanoid", _TREE, 1)}


if __name__ == "__main__":
    main()
