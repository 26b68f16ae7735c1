"""Command and position as strangers record them: `diagnose` and `identify` of robots, drives and clocks that are drawn.

    python benchmarks/rollout_conditions.py --seeds 0 60 [--effects nothing payload] [--most 3] [--commands diagnose]
    python benchmarks/rollout_conditions.py --differ --seeds 0 60 [--effects warming battery]
    python benchmarks/rollout_conditions.py --files FOLDER [FOLDER ...] [--part K N]

With `--differ` the robot is not the same in all of its two to four recordings: some have what others lack (a tool, a
base that is not level, a late command, another zero or gain of a joint), or it comes by and by (a battery that drains,
joints that grow warm). The effect's own name is right, with or without that; `blind` is `nothing` beside recordings,
kept out or not, of which the model leaves more than twice the noise.

With `--files` MuJoCo C moves the robots of the MJCF files there, whose joints are single axes, by sines at each
actuator; damping, friction and rotors are off in every other one. Nothing is hidden. Commands are those of the drives,
or of the joints where all are driven; every third time they stay in the order of the actuators, which is to be refused
where it is another one.

Drawn are: number of joints (`--most`), their axes and which of them slide, a branch, how the base is mounted (turned in
the file, or gravity turned), inertias or geoms, joints' zero positions, order of the columns, drives (position servos
with and without limits, gears, filters; general ones of the same law; a URDF's way of a task's `actuator`), gains, time
step and integrator, sampling, first time stamp, number and length of recordings, motions (waves, steps, one joint after
another), noise (white or counts), and how far the file's friction, damping and armature are off, also not at all. Half
of them hide nothing, the others one effect. Everything is made by MuJoCo C and goes through the command line.
One line a case; at the end tables of verdicts, and every case with a name that is neither the truth nor said to be
alike, an error or a warning. `identify` of robots that hide nothing is asked whether its 95 % intervals hold the truth.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import json
import re
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import yaml

import figaroh_jax as fj
from figaroh_jax.cli import main as command_line

MADE: Any = mujoco
EFFECTS = (
    "stribeck_friction",
    "load_dependent_friction",
    "command_delay",
    "encoder_offset",
    "payload",
    "joint_spring",
    "gravity_tilt",
    "dead_band",
    "torque_ripple",
)
BLIND = 2.0  # times the noise
DIFFERING = {  # from recording to recording: what may be named of it; at a joint, at all of them or of the whole robot
    "payload": ("payload", "link_inertia"),
    "gravity_tilt": ("gravity_tilt",),
    "command_delay": ("command_delay",),
    "late_recorder": ("command_delay",),
    "encoder_offset": ("encoder_offset",),
    "actuator_gain": ("actuator_gain",),
    "battery": ("actuator_gain", "actuator_saturation"),
    "warming": (),
}
BY_AND_BY = ("battery", "warming")
DRIVES = ("position", "position", "limited", "geared", "general", "filtered", "stated")
AXES = ("1 0 0", "0 1 0", "0 0 1", "0 -1 0", "0.6 0 0.8", "0 0.8 0.6")


class Robot(NamedTuple):
    """A robot as it is (`text`) and as its file has it, with what was drawn in words."""

    text: str
    file: str
    names: list[str]  # of the joints, in the order of the file
    ranges: np.ndarray  # rad or m that the joints travel about their start
    slides: np.ndarray
    friction: np.ndarray  # N m or N
    weights: np.ndarray  # the same, of gravity and inertia at the joints
    numbers: dict[str, float]  # of the joints, as they are, by the names that `identify` gives them
    stated: dict[str, Any]  # drives that the task states, for a file that has none
    told: str


class Case(NamedTuple):
    told: str
    task: dict[str, Any]
    file: str
    recordings: list[dict[str, np.ndarray]]
    truth: tuple[str, str] | None
    numbers: dict[str, float]
    differs: bool = False


class Hidden(NamedTuple):
    """What is hidden at a joint, and its size; that of each recording, where they differ, stands in its place."""

    effect: str
    joint: int
    size: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 60], metavar=("FIRST", "END"))
    parser.add_argument("--effects", nargs="+", choices=sorted({"nothing", *EFFECTS, *DIFFERING}), default=[])
    parser.add_argument("--differ", action="store_true", help="effects that not all recordings have alike")
    parser.add_argument("--most", type=int, default=4, help="joints of a robot")
    parser.add_argument("--integrators", nargs="+", default=["implicitfast", "implicitfast", "Euler", "Euler", "RK4"])
    parser.add_argument("--drives", nargs="+", choices=DRIVES, default=DRIVES)
    parser.add_argument("--commands", nargs="+", choices=["diagnose", "identify"], default=["diagnose", "identify"])
    parser.add_argument("--files", nargs="+", type=Path, metavar="FOLDER", help="of MJCF files, in place of drawn ones")
    parser.add_argument("--part", nargs=2, type=int, default=[0, 1], metavar=("K", "N"), help="every N-th file from K")
    args = parser.parse_args()
    if args.files:
        of_files(args.files, args.part, args.commands)
        return
    count: collections.Counter[tuple[str, str]] = collections.Counter()
    odd, inside = [], list[tuple[int, int]]()
    for seed in range(*args.seeds):
        case = drawn(np.random.default_rng([seed, 77]), args)
        if case is None:
            print(f"{seed}: its own simulation is not stable", flush=True)
            continue
        marks, lines = answered(case, args.commands)
        line = f"{seed}: {case.told}\n    " + "\n    ".join(lines)
        print(line, flush=True)
        inside += [(int(x), int(n)) for x, n in re.findall(r"(\d+) of (\d+) intervals", line)]
        effect = case.told.split(",", 1)[0].split()[0]
        for job, mark in zip(args.commands, marks, strict=True):
            count[f"{job} {effect}", mark] += 1
        if any(mark in ("wrong", "blind", "error", "warning") for mark in marks):
            odd.append(line)
    if inside:
        held, all_of = (sum(x) for x in zip(*inside, strict=True))
        print(f"95 % intervals of `identify` that hold the truth: {held} of {all_of}")
    for (effect, mark), number in sorted(count.items()):
        print(f"{effect:36} {mark:10} {number}")
    print(*odd, sep="\n")


def drawn(rng: np.random.Generator, args: argparse.Namespace) -> Case | None:
    """A case, or None where the robot's own simulation does not stay where it is commanded."""
    known = list(DIFFERING) if args.differ else list(EFFECTS)
    every = args.effects or (["nothing"] if rng.random() < 0.5 and not args.differ else known)
    effect = str(rng.choice(every))
    robot = _robot(rng, args.most, args.drives)
    n, j = len(robot.names), int(rng.integers(len(robot.names)))
    size = float(rng.choice([0.5, 1.0, 2.0]))
    step, scheme = float(rng.choice([0.001, 0.002, 0.004])), str(rng.choice(args.integrators))
    every_rows = int(rng.choice([k for k in (1, 2, 4, 5, 8, 10) if 0.003 < k * step <= 0.02]))
    known = bool(rng.random() < 0.8)
    noise, counts = float(rng.choice([5e-5, 2e-4, 1e-3])), int(rng.choice([0, 0, 4096, 16384]))
    number, seconds = int(rng.integers(1, 4)), float(rng.choice([6.0, 12.0, 20.0]))
    motion = str(rng.choice(["waves", "waves", "steps", "one after another"]))
    option = f'timestep="{step}" integrator="{scheme}"'
    shares = np.ones(number)
    if args.differ:
        number, shares = _shares(rng, effect)
    recordings = []
    for share in shares:
        u = _command(rng, robot, motion, seconds, every_rows * step)
        q, v = _moved(robot, option, u, every_rows, Hidden(effect, j, share * size))
        if q is None:
            return None
        sizes = np.where(robot.slides, 0.16, 1.0)  # a joint that slides has .08 m where others have .5 rad
        read = q + (sizes * noise * rng.standard_normal(q.shape) if not counts else 0.0)
        if effect == "encoder_offset":
            read[:, j] += 0.02 * share * size * sizes[j]
        if counts:
            resolution = sizes * 2 * np.pi / counts
            read = np.round(read / resolution) * resolution
        recordings.append({"q": read, "u": u, "dq": v})
    start = float(rng.choice([0.0, 0.0, 17.3, 1.7e9]))
    order = rng.permutation(n) if rng.random() < 0.5 else np.arange(n)
    with_speed = bool(rng.random() < 0.3)
    for one in recordings:
        one["t"] = start + np.arange(len(one["q"])) * every_rows * step
        one["u"], one["q"] = one["u"][:, order], one["q"][:, order]
        one["dq"] = one["dq"][:, order] + 20 * noise * rng.standard_normal(one["dq"].shape)
    entries = [
        {"file": f"run{k}.npz", "time": "t", "command": "u", "position": "q"}
        | ({"velocity": "dq"} if with_speed else {})
        for k in range(number)
    ]
    if number > 1 and rng.random() < 0.5:
        entries[-1]["role"] = "holdout"
    joints = [robot.names[k] for k in order]
    task: dict[str, Any] = {"robot": {"model": "robot.xml", "joints": joints}, "data": entries}
    task["actuator"] = {"gains": "known" if known else "free"} | robot.stated
    whole = {"payload": f"body{n - 1}"} | dict.fromkeys(("gravity_tilt", "late_recorder", *BY_AND_BY), "")
    at = whole.get(effect, robot.names[j])
    place = f" at {at}" if at and effect != "nothing" else ""
    reading = f"{counts} counts" if counts else f"noise {1e3 * noise:g} mrad"
    told = (
        f"{effect}{place} x{size:g}{f' of which {shares}' if args.differ else ''}, {robot.told}, {option},"
        f" every {every_rows} steps, {number} of {seconds:g} s,"
        f" {motion}, {reading}, gains {'known' if known else 'free'}"
        f"{', columns ' + ' '.join(joints) if (order != np.arange(n)).any() else ''}"
        f"{', holdout' if 'role' in entries[-1] else ''}{f', from {start:g} s' if start else ''}"
        f"{', velocity' if with_speed else ''}"
    )
    file = robot.file.replace("<option", f"<option {option}")
    truth = (effect, at) if effect != "nothing" else None
    return Case(told, task, file, recordings, truth, robot.numbers, args.differ)


