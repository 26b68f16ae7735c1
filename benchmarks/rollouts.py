"""Diagnosis of rollouts: what real robots' commands and positions show.

    python benchmarks/rollouts.py servo_miuzei [--runs 1::4 ...]  # a hobby servo: train, test and all other runs
    python benchmarks/rollouts.py dfki_double_pendulum --window 0.3
    python benchmarks/rollouts.py so101_sage [--third K] [--again] [--uncut]  # a 6-joint servo arm
    python benchmarks/rollouts.py so101_thirds [--processes 4]  # all of it, and without each third of the recordings
    python benchmarks/rollouts.py so101_speed                   # CPU seconds of sensitivities: arm and joints

Data under the folder that FIGAROH_JAX_DATA names. It prints the RMS of the position error, rad, after each cause, on
runs that were fitted and on runs that were not, each simulated from its first measured state by its command alone.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from figaroh_jax.rollouts.alone import alone, carried_by
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.faults import faults
from figaroh_jax.rollouts.fit import fit, start_of
from figaroh_jax.rollouts.found import Search
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.parameters import Entry, put, values
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.sensitivity import linear_sums
from figaroh_jax.rollouts.setting import Setting, setting
from figaroh_jax.rollouts.table import on_table
from figaroh_jax.rollouts.task import simulated

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


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


def servo_miuzei(law: str = "hard", fitted: str = "0::4") -> None:
    """Every fourth run is fitted and every fourth from the second the test, or of others all that are not fitted."""
    file = DATA / "servo_miuzei" / "servo_meshfree.xml"
    loop, _ = load_loop(file, {"servo": {"kind": "position", "kp": 25.0, "kd": 5.0}}, law=law, dt=0.005)
    runs = miuzei_runs()
    first, every = map(int, fitted.split("::"))
    train, unseen = runs[first::every], [r for k, r in enumerate(runs) if k % every != first]
    groups = {"train": train, "unseen": unseen}
    if (first, every) == (0, 4):
        groups = {"train": train, "test": runs[1::4], "other": [r for k, r in enumerate(runs) if k % 4 > 1]}
    here = setting(
        loop, train, baseline=("rotor_inertia", "friction_loss"), gains_known=False,
        more=[("actuator_gain", "servo"), ("joint_damping", "servo")], block=0.24,
        forbid=("payload", "encoder_offset", "torque_offset", "joint_elasticity", "backlash"),
    )  # fmt: skip
    start = time.process_time()
    found = search(here, _told(start))
    print(f"verdict {found.verdict}, {time.process_time() - start:.0f} CPU s, {len(train)} runs fitted")
    show(found, [n.candidate.effect for n in (found.named or found.proxy)])
    loop0 = here.loop
    for name, group in groups.items():
        models = {
            "model file": loop0,
            "baseline": put(loop0, here.known.table, found.first.theta),
            "with the causes": put(found.structure.loop, found.structure.table, found.last.theta),
        }
        print(
            f"{name:>6}: "
            + ", ".join(f"{k} {total([(r, simulated(m, r)) for r in group]):.4f}" for k, m in models.items())
        )


def _told(start: float) -> Callable[[str, float | None], None]:
    """Prints what a search does, with the CPU seconds spent."""
    return lambda phase, share: print(f"  [{time.process_time() - start:.0f} CPU s] {phase}", flush=True)


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
        data[name] = windows(loop, runs, cut, noise, window, smooth=True)
    table = (
        *(Entry(name, (i,)) for name in ("mass_z", "inertia_xx") for i in range(2)),
        *(Entry(name, (i,)) for name in ("damping", "friction", "armature") for i in range(2)),
        Entry("delay", (0, 1)),
    )
    theta, free = np.array([0.0] * 4 + [0.001, 0.001, 0.0, 0.0, 1e-6, 1e-6, 0.0]), list[int]()
    steps = (
        ("nominal", ()),
        ("+ rigid", (0, 1, 2, 3)),  # all that gravity and inertia of two links in a plane show
        ("+ viscous", (4, 5)),
        ("+ Coulomb", (6, 7)),
        ("+ rotor", (8, 9)),
        ("+ delay", (10,)),
    )
    start = None
    for label, more in steps:
        free += more
        for entry in more:
            theta[entry] = {"friction": 0.05, "armature": 1e-3, "delay": 0.001}.get(table[entry].name, theta[entry])
        one = fit(loop, table, data["train"], theta[None], [free], start, width=11, lanes=1)[0]
        theta, start = one.theta, one.start[None]
        held = fit(loop, table, data["test"], theta[None], [[]], width=11, lanes=1)[0]
        rms = [
            1e3 * np.sqrt(f.squares / (d.weight > 0).sum()) * 2e-3
            for f, d in ((one, data["train"]), (held, data["test"]))
        ]
        values = ", ".join(f"{table[k].name} {theta[k]:.4g}" for k in more)
        print(f"{label:<10} train {rms[0]:7.2f} mrad, held out {rms[1]:7.2f} mrad   {values}", flush=True)


SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
WHOLE = ((0.0, 999.0),)
TRAIN = {
    "friction_gravity": WHOLE, "prbs_excitation": WHOLE, "chirp_sweep": ((0.0, 108.0),), "multisine": WHOLE,
    "backlash_detection": WHOLE, "single_joint_rotation": WHOLE, "single_joint_wrist_pitch": WHOLE,
    "single_joint_wrist_roll": ((0.0, 41.0),),
    "large_amplitude": ((0.0, 30.0), (36.0, 53.0), (60.0, 90.0), (112.0, 133.0)),
}  # fmt: skip
TEST = {
    "step_response": WHOLE, "velocity_ramp": WHOLE, "slow_precision": WHOLE, "repetitive_motion": WHOLE,
    "hold_under_gravity": ((0.0, 14.0), (49.0, 61.0)),
}  # fmt: skip
PERIOD = 0.02006  # s


def so101_runs(which: dict[str, tuple[tuple[float, float], ...]]) -> list[Run]:
    """Motions of the arm, cut as its README says: without the table, the chirp before its clock jumps."""
    found = []
    for name, cuts in which.items():
        z = np.load(DATA / "so101_sage" / f"{name}.npz")
        command, position = (np.array(z[k], float) for k in ("command", "q"))
        for x in (command, position):  # the jaw is told as a share of its range
            x[:, 5] = -0.174533 + 1523 * 2 * np.pi / 4096 * x[:, 5]
        for k, (first, last) in enumerate(cuts):
            inside = (z["t"] - z["t"][0] >= first) & (z["t"] - z["t"][0] <= last)
            label = f"{name} {k + 1}" if len(cuts) > 1 else name
            found.append(Run(label, PERIOD * np.arange(inside.sum()), command[inside], position[inside], None))
    return found


def so101_loop(**values: float) -> Loop:
    """The arm with the servo of the BAM study at every joint, no dry friction, unless told otherwise."""
    drive = {"kind": "position", "kp": values.get("kp", 17.8), "kd": values.get("kd", 0.6), "force": 3.35}
    file = DATA / "so101_sage" / "so101.xml"
    loop, _ = load_loop(file, dict.fromkeys(SO101, drive), law="hard", dt=PERIOD / 4)
    full = np.ones(6)
    where = lambda m: (m.joints.friction, m.joints.armature, m.joints.damping)  # noqa: E731
    new = (values.get("friction", 0.0) * full, values.get("armature", 0.028) * full, values.get("damping", 0.0) * full)
    return eqx.tree_at(where, loop, new)


def so101_sage(
    motions: list[str],
    third: int | None,
    most: float,
    unseen: float,
    forbid: list[str],
    again: bool = False,
    uncut: bool = False,
) -> tuple[Search, float]:
    """Gains and viscous friction of every servo are fitted; what else it shows is sought: with the unseen RMS, mrad.

    `uncut`: with the rows that touch the table, of the late clock and of the held wrist, which are cut by hand else.
    """
    loop = so101_loop()
    cuts = {k: WHOLE if uncut else TRAIN[k] for k in motions}
    runs = [r for k, r in enumerate(so101_runs(cuts)) if third is None or k % 3 != third]
    runs = [_shorter(r, most) for r in runs]
    cut = [
        Stretch(k, f, min(750, len(r.time) - f)) for k, r in enumerate(runs) for f in range(0, len(r.time) - 100, 750)
    ]
    here = setting(
        loop, runs, baseline=("joint_damping",), more=[("actuator_gain", name) for name in SO101], gains_known=False,
        stretches=cut, forbid=forbid,
    )  # fmt: skip
    start = time.process_time()
    found = search_arm(here, _told(start), forbid=forbid)
    if again:  # everything is compiled now
        print(f"cold {time.process_time() - start:.0f} CPU s", flush=True)
        start = time.process_time()
        found = search_arm(here, forbid=forbid)
    seconds = sum(len(r.time) for r in runs) * PERIOD
    print(
        f"verdict {found.verdict}, {time.process_time() - start:.0f} CPU s, {seconds:.0f} s of {len(runs)} recordings"
    )
    for fault in found.faults:
        print(f"  {fault.text(here.loop, here.runs)}")
    for n in found.named or found.proxy:
        alike = f", alike {', '.join(str(a) for a in n.alike)}" if n.alike else ""
        gain = f"{1e3 * n.before:.2f} -> {1e3 * n.after:.2f} mrad"
        print(f"  {n.candidate.effect} ({n.candidate.at[0]}) t {n.t:.1f}, {gain}{alike}")
    for label, level in found.table:
        print(f"  chi2/N {level:10.2f} after {label}")
    for entry in dict.fromkeys(found.last.free[found.last.free >= 0]):
        one = found.structure.table[entry]
        column = int(np.flatnonzero(found.last.free == entry)[0])
        half = "" if found.spread is None else f" +- {1.96 * found.spread[column]:.2g}"
        where = SO101[one.at[0]] if one.at[0] < 6 else "spring"
        print(f"  {one.name:>14} {where:<14} {found.last.theta[entry]:.5g}{half}")
    models = {
        "as stated": here.loop,
        "gains and damping": put(here.loop, here.known.table, found.first.theta),
        "with the causes": put(found.structure.loop, found.structure.table, found.last.theta),
        "friction 1e-4, armature .15": so101_loop(friction=1e-4, armature=0.15),
        "friction .35, kp 48, armature .05": so101_loop(friction=0.35, kp=48.0, armature=0.05),
    }
    rms = {
        label: show_motions(label, model, [_shorter(r, unseen) for r in so101_runs(TEST)])
        for label, model in models.items()
    }
    return found, rms["with the causes"]


class Part(NamedTuple):
    """What the arm's recordings say, all of them or without a third."""

    verdict: str
    names: list[str]  # in the order in which they were found
    sizes: dict[str, tuple[float, float]]  # of the numbers of the named causes: value, half of the 95 % interval
    unseen: float  # mrad
    seconds: float  # CPU


