"""Designs as strangers ask for them: `figaroh-jax excite` on robots of public packages and options that are drawn.

    python benchmarks/excite_conditions.py FOLDER [FOLDER ...] --seeds 0 60 [--most 7] [--keep DIR]

Each case takes a URDF or an MJCF of the folders and draws which joints move and where the others are locked, gravity,
the basis, durations, trajectories, limits (the file's, numbers, maps by joint, none), the start, noise, spheres with a
floor and a clearance, the objective, or postures and the device that measures them. What is written is checked
by Pinocchio (URDF) and MuJoCo C (MJCF): velocities and accelerations are those of the positions, the motion begins and
ends at rest, torques are those of the file, every limit holds at 1 kHz, spheres keep their distance from the floor.
One line a case; at the end whatever is odd: an error, a warning, a limit that is broken, a wrong number.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import json
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import yaml

from figaroh_jax.cli import main as command_line

MADE: Any = mujoco
OVER = 2e-3  # of a limit


class Found(NamedTuple):
    """A robot of a file as Pinocchio or MuJoCo C has it: single axes, by name."""

    file: Path
    names: list[str]
    range: np.ndarray  # (n, 2) rad or m
    speed: np.ndarray  # (n,)
    effort: np.ndarray
    links: list[str]  # frames that move
    torque: Any  # (q, v, a, gravity) by name -> torque by name, of the rigid body and the file's passive terms
    place: Any  # (q, frame) -> position in the world


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 40], metavar=("FIRST", "END"))
    parser.add_argument("--most", type=int, default=7, help="joints that move")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave the runs there")
    args = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    files = [f for folder in args.folders for form in ("urdf", "xml") for f in sorted(folder.rglob(f"*.{form}"))]
    count: collections.Counter[str] = collections.Counter()
    odd = []
    for seed in range(*args.seeds):
        rng = np.random.default_rng([seed, 131])
        robot = None
        while robot is None:
            robot = read(files[int(rng.integers(len(files)))])
        mark, line = asked(robot, rng, args.most, None if args.keep is None else args.keep / str(seed))
        count[mark] += 1
        said = f"{seed}: {mark}  {robot.file.name} {line}"
        print(said, flush=True)
        if mark in ("odd", "error", "warning"):
            odd.append(said)
    print(dict(count))
    print(*odd, sep="\n")


def read(file: Path) -> Found | None:
    """The robot, or None for a file that another tool does not read, or whose joints are not single axes."""
    try:
        return _of_urdf(file) if file.suffix == ".urdf" else _of_mjcf(file)
    except Exception:  # another tool's
        return None


def _of_urdf(file: Path) -> Found | None:
    text = file.read_text(errors="replace")
    if "<mimic" in text or not 10 < len(text) < 200_000:
        return None
    model = pin.buildModelFromUrdf(str(file))
    joints = [*model.joints][1:]
    if not 1 <= len(joints) <= 40 or any(joint.nv != 1 for joint in joints):
        return None
    names, data = [*model.names][1:], model.createData()
    circle = np.array([joint.nq == 2 for joint in joints])
    at = np.array([joint.idx_v for joint in joints])

    def placed(q: np.ndarray) -> np.ndarray:
        full = pin.neutral(model)
        for k, joint in enumerate(joints):
            full[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(q[k]), np.sin(q[k])) if circle[k] else q[k]
        return full

    def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        model.gravity.linear = gravity
        rows = []
        for one in zip(q, v, a, strict=True):
            back = [np.zeros(model.nv), np.zeros(model.nv)]
            back[0][at], back[1][at] = one[1], one[2]
            rows.append(pin.rnea(model, data, placed(one[0]), *back)[at])
        return np.array(rows) + model.damping[at] * v + model.friction[at] * np.sign(v)

    def place(q: np.ndarray, frame: str) -> np.ndarray:
        pin.framesForwardKinematics(model, data, placed(q))
        return data.oMf[model.getFrameId(frame)].translation.copy()

    ends = np.array([[-np.inf, np.inf] if c else [_at(model.lowerPositionLimit, j), _at(model.upperPositionLimit, j)]
                     for c, j in zip(circle, joints, strict=True)])  # fmt: skip
    ends[ends[:, 0] == ends[:, 1]] = -np.inf, np.inf  # urdfdom's zeros, of limits that the file does not give
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint > 0]
    return Found(file, names, ends, model.velocityLimit[at], model.effortLimit[at], links, torque, place)


def _at(values: np.ndarray, joint: Any) -> float:
    return float(values[joint.idx_q])


def _of_mjcf(file: Path) -> Found | None:
    text = file.read_text(errors="replace")
    if "<mujoco" not in text or "<equality" in text or "<tendon" in text or "gravcomp" in text:
        return None
    model = MADE.MjModel.from_xml_path(str(file))
    if not 1 <= model.njnt <= 40 or (model.jnt_type < 2).any() or model.opt.density or model.ntendon:
        return None
    if model.jnt_stiffness.any() or model.neq:
        return None
    for flag in ("CONTACT", "LIMIT", "CONSTRAINT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(MADE.mjtDisableBit, f"mjDSBL_{flag}"))
    data, names = MADE.MjData(model), [model.joint(k).name for k in range(model.njnt)]
    if not all(names):
        return None

    def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        model.opt.gravity[:] = gravity
        rows = []
        for one in zip(q, v, a, strict=True):
            data.qpos[:], data.qvel[:], data.qacc[:] = one
            MADE.mj_inverse(model, data)
            rows.append(data.qfrc_inverse.copy())
        return np.array(rows) + model.dof_frictionloss * np.sign(v)

    def place(q: np.ndarray, frame: str) -> np.ndarray:
        data.qpos[:] = q
        MADE.mj_kinematics(model, data)
        return data.body(frame).xpos.copy()

    limited = model.jnt_limited[:, None] > 0
    ends = np.where(limited, model.jnt_range, [-np.inf, np.inf])
    links = [model.body(k).name for k in range(1, model.nbody) if model.body_weldid[k] and model.body(k).name]
    inf = np.full(len(names), np.inf)
    return Found(file, names, ends, inf, inf, links, torque, place)


def asked(robot: Found, rng: np.random.Generator, most: int, keep: Path | None) -> tuple[str, str]:
    """How `excite` did, in a word and in a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        task, moving, told = drawn(robot, rng, most, folder)
        (folder / "task.yaml").write_text(yaml.safe_dump(task))
        said, began = io.StringIO(), time.process_time()
        try:
            with (
                contextlib.redirect_stderr(said),
                contextlib.redirect_stdout(said),
                warnings.catch_warnings(record=True) as noted,
            ):
                warnings.simplefilter("always")
                warnings.simplefilter("ignore", UserWarning)
                code = command_line(["excite", str(folder / "task.yaml"), "--out", str(folder / "run"), "--quiet"])
        except Exception as error:  # whatever it is, it is found
            return "error", f"{told}: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        used = f"{time.process_time() - began:.0f} CPU s"
        text = " ".join(said.getvalue().split())
        if code == 2:
            return "refused", f"{told}: {text[-260:]}"
        found = json.loads((folder / "run" / "excitation.json").read_text())
        moving = [robot.names.index(name) for name in found.get("joints", [])] or moving  # in the file's order
        wrong = checked(robot, task, moving, found, folder / "run")
        if noted:
            return "warning", f"{told}: {noted[0].message}, {used}"
        if wrong:
            return "odd", f"{told}: {'; '.join(wrong)}, {used}"
        if code:
            return "not met", f"{told}: {text[-200:]}, {used}"
        return "met", f"{told}, {used}"


