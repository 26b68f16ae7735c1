"""Torques as strangers record them: `diagnose` and `identify` of robots, drives, motions and files that are drawn.

    python benchmarks/torque_conditions.py --seeds 0 60 [--effects nothing payload] [--most 5] [--commands diagnose]

Drawn are: number of joints (`--most`), their axes and which of them slide, a branch, how the base is mounted (turned in
the file, or gravity turned), URDF or MJCF, zero positions, a joint that is locked or hangs beside the others, how far
the links, rotors and friction of the file are off, also not at all; the motion (waves, one joint after another, moves
with rests) and whether its torque is of exact inverse dynamics or of a loop that MuJoCo C closes, with friction that
sticks; sampling, stamps, order of the columns, units, a motor side, a known load, recordings that are kept out or
repeated, noise, counts, filter, gate and baseline. Half of them hide nothing, the others one effect.
One line a case; at the end tables of verdicts, and every case with a name that is neither the truth nor said to be
alike, an error or a warning. Of `identify` its errors are printed, on fitted and on held-out rows.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.rollout_conditions import asked, diagnosed, tilted, words

MADE: Any = mujoco
EFFECTS = (
    "payload",
    "stribeck_friction",
    "asymmetric_coulomb_friction",
    "load_dependent_friction",
    "position_dependent_friction",
    "rotor_inertia",
    "torque_offset",
    "torque_ripple",
    "joint_spring",
    "gravity_tilt",
    "torque_delay",
    "coupled_transmission",
    "torque_saturation",
    "encoder_offset",
)
IN_LOOP = ("payload", "rotor_inertia", "joint_spring", "gravity_tilt", "torque_ripple")  # as the robot itself has them
ASKED_FOR = ("joint_elasticity",)  # drawn by --effects alone, so that a seed stays the case that it was
AXES = ("1 0 0", "0 1 0", "0 0 1", "0 -1 0", "0.6 0 0.8", "0 0.8 0.6")
ALIKE = (
    {"payload", "link_inertia"},
    {"torque_offset", "asymmetric_coulomb_friction"},
    {"torque_delay", "torque_lag"},
)


class Link(NamedTuple):
    """A body behind its joint: numbers as they are, in its own frame."""

    parent: int
    place: np.ndarray  # m, in the parent
    turn: np.ndarray  # rad, roll, pitch and yaw
    axis: str
    slides: bool
    zero: float
    mass: float
    com: np.ndarray
    inertia: np.ndarray  # (3, 3) about the centre of mass


class Case(NamedTuple):
    told: str
    task: dict[str, Any]
    files: dict[str, str]
    recordings: list[dict[str, np.ndarray]]
    table: str
    truth: tuple[str, str] | None
    numbers: dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 60], metavar=("FIRST", "END"))
    parser.add_argument("--effects", nargs="+", choices=["nothing", *EFFECTS, *ASKED_FOR], default=[])
    parser.add_argument("--most", type=int, default=5, help="joints of a robot")
    parser.add_argument("--commands", nargs="+", choices=["diagnose", "identify"], default=["diagnose", "identify"])
    parser.add_argument("--keep", type=Path, help="folder that keeps every case's files")
    args = parser.parse_args()
    count: collections.Counter[tuple[str, str]] = collections.Counter()
    odd = list[str]()
    for seed in range(*args.seeds):
        case = drawn(np.random.default_rng([seed, 91]), args)
        if case is None:
            print(f"{seed}: its loop is not stable", flush=True)
            continue
        marks, lines = answered(case, args.commands, args.keep and args.keep / str(seed))
        line = f"{seed}: {case.told}\n    " + "\n    ".join(lines)
        print(line, flush=True)
        effect = case.told.split(",", 1)[0].split()[0]
        for job, mark in zip(args.commands, marks, strict=True):
            count[f"{job} {effect}", mark] += 1
        if any(mark in ("wrong", "error", "warning") for mark in marks):
            odd.append(line)
    for (effect, mark), number in sorted(count.items()):
        print(f"{effect:40} {mark:10} {number}")
    print(*odd, sep="\n")


def drawn(rng: np.random.Generator, args: argparse.Namespace) -> Case | None:
    """A case, or None where the closed loop does not follow its reference."""
    every = args.effects or (["nothing"] if rng.random() < 0.5 else list(EFFECTS))
    effect = str(rng.choice(every))
    n = int(rng.integers(1, args.most + 1))
    links, pull, mounted = _links(rng, n)
    urdf = bool(rng.random() < 0.6)
    if urdf:
        links = [one._replace(zero=0.0) for one in links]
    locked = int(rng.integers(n)) if n > 2 and rng.random() < 0.2 else -1
    held = round(float(rng.uniform(-0.8, 0.8)), 2)
    moving = [k for k in range(n) if k != locked]
    slides = np.array([one.slides for one in links])
    start = np.array([one.zero for one in links])
    if locked >= 0:
        held = 0.05 if slides[locked] else held
        start[locked] = held
    travel = np.where(slides, 0.15, 1.0)
    rotors = bool(rng.random() < 0.5)
    j = int(rng.choice(moving))
    size = float(rng.choice([0.1, 0.2, 0.4]))
    inertia, weight = _sizes(_model(links, pull, np.zeros(n)), start, travel, rng)
    armature = inertia * rng.uniform(0.1, 0.8, n) * rotors
    load = weight + (inertia + armature) * travel * 4.0  # torque that is typical of the joint
    dry, viscous = load * rng.uniform(0.03, 0.2, n), 0.5 * load * rng.uniform(0.02, 0.15, n) / travel
    real_links, real_armature, real_pull = list(links), armature.copy(), pull.copy()
    if effect == "payload":
        real_links[-1] = _loaded(links[-1], size * 2.0)
    if effect == "rotor_inertia":
        real_armature[j] += 2.0 * size * load[j] / travel[j] / 4.0
    if effect == "gravity_tilt":
        real_pull = tilted(pull, 0.3 * size)
    real = _model(real_links, real_pull, real_armature)

    closed = bool(rng.random() < 0.5)
    motion = str(rng.choice(["waves", "waves", "one after another", "moves with rests"]))
    closed = closed or motion != "waves"  # friction at rest is a loop's to tell
    number, seconds = int(rng.integers(1, 5)), float(rng.choice([8.0, 15.0, 30.0]))
    rate = float(rng.choice([100.0, 200.0, 250.0, 500.0, 1000.0]))
    noise = float(rng.choice([0.003, 0.01, 0.03]))
    counts = int(rng.choice([0, 0, 2**14, 2**18]))
    fast = float(rng.choice([0.6, 1.0, 1.8]))
    again, kept = bool(rng.random() < 0.25), bool(rng.random() < 0.4)
    with_load = bool(rng.random() < 0.2) and number > 1
    recordings, entries, waves, last = [], [], 0, n - 1
    for run in range(number):
        waves = waves if again and run % 2 else int(rng.integers(2**31))
        carried = real
        if with_load and run == 0:
            carried = _model(
                [*real_links[:-1], _point(real_links[-1], 0.5, np.array([0.05, 0.0, 0.1]))], real_pull, real_armature
            )
        made = _moved(
            np.random.default_rng(waves),
            carried,
            start,
            moving,
            travel,
            motion,
            seconds,
            rate,
            fast,
            closed,
            (dry, viscous),
            (effect if effect in IN_LOOP[2:] else "", j, size, load),
        )
        if made is None:
            return None
        q, v, tau = made
        tau = _measured(tau, q, v, (effect, j, size), load, dry, rate, moving, _rigid(carried, q, v, rate))
        tau += noise * load * rng.standard_normal(tau.shape)
        read = q.copy()
        if effect == "encoder_offset":
            read[:, j] += 0.1 * size * travel[j]
        if effect == "joint_elasticity":  # an encoder on the motor of a gear that winds up
            read[:, j] += 0.02 * size * travel[j] * _rigid(carried, q, v, rate)[:, j] / load[j]
        if counts:
            step = 2 * np.pi / counts * travel
            read = np.round(read / step) * step
        speed = v + 20 / max(counts, 2**17) * travel * rng.standard_normal(v.shape)
        recordings.append({"q": read, "dq": speed, "tau": tau})
        entry: dict[str, Any] = {}
        if with_load and run == 0:
            entry["load"] = {"frame": f"body{last}", "mass": 0.5, "com": [0.05, 0.0, 0.1]}
        entries.append(entry)
    if again and number > 1:
        for run in range(number - number % 2):
            entries[run]["repeat"] = f"m{run // 2}"
    if kept and number > 1 and "repeat" not in entries[-1]:
        entries[-1]["role"] = "holdout"

    order = np.array(moving)[rng.permutation(len(moving)) if rng.random() < 0.5 else slice(None)]
    begins = float(rng.choice([0.0, 0.0, 12.5, 1.7e9]))
    degrees, table = bool(rng.random() < 0.25) and not slides.any(), str(rng.choice(["npz", "npz", "csv"]))
    with_speed, clock = bool(rng.random() < 0.4), str(rng.choice(["time", "time", "jitter", "rate"]))
    motor = bool(rng.random() < 0.2)
    ratio = np.round(rng.uniform(5, 100, len(order))) * rng.choice([-1, 1], len(order))
    for entry, one in zip(entries, recordings, strict=True):
        t = begins + np.arange(len(one["q"])) / rate
        if clock == "jitter":
            t = t + rng.uniform(-0.1, 0.1, len(t)) / rate
        one |= {name: one[name][:, order] for name in ("q", "dq", "tau")} | {"t": t}
        if motor:
            one["q"], one["dq"], one["tau"] = one["q"] * ratio, one["dq"] * ratio, one["tau"] / ratio
        if degrees:
            one["q"], one["dq"] = np.degrees(one["q"]), np.degrees(one["dq"])
            entry["units"] = {"position": "deg"}
        entry |= {"rate": rate} if clock == "rate" else {"time": "t"}
        entry |= {"position": "q", "torque": "tau"} | ({"velocity": "dq"} if with_speed else {})
    for run, entry in enumerate(entries):
        entry["file"] = f"run{run}.{table}"
        if table == "csv":
            for key in {"position", "velocity", "torque"} & entry.keys():
                entry[key] = [f"{entry[key]}_{k}" for k in range(len(order))]

    exact = bool(rng.random() < 0.3)
    filed = links if exact else [_mistaken(one, rng) for one in links]
    joints = [f"j{k}" for k in order]
    robot: dict[str, Any] = {"model": f"robot.{'urdf' if urdf else 'xml'}", "joints": joints}
    if locked >= 0:
        robot["posture"] = {f"j{locked}": held}
    if urdf and (pull != [0, 0, -9.81]).any():
        robot["gravity"] = pull.tolist()
    files = {robot["model"]: _urdf(filed) if urdf else _mjcf(filed, pull, armature)}
    baseline: dict[str, Any] = {}
    if urdf and rotors and effect != "rotor_inertia":
        baseline["rotor"] = True
    if effect != "torque_offset" and rng.random() < 0.3:
        baseline["offset"] = True
    cutoff = float(rng.choice([0, 10.0, 20.0, 40.0]))
    cutoff = min(cutoff, 0.3 * rate)
    before: dict[str, Any] = {"cutoff": cutoff} if cutoff else {}
    if cutoff and rng.random() < 0.4:
        before["rate"] = float(min(rate, 5 * cutoff))
    if rng.random() < 0.15:
        before["gate"] = {f"j{j}": float(0.03 * travel[j])}
    task: dict[str, Any] = {"robot": robot, "data": entries}
    if motor:
        task["transmission"] = {"position": np.diag(ratio).tolist(), "torque": np.diag(ratio).tolist()}
    if before:
        task["preprocess"] = before
    if baseline:
        task["baseline"] = {"viscous": True, "coulomb": True} | baseline
    at = {"payload": f"body{last}", "gravity_tilt": "", "torque_delay": ""}.get(effect, f"j{j}")
    if effect == "coupled_transmission":
        at = _pair(moving, j)
    letters = "".join("s" if one.slides else "h" for one in links)
    branched = " branched" if [one.parent for one in links] != list(range(-1, n - 1)) else ""
    told = (
        f"{effect}{f' at {at}' if at and effect != 'nothing' else ''} x{size:g}, {n} joints {letters}{branched},"
        f" {mounted},"
        f" {'urdf' if urdf else 'mjcf'} {'exact' if exact else 'off'}{', rotors' * rotors}"
        f"{f', j{locked} locked' if locked >= 0 else ''}, {motion} {fast:g}, {'loop' if closed else 'inverse'},"
        f" {number} of {seconds:g} s at {rate:g} Hz, noise {noise:g}{f', {counts} counts' if counts else ''}"
        f"{', repeats' if again and number > 1 else ''}{', holdout' if 'role' in entries[-1] else ''}"
        f"{', load' * with_load}{', columns ' + ' '.join(joints) if (np.diff(order) < 0).any() else ''},"
        f" {clock}{f' from {begins:g}' if begins else ''}"
        f"{', deg' * degrees}, {table}{', velocity' * with_speed}{', motor' * motor}, {before}, {baseline}"
    )
    numbers = {f"friction j{k}": float(dry[k]) for k in moving}
    if locked < 0 and effect == "nothing" and not with_load:
        numbers |= _numbers(real_links, real_armature, dry, viscous)
    truth = (effect, at) if effect != "nothing" else None
    return Case(told, task, files, recordings, table, truth, numbers)


def _links(rng: np.random.Generator, n: int) -> tuple[list[Link], np.ndarray, str]:
    slides = rng.random(n) < 0.12
    parent = [k - 1 for k in range(n)]
    if n > 2 and rng.random() < 0.2:
        parent[n - 1] = 0
    mounted = str(rng.choice(["upright", "turned in the file", "gravity turned"], p=[0.6, 0.2, 0.2]))
    pull = np.array([0.0, 0.0, -9.81])
    if mounted == "gravity turned":
        pull = 9.81 * np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.6, 0, -0.8]][int(rng.integers(4))])
    links = []
    mass, length = rng.uniform(1.0, 8.0, n) * 0.7 ** np.arange(n), rng.uniform(0.1, 0.45, n)
    for k in range(n):
        square = rng.standard_normal((3, 3))
        spin = np.linalg.qr(square)[0]
        size = mass[k] * length[k] ** 2 / 12 + 1e-4
        moments = size * np.array([1.0, rng.uniform(0.6, 1.0), 0.3])  # of a rod, nearly
        moments[2] = max(moments[2], abs(moments[0] - moments[1]) * 1.1)
        turn = rng.uniform(-1, 1, 3) * (rng.random() < 0.3)
        if k == 0 and mounted == "turned in the file":
            turn = rng.uniform(-3, 3, 3)
        place = np.array([0.0, 0.0, 0.2]) if parent[k] < 0 else np.array([0.0, 0.03, length[parent[k]]])
        com = length[k] * np.array([0.1, -0.08, 0.5]) * rng.uniform(0.5, 1.3, 3)
        axis = str(rng.choice(AXES))
        zero = float(round(rng.uniform(-1, 1), 2)) * (rng.random() < 0.3) * (0.1 if slides[k] else 1.0)
        links.append(
            Link(
                parent[k],
                place,
                turn,
                axis,
                bool(slides[k]),
                zero,
                float(mass[k]),
                com,
                spin @ np.diag(moments) @ spin.T,
            )
        )
    return links, pull, mounted


def _mistaken(one: Link, rng: np.random.Generator) -> Link:
    """What a file has in place of the link: about 5 % off."""
    com = one.com + 0.04 * np.linalg.norm(one.com) * rng.standard_normal(3)
    return one._replace(
        mass=one.mass * float(1 + 0.05 * rng.standard_normal()),
        com=com,
        inertia=one.inertia * float(1 + 0.08 * rng.standard_normal()),
    )


def _point(one: Link, mass: float, place: np.ndarray) -> Link:
    """The link with a point mass at a place of its frame."""
    middle = (one.mass * one.com + mass * place) / (one.mass + mass)

    def about(m: float, r: np.ndarray) -> np.ndarray:
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    inertia = one.inertia + about(one.mass, one.com - middle) + about(mass, place - middle)
    return one._replace(mass=one.mass + mass, com=middle, inertia=inertia)


def _loaded(one: Link, size: float) -> Link:
    return _point(one, size * one.mass, 2.0 * one.com + np.array([0.02, 0.03, 0.0]))


def _mjcf(links: list[Link], pull: np.ndarray, armature: np.ndarray, more: str = "") -> str:
    inside = [""] * len(links)
    for k in reversed(range(len(links))):
        one = links[k]
        kind = "slide" if one.slides else "hinge"
        own = f'<joint name="j{k}" type="{kind}" axis="{one.axis}" ref="{one.zero:.3g}" armature="{armature[k]:.9g}"/>'
        i = one.inertia
        full = words(i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
        body = f'<inertial pos="{words(*one.com)}" mass="{one.mass:.9g}" fullinertia="{full}"/>'
        place = f'pos="{words(*one.place)}" euler="{words(*one.turn)}"'
        whole = f'<body name="body{k}" {place}>{own}{body}{inside[k]}</body>'
        inside[one.parent] = whole + inside[one.parent] if one.parent >= 0 else inside[one.parent]
        if one.parent < 0:
            inside[k] = whole
    return (
        f'<mujoco model="made"><compiler angle="radian" eulerseq="XYZ"/><option gravity="{words(*pull)}"'
        f' timestep="0.001" integrator="implicitfast"/><worldbody>{inside[0]}</worldbody>{more}</mujoco>'
    )


def _urdf(links: list[Link]) -> str:
    parts = ['<robot name="made"><link name="base"/>']
    for k, one in enumerate(links):
        i = one.inertia
        inertia = " ".join(f'i{"xyz"[a]}{"xyz"[b]}="{i[a, b]:.9g}"' for a in range(3) for b in range(a, 3))
        parts.append(
            f'<link name="body{k}"><inertial><mass value="{one.mass:.9g}"/><origin xyz="{words(*one.com)}"/>'
            f"<inertia {inertia}/></inertial></link>"
            f'<joint name="j{k}" type="{"prismatic" if one.slides else "revolute"}">'
            f'<parent link="{f"body{one.parent}" if one.parent >= 0 else "base"}"/><child link="body{k}"/>'
            f'<origin xyz="{words(*one.place)}" rpy="{words(*one.turn)}"/><axis xyz="{one.axis}"/>'
            f'<limit lower="-6" upper="6" velocity="20" effort="10000"/></joint>'
        )
    return "".join(parts) + "</robot>"


def _model(links: list[Link], pull: np.ndarray, armature: np.ndarray) -> Any:
    return MADE.MjModel.from_xml_string(_mjcf(links, pull, armature))


def _numbers(links: list[Link], armature: np.ndarray, dry: np.ndarray, viscous: np.ndarray) -> dict[str, float]:
    """Every link's ten numbers about its own frame, its drive's rotor and friction; no link's that stands turned."""
    out = dict[str, float]()
    for k, one in enumerate(links, 1):
        out |= {f"Ia{k}": float(armature[k - 1]), f"fc{k}": float(dry[k - 1]), f"fv{k}": float(viscous[k - 1])}
        out[f"off{k}"] = 0.0
        if one.zero:
            continue
        about = one.inertia + one.mass * (one.com @ one.com * np.eye(3) - np.outer(one.com, one.com))
        out |= {f"m{k}": one.mass} | {f"m{x}{k}": float(one.mass * c) for x, c in zip("xyz", one.com, strict=True)}
        out |= {f"I{'xyz'[a]}{'xyz'[b]}{k}": float(about[a, b]) for a in range(3) for b in range(a, 3)}
    return out