def so101_part(third: int | None, folder: str | None) -> Part:
    """The arm's whole recordings without a third of them; everything that is found goes to a file of its own."""
    name = "whole" if third is None else f"without_{third + 1}"
    out = contextlib.nullcontext() if folder is None else (Path(folder) / f"so101_{name}.txt").open("w", buffering=1)
    with out as file, contextlib.redirect_stdout(file or sys.stdout):
        start = time.process_time()
        found, unseen = so101_sage(list(TRAIN), third, 999.0, 999.0, [])
        seconds = time.process_time() - start
    last, sizes, names = found.last, {}, []
    for one in found.named or found.proxy:
        place = one.candidate.at[0] if one.candidate.at else "all"
        alike = f" (or {', '.join(a.effect for a in one.alike)})" if one.alike else ""
        names.append(f"{one.candidate.effect} {place}{alike}")
        for entry in one.candidate.entries:
            column = int(np.flatnonzero(last.free == entry)[0])
            half = float("nan") if found.spread is None else 1.96 * found.spread[column]
            sizes[f"{found.structure.table[entry].name} {place}"] = float(last.theta[entry]), float(half)
    return Part(found.verdict, names, sizes, unseen, seconds)


def so101_thirds(processes: int, folder: str | None) -> None:
    """All recordings whole, and without each third of them: what is named each time, and whether the sizes agree."""
    thirds = (None, 0, 1, 2)
    if folder is not None:
        Path(folder).mkdir(parents=True, exist_ok=True)
    if processes > 1:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            parts = list(pool.map(so101_part, thirds, [folder] * 4))
    else:
        parts = [so101_part(third, folder) for third in thirds]
    labels = ("the whole set", "without the first third", "without the second", "without the third")
    for label, one in zip(labels, parts, strict=True):
        print(f"{label}: {one.verdict}, unseen {one.unseen:.2f} mrad, {one.seconds:.0f} CPU s; {'; '.join(one.names)}")
    whole = parts[0].sizes
    for name in dict.fromkeys(k for one in parts for k in one.sizes):
        told = [f"{x[0]:.4g} +- {x[1]:.2g}" if (x := one.sizes.get(name)) else "-" for one in parts]
        beyond = [
            abs(one.sizes[name][0] - whole[name][0]) > whole[name][1]
            for one in parts[1:]
            if name in one.sizes and name in whole
        ]
        print(f"  {name:<28} {' | '.join(told)}{'; beyond the interval of all' if any(beyond) else ''}")


