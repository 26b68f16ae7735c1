"""Diagnosis of rollouts: what real robots' commands and positions show.

    python benchmarks/rollouts.py servo_miuzei      # a hobby servo with a weight: train, test and all other runs
    python benchmarks/rollouts.py dfki_double_pendulum --window 0.3

Data under the folder that FIGAROH_JAX_DATA names. It prints the RMS of the position error, rad, after each cause, on
runs that were fitted and on runs that were not, each simulated from its first measured state by its command alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path

import equinox as eqx
import numpy as np

from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.fit import fit
from figaroh_jax.rollouts.parameters import Entry, put
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import Search, search, setting
from figaroh_jax.rollouts.task import simulated

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", "/data"))


def miuzei_runs() -> list[Run]:
    """All powered runs, 50 Hz."""
    found = []
    for k, one in enumerate(json.loads((DATA / "servo_miuzei" / "dataset.json").read_text())["data"]):
        if one["type"] == "drop" or any(action is None for action in one["actions"]):
            continue
        command = np.array(one["actions"], float).reshape(-1, 1)
        position = np.array(one["sensor_data"], float).reshape(len(command), -1)[:, :1]
        found.append(Run(f"{one['type']} {k}", np.arange(len(command)) / 50.0, command, position, None))
    return found


def servo_miuzei(law: str = "hard") -> None:
    """Every fourth run is fitted, every fourth from the second is the test."""
    file = DATA / "servo_miuzei" / "servo_meshfree.xml"
    loop, _ = load_loop(file, {"servo": {"kind": "position", "kp": 25.0, "kd": 5.0}}, law=law)
    runs = miuzei_runs()
    train, test = runs[::4], runs[1::4]
    other = [r for k, r in enumerate(runs) if k % 4 > 1]
    here = setting(
        loop, train, baseline=("rotor_inertia", "friction_loss"), gains_known=False,
        more=[("actuator_gain", "servo"), ("joint_damping", "servo")], block=0.24,
        forbid=("payload", "encoder_offset", "torque_offset", "joint_elasticity", "backlash"),
    )  # fmt: skip
    start = time.process_time()
    found = search(here)
    print(f"verdict {found.verdict}, {time.process_time() - start:.0f} CPU s, {len(train)} runs fitted")
    show(found, [n.candidate.effect for n in (found.named or found.proxy)])
    loop0 = here.loop
    for name, group in (("train", train), ("test", test), ("other", other)):
        models = {
            "model file": loop0,
            "baseline": put(loop0, here.known.table, found.first.theta),
            "with the causes": put(found.structure.loop, found.structure.table, found.last.theta),
        }
        print(
            f"{name:>6}: "
            + ", ".join(f"{k} {total([(r, simulated(m, r)) for r in group]):.4f}" for k, m in models.items())
        )


def pendulum_runs() -> list[Run]:
    """The ten runs of the double pendulum on a regular clock of 2 ms, torque as the command."""
    found = []
    for file in sorted((DATA / "dfki_double_pendulum").glob("C1_*.npz")):
        z = np.load(file)
        time = np.arange(z["t"][0], z["t"][-1], 0.002)
        command, position = (np.stack([np.interp(time, z["t"], c) for c in z[k].T], 1) for k in ("tau", "q"))
        found.append(Run(file.stem, time - time[0], command, position, None))
    return found


def dfki_double_pendulum(window: float, every: int) -> None:
    """Short windows, their first states fitted too; seven runs are fitted, three are not."""
    drives = {name: {"kind": "torque"} for name in ("Joint1", "Joint2")}
    loop, _ = load_loop(DATA / "dfki_double_pendulum" / "double_pendulum_C1.urdf", drives, law="hard", dt=0.002)
    zero = np.zeros(2)
    loop = eqx.tree_at(lambda m: (m.joints.friction, m.joints.damping), loop, (zero, zero + 0.001))
    loop = dataclasses.replace(loop, limited=False)
    runs, rows = pendulum_runs(), round(window / 0.002)
    train = [k for k in range(len(runs)) if k % 3 != 2]
    test = [k for k in range(len(runs)) if k % 3 == 2]
    noise = [np.full(2, 2e-3)]
    data = {}
    for name, group in (("train", train), ("test", test)):
        cut = [Stretch(k, f, rows) for k in group for f in range(0, len(runs[k].time) - rows, every * rows)]
        data[name] = windows(loop, runs, cut, noise, window)
    table = (
        *(Entry("payload", (i,)) for i in range(2)),
        *(Entry(name, (i,)) for name in ("damping", "friction", "armature") for i in range(2)),
        Entry("delay", (0, 1)),
    )
    theta, free = np.array([0.0, 0.0, 0.001, 0.001, 0.0, 0.0, 1e-6, 1e-6, 0.0]), list[int]()
    steps = (
        ("nominal", ()),
        ("+ masses", (0, 1)),
        ("+ viscous", (2, 3)),
        ("+ Coulomb", (4, 5)),
        ("+ rotor", (6, 7)),
        ("+ delay", (8,)),
    )
    start = None
    for label, more in steps:
        free += more
        for entry in more:
            theta[entry] = {"friction": 0.05, "armature": 1e-3, "delay": 0.001}.get(table[entry].name, theta[entry])
        one = fit(loop, table, data["train"], theta[None], [free], start, width=9, lanes=1)[0]
        theta, start = one.theta, one.start[None]
        held = fit(loop, table, data["test"], theta[None], [[]], width=9, lanes=1)[0]
        rms = [
            1e3 * np.sqrt(f.squares / (d.weight > 0).sum()) * 2e-3
            for f, d in ((one, data["train"]), (held, data["test"]))
        ]
        values = ", ".join(f"{table[k].name} {theta[k]:.4g}" for k in more)
        print(f"{label:<10} train {rms[0]:7.2f} mrad, held out {rms[1]:7.2f} mrad   {values}", flush=True)


def total(pairs: list[tuple[Run, np.ndarray]]) -> float:
    """RMS over all samples, rad."""
    return float(np.sqrt(np.mean(np.concatenate([((run.position - read) ** 2).ravel() for run, read in pairs]))))


def show(found: Search, causes: list[str]) -> None:
    for label, level in found.table:
        print(f"  chi2/N {level:10.2f} after {label}")
    print(f"  causes in order: {', '.join(causes) or 'none'}")
    print(f"  held-out by left-out runs, rad: {', '.join(f'{x:.4f}' for x in found.held)}")
    for entry in dict.fromkeys(found.last.free[found.last.free >= 0]):
        print(f"  {found.structure.table[entry].name:>14} {found.last.theta[entry]:.5g}")
    for name, gain, why in found.nearest:
        print(f"  nearest: {name}, gain {gain:.4f}, {why}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", choices=["servo_miuzei", "dfki_double_pendulum"])
    parser.add_argument("--window", type=float, default=0.3, help="s, of the double pendulum")
    parser.add_argument("--law", choices=["hard", "soft"], default="hard")
    parser.add_argument("--every", type=int, default=1, help="takes one window of so many")
    args = parser.parse_args()
    if args.data == "servo_miuzei":
        servo_miuzei(args.law)
    else:
        dfki_double_pendulum(args.window, args.every)