def _sizes(
    model: Any, start: np.ndarray, travel: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Typical inertia and weight felt at each joint."""
    data, n = MADE.MjData(model), model.nv
    inertias, weights = [], []
    for _ in range(30):
        data.qpos[:] = start + travel * rng.uniform(-1, 1, n)
        MADE.mj_forward(model, data)
        dense = np.zeros((n, n))
        MADE.mj_fullM(model, data, dense)
        inertias.append(np.diag(dense).copy())
        weights.append(np.abs(data.qfrc_bias))
    return np.mean(inertias, 0), np.mean(weights, 0)


def _reference(
    rng: np.random.Generator,
    motion: str,
    seconds: float,
    step: float,
    travel: np.ndarray,
    moving: list[int],
    fast: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position about the start, velocity and acceleration (rows, joints), at rest where it begins."""
    n, t = len(travel), np.arange(round(seconds / step)) * step
    q = np.zeros((len(t), n))
    for k in moving:
        if motion == "moves with rests":
            at, now = 0, 0.0
            while at < len(t):
                there = float(rng.uniform(-1, 1))
                lasts = max(0.5, 1.9 * abs(there - now) / (1.2 * fast))
                s = (t - t[at]) / lasts
                q[at:, k] = now + (there - now) * _begun(s)[at:]
                at, now = at + round((lasts + float(rng.uniform(0.1, 0.6))) / step), there
        else:
            rates = 2 * np.pi * fast * np.array([rng.uniform(0.1, 0.2), rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8)])
            wave = sum(a * np.sin(w * t + rng.uniform(0, 6)) for a, w in zip((0.6, 0.3, 0.12), rates, strict=True))
            if motion == "one after another":
                length = seconds / len(moving)
                inside = t - moving.index(k) * length
                wave = wave * _begun(inside / 1.0) * _begun((length - inside) / 1.0)
            else:
                wave = wave * _begun(t / 1.0)
            q[:, k] = wave
    q *= travel
    v = np.asarray(np.gradient(q, step, axis=0))
    return q, v, np.asarray(np.gradient(v, step, axis=0))