def _rough_arm() -> Loop:
    """The arm roughly fitted, as it is where faults are looked for."""
    loop = so101_loop(kp=12.0)
    friction, damping = np.array([0.1, 0.3, 0.4, 0.14, 0.1, 0.1]), np.array([0.6, 0.3, 0.3, 0.3, 0.6, 0.6])
    return eqx.tree_at(lambda m: (m.joints.friction, m.joints.damping), loop, (friction, damping))


FREE = {
    **{name: WHOLE for name in [*TRAIN, *TEST] if name not in ("large_amplitude", "hold_under_gravity")},
    "large_amplitude": ((0.0, 30.0), (60.0, 100.0)), "hold_under_gravity": ((0.0, 24.0),),
}  # fmt: skip


def so101_contact() -> None:
    """Where the arm's end rests on the table: all recordings, and those that are free with models that are wrong."""
    loop = _rough_arm()
    scaled = lambda of, share: eqx.tree_at(of, loop, share * np.asarray(of(loop)))  # noqa: E731
    friction, gain = (lambda m: m.joints.friction), (lambda m: m.drives.scale)
    heavy = np.where(np.arange(len(loop.robot.joints)) == 4, 2.0, 1.0)[:, None]
    wrong = {
        "roughly fitted": loop,
        "as stated": so101_loop(),
        "half the friction": scaled(friction, 0.5),
        "half as much more": scaled(friction, 1.5),
        "no friction": scaled(friction, 0.02),
        "gains of .7": scaled(gain, 0.7),
        "gains of 1.4": scaled(gain, 1.4),
        "a gripper without mass": scaled(lambda m: m.robot.inertia, np.where(heavy > 1, 0.01, 1.0)),
        "a gripper of twice the mass": scaled(lambda m: m.robot.inertia, heavy),
    }
    cases = [("all recordings", loop, dict.fromkeys([*TRAIN, *TEST], WHOLE)), *((k, m, FREE) for k, m in wrong.items())]
    for label, model, which in cases:
        start, runs = time.process_time(), so101_runs(which)
        table = on_table(model, runs)
        label = label if which is not FREE else f"free motions, {label}"
        told = [] if table is None else [(x, table.height) for x in table.stretches]
        print(
            f"{label}: {len(told) or 'no'} contacts with a table, {time.process_time() - start:.1f} CPU s", flush=True
        )
        for x, height in told:
            print(f"  {runs[x.run].name}, {x.first:.1f} to {x.last:.1f} s: {x.force:.2g} N, {1e3 * height:.0f} mm")