def drawn(robot: Found, rng: np.random.Generator, most: int, folder: Path) -> tuple[dict, list[int], str]:
    """A task, the joints that move, and what was drawn in words."""
    n = len(robot.names)
    count = int(rng.integers(1, min(n, most) + 1)) if rng.random() < 0.6 or n > most else n
    moving = sorted(rng.permutation(n)[:count].tolist())
    if rng.random() < 0.2:
        moving = rng.permutation(moving).tolist()
    low, high = np.clip(robot.range[:, 0], -3.0, 3.0), np.clip(robot.range[:, 1], -3.0, 3.0)
    posture = {}
    for k in range(n):
        if k not in moving and rng.random() < 0.5:
            posture[robot.names[k]] = float(rng.uniform(low[k], high[k]))
    entry: dict[str, Any] = {"model": str(robot.file.resolve()), "trust": float(rng.choice([0.05, 0.1, 0.3, 1.0]))}
    if count < n or rng.random() < 0.3:
        entry |= {"joints": [robot.names[k] for k in moving]} | ({"posture": posture} if posture else {})
    else:
        moving = list(range(n))
    if rng.random() < 0.3:
        entry["gravity"] = [float(x) for x in rng.normal(0, 5, 3)]
    if rng.random() < 0.2 and robot.links:
        return {"robot": entry} | postures(robot, rng, moving), moving, f"{len(moving)} of {n} joints, postures"
    kind = str(rng.choice(["fourier", "spline", "quintic"]))
    basis: dict[str, Any] = {kind: int(rng.integers(*{"fourier": (2, 7), "spline": (4, 11), "quintic": (3, 8)}[kind]))}
    if kind == "fourier" and rng.random() < 0.4:
        basis["base"] = float(rng.uniform(0.1, 0.6))
    block: dict[str, Any] = {
        "duration": float(rng.uniform(2.0, 12.0)),
        "basis": basis,
        "starts": int(rng.integers(1, 4)),
    }
    limits: dict[str, Any] = {}
    names = [robot.names[k] for k in moving]
    some = [x for x in names if rng.random() < 0.5]
    draw = rng.random()
    if draw < 0.3:
        limits["position"] = float(rng.uniform(0.2, 2.0))
    elif draw < 0.5 and some:
        limits["position"] = {
            x: [-float(rng.uniform(0.1, 1.0)), float(rng.uniform(0.1, 1.0))]
            if rng.random() < 0.5
            else float(rng.uniform(0.2, 2))
            for x in some
        }
    for word, size in (("velocity", 1.5), ("acceleration", 6.0), ("torque", 50.0)):
        draw = rng.random()
        if draw < 0.3:
            limits[word] = float(size * rng.uniform(0.5, 2.0))
        elif draw < 0.4 and some:
            limits[word] = {x: float(size * rng.uniform(0.5, 2.0)) for x in some}
        elif draw < 0.5 and word != "acceleration":
            limits[word] = "none"
    if rng.random() < 0.25 and robot.links:
        chosen = [x for x in robot.links if rng.random() < 0.4][:4] or robot.links[-1:]
        block["bodies"] = [{"link": x, "radius": float(rng.uniform(0.02, 0.08))} for x in chosen]
        block["floor"] = float(rng.uniform(-1.5, -0.1))
        limits["clearance"] = float(rng.uniform(0.005, 0.05))
    if limits:
        block["limits"] = limits
    if rng.random() < 0.3:
        block["trajectories"] = 2
    if rng.random() < 0.3:
        block["noise"] = float(rng.uniform(0.002, 0.05))
    if rng.random() < 0.2:
        block["rate"] = float(rng.uniform(5, 60))
    if rng.random() < 0.2:
        block["start"] = [float(rng.uniform(0.5 * low[k], 0.5 * high[k])) for k in moving]
    draw = rng.random()
    if draw < 0.15:
        block["objective"] = "condition"
    elif draw < 0.3:
        block["objective"] = "prediction"
        t = np.arange(0, 4, 0.01)
        rates = rng.uniform(0.5, 2.0, len(moving))
        middle, half = (low + high)[moving] / 2, (high - low)[moving] / 2
        np.savez(folder / "motion.npz", t=t, q=middle + 0.5 * half * np.sin(rates * t[:, None]))
        block["predict"] = ["motion.npz"]
    told = f"{len(moving)} of {n} joints, {basis}, {block.get('objective', 'information')}, {limits}"
    return {"robot": entry, "excite": block}, moving, told