def _shares(rng: np.random.Generator, effect: str) -> tuple[int, np.ndarray]:
    """Number of recordings, and how much of the effect each has: some of them all, others none; or more and more."""
    number = int(rng.integers(2, 5))
    if effect in BY_AND_BY:
        return number, np.round(np.linspace(0.0, 1.0, number), 2)
    odd = int(rng.integers(1, number))
    return number, rng.permutation(np.arange(number) < odd).astype(float)


def _robot(rng: np.random.Generator, most: int, kinds: list[str]) -> Robot:
    """A chain, or a chain with a branch, of servos that follow their commands with 1.5 to 5 Hz."""
    n = int(rng.integers(1, most + 1))
    slides = rng.random(n) < 0.12
    axes = [str(rng.choice(AXES)) for _ in range(n)]
    parent = [k - 1 for k in range(n)]
    if n > 2 and rng.random() < 0.25:
        parent[n - 1] = 0
    mounted = str(rng.choice(["upright", "turned in the file", "gravity turned"], p=[0.6, 0.2, 0.2]))
    turn = rng.uniform(-3, 3, 3) if mounted == "turned in the file" else np.zeros(3)
    pull = np.array([0.0, 0.0, -9.81])
    if mounted == "gravity turned":
        pull = 9.81 * np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.6, 0, -0.8]][int(rng.integers(4))])
    geoms, zeros = bool(rng.random() < 0.3), bool(rng.random() < 0.2)
    mass, length = rng.uniform(0.2, 2.0, n) * 0.8 ** np.arange(n), rng.uniform(0.06, 0.3, n)
    zero = np.round(rng.uniform(-1, 1, n), 2) if zeros else np.zeros(n)
    spin = rng.uniform(0.5, 1.0, (n, 3))

    def text(armature: np.ndarray, damping: np.ndarray, friction: np.ndarray, drives: str) -> str:
        inside: list[str] = [""] * n
        for k in reversed(range(n)):
            size, half = mass[k] * length[k] ** 2 / 12 + 1e-5, length[k] / 2
            loss = f'armature="{armature[k]:.6g}" damping="{damping[k]:.6g}" frictionloss="{friction[k]:.6g}"'
            kind = "slide" if slides[k] else "hinge"
            own = f'<joint name="j{k}" type="{kind}" axis="{axes[k]}" ref="{zero[k]:.3g}" {loss}/>'
            middle = words(0.1 * half, -0.2 * half, half)
            spins = words(size * (1 + spin[k, 0]), 2 * size, size * spin[k, 1])
            link = f'<inertial pos="{middle}" mass="{mass[k]:.6g}" diaginertia="{spins}"/>'
            if geoms:
                shape = f'fromto="0 0 0 {words(0.2 * half, 0.0, length[k])}" size="{0.15 * length[k]:.5g}"'
                link = f'<geom type="capsule" {shape} mass="{mass[k]:.6g}" contype="0" conaffinity="0"/>'
            place = words(0.0, 0.0, 0.1 if parent[k] < 0 else length[parent[k]])
            whole = f'<body name="body{k}" pos="{place}">{own}{link}{inside[k]}</body>'
            if parent[k] < 0:
                inside[k] = whole
            else:
                inside[parent[k]] += whole
        return (
            f'<mujoco><compiler angle="radian" eulerseq="XYZ"/><option gravity="{words(*pull)}">'
            f'<flag contact="disable"/></option><worldbody><body name="stand" euler="{words(*turn)}">{inside[0]}'
            f"</body></worldbody><actuator>{drives}</actuator></mujoco>"
        )

    bare = MADE.MjModel.from_xml_string(text(np.zeros(n), np.zeros(n), np.zeros(n), ""))
    inertia, weight = _sizes(bare, zero, rng)
    armature = inertia * rng.uniform(0.2, 1.5, n)
    whole = inertia + armature
    speed = 2 * np.pi * rng.uniform(1.5, 5.0, n)
    kp, kv = whole * speed**2, 2 * rng.uniform(0.5, 1.1, n) * whole * speed * 0.7
    damping, travel = 0.3 * kv, np.where(slides, 0.08, 0.5)
    load = weight + whole * travel * 4.0
    friction = load * rng.uniform(0.03, 0.25, n)
    drive, strong = str(rng.choice(kinds)), float(rng.choice([1.5, 3.0]))
    gear = float(rng.choice([0.5, 3.0])) if drive == "geared" else 1.0
    lines, stated = [], {}
    for k in range(n):
        limit = strong * (load[k] + friction[k])
        more = f' forcerange="{words(-limit, limit)}"' if drive == "limited" else ""
        more += ' timeconst="0.03"' if drive == "filtered" else ""
        gains = f'kp="{kp[k] / gear**2:.6g}" kv="{kv[k] / gear**2:.6g}" gear="{gear:g}"'
        law = f'gainprm="{kp[k]:.6g}" biastype="affine" biasprm="{words(0.0, -kp[k], -kv[k])}"'
        one = f'general name="m{k}" joint="j{k}" {law}'
        lines.append(f"<{one}/>" if drive == "general" else f'<position name="m{k}" joint="j{k}" {gains}{more}/>')
        stated[f"j{k}"] = {"kind": "position", "kp": float(f"{kp[k]:.6g}"), "kd": float(f"{kv[k]:.6g}")}
    lines = [lines[k] for k in (rng.permutation(n) if rng.random() < 0.3 else range(n))]
    off = np.ones((3, n)) if rng.random() < 0.25 else rng.uniform(0.6, 1.7, (3, n))
    real = text(armature, damping, friction, "".join(lines))
    filed = [x * y for x, y in zip((armature, damping, friction), off, strict=True)]
    file = text(filed[0], filed[1], filed[2], "" if drive == "stated" else "".join(lines))
    letters = "".join("s" if s else "h" for s in slides)
    branched = " branched" if parent != [k - 1 for k in range(n)] else ""
    told = (
        f"{n} joints {letters}{branched}, {mounted}{', geoms' * geoms}{', zeros' * zeros},"
        f" {drive} drives{f' {gear:g}' if gear != 1 else ''}, file {'exact' if (off == 1).all() else 'off'}"
    )
    names = [f"j{k}" for k in range(n)]
    own = {"armature": armature, "damping": damping, "friction": friction}
    numbers = {f"{called} {name}": float(x[k]) for called, x in own.items() for k, name in enumerate(names)}
    return Robot(real, file, names, travel, slides, friction, load, numbers, stated if drive == "stated" else {}, told)