def so101_faults() -> None:
    """What is told of whole recordings, three with known faults among them, with a roughly fitted arm."""
    loop = _rough_arm()
    whole = ("hold_under_gravity", "large_amplitude", "chirp_sweep", "single_joint_wrist_roll")
    first = {"multisine": ((0.0, 60.0),), "step_response": ((0.0, 60.0),)}
    runs = so101_runs(dict.fromkeys(whole, WHOLE) | first)
    for one in faults(loop, runs, [simulated(loop, run) for run in runs]):
        print(one.text(loop, runs))


def so101_speed() -> None:
    """CPU time of the squares and sensitivities of 60 s, warm: the whole arm at once, and its joints one by one."""
    loop, run = so101_loop(), _shorter(so101_runs({"multisine": WHOLE})[0], 60.0)
    cut = [Stretch(0, f, 500) for f in range(0, len(run.time) - 500, 500)]
    here = setting(loop, [run], stretches=cut)
    whole = _sums_seconds(here)
    carried, total = carried_by(loop, [run]), 0.0
    for j in range(6):
        one, mine = alone(loop, [run], carried, j)
        total += _sums_seconds(setting(one, mine, stretches=cut))
    print(
        f"squares and sensitivities of {len(run.time) * PERIOD:.0f} s, CPU ms: arm {1e3 * whole:.1f}, joints"
        f" {1e3 * total:.1f}"
    )