def postures(robot: Found, rng: np.random.Generator, moving: list[int]) -> dict:
    kind = str(rng.choice(["pose", "position"]))
    tool = str(rng.choice(robot.links))
    device = {kind: "m", "base_frame": "world" if robot.file.suffix == ".xml" else None, "tool_frame": tool}
    if device["base_frame"] is None:
        device["base_frame"] = _root(robot.file)
    device["unknown"] = ["base_frame", "tool_frame"] if rng.random() < 0.5 else []
    if rng.random() < 0.5:
        device["accuracy"] = {"position": float(rng.uniform(1e-5, 1e-3)), "orientation": float(rng.uniform(1e-4, 5e-3))}
        if kind == "position":
            device["accuracy"].pop("orientation")
    block: dict[str, Any] = {"kind": "postures", "postures": int(rng.integers(8, 40)), "measurement": device}
    block["candidates"] = int(rng.integers(60, 300))
    if rng.random() < 0.3:
        block["limits"] = {"position": float(rng.uniform(0.3, 2.0))}
    return {"excite": block}


def _root(file: Path) -> str:
    """The root link of a URDF."""
    return pin.buildModelFromUrdf(str(file)).frames[1].name


def checked(robot: Found, task: dict, moving: list[int], found: dict, run: Path) -> list[str]:
    """What is wrong with what was written."""
    block, wrong = task["excite"], []
    limits, names = block.get("limits", {}), [robot.names[k] for k in moving]
    low, high = robot.range[moving].T.copy()
    stated = limits.get("position", "model")
    for k, name in enumerate(names):
        one = stated.get(name, None) if isinstance(stated, dict) else None if stated == "model" else stated
        if one is not None:
            low[k], high[k] = one if isinstance(one, list) else (-one, one)
    still = np.array(
        [task["robot"].get("posture", {}).get(name, _rest(robot, k)) for k, name in enumerate(robot.names)]
    )
    gravity = np.array(task["robot"].get("gravity", [0.0, 0.0, -9.81]))
    if robot.file.suffix == ".xml" and "gravity" not in task["robot"]:
        gravity = MADE.MjModel.from_xml_path(str(robot.file)).opt.gravity
    if block.get("kind") == "postures":
        q = np.loadtxt(run / "postures.csv", delimiter=",", skiprows=1, ndmin=2)[:, : len(names)]
        if len(q) != block["postures"]:
            wrong.append(f"{len(q)} postures of {block['postures']}")
        if (q < low - 1e-6).any() or (q > high + 1e-6).any():
            wrong.append("a posture is out of its range")
        return wrong
    for number in range(1, len(found["trajectories"]) + 1):
        with np.load(run / f"trajectory_{number}.npz") as file:
            t, q, v, a, torque = (file[key] for key in ("t", "q", "v", "a", "torque"))
        dt = t[1] - t[0]
        if abs(dt - 1e-3) > 1e-9 or abs(t[-1] - block["duration"]) > 1.5e-3:
            wrong.append(f"ends at {t[-1]} of {block['duration']}")
        if (np.abs(v[0]) > 1e-6).any() or (np.abs(v[-1]) > 1e-6 + np.abs(a).max(0) * dt).any():  # within the last row
            wrong.append(f"not at rest: {np.abs(v[[0, -1]]).max():.2g}")
        for word, one, other in (("v", q, v), ("a", v, a)):
            rough = np.abs((one[2:] - one[:-2]) / (2 * dt) - other[1:-1])
            if np.quantile(rough, 0.98) > 1e-3 * (1 + np.abs(other).max()):
                wrong.append(f"{word} is not the derivative: {np.quantile(rough, 0.98):.2g}")
        rows = np.arange(0, len(t), max(1, len(t) // 400))
        whole = [np.tile(x, (len(rows), 1)) for x in (still, 0 * still, 0 * still)]
        for full, one in zip(whole, (q, v, a), strict=True):
            full[:, moving] = one[rows]
        truth = robot.torque(*whole, gravity)[:, moving]
        apart = np.abs(truth - torque[rows])
        turning = np.abs(v[rows]) > 0.4 * np.abs(v).max(0)  # about rest dry friction is smoothed
        if (apart * turning).max() > 1e-6 * (1 + np.abs(truth).max()):
            wrong.append(f"torque is off by {(apart * turning).max():.3g} of {np.abs(truth).max():.3g}")
        if found["met"]:
            wrong += _broken(robot, moving, names, limits, (low, high), (q, v, a, torque))
            if "floor" in block:
                for body in block["bodies"]:
                    heights = [robot.place(full, body["link"])[2] for full in whole[0][::4]]
                    gap = min(heights) - body["radius"] - block["floor"] - limits["clearance"]
                    if gap < -1e-4:
                        wrong.append(f"{body['link']} is {-gap:.2g} m too near to the floor")
    for one in found["parameters"]:
        if not np.isfinite(one["std"]) or (
            one["std_before"] is not None and one["std"] > one["std_before"] * (1 + 1e-6)
        ):
            wrong.append(f"std of {one['expression']}: {one['std_before']} -> {one['std']}")
    return wrong


def _rest(robot: Found, k: int) -> float:
    """Where a locked joint without a posture stands."""
    if robot.file.suffix == ".xml":
        model = MADE.MjModel.from_xml_path(str(robot.file))
        return float(model.qpos0[model.jnt_qposadr[k]])
    return 0.0


def _broken(robot: Found, moving: list[int], names: list[str], limits: dict, ends: tuple, motion: tuple) -> list[str]:
    q, v, a, torque = motion
    wrong = []
    reach = np.where(np.isfinite(ends[1] - ends[0]), ends[1] - ends[0], 1.0)
    if (q < ends[0] - OVER * reach).any() or (q > ends[1] + OVER * reach).any():
        wrong.append("position beyond its limit")
    for word, values, own in (
        ("velocity", v, robot.speed),
        ("acceleration", a, None),
        ("torque", torque, robot.effort),
    ):
        stated = limits.get(word, "model")
        for k, name in enumerate(names):
            most = np.inf if own is None or own[moving[k]] <= 0 else own[moving[k]]
            if stated == "none":
                most = np.inf
            elif isinstance(stated, dict):
                most = stated.get(name, most)
            elif stated != "model":
                most = stated
            if np.abs(values[:, k]).max() > most * (1 + OVER):
                wrong.append(f"{word} of {name}: {np.abs(values[:, k]).max():.4g} of {most:.4g}")
    return wrong


if __name__ == "__main__":
    main()