def words(*numbers: float) -> str:
    return " ".join(f"{x:.6g}" for x in numbers)


def _sizes(model: Any, zero: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Typical inertia and weight felt at each joint."""
    data, n = MADE.MjData(model), model.nv
    inertias, weights = [], []
    for _ in range(20):
        data.qpos[:] = zero + rng.uniform(-0.5, 0.5, n)
        MADE.mj_forward(model, data)
        dense = np.zeros((n, n))
        MADE.mj_fullM(model, data, dense)
        inertias.append(np.diag(dense).copy())
        weights.append(np.abs(data.qfrc_bias))
    return np.mean(inertias, 0), np.mean(weights, 0)


def _command(rng: np.random.Generator, robot: Robot, motion: str, seconds: float, period: float) -> np.ndarray:
    """Commanded offsets from the start (rows, joints), at rest at the beginning."""
    n, t = len(robot.names), np.arange(round(seconds / period))[:, None] * period
    waves = 0.5 * np.sin(2 * np.pi * rng.uniform(0.1, 0.4, n) * t + rng.uniform(0, 6, n))
    waves += 0.25 * np.sin(2 * np.pi * rng.uniform(0.5, 1.2, n) * t + rng.uniform(0, 6, n))
    held = round(0.8 / period)
    steps = np.repeat(rng.uniform(-0.5, 0.5, (len(t) // held + 1, n)), held, 0)[: len(t)]
    moved = waves + 0.2 * steps if motion == "waves" else steps
    if motion == "one after another":
        turn = (t[:, 0] / seconds * n).astype(int).clip(0, n - 1)
        moved = np.where(np.arange(n) == turn[:, None], waves, 0.0)
    return robot.ranges * moved * np.clip(t / 0.5, 0, 1)


def _moved(robot: Robot, option: str, u: np.ndarray, rows: int, hidden: Hidden) -> tuple[np.ndarray | None, np.ndarray]:
    """Positions and velocities at the command's rows; None where the loop is not stable."""
    model = MADE.MjModel.from_xml_string(robot.text.replace("<option", f"<option {option}"))
    effect, j, size = hidden
    step, dofs = model.opt.timestep, [int(model.joint(name).dofadr[0]) for name in robot.names]
    if effect == "payload":
        _loaded(model, 0.08 * size)
    if effect in ("actuator_gain", *BY_AND_BY):
        _worn(model, hidden)
    if effect == "gravity_tilt":
        model.opt.gravity[:] = tilted(model.opt.gravity.copy(), 0.03 * size)
    data = MADE.MjData(model)
    drives = [int(model.actuator(f"m{name[1:]}").id) for name in robot.names]
    gears = np.array([model.actuator_gear[a, 0] for a in drives])
    start = data.qpos[dofs].copy()
    u[:] = start + u
    data.qpos[dofs] = u[0]
    late = round(0.01 * size / step) if effect in ("command_delay", "late_recorder") else 0
    later = slice(None) if effect == "late_recorder" else slice(j, j + 1)
    q, v = np.zeros_like(u), np.zeros_like(u)
    held = np.repeat(u, rows, 0)
    friction = robot.friction
    for k in range(len(held)):
        now, rate = data.qpos[dofs].copy(), data.qvel[dofs].copy()
        if k % rows == 0:
            q[k // rows], v[k // rows] = now, rate
        wanted = held[k].copy()
        if late:
            wanted[later] = held[max(k - late, 0), later]
        if effect == "dead_band":
            band = 0.006 * size * robot.ranges[j] / 0.5
            error = wanted[j] - now[j]
            wanted[j] -= np.clip(error, -band, band)
        data.ctrl[drives] = wanted * gears
        if effect == "stribeck_friction":
            model.dof_frictionloss[dofs[j]] = friction[j] * (
                1 + 0.6 * size * np.exp(-((rate[j] / 0.2 / robot.ranges[j] * 0.5) ** 2))
            )
        if effect == "load_dependent_friction":
            MADE.mj_forward(model, data)
            load = abs(data.qfrc_actuator[dofs[j]] + data.qfrc_bias[dofs[j]])
            model.dof_frictionloss[dofs[j]] = 0.5 * friction[j] + 0.12 * size * load
        if effect == "joint_spring":
            data.qfrc_applied[dofs[j]] = (
                -0.15 * size * robot.weights[j] / robot.ranges[j] * (now[j] - start[j] - 0.1 * robot.ranges[j])
            )
        if effect == "torque_ripple":
            data.qfrc_applied[dofs[j]] = -0.1 * size * robot.weights[j] * np.sin(12.0 * now[j] / robot.ranges[j] + 0.9)
        MADE.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or np.abs(data.qpos).max() > 10:
            return None, v
    u *= gears
    return q, v


def _worn(model: Any, hidden: Hidden) -> None:
    """A drive with another gain, drives on a battery that has drained, or joints that have grown warm, in a model."""
    effect, j, size = hidden
    if effect == "warming":  # grease
        model.dof_damping[:] *= 1 - 0.25 * size
        model.dof_frictionloss[:] *= 1 - 0.15 * size
        return
    drives = slice(None) if effect == "battery" else int(model.actuator(f"m{j}").id)
    factor = 1 - 0.1 * size if effect == "battery" else 1 + 0.15 * size
    model.actuator_gainprm[drives] *= factor
    model.actuator_biasprm[drives] *= factor
    if effect == "battery":
        model.actuator_forcerange[:] *= factor


def _loaded(model: Any, mass: float) -> None:
    """A point mass at the last body's end, in the model's numbers."""
    b = model.nbody - 1
    old, at = float(model.body_mass[b]), model.body_ipos[b].copy()
    place = 2.0 * at
    turn = np.zeros(9)
    MADE.mju_quat2Mat(turn, model.body_iquat[b])
    turn = turn.reshape(3, 3)
    whole = turn @ np.diag(model.body_inertia[b]) @ turn.T

    def point(m: float, r: np.ndarray) -> np.ndarray:
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    middle = (old * at + mass * place) / (old + mass)
    whole = whole + point(old, at - middle) + point(mass, place - middle)
    values, vectors = np.linalg.eigh(whole)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1
    quaternion = np.zeros(4)
    MADE.mju_mat2Quat(quaternion, vectors.ravel())
    model.body_mass[b], model.body_ipos[b] = old + mass, middle
    model.body_inertia[b], model.body_iquat[b] = values, quaternion
    MADE.mj_setConst(model, MADE.MjData(model))


def tilted(gravity: np.ndarray, angle: float) -> np.ndarray:
    """Gravity turned about an axis across it."""
    across = np.cross(gravity, [0.3, 1.0, 0.5])
    across /= np.linalg.norm(across)
    return np.cos(angle) * gravity + np.sin(angle) * np.cross(across, gravity)


def answered(case: Case, jobs: list[str]) -> tuple[list[str], list[str]]:
    """How each command did, in a word and in a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k, arrays in enumerate(case.recordings):
            np.savez(folder / f"run{k}.npz", **arrays)  # pyright: ignore[reportArgumentType]
        (folder / "robot.xml").write_text(case.file)
        (folder / "task.yaml").write_text(yaml.safe_dump(case.task))
        return asked(folder, jobs, lambda job: (_diagnosed if job == "diagnose" else _identified)(case, folder / job))


def of_files(folders: list[Path], part: list[int], jobs: list[str]) -> None:
    """One line for each file of a robot."""
    warnings.simplefilter("ignore", UserWarning)  # MuJoCo's, of words that it is going to forget
    count: collections.Counter[str] = collections.Counter()
    files = [file for folder in folders for file in sorted(folder.rglob("*.xml")) if _robot_of(file) is not None]
    for k, file in [*enumerate(files)][part[0] :: part[1]]:
        rng, model = np.random.default_rng([k, 93]), _robot_of(file)
        runs = _by_sines(model, rng, off=k % 2 == 0)
        if runs is None:
            count["unstable"] += 1
            continue
        joints = [int(model.actuator_trnid[i, 0]) for i in range(model.nu)]
        as_driven = k % 3 == 2 or model.nu < model.nv
        columns = np.arange(model.nu) if as_driven else np.argsort(joints)
        if model.nu < model.nv:
            columns = np.argsort(joints)
        due = as_driven and model.nu == model.nv and joints != sorted(joints)
        with tempfile.TemporaryDirectory() as name:
            folder, data = Path(name), []
            for i, (t, u, q) in enumerate(runs):
                noise = float(rng.choice([1e-4, 3e-4, 1e-3])) * rng.normal(size=q.shape)
                np.savez(folder / f"run{i}.npz", t=t, u=u[:, columns], q=q + noise)
                data.append({"file": f"run{i}.npz", "time": "t", "command": "u", "position": "q"})
            task = {"robot": {"model": str(file.resolve())}, "data": data}
            (folder / "task.yaml").write_text(yaml.safe_dump(task))
            marks, lines = asked(folder, jobs, lambda job, here=folder: _told(here, job))
        refused = "order of the model's actuators" in lines[0]
        marks = ["refused" if due else "odd"] if refused else ["not told"] if due else marks
        count[marks[0]] += 1
        print(f"{file}: {marks}, {model.nu} drives of {model.nv} joints; {lines[0][:300]}", flush=True)
    print(dict(count))


def _told(folder: Path, job: str) -> tuple[str, str]:
    return diagnosed(folder / job, lambda name: False) if job == "diagnose" else ("done", "")


def _robot_of(file: Path) -> Any:
    """A robot of named single axes that rollouts take whole, with at most one drive a joint; None for another file."""
    if b"<mujoco" not in (text := file.read_bytes()) or b"<mujocoinclude" in text:
        return None
    try:
        model = MADE.MjModel.from_xml_path(str(file))
        loop, notes = fj.load_loop(file)
    except (ValueError, fj.InputError):
        return None
    single = 1 <= model.nv <= 8 and (model.jnt_type >= 2).all() and all(model.joint(k).name for k in range(model.njnt))
    whole = not [note for note in notes if not note.startswith("contacts")] and not model.neq
    at = [int(x) for x in np.abs(np.asarray(loop.drives.transmission)).argmax(1)]
    model.opt.disableflags |= int(MADE.mjtDisableBit.mjDSBL_CONTACT)
    return model if single and whole and model.nu and len(set(at)) == len(at) else None


def _by_sines(model: Any, rng: np.random.Generator, *, off: bool) -> list[tuple[np.ndarray, ...]] | None:
    """Two recordings of 12 s at 100 Hz, with smaller commands where the robot does not stay where it is."""
    if off:
        for name, low, high in (("damping", 0.7, 1.5), ("frictionloss", 0.7, 1.5), ("armature", 0.8, 1.3)):
            getattr(model, f"dof_{name}")[:] *= rng.uniform(low, high, model.nv)
    every, held = max(1, round(0.01 / model.opt.timestep)), model.actuator_ctrllimited > 0
    rows = round(12.0 / (every * model.opt.timestep))
    t = every * model.opt.timestep * np.arange(rows)
    low, high = (np.where(held, model.actuator_ctrlrange[:, k], (-0.5, 0.5)[k]) for k in (0, 1))
    for share in (0.5, 0.2, 0.05):
        runs = []
        for _ in range(2):
            rate, late = 2 * np.pi * rng.uniform(0.1, 0.8, (3, model.nu)), rng.uniform(0, 6, (3, model.nu))
            size = rng.uniform(0.3, 1.0, (3, model.nu))
            wave = (size / size.sum(0) * np.sin(rate * t[:, None, None] + late)).sum(1)
            data, u, q = MADE.MjData(model), (low + high) / 2 + share * (high - low) / 2 * wave, []
            for row in u:
                q.append(data.qpos.copy())
                data.ctrl[:] = row
                MADE.mj_step(model, data, every)
            runs.append((t, u, np.array(q)))
        if all(np.isfinite(run[2]).all() and np.abs(run[2]).max() < 15 for run in runs):
            return runs
    return None


def asked(folder: Path, jobs: list[str], judged: Callable[[str], tuple[str, str]]) -> tuple[list[str], list[str]]:
    """How each command did on the folder's `task.yaml`, in a word and in a line; `judged` reads what it wrote."""
    marks, lines = [], []
    for job in jobs:
        said, began = io.StringIO(), time.process_time()
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(record=True) as noted,
        ):
            warnings.simplefilter("always")
            status = command_line([job, str(folder / "task.yaml"), "--out", str(folder / job), "--quiet"])
        used = f", {time.process_time() - began:.0f} CPU s"
        if status:
            marks.append("error")
            lines.append(f"{job}: {status} {' '.join(said.getvalue().split())[-600:]}{used}")
            continue
        mark, line = judged(job)
        marks.append("warning" if noted else mark)
        lines.append(f"{job}: {line}{used}" + "".join(f"; {one.message}" for one in noted[:1]))
    return marks, lines


def _diagnosed(case: Case, out: Path) -> tuple[str, str]:
    if not case.differs:
        return diagnosed(out, lambda name: _same(name, case.truth))
    mark, line = diagnosed(out, lambda name: _may_be_named(name, case))
    left = _left(out, case)
    return ("blind" if mark == "nothing" and left > BLIND else mark), f"{line}; the most that is left {left:.3g}"


def _may_be_named(name: tuple[str, str], case: Case) -> bool:
    """Whether a name is that of what differs, where it is; a load at any link, what all drives have at any joint."""
    if case.truth is None:
        return False
    effect, at = case.truth
    return name[0] in DIFFERING[effect] and (name[1] == at or not at or effect == "payload")


def _left(out: Path, case: Case) -> float:
    """The largest error that the model leaves at a joint, of the fit or of a recording kept out, over the noise."""
    error = json.loads((out / "answer.json").read_text())["residual"]
    noise, told = np.array(error["noise"]), np.load(out / "predictions.npz")
    held = [(told[key], case.recordings[int(key[3])]["q"]) for key in told.files if key.endswith("_position")]
    kept_out = [np.sqrt(((model - read) ** 2).mean(0)) for model, read in held]
    return float(max((one / noise).max() for one in [np.array(error["after"]), *kept_out]))


def diagnosed(out: Path, same: Callable[[tuple[str, str]], bool]) -> tuple[str, str]:
    """The grade of an answer, and its line; `same` says whether a name is the truth."""
    answer = json.loads((out / "answer.json").read_text())
    names = [(c["effect"], " ".join(c["at"])) for c in answer["causes"]]
    sets = [[(o["effect"], " ".join(o["at"])) for o in c["ambiguous_with"]] for c in answer["causes"]]
    fair = [same(one) or any(map(same, also)) for one, also in zip(names, sets, strict=True)]
    right = any(same(one) for one in names)
    mark = "wrong" if not all(fair) else "right" if right else "set" if any(fair) else answer["verdict"]
    line = f"{answer['verdict']}, {', '.join(' '.join(one) for one in names) or 'no cause'}"
    line += f"; alike {sets}" if any(sets) else ""
    if answer["verdict"] == "unknown":
        line += "".join(f"; {x['effect']} {' '.join(x['at'])}: {x['why_not']}" for x in answer["rest"]["nearest"])
    error = (answer["residual"][key] for key in ("before", "after", "noise"))
    ratios = [f"{before / noise:.3g} -> {after / noise:.3g}" for before, after, noise in zip(*error, strict=True)]
    return mark, f"{line}; of the noise {', '.join(ratios)}"


def _same(name: tuple[str, str], truth: tuple[str, str] | None) -> bool:
    """Whether a name is the truth; a load may be told at any link that moves alike, and as a link's own mass."""
    if truth is None:
        return False
    loads = ("payload", "link_inertia")
    return name == truth or (name[0] in loads and truth[0] in loads)


def _identified(case: Case, out: Path) -> tuple[str, str]:
    result = json.loads((out / "result.json").read_text())
    told = [p for p in result["base_parameters"] if p["status"] == "identified" and p["expression"] in case.numbers]
    if case.truth is not None:
        return "done", f"{len(told)} numbers"
    off = [abs(p["value"] - case.numbers[p["expression"]]) / p["std"] for p in told]
    held = sum(x < 1.96 for x in off)
    return (
        "done",
        f"{held} of {len(off)} intervals hold the truth, the worst {max(off, default=0.0):.1f} deviations off",
    )


if __name__ == "__main__":
    main()