def _sums_seconds(here: Setting) -> float:
    """The least of three, after one that compiles."""
    theta, free, found = values(here.loop, here.known.table), np.array(here.baseline), []
    for _ in range(4):
        start = time.process_time()
        with jax.enable_x64(True):
            sums = linear_sums(here.loop, here.known.table, theta[None], free[None], here.data, start_of(here.data))
            jax.block_until_ready(sums)
        found.append(time.process_time() - start)
    return min(found[1:])


def show_motions(label: str, model: Loop, runs: list[Run]) -> float:
    """RMS by motion and joint, mrad, each simulated from its first position and its command alone; their mean."""
    rms = np.array(
        [1e3 * np.sqrt(np.mean((simulated(model, r)[:, :5] - r.position[:, :5]) ** 2, axis=0)) for r in runs]
    )
    each = ", ".join(f"{r.name} {x.mean():.2f}" for r, x in zip(runs, rms, strict=True))
    print(f"{label:<34} unseen {rms.mean():6.2f} mrad, by joint {np.round(rms.mean(0), 1)}; {each}", flush=True)
    return float(rms.mean())


def _shorter(run: Run, most: float) -> Run:
    rows = slice(0, round(most / PERIOD))
    return run._replace(time=run.time[rows], command=run.command[rows], position=run.position[rows])


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
    parser.add_argument(
        "data",
        choices=[
            "servo_miuzei",
            "dfki_double_pendulum",
            "so101_sage",
            "so101_thirds",
            "so101_speed",
            "so101_faults",
            "so101_contact",
        ],
    )
    parser.add_argument("--window", type=float, default=0.3, help="s, of the double pendulum")
    parser.add_argument("--law", choices=["hard", "soft"], default="hard")
    parser.add_argument("--runs", nargs="+", default=["0::4"], metavar="FIRST::EVERY", help="of the Miuzei, fitted")
    parser.add_argument("--every", type=int, default=1, help="takes one window of so many")
    parser.add_argument("--third", type=int, choices=[0, 1, 2], help="of the arm's recordings, left out of the fit")
    parser.add_argument("--most", type=float, default=999.0, help="s of each of the arm's recordings that are fitted")
    parser.add_argument("--motions", nargs="+", choices=list(TRAIN), default=list(TRAIN), help="of the arm, fitted")
    parser.add_argument("--unseen", type=float, default=999.0, help="s of each of the arm's motions that are predicted")
    parser.add_argument("--forbid", nargs="*", default=[], help="effects that the arm's search leaves out")
    parser.add_argument("--uncut", action="store_true", help="the arm's recordings with their faulty rows")
    parser.add_argument("--again", action="store_true", help="the arm's search a second time, everything compiled")
    parser.add_argument("--processes", type=int, default=4, help="of so101_thirds, one thread each")
    parser.add_argument("--out", help="folder for all that so101_thirds finds")
    args = parser.parse_args()
    if args.data == "so101_thirds":
        so101_thirds(args.processes, args.out)
    elif args.data == "so101_speed":
        so101_speed()
    elif args.data == "so101_contact":
        so101_contact()
    elif args.data == "so101_faults":
        so101_faults()
    elif args.data == "so101_sage":
        so101_sage(args.motions, args.third, args.most, args.unseen, args.forbid, args.again, args.uncut)
    elif args.data == "servo_miuzei":
        for fitted in args.runs:
            print(f"runs {fitted}")
            servo_miuzei(args.law, fitted)
    else:
        dfki_double_pendulum(args.window, args.every)