def _begun(time: np.ndarray) -> np.ndarray:
    """From 0 to 1, smooth, while the time goes from 0 to 1."""
    s = np.clip(time, 0, 1)
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def _moved(
    rng: np.random.Generator,
    model: Any,
    start: np.ndarray,
    moving: list[int],
    travel: np.ndarray,
    motion: str,
    seconds: float,
    rate: float,
    fast: float,
    closed: bool,
    rub: tuple[np.ndarray, np.ndarray],
    hidden: tuple[str, int, float, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Position, velocity and torque of the drives at the samples; None where the loop does not follow."""
    dry, viscous = rub
    q, v, a = _reference(rng, motion, seconds, 0.001, travel, moving, fast)
    q = q + start
    every = round(1000 / rate)
    data = MADE.MjData(model)
    if not closed:
        q, v, a = q[::every], v[::every], a[::every]
        tau = np.zeros_like(q)
        for k in range(len(q)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
            MADE.mj_inverse(model, data)
            tau[k] = data.qfrc_inverse
        still = 1e-3 * travel
        tau += viscous * v + dry * np.tanh(v / still)
        return q, v, tau - np.array([_pushed(hidden, x, start, travel) for x in q])
    model.dof_frictionloss[:], model.dof_damping[:] = dry, viscous
    model.dof_solref[:], model.dof_solimp[:, :3] = (0.002, 1.0), (0.999, 0.9999, 1e-3)  # it holds as dry friction does
    model.dof_armature[[k for k in range(model.nv) if k not in moving]] = 1e6  # locked
    data.qpos[:] = q[0]
    MADE.mj_forward(model, data)
    dense = np.zeros((model.nv, model.nv))
    MADE.mj_fullM(model, data, dense)
    rates = 2 * np.pi * rng.uniform(4.0, 8.0)
    got, speed, tau = (np.zeros_like(q[::every]) for _ in range(3))
    for k in range(len(q)):
        push = _pushed(hidden, data.qpos, start, travel)
        MADE.mj_fullM(model, data, dense)
        force = dense @ (a[k] + rates**2 * (q[k] - data.qpos) + 1.6 * rates * (v[k] - data.qvel)) + data.qfrc_bias
        data.qfrc_applied[:] = force + push
        if k % every == 0:
            got[k // every], speed[k // every], tau[k // every] = data.qpos, data.qvel, force
        MADE.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or (np.abs(data.qpos - q[k]) > 0.6 * travel).any():
            return None
    return got, speed, tau


def _pushed(
    hidden: tuple[str, int, float, np.ndarray], q: np.ndarray, start: np.ndarray, travel: np.ndarray
) -> np.ndarray:
    """Torque that an effect of the robot itself adds to the drives'."""
    effect, j, size, load = hidden
    push = np.zeros(len(q))
    if effect == "joint_spring":
        push[j] = -1.5 * size * load[j] / travel[j] * (q[j] - start[j] - 0.1 * travel[j])
    if effect == "torque_ripple":
        push[j] = -1.2 * size * load[j] * np.sin(12.0 * q[j] / travel[j] + 0.9)
    return push


def _rigid(model: Any, q: np.ndarray, v: np.ndarray, rate: float) -> np.ndarray:
    """Torque of the rigid body alone, at the samples."""
    data, out = MADE.MjData(model), np.zeros_like(q)
    a = np.gradient(v, 1 / rate, axis=0)
    model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        MADE.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out


def _pair(moving: list[int], j: int) -> str:
    place = moving.index(j)
    two = sorted([j, moving[place + 1] if place + 1 < len(moving) else moving[place - 1]])
    return " ".join(f"j{k}" for k in dict.fromkeys(two))


def _measured(
    tau: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    hidden: tuple[str, int, float],
    load: np.ndarray,
    dry: np.ndarray,
    rate: float,
    moving: list[int],
    rigid: np.ndarray,
) -> np.ndarray:
    """The drives' torque with effects that are added to what was measured, for what the sensor reads or friction."""
    effect, j, size = hidden
    tau, one = tau.copy(), size * load[j]
    top = np.abs(v[:, j]).max()
    sign = np.tanh(v[:, j] / (0.003 * top))
    if effect == "stribeck_friction":
        tau[:, j] += 1.5 * one * np.exp(-((v[:, j] / (0.15 * top)) ** 2)) * sign
    if effect == "asymmetric_coulomb_friction":
        tau[:, j] += one * np.abs(sign)
    if effect == "load_dependent_friction":
        tau[:, j] += 1.5 * size * np.abs(rigid[:, j]) * sign
    if effect == "position_dependent_friction":
        tau[:, j] += min(one, 0.9 * dry[j]) * np.sin(q[:, j] + 0.4) * sign
    if effect == "torque_offset":
        tau[:, j] += one
    if effect == "torque_delay":
        t = np.arange(len(tau)) / rate
        late = 0.05 * size
        tau = np.stack([np.interp(t - late, t, x) for x in tau.T], 1)
    if effect == "coupled_transmission":
        a, b = (int(name[1:]) for name in _pair(moving, j).split()) if len(moving) > 1 else (j, j)
        if a != b:
            acceleration = np.gradient(v, 1 / rate, axis=0)
            inertia = size * min(load[a], load[b]) / 4.0
            tau[:, a] += inertia * acceleration[:, b]
            tau[:, b] += inertia * acceleration[:, a]
    if effect == "torque_saturation":
        most = (1 - 0.5 * size) * np.abs(tau[:, j]).max()
        tau[:, j] = np.clip(tau[:, j], -most, most)
    return tau


def answered(case: Case, jobs: list[str], keep: Path | None = None) -> tuple[list[str], list[str]]:
    """How each command did, in a word and in a line."""
    with written(case, keep) as folder:
        return asked(folder, jobs, lambda job: (_diagnosed if job == "diagnose" else _identified)(case, folder / job))


@contextlib.contextmanager
def written(case: Case, keep: Path | None) -> Iterator[Path]:
    """The folder with a case's files, its recordings and its `task.yaml`."""
    with tempfile.TemporaryDirectory() as name:
        folder = keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for k, arrays in enumerate(case.recordings):
            if case.table == "npz":
                np.savez(folder / f"run{k}.npz", **arrays)  # pyright: ignore[reportArgumentType]
                continue
            wide = [
                (f"{key}_{i}" if x.ndim > 1 else key, y)
                for key, x in arrays.items()
                for i, y in enumerate(np.atleast_2d(x.T))
            ]
            head = ",".join(key for key, _ in wide)
            np.savetxt(
                folder / f"run{k}.csv",
                np.stack([y for _, y in wide], 1),
                delimiter=",",
                header=head,
                comments="",
                fmt="%.16g",
            )
        for file, text in case.files.items():
            (folder / file).write_text(text)
        (folder / "task.yaml").write_text(yaml.safe_dump(case.task))
        yield folder


def _diagnosed(case: Case, out: Path) -> tuple[str, str]:
    return diagnosed(out, lambda name: _same(name, case.truth))


def _same(name: tuple[str, str], truth: tuple[str, str] | None) -> bool:
    if truth is None:
        return False
    return name == truth or (any({name[0], truth[0]} <= names for names in ALIKE) and name[1] == truth[1])


def _identified(case: Case, out: Path) -> tuple[str, str]:
    result = json.loads((out / "result.json").read_text())
    relative = ", ".join(f"{x:.3g}" for x in result["fit"]["relative"])
    held_out = "; ".join(", ".join(f"{x:.3g}" for x in one["relative"]) for one in (result["holdout"] or {}).values())
    told = f"relative {relative}{f', held out {held_out}' if held_out else ''}"
    apart = {}
    for one in result["base_parameters"]:
        parts = re.findall(r"([+-]?) ?(?:([0-9.]+(?:e[+-]?[0-9]+)?) )?([A-Za-z]+[0-9]+)", one["expression"])
        if one["status"] == "identified" and all(name in case.numbers for _, _, name in parts):
            truth = sum(float(f"{sign}{size or 1}") * case.numbers[name] for sign, size, name in parts)
            apart[one["expression"]] = (one["value"] - truth) / one["std"]
    if apart:
        inside = sum(abs(x) < 1.96 for x in apart.values())
        worst = max(apart, key=lambda name: abs(apart[name]))
        told += f", intervals hold {inside} of {len(apart)}, worst {worst} ({apart[worst]:.1f} std)"
    return "done", told


if __name__ == "__main__":
    main()
